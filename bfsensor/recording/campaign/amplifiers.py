"""Pixels of an exposure, one frame for each amplifier, in the order in which they were read."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bfsensor.errors import RecordingError
from bfsensor.recording.campaign.campaign import Campaign
from bfsensor.recording.campaign.exposures import Exposure
from bfsensor.recording.raw.pixels import read_pixels
from bfsensor.recording.raw.sections import AmplifierLayout, to_sensor


@dataclass(frozen=True, eq=False)
class AmplifierFrame:
    """What one amplifier read out of one exposure, as it came.

    Attributes
    ----------
    name : str
        Of the amplifier.
    pixels : ndarray of float32, shape (ny, nx)
        All that was read [ADU], prescan and overscan with it: axis 1 counts serial
        transfers from the output, axis 0 parallel ones.  Nothing is subtracted.
    bad : ndarray of bool, shape (ny, nx)
        Not finite, saturated, or masked in campaign.yaml.
    layout : AmplifierLayout
        Where it lies in the file and on the sensor.
    saturation : float
        Level at which ``bad`` begins [ADU]; inf where none is known.
    exposure : int
        Number of the exposure.
    """

    name: str
    pixels: NDArray[np.float32] = field(repr=False)
    bad: NDArray[np.bool_] = field(repr=False)
    layout: AmplifierLayout
    saturation: float = np.inf
    exposure: int = 0

    @property
    def image(self) -> NDArray[np.float32]:
        """Pixels that saw light, a view."""
        return self.pixels[self.layout.data]

    @property
    def mask(self) -> NDArray[np.bool_]:
        """True where a pixel of ``image`` is bad, a view."""
        return self.bad[self.layout.data]

    @property
    def prescan(self) -> NDArray[np.float32]:
        """Columns read before the image's first, in its rows, a view."""
        rows, columns = self.layout.data
        return self.pixels[rows, : columns.start]

    @property
    def serial_overscan(self) -> NDArray[np.float32]:
        """Columns read after the image's last, in its rows, a view.

        The first column is the first transfer without a pixel, also where BIASSEC leaves it
        out: deferred charge is there.
        """
        rows, columns = self.layout.data
        return self.pixels[rows, columns.stop :]

    @property
    def parallel_overscan(self) -> NDArray[np.float32]:
        """Rows read after the image's last, in its columns, a view."""
        rows, columns = self.layout.data
        return self.pixels[rows.stop :, columns]

    @property
    def flip_x(self) -> bool:
        """Whether the sensor's x falls in readout order."""
        return self.layout.flip_x

    @property
    def flip_y(self) -> bool:
        """Whether the sensor's y falls in readout order."""
        return self.layout.flip_y

    @property
    def origin(self) -> tuple[int, int] | None:
        """Lowest x and y on the sensor, from 0; None where not known."""
        return self.layout.origin

    @property
    def gain(self) -> float | None:
        """As header or campaign.yaml says [e-/ADU]; None where neither does."""
        return self.layout.gain

    @property
    def noise(self) -> float | None:
        """As header or campaign.yaml says [e-]; None where neither does."""
        return self.layout.noise


def read_exposure(campaign: Campaign, exposure: Exposure) -> tuple[AmplifierFrame, ...]:
    """Read the pixels of one exposure.

    Parameters
    ----------
    campaign : Campaign
        It gives the layout of the amplifiers and the masks.
    exposure : Exposure
        One of its exposures.

    Returns
    -------
    frames : tuple of AmplifierFrame
        In the order of ``campaign.amplifiers``.

    Raises
    ------
    RecordingError
        The file cannot be read, or is not what its header said when the campaign was read.

    Notes
    -----
    Files are opened, read extension by extension, and closed
    (:func:`bfsensor.recording.raw.pixels.read_pixels`): no more than one exposure is held, as
    float32 and a byte of mask for each pixel.
    """
    return tuple(
        AmplifierFrame(
            name=one.layout.name,
            pixels=one.values,
            bad=one.bad,
            layout=one.layout,
            saturation=one.saturation,
            exposure=exposure.number,
        )
        for one in read_pixels(exposure.path, campaign.amplifiers, campaign.masks)
    )


def assemble(
    frames: Sequence[AmplifierFrame],
    images: Mapping[str, ArrayLike] | None = None,
) -> NDArray[np.float32]:
    """Put amplifiers where they lie on the sensor.

    Parameters
    ----------
    frames : sequence of AmplifierFrame
        Of one exposure.
    images : mapping of str to array_like, optional
        What to put there, by amplifier, of the shape of its image, in readout order: such as
        images in electrons.  By default the raw pixels.

    Returns
    -------
    image : ndarray of float32, shape (ny, nx)
        From the lowest to the highest x and y of these amplifiers; nan in gaps.

    Raises
    ------
    RecordingError
        An amplifier whose place is not known, or two that overlap.
    """
    if not frames:
        raise RecordingError("no amplifiers to put together")
    boxes = []
    for one in frames:
        box = one.layout.footprint()
        if box is None:
            raise RecordingError(f"{one.name}: no DETSEC says where it lies on the sensor")
        boxes.append(box)
    x0, y0 = min(b[0] for b in boxes), min(b[2] for b in boxes)
    shape = max(b[3] for b in boxes) - y0, max(b[1] for b in boxes) - x0
    out = np.full(shape, np.nan, np.float32)
    filled = np.zeros(shape, bool)
    for one, (left, right, low, high) in zip(frames, boxes, strict=True):
        image = one.image if images is None else np.asarray(images[one.name])
        if image.shape != one.layout.shape:
            raise RecordingError(
                f"{one.name}: an image of shape {image.shape}, not {one.layout.shape}"
            )
        place = np.s_[low - y0 : high - y0, left - x0 : right - x0]
        if filled[place].any():
            raise RecordingError(f"{one.name}: its DETSEC overlaps another amplifier's")
        filled[place] = True
        out[place] = to_sensor(one.layout, image)
    return out
