"""Files of images without the brighter-fatter effect: FITS as cameras and LSST's pipelines write it."""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import galsim
import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from bfsensor import __version__
from bfsensor.errors import RecordingError, SensorError
from bfsensor.files import refuse_existing, written_whole
from bfsensor.measure.correct import correct_edges, correct_kernel
from bfsensor.recording.campaign.settings import read_settings
from bfsensor.recording.raw.headers import scan_file
from bfsensor.recording.raw.images import AmplifierImage, read_images
from bfsensor.recording.raw.masks import read_masks
from bfsensor.recording.raw.open_fits import open_fits
from bfsensor.recording.raw.overscan import find_overscan
from bfsensor.recording.raw.sections import AmplifierLayout, layout_of, to_sensor
from bfsensor.sensor.options import find_table, load_table
from bfsensor.sensor.table_correction import correct_table
from bfsensor.sensor.weight_maps import corrected_variance
from bfsensor.table.lsst_format import solve_kernel
from bfsensor.table.quadrant_shifts import quadrant_shifts
from bfsensor.typing import FloatArray

KINDS = ("table", "kernel", "edges")
"""Corrections: by the whole table; by the scalar kernel and by the edge shifts of LSST's pipelines."""

BANDS = {
    "u": (324.0, 395.0), "g": (405.0, 552.0), "r": (552.0, 691.0), "i": (691.0, 818.0),
    "z": (818.0, 921.0), "y": (922.0, 1060.0),
}  # fmt: skip
"""Ends of LSST's bands [nm], published by Ivezic et al. 2019, ApJ 873, 111; between them all wavelengths
have as many photons."""

STEP = 5.0
"""Distance of the wavelengths that stand for a band [nm].

Measured: shifts in y are within 4e-4 of those with 1 nm; with 10 nm within 8e-4."""

PLANES = ("SAT", "BAD", "CR", "NO_DATA")
"""Mask planes of LSST's exposures whose pixels light did not fill, as named by lsst.afw."""

MARK = "BFCORR"
"""Keyword by which a corrected image is known."""


def band_wavelengths(band: str) -> FloatArray:
    """Wavelengths that stand for a band of LSST, equally many photons each.

    Parameters
    ----------
    band : str
        One of :data:`BANDS`.

    Returns
    -------
    wavelengths : ndarray, shape (n,)
        Vacuum wavelengths [nm].

    Raises
    ------
    SensorError
        There is no such band.

    Examples
    --------
    >>> waves = band_wavelengths("r")
    >>> float(waves[0]), float(waves[-1]), len(waves)
    (552.0, 691.0, 29)
    """
    if band not in BANDS:
        raise SensorError(f"band = {band!r} must be one of {', '.join(BANDS)}")
    low, high = BANDS[band]
    return np.linspace(low, high, round((high - low) / STEP) + 1)


@dataclass(frozen=True)
class Correction:
    """Correction of images in electrons, as a file of options: it can be sent to other processes.

    Attributes
    ----------
    table : str
        Name of a built-in device, or a table's .fits file.
    kind : {'table', 'kernel', 'edges'}
        One of :data:`KINDS`.
    wavelengths, photons : tuple of float
        Light [nm] and the photons of each; empty: it converts at the back surface.
    sky : float
        Sky that was subtracted from the images [e-]: it is there while they are corrected.
    level : float
        Charge of all pixels at which kernel and edges have their one response [e-].
    threads : int
        Threads of a correction by the whole table.
    read_noise : float, optional
        Standard deviation of the read noise [e-], for the variance of the corrected pixels; by default
        no variance is written.
    """

    table: str
    kind: str = "table"
    wavelengths: tuple[float, ...] = ()
    photons: tuple[float, ...] = ()
    sky: float = 0.0
    level: float = 0.0
    threads: int = 1
    read_noise: float | None = None

    def check(self) -> None:
        """Read the table, and refuse values that are not allowed, before any image is read.

        Raises
        ------
        SensorError, TableError
            The table cannot be read, or a value is not allowed.
        """
        if self.kind not in KINDS:
            raise SensorError(f"kind = {self.kind!r} must be one of {', '.join(KINDS)}")
        if not np.isfinite(self.sky):
            raise SensorError(f"sky = {self.sky} e- must be finite")
        blank = np.zeros((2, 2)) - self.sky
        self.apply(blank, None)
        self.variance(blank, None)

    def apply(
        self, image: NDArray[Any], mask: NDArray[np.bool_] | None
    ) -> tuple[FloatArray, int]:
        """Correct an image.

        Parameters
        ----------
        image : ndarray, shape (ny, nx)
            Charge without the sky that was subtracted [e-].
        mask : ndarray of bool, shape (ny, nx), optional
            True for pixels that light did not fill.

        Returns
        -------
        corrected : ndarray, shape (ny, nx)
            Corrected charge [e-], not finite where the image is not.
        beyond : int
            Number of pixels beyond the table, by whose last level they were corrected.
        """
        table = load_table(*find_table(self.table))
        waves: dict[str, Any] = {}
        if self.wavelengths:
            waves = {"wavelengths": self.wavelengths, "photons": self.photons or None}
        whole = image + self.sky
        if self.kind == "table":
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always", galsim.GalSimWarning)
                found = correct_table(
                    whole, table, mask=mask, threads=self.threads, **waves
                )
            beyond = [int(str(w.message).split()[0]) for w in caught]
            return found - self.sky, sum(beyond)
        shifts = quadrant_shifts(table, background=self.level, tail_slope=None, **waves)
        known = np.isfinite(whole)
        # Neither formula has masks: unknown pixels are like the median of all.
        filled = np.where(known, whole, np.median(whole[known]) if known.any() else 0.0)
        if self.kind == "kernel":
            found = correct_kernel(filled, solve_kernel(shifts.areas))
        else:
            found = correct_edges(filled, *shifts)
        return np.where(known, found - self.sky, image), 0

    def variance(
        self, corrected: FloatArray, mask: NDArray[np.bool_] | None
    ) -> FloatArray | None:
        """Variance of a corrected image, see :func:`~bfsensor.sensor.corrected_variance`.

        Parameters
        ----------
        corrected : ndarray, shape (ny, nx)
            Corrected charge without the sky [e-].
        mask : ndarray of bool, shape (ny, nx), optional
            True for pixels that light did not fill.

        Returns
        -------
        variance : ndarray, shape (ny, nx), or None
            Variance [e-^2], infinite in masked pixels; None without a read noise.
        """
        if self.read_noise is None:
            return None
        table = load_table(*find_table(self.table))
        return corrected_variance(
            corrected + self.sky, table, read_noise=self.read_noise, mask=mask
        )


@dataclass(frozen=True)
class FileOptions:
    """Ways to read a file's pixels.

    Attributes
    ----------
    gain : float, optional
        Gain of all amplifiers [e-/ADU]; by default the header's, or campaign.yaml's.
    overscan : str
        Method of :func:`bfsensor.recording.raw.read_images`, where there is an overscan.
    mask : str
        FITS image of the sensor, 0 where a pixel is good; '' for none.
    """

    gain: float | None = None
    overscan: str = "row median"
    mask: str = ""


@dataclass(frozen=True, eq=False)
class Part:
    """One image that is corrected as a whole: amplifiers that touch on the sensor, or a single one.

    Attributes
    ----------
    image : ndarray, shape (ny, nx)
        Charge [e-], along the sensor's axes.
    mask : ndarray of bool, shape (ny, nx)
        True for pixels that light did not fill, and where no amplifier is.
    places : tuple of (AmplifierLayout, gain, rows, columns)
        Where in the image each amplifier lies, and its gain [e-/ADU].
    """

    image: FloatArray
    mask: NDArray[np.bool_]
    places: tuple[tuple[AmplifierLayout, float, slice, slice], ...]


def read_parts(path: str | os.PathLike[str], options: FileOptions) -> tuple[Part, ...]:
    """Read a file as images in electrons: its whole sensor where the headers place all amplifiers.

    Parameters
    ----------
    path : path-like
        FITS with an image, an extension an amplifier, or image, mask and variance of LSST's pipelines.
    options : FileOptions
        How it is read.

    Returns
    -------
    parts : tuple of Part

    Raises
    ------
    RecordingError
        The file cannot be read, was corrected before, or an amplifier has no gain and no unit of
        electrons.
    """
    path = Path(path)
    with open_fits(path, as_stored=True) as hdus:
        cards = [dict(hdu.header) for hdu in hdus]
    if any(MARK in one for one in cards):
        raise RecordingError(
            f"{path}: was corrected for the brighter-fatter effect before ({MARK})"
        )
    names = [str(one.get("EXTNAME", "")).strip().upper() for one in cards]
    if {"IMAGE", "MASK", "VARIANCE"} <= set(names):
        return (_lsst_part(path, names, options),)
    settings = read_settings(path.parent)
    scan = scan_file(path, amplifiers=settings.amplifiers, overrides=settings.overrides)
    masks = read_masks(path.parent, settings.masks, scan.amplifiers)
    if options.mask:
        given = Path(options.mask).resolve()
        for name, bad in read_masks(given.parent, [given.name], scan.amplifiers).items():
            masks[name] = bad | masks.get(name, False)
    images: list[AmplifierImage] = []
    for n, layout in enumerate(scan.amplifiers):
        one = type(scan)(
            **{**vars(scan), "amplifiers": (layout,), "problems": (scan.problems[n],)}
        )
        unit = str(scan.own[n].get("BUNIT", "")).strip().lower()
        gain = 1.0 if unit in ("electron", "electrons", "e-", "e") else options.gain
        overscan = options.overscan if find_overscan(layout) is not None else None
        (found,) = read_images(one, gain=gain, overscan=overscan, masks=masks)
        if found.unit != "electron":
            raise RecordingError(
                f"{path}: {layout.name}: {found.no_gain}, and a correction needs electrons: give --gain "
                "[e-/ADU], or BUNIT = 'electron' in the header"
            )
        images.append(found)
    return _assembled(scan.amplifiers, images)


def _assembled(
    layouts: Sequence[AmplifierLayout], images: Sequence[AmplifierImage]
) -> tuple[Part, ...]:
    """Put amplifiers together whose places on the sensor fill a rectangle; else leave them apart."""
    boxes = [layout.footprint() for layout in layouts]
    placed = [box for box in boxes if box is not None]
    together = len(placed) == len(boxes) > 1
    if together:
        left, low = min(b[0] for b in placed), min(b[2] for b in placed)
        width = max(b[1] for b in placed) - left
        height = max(b[3] for b in placed) - low
        # Amplifiers that overlap or leave gaps do not add up to the rectangle around them.
        together = sum((b[1] - b[0]) * (b[3] - b[2]) for b in placed) == width * height
    if not together:
        return tuple(
            Part(
                to_sensor(layout, one.image), to_sensor(layout, one.mask),
                ((layout, one.gain, slice(None), slice(None)),),
            )
            for layout, one in zip(layouts, images, strict=True)
        )  # fmt: skip
    image, mask = np.zeros((height, width)), np.zeros((height, width), bool)
    places = []
    for layout, one, box in zip(layouts, images, placed, strict=True):
        rows = slice(box[2] - low, box[3] - low)
        columns = slice(box[0] - left, box[1] - left)
        image[rows, columns] = to_sensor(layout, one.image)
        mask[rows, columns] = to_sensor(layout, one.mask)
        places.append((layout, one.gain, rows, columns))
    return (Part(image, mask, tuple(places)),)


def _lsst_part(path: Path, names: Sequence[str], options: FileOptions) -> Part:
    """Image of an exposure of LSST's pipelines, with the planes of its mask."""
    with open_fits(path) as hdus:
        number = names.index("IMAGE")
        header = hdus[number].header
        image = np.asarray(hdus[number].data, float)
        bits = np.asarray(hdus[names.index("MASK")].data)
        planes = hdus[names.index("MASK")].header
        unit = str(header.get("BUNIT", "")).strip().lower()
    known = [p for p in PLANES if f"MP_{p}" in planes]
    mask = np.zeros(image.shape, bool)
    for plane in known:
        mask |= (bits >> int(planes[f"MP_{plane}"])) & 1 != 0
    gain = 1.0 if unit in ("electron", "electrons") else options.gain
    if gain is None:
        raise RecordingError(
            f"{path}: BUNIT = {unit!r}, and a correction needs electrons: give --gain [e-/ADU]"
        )
    layout = layout_of("IMAGE", "IMAGE", number, (image.shape[0], image.shape[1]), {})
    if options.mask:
        given = Path(options.mask).resolve()
        mask |= read_masks(given.parent, [given.name], [layout])[layout.name]
    return Part(gain * image, mask, ((layout, gain, slice(None), slice(None)),))


def correct_file(
    path: str | os.PathLike[str],
    output: str | os.PathLike[str],
    correction: Correction,
    options: FileOptions | None = None,
    *,
    history: str = "",
    overwrite: bool = False,
) -> dict[str, Any]:
    """Correct a FITS file into another one.

    The output has the extensions, shapes and headers of the input.  Pixels are in its unit, single
    precision, their overscan's level subtracted; pixels outside data sections are relative to the median
    of the overscan.  With a read noise each image has a further extension with its variance, named
    VARIANCE, or VARIANCE_ and its name or number where there are several, infinite where a pixel is
    masked or outside data sections.

    Parameters
    ----------
    path, output : path-like
        Files to read and to write.
    correction : Correction
        What is done.
    options : FileOptions, optional
        How the file is read.
    history : str
        Text for the headers' HISTORY, such as the command.
    overwrite : bool
        Replace an existing output.

    Returns
    -------
    summary : dict
        ``pixels``, ``masked``, ``beyond`` the table, and ``moved``: half the sum of absolute changes
        [e-].

    Raises
    ------
    RecordingError
        The input cannot be read, see :func:`read_parts`, or has an extension VARIANCE of its own, as
        LSST's exposures do, and a read noise is given; the output exists or cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> folder = Path(tempfile.mkdtemp())
    >>> star = 9e4 * np.exp(-0.5 * np.hypot(*np.indices((41, 41)) - 20) ** 2 / 1.5**2)
    >>> image = fits.PrimaryHDU(star.astype(np.float32), fits.Header({"BUNIT": "electron"}))
    >>> image.writeto(folder / "star.fits")
    >>> done = correct_file(
    ...     folder / "star.fits", folder / "out.fits", Correction("itl_sta3800c")
    ... )
    >>> done["pixels"], bool(fits.getdata(folder / "out.fits")[20, 20] > star[20, 20])
    (1681, True)
    """
    refuse_existing(output, overwrite, RecordingError)
    parts = read_parts(path, options or FileOptions())
    summary: dict[str, Any] = {"pixels": 0, "masked": 0, "beyond": 0, "moved": 0.0}
    found: list[_Amplifier] = []
    for part in parts:
        image, beyond = correction.apply(part.image, part.mask)
        with np.errstate(invalid="ignore"):
            change = np.abs(image - part.image)
        summary["pixels"] += image.size
        summary["masked"] += int(part.mask.sum())
        summary["beyond"] += beyond
        summary["moved"] += 0.5 * float(np.nansum(change))
        variance = correction.variance(image, part.mask)
        for layout, gain, rows, columns in part.places:
            pixels = to_sensor(layout, image[rows, columns]) / gain
            scatter = None
            if variance is not None:
                scatter = to_sensor(layout, variance[rows, columns]) / gain**2
            found.append(_Amplifier(layout, pixels, scatter))
    cards = _cards(correction, summary)
    _write(path, output, found, cards, history)
    return summary


@dataclass(frozen=True, eq=False)
class _Amplifier:
    """Corrected pixels of an amplifier and their variance, in the file's unit, in readout order."""

    layout: AmplifierLayout
    image: FloatArray
    variance: FloatArray | None


def _cards(
    correction: Correction, summary: Mapping[str, Any]
) -> list[tuple[str, Any, str]]:
    """Keywords of a corrected image with their comments."""
    waves = correction.wavelengths
    light = [("BFWAVEL", 0.0, "no wavelength: light converts at the back")]
    if waves:
        light = [
            ("BFWAVEL", float(np.average(waves, weights=correction.photons or None)),
             "[nm] mean wavelength of the light"),
        ]  # fmt: skip
    noise = []
    if correction.read_noise is not None:
        noise = [
            ("BFNOISE", correction.read_noise, "[electron] read noise of the variance")
        ]
    level = [("BFLEVEL", correction.level, "[electron] level of the one response")]
    return [
        (MARK, correction.kind, "brighter-fatter correction by"),
        ("BFTABLE", Path(correction.table).name[-60:], "distortion table"),
        ("BFVERS", __version__, "version of bfsensor"),
        ("BFSKY", correction.sky, "[electron] sky added while correcting"),
        *noise,
        *light,
        *(level if correction.kind != "table" else []),
        ("BFMASKED", summary["masked"], "pixels that light did not fill"),
        ("BFBEYOND", summary["beyond"], "pixels beyond the table, last level used"),
    ]


def _write(
    path: str | os.PathLike[str],
    output: str | os.PathLike[str],
    found: Sequence[_Amplifier],
    cards: Sequence[tuple[str, Any, str]],
    history: str,
) -> None:
    """Write a file like the input with other pixels."""
    with open_fits(path) as hdus:
        new = fits.HDUList()
        variances = []
        names = [str(hdu.name).strip().upper() for hdu in hdus]
        if "VARIANCE" in names and any(one.variance is not None for one in found):
            raise RecordingError(
                f"{path}: has an extension VARIANCE, which is kept: correct it without a read noise"
            )
        several = len({one.layout.hdu for one in found}) > 1
        for number, hdu in enumerate(hdus):
            own = [one for one in found if one.layout.hdu == number]
            if not own:
                new.append(hdu.copy())
                continue
            header = hdu.header.copy()
            for keyword in ("BZERO", "BSCALE", "BLANK"):
                header.remove(keyword, ignore_missing=True)
            pixels = np.array(hdu.data, np.float32)
            for one in own:
                _put(pixels, one.layout, one.image)
            for card in cards:
                header[card[0]] = card[1:]
            made = fits.PrimaryHDU if number == 0 else fits.ImageHDU
            new.append(made(pixels, header))
            if own[0].variance is not None:
                name = f"VARIANCE_{names[number] or number}" if several else "VARIANCE"
                variances.append(_variance_hdu(own, header, pixels.shape, name))
        new.extend(variances)
        new.update_extend()
        for card in cards if found[0].layout.hdu else ():
            new[0].header[card[0]] = card[1:]
        if history:
            new[0].header.add_history(history)
        with written_whole(output, RecordingError) as beside:
            new.writeto(beside, checksum=True)


def _variance_hdu(
    own: Sequence[_Amplifier], header: fits.Header, shape: tuple[int, ...], name: str
) -> fits.ImageHDU:
    """Variances of the amplifiers of an image as an extension like it."""
    pixels = np.full(shape, np.inf, np.float32)
    for one in own:
        assert one.variance is not None
        _section(pixels, one.layout)[one.layout.data] = one.variance
    made = fits.ImageHDU(pixels, header.copy(), name=name)
    unit = str(header.get("BUNIT", "")).strip()
    if unit:
        made.header["BUNIT"] = f"{unit}**2"
    return made


def _section(pixels: NDArray[np.float32], layout: AmplifierLayout) -> NDArray[np.float32]:
    """View of an amplifier's stored image, in readout order."""
    window = pixels[layout.window]
    return window[
        :: -1 if layout.stored_flip_y else 1, :: -1 if layout.stored_flip_x else 1
    ]


def _put(pixels: NDArray[np.float32], layout: AmplifierLayout, image: FloatArray) -> None:
    """Put the data section of an amplifier, in readout order, into its stored image."""
    window = _section(pixels, layout)
    over = find_overscan(layout)
    if over is not None:
        window -= np.nanmedian(window[over])
    window[layout.data] = image
