"""Campaign folders: raw frames, manifest, card, baseline, description, and the sealed truth."""

from __future__ import annotations

import hashlib
import json
import os
import secrets
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits
from astropy.table import Table

from validation.concealed.card import baseline_edges, device_card
from validation.concealed.effect import Effect
from validation.concealed.plan import SIZES, Exposure, Geometry, exposures_of
from validation.concealed.readout import NOMINAL_GAIN, NOMINAL_NOISE
from validation.concealed.sensor import Taken, VirtualSensor

SPOT_GRID = 30

_DESCRIPTION = """\
# a campaign of recordings: what the headers cannot say
schema: bfsensor-campaign-1
sensor: VCCD1
manifest: manifest.ecsv          # one row per exposure; without it the headers are read
device_card: device_card.json    # nominal device and the 1-sigma scatter of the real one about it
baseline: baseline_edges.json    # edge displacements per electron of the nominal device
lamp_monitor: {keyword: MONDIODE, relative_error: 2.0e-4}
spots: {grid_px: 30}
"""


def write_campaign(
    folder: str | Path,
    *,
    seed: int,
    size: str = "S",
    effects: Sequence[Effect] = (),
    amplifiers: int = 2,
    truth_folder: str | Path | None = None,
    withheld_folder: str | Path | None = None,
    salt: str | None = None,
    progress: Any = None,
) -> dict[str, Any]:
    """Make one campaign; its folder's name is its name.

    Parameters
    ----------
    folder : path
        New or empty.
    seed, size, effects, amplifiers
        As for :func:`validation.concealed.arrays.iterate_exposures`; the size by its letter.
    truth_folder : path, optional
        Where NAME.json is written, the truth; by default ``truth.json`` in the campaign.  The
        SHA-256 of its bytes goes into ``commitments.json`` beside the campaign.
    withheld_folder : path, optional
        Where withheld exposures are written, under the campaign's name; not written if None.
    salt : str, optional
        Sixteen random bytes by default, so that a truth cannot be guessed from its hash.
    progress : callable, optional
        Wraps the sequence of exposures, as ``tqdm`` does.

    Returns
    -------
    truth : dict

    Raises
    ------
    ValueError
        Unknown size, or the folder holds something.
    """
    folder = Path(folder)
    if size not in SIZES:
        raise ValueError(f"size = {size!r}: one of {', '.join(SIZES)}")
    if folder.exists() and any(folder.iterdir()):
        raise ValueError(f"{folder}: holds files already; give a new or empty folder")
    folder.mkdir(parents=True, exist_ok=True)
    plan, name = SIZES[size], folder.name
    geometry = Geometry(plan.pixels, amplifiers)
    sensor = VirtualSensor(geometry, seed=seed, effects=effects)
    rows: list[dict[str, Any]] = []
    exposures = exposures_of(plan)
    for exposure in exposures if progress is None else progress(exposures):
        taken = sensor.take(exposure)
        if not exposure.withheld:
            rows.append(_write_exposure(folder, name, geometry, taken))
        elif withheld_folder is not None:
            _write_exposure(Path(withheld_folder) / name, name, geometry, taken)
    _write_manifest(folder / "manifest.ecsv", rows)
    _write_json(folder / "device_card.json", device_card(name, geometry, SPOT_GRID))
    _write_json(folder / "baseline_edges.json", baseline_edges())
    (folder / "campaign.yaml").write_text(_DESCRIPTION)
    truth = {
        "campaign": name,
        **sensor.truth(),
        "size": size,
        "seed": seed,
        "salt": secrets.token_hex(16) if salt is None else salt,
    }
    seal(folder, truth, truth_folder)
    return truth


def _header(campaign: str, geometry: Geometry, taken: Taken) -> fits.Header:
    e: Exposure = taken.exposure
    lit = e.kind in ("FLAT", "SPOT")
    n = geometry.pixels
    cards = [
        ("ORIGIN", "VCCD", "virtual sensor"),
        ("INSTRUME", "VCCD1", ""),
        ("CCD_MANU", "NONE", ""),
        ("CCD_SERN", campaign, ""),
        ("TESTTYPE", e.kind, ""),
        ("IMGTYPE", e.kind, ""),
        ("SEQNUM", e.sequence, "time order"),
        ("MJD-OBS", e.mjd, ""),
        ("EXPTIME", e.seconds, "s"),
        ("MONDIODE", round(taken.monitor, 5), "nA"),
        ("MONOWL", e.wavelength if lit else 0.0, "nm"),
        ("FILTER", "mono", ""),
        ("CCDTEMP", e.temperature, "C"),
        ("VBB", e.back_bias, "V back bias"),
        ("PARLHI", 4.0, "V collecting"),
        ("PARLLO", -8.0, "V barrier"),
        ("DETSIZE", f"[1:{n},1:{n}]", ""),
        ("CCDGAIN", NOMINAL_GAIN, "nominal e-/ADU"),
        ("CCDNOISE", NOMINAL_NOISE, "nominal e-"),
    ]
    return fits.Header(cards)


def _write_exposure(
    folder: Path, campaign: str, geometry: Geometry, taken: Taken
) -> dict[str, Any]:
    """Write one file beside and rename it; return its row of the manifest."""
    folder.mkdir(parents=True, exist_ok=True)
    n, w, pre, over = (
        geometry.pixels,
        geometry.width,
        geometry.prescan,
        geometry.serial_overscan,
    )
    units: list[Any] = [fits.PrimaryHDU(header=_header(campaign, geometry, taken))]
    for k, frame in enumerate(taken.frames):
        low, high = k * w + 1, (k + 1) * w
        ends = f"{high}:{low}" if k % 2 else f"{low}:{high}"
        header = fits.Header(
            [
                ("CHANNEL", k + 1),
                ("DATASEC", f"[{pre + 1}:{pre + w},1:{n}]"),
                ("BIASSEC", f"[{pre + w + 1}:{pre + w + over},1:{frame.shape[0]}]"),
                ("DETSEC", f"[{ends},1:{n}]"),
                ("CCDSUM", "1 1"),
            ]
        )
        units.append(
            fits.CompImageHDU(
                frame, header, name=f"SEGMENT{10 + k}", compression_type="RICE_1"
            )
        )
    e = taken.exposure
    beside = folder / f"{e.file}.part"
    fits.HDUList(units).writeto(beside, overwrite=True)
    digest = hashlib.sha256(beside.read_bytes()).hexdigest()
    os.replace(beside, folder / e.file)
    return {
        "file": e.file,
        "imgtype": e.kind,
        "seq": e.sequence,
        "mjd": round(e.mjd, 8),
        "exptime": e.seconds,
        "wavelength": e.wavelength,
        "vbb": e.back_bias,
        "temp": e.temperature,
        "diode": round(taken.monitor, 5),
        "sha256": digest,
    }


def _write_manifest(path: Path, rows: list[dict[str, Any]]) -> None:
    table = Table(rows=rows)
    table["seq"] = table["seq"].astype(np.int64)
    table.write(path, format="ascii.ecsv")


def _write_json(path: Path, content: dict[str, Any]) -> None:
    path.write_text(json.dumps(content, indent=1))


def seal(folder: Path, truth: dict[str, Any], truth_folder: str | Path | None) -> None:
    """Write the truth, and its hash beside the campaign."""
    path = folder / "truth.json"
    if truth_folder is not None:
        Path(truth_folder).mkdir(parents=True, exist_ok=True)
        path = Path(truth_folder) / f"{folder.name}.json"
    _write_json(path, truth)
    commitments = folder.parent / "commitments.json"
    known = json.loads(commitments.read_text()) if commitments.exists() else {}
    known[folder.name] = hashlib.sha256(path.read_bytes()).hexdigest()
    beside = commitments.with_suffix(".part")
    beside.write_text(json.dumps(known, indent=1, sort_keys=True))
    os.replace(beside, commitments)


def truth_matches(campaign: str | Path, truth_file: str | Path) -> bool:
    """Whether a truth's bytes are those that were committed beside its campaign."""
    campaign = Path(campaign)
    known = json.loads((campaign.parent / "commitments.json").read_text())
    if campaign.name not in known:
        raise ValueError(f"{campaign.parent}/commitments.json: no {campaign.name}")
    digest = hashlib.sha256(Path(truth_file).read_bytes()).hexdigest()
    return bool(known[campaign.name] == digest)
