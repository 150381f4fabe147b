"""Headers as laboratories write them, and what campaign.yaml says to translate them.

    practice    the project's practice campaigns
    lsst        LSST's test stands (eotest): IMGTYPE and TESTTYPE, MONOWL, MONDIODE, voltages in an
                extension CCD_COND (V_BSS, V_P1H, V_P1L), extensions Segment10, ...
    noao        NOAO and DECam: OBSTYPE 'zero', 'dome flat', 'object'; LAMBDA in Angstrom, the
                substrate's voltage VSUB as a positive number, DATE-OBS
    eso         ESO: HIERARCH ESO DPR TYPE 'FLAT,LAMP', temperature in K

Each gives cards of the primary header, cards of an amplifier's extension, names of files, and the
entries of campaign.yaml (keywords, lamp monitor).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from astropy.io import fits
from astropy.time import Time

from validation.foreign.bench import MONITOR_ERROR, NOMINAL_GAIN, NOMINAL_NOISE, Taken
from validation.foreign.layout import Amplifier, Layout

GATES = (4.0, -8.0)
"""Voltages of the parallel gates, collecting and barrier [V], as in the practice campaigns."""

LAMP_KEYS = {
    "practice": "MONDIODE", "lsst": "MONDIODE", "noao": "PHOTCUR", "eso": "ESO INS DIODE CURRENT",
}  # fmt: skip

_ESO_TYPES = {"BIAS": "BIAS", "DARK": "DARK", "FLAT": "FLAT,LAMP", "SPOT": "OBJECT,SPOT"}
_NOAO_TYPES = {"BIAS": "zero", "DARK": "dark", "FLAT": "dome flat", "SPOT": "object"}


def file_name(taken: Taken, layout: Layout) -> str:
    """Name of an exposure's file."""
    e = taken.exposure
    end = ".fits.fz" if layout.compressed else ".fits"
    if layout.vocabulary == "practice":
        return f"{e.kind.lower()}_{e.sequence:04d}{end}"
    if layout.vocabulary == "lsst":
        return f"{e.kind.lower()}_{e.seconds:07.2f}_{e.sequence:05d}{end}"
    if layout.vocabulary == "noao":
        return f"n{e.sequence:05d}{end}"
    stamp = Time(e.mjd, format="mjd").isot.replace(":", "-")
    return f"VCCD.{stamp}{end}"


def primary_cards(
    campaign: str, taken: Taken, layout: Layout, *, monitor: bool
) -> tuple[list[tuple[Any, ...]], list[tuple[Any, ...]]]:
    """Cards of the primary header, and of an extension CCD_COND (maybe none).

    Examples
    --------
    >>> from validation.foreign.plan import Exposure
    >>> taken = Taken(Exposure("BIAS", 3, 60000.0, 0.0), [], 0.0, 0.0)
    >>> cards, _ = primary_cards("c0", taken, Layout(vocabulary="noao"), monitor=True)
    >>> dict((c[0], c[1]) for c in cards)["OBSTYPE"]
    'zero'
    """
    e, n, words = taken.exposure, layout.pixels, layout.vocabulary
    lit = e.lit
    shared: list[tuple[Any, ...]] = [
        ("ORIGIN", "VCCD", "virtual bench"),
        ("INSTRUME", "VCCD2", ""),
        ("DETSIZE", f"[1:{n},1:{n}]", ""),
    ]
    iso = Time(e.mjd, format="mjd").isot
    if words in ("practice", "lsst"):
        cards = [
            *shared,
            ("CCD_SERN", campaign, ""),
            ("IMGTYPE", e.kind, ""),
            ("TESTTYPE", e.kind, ""),
            ("SEQNUM", e.sequence, "time order"),
            ("MJD-OBS", e.mjd, ""),
            ("EXPTIME", taken.seconds, "s"),
            ("MONOWL", e.wavelength if lit else 0.0, "nm"),
            ("FILTER", "mono", ""),
            ("CCDTEMP", e.temperature, "C"),
            ("CCDGAIN", NOMINAL_GAIN, "nominal e-/ADU"),
            ("CCDNOISE", NOMINAL_NOISE, "nominal e-"),
        ]
        if monitor:
            cards.append(("MONDIODE", round(taken.monitor, 5), "nA"))
        volts = [
            ("VBB", e.back_bias, "V"),
            ("PARLHI", GATES[0], "V"),
            ("PARLLO", GATES[1], "V"),
        ]
        if words == "practice":
            return [*cards, *volts], []
        names = ("V_BSS", "V_P1H", "V_P1L")
        return cards, [(k, v[1], "V") for k, v in zip(names, volts, strict=True)]
    if words == "noao":
        cards = [
            *shared,
            ("OBSTYPE", _NOAO_TYPES[e.kind], ""),
            ("OBJECT", "pinholes" if e.kind == "SPOT" else e.kind.lower(), ""),
            ("EXPTIME", taken.seconds, "[s] shutter open"),
            ("DARKTIME", round(taken.seconds + 0.8, 4), "[s]"),
            ("DATE-OBS", iso, "UTC"),
            ("LAMBDA", 10 * e.wavelength if lit else 0.0, "[Angstrom]"),
            ("CCDTEMP", e.temperature, "deg C"),
            ("VSUB", -e.back_bias, "[V] substrate, positive"),
            ("GAIN", NOMINAL_GAIN, "[e-/ADU]"),
            ("RDNOISE", NOMINAL_NOISE, "[e-]"),
        ]
        if e.kind == "SPOT":
            cards.append(("TESTTYPE", "SPOT", ""))
        if monitor:
            cards.append(("PHOTCUR", round(taken.monitor, 5), "[nA]"))
        return cards, []
    cards = [
        *shared,
        ("MJD-OBS", e.mjd, ""),
        ("EXPTIME", taken.seconds, "s"),
        ("HIERARCH ESO DPR TYPE", _ESO_TYPES[e.kind], ""),
        ("HIERARCH ESO TPL EXPNO", e.sequence, ""),
        ("HIERARCH ESO INS MONO WLEN", e.wavelength if lit else 0.0, "nm"),
        ("HIERARCH ESO DET CHIP TEMP", e.temperature + 273.15, "K"),
        ("HIERARCH ESO DET VSUB", e.back_bias, "V"),
        ("GAIN", NOMINAL_GAIN, "e-/ADU"),
        ("RDNOISE", NOMINAL_NOISE, "e-"),
    ]
    if monitor:
        cards.append(("HIERARCH ESO INS DIODE CURRENT", round(taken.monitor, 5), "nA"))
    return cards, []


def keyword_entries(layout: Layout) -> dict[str, Any]:
    """Entry ``keywords`` of campaign.yaml; empty where headers need no translation."""
    if layout.vocabulary == "noao":
        return {
            "wavelength": {"keyword": "LAMBDA", "unit": "Angstrom"},
            "back_bias": {"keyword": "VSUB", "scale": -1},
        }
    if layout.vocabulary == "eso":
        return {
            "kind": {
                "keyword": "ESO DPR TYPE",
                "values": {"flat,lamp": "flat", "object,spot": "spot"},
            },
            "wavelength": "ESO INS MONO WLEN",
            "temperature": {"keyword": "ESO DET CHIP TEMP", "unit": "K"},
            "back_bias": "ESO DET VSUB",
            "number": "ESO TPL EXPNO",
        }
    return {}


def lamp_entry(layout: Layout) -> dict[str, Any]:
    """Entry ``lamp_monitor`` of campaign.yaml."""
    return {"keyword": LAMP_KEYS[layout.vocabulary], "relative_error": MONITOR_ERROR}


def extension_name(number: int, layout: Layout) -> str:
    """Name of an amplifier's extension (from 1), two rows as on LSST's sensors."""
    if layout.vocabulary == "noao":
        return f"im{number}"
    if layout.vocabulary == "eso":
        return f"CCD1.OUT{number}"
    across = layout.amplifiers // layout.rows
    row, column = divmod(number - 1, across)
    word = "Segment" if layout.vocabulary == "lsst" else "SEGMENT"
    return f"{word}{1 - row if layout.rows == 2 else 1}{column:X}"


def amplifier_header(amplifier: Amplifier, layout: Layout) -> fits.Header:
    """Header of an amplifier's extension: where its light and its overscan are."""
    cards: list[tuple[str, Any]] = [
        ("CHANNEL", amplifier.number),
        ("DATASEC", layout.data_section()),
        ("DETSEC", amplifier.detector_section()),
        ("CCDSUM", "1 1"),
    ]
    if bias := layout.bias_section():
        cards.append(("BIASSEC", bias))
    return fits.Header(cards)


def hdus(campaign: str, taken: Taken, layout: Layout, *, monitor: bool) -> fits.HDUList:
    """An exposure as FITS."""
    cards, volts = primary_cards(campaign, taken, layout, monitor=monitor)
    header = fits.Header()
    for card in cards:
        header.append(card)
    out: list[Any] = []
    if layout.storage == "single":
        image = layout.single_image(taken.frames)
        if layout.compressed:
            out = [
                fits.PrimaryHDU(header=header),
                fits.CompImageHDU(image, name="IMAGE", compression_type="RICE_1"),
            ]
        else:
            out = [fits.PrimaryHDU(image, header=header)]
    else:
        out = [fits.PrimaryHDU(header=header)]
        for place, frame in zip(layout.places(), taken.frames, strict=True):
            name = extension_name(place.number, layout)
            h = amplifier_header(place, layout)
            if layout.compressed:
                out.append(
                    fits.CompImageHDU(frame, h, name=name, compression_type="RICE_1")
                )
            else:
                out.append(fits.ImageHDU(frame, h, name=name))
    if volts:
        extension = fits.ImageHDU(name="CCD_COND")
        for card in volts:
            extension.header.append(card)
        out.append(extension)
    return fits.HDUList(out)


def manifest_row(
    taken: Taken, name: str, sha256: str, layout: Layout, *, monitor: bool
) -> Mapping[str, Any]:
    """One row of manifest.ecsv, in the units of the headers, which campaign.yaml translates."""
    e = taken.exposure
    angstrom = 10 if layout.vocabulary == "noao" else 1
    sign = -1 if layout.vocabulary == "noao" else 1
    kelvin = 273.15 if layout.vocabulary == "eso" else 0.0
    row = {
        "file": name,
        "imgtype": e.kind,
        "seq": e.sequence,
        "mjd": round(e.mjd, 8),
        "exptime": taken.seconds,
        "wavelength": angstrom * e.wavelength,
        "vbb": sign * e.back_bias,
        "temp": e.temperature + kelvin,
    }
    if monitor:
        row["diode"] = round(taken.monitor, 5)
    return {**row, "sha256": sha256}
