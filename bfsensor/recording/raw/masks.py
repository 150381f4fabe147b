"""Masks of bad pixels that campaign.yaml names, cut into amplifiers."""

from __future__ import annotations

import os
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
    """Read the ``masks:`` of campaign.yaml and cut them into amplifiers.

    Parameters
    ----------
    folder : Path
        Folder of the campaign.
    masks : sequence of str
        FITS sections of the sensor, such as '[1:2,1:495]', or names of FITS images of the whole
        sensor, 0 where a pixel is good.
    layouts : sequence of AmplifierLayout
        The amplifiers.

    Returns
    -------
    masks : dict of str to ndarray of bool
        Masks of the image sections by amplifier, in readout order, True where a pixel is bad;
        empty without masks.

    Raises
    ------
    RecordingError
        A section or file cannot be read, an image has another size than the sensor, or an
        amplifier has no DETSEC.
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
            f"{folder}: masks are in pixels of the sensor, and {lost[0]} has no DETSEC; give its "
            "place in campaign.yaml: amplifiers: [{name: ..., detector: '[x1:x2,y1:y2]'}]"
        )
    width = max(box[1] for box in boxes.values() if box is not None)
    height = max(box[3] for box in boxes.values() if box is not None)
    sensor = np.zeros((height, width), bool)
    for text in masks:
        if text.strip().startswith("["):
            section = parse_section(text, f"{folder / 'campaign.yaml'}: masks")
            if section.rows.stop > height or section.columns.stop > width:
                raise RecordingError(
                    f"{folder / 'campaign.yaml'}: masks: {text} does not lie on the sensor of {width} x "
                    f"{height} pixels"
                )
            sensor[section.rows, section.columns] = True
            continue
        if not os.path.isfile(folder / text):
            raise RecordingError(
                f"{folder / 'campaign.yaml'}: masks: {text!r} is neither a section such as "
                "'[1:2,1:495]' nor a file of the folder"
            )
        image = _read_mask(folder / text)
        if image.shape != sensor.shape:
            raise RecordingError(
                f"{folder / text}: the mask has {image.shape[1]} x {image.shape[0]} pixels, the "
                f"sensor {width} x {height}"
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
    raise RecordingError(f"{path}: holds no image; a mask is a FITS image, 0 where good")
