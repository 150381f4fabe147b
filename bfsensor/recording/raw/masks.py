"""Pixels that campaign.yaml leaves out, by amplifier."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bfsensor.errors import RecordingError
from bfsensor.recording.raw.open_fits import open_fits
from bfsensor.recording.raw.sections import AmplifierLayout, parse_section, to_sensor


def read_masks(
    folder: Path, masks: Sequence[str], layouts: Sequence[AmplifierLayout]
) -> dict[str, NDArray[np.bool_]]:
    """Read what campaign.yaml says is bad, cut into amplifiers.

    Parameters
    ----------
    folder : Path
        The campaign.
    masks : sequence of str
        FITS sections of the sensor, or FITS images of it, 0 where good.
    layouts : sequence of AmplifierLayout

    Returns
    -------
    masks : dict of str to ndarray of bool
        Image sections by amplifier in readout order, True where bad; empty without masks.

    Raises
    ------
    RecordingError
        A section or file that cannot be read, is of another size, or an amplifier whose
        place on the sensor is not known.
    """
    if not masks:
        return {}
    boxes = {one.name: one.footprint() for one in layouts}
    if len(layouts) == 1 and layouts[0].origin is None:
        # One amplifier alone is the sensor.
        rows, columns = layouts[0].shape
        boxes = {layouts[0].name: (0, columns, 0, rows)}
    lost = [name for name, box in boxes.items() if box is None]
    if lost:
        raise RecordingError(
            f"{folder}: masks are of the sensor, and {lost[0]} has no DETSEC"
        )
    width = max(box[1] for box in boxes.values() if box is not None)
    height = max(box[3] for box in boxes.values() if box is not None)
    sensor = np.zeros((height, width), bool)
    for text in masks:
        if text.strip().startswith("["):
            section = parse_section(text, f"{folder}: masks")
            sensor[section.rows, section.columns] = True
            continue
        image = _read_mask(folder / text)
        if image.shape != sensor.shape:
            raise RecordingError(
                f"{folder / text}: a mask of {image.shape[1]} x {image.shape[0]} pixels for a "
                f"sensor of {width} x {height}"
            )
        sensor |= image
    out = {}
    for layout in layouts:
        left, right, low, high = boxes[layout.name] or (0, 0, 0, 0)
        out[layout.name] = to_sensor(layout, sensor[low:high, left:right]).copy()
    return out


def _read_mask(path: Path) -> NDArray[np.bool_]:
    """Read a FITS image whose good pixels are 0."""
    with open_fits(path) as hdus:
        for hdu in hdus:
            if hdu.is_image and hdu.data is not None:
                return np.asarray(hdu.data) != 0
    raise RecordingError(f"{path}: holds no image")
