"""Pixels of an exposure as one frame for each amplifier, and images of the whole sensor."""

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
    """Raw pixels of one amplifier in one exposure, in readout order.

    Attributes
    ----------
    name : str
        Name of the amplifier.
    pixels : ndarray of float32, shape (ny, nx)
        All pixels [ADU], with prescan and overscan: axis 1 counts serial transfers from the
        output, axis 0 parallel ones.  Nothing is subtracted.
    bad : ndarray of bool, shape (ny, nx)
        True where a pixel is not finite, saturated, or masked in campaign.yaml.
    layout : AmplifierLayout
        Place of the amplifier in the file and on the sensor.
    saturation : float
        Level at and above which a pixel counts as saturated [ADU]; inf where none is known.
    exposure : int
        Number of the exposure.

    Examples
    --------
    >>> from bfsensor.recording.raw.sections import layout_of
    >>> sections = {"DATASEC": "[3:34,1:20]"}
    >>> layout = layout_of("a.fits", "A", 0, (20, 40), sections)
    >>> frame = AmplifierFrame("A", np.zeros((20, 40), np.float32), np.zeros((20, 40), bool), layout)
    >>> frame.image.shape, frame.prescan.shape, frame.serial_overscan.shape
    ((20, 32), (20, 2), (20, 6))
    """

    name: str
    pixels: NDArray[np.float32] = field(repr=False)
    bad: NDArray[np.bool_] = field(repr=False)
    layout: AmplifierLayout
    saturation: float = np.inf
    exposure: int = 0

    @property
    def image(self) -> NDArray[np.float32]:
        """Pixels of the image section (DATASEC), shape (ny, nx) [ADU]; a view."""
        return self.pixels[self.layout.data]

    @property
    def mask(self) -> NDArray[np.bool_]:
        """True where a pixel of ``image`` is bad, a view."""
        return self.bad[self.layout.data]

    @property
    def prescan(self) -> NDArray[np.float32]:
        """Columns read before the image's first, in the image's rows [ADU]; a view."""
        rows, columns = self.layout.data
        return self.pixels[rows, : columns.start]

    @property
    def serial_overscan(self) -> NDArray[np.float32]:
        """Columns read after the image's last, in the image's rows [ADU]; a view.

        The first column is the first transfer beyond the image, also where BIASSEC leaves it
        out, because deferred charge appears there.
        """
        rows, columns = self.layout.data
        return self.pixels[rows, columns.stop :]

    @property
    def parallel_overscan(self) -> NDArray[np.float32]:
        """Rows read after the image's last, in the image's columns [ADU]; a view."""
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
        """Lowest x and y on the sensor, from 0 [pixel]; None without DETSEC."""
        return self.layout.origin

    @property
    def gain(self) -> float | None:
        """Gain by header or campaign.yaml [e-/ADU]; None where neither states one."""
        return self.layout.gain

    @property
    def noise(self) -> float | None:
        """Read noise by header or campaign.yaml [e-]; None where neither states one."""
        return self.layout.noise


def read_exposure(campaign: Campaign, exposure: Exposure) -> tuple[AmplifierFrame, ...]:
    """Read the pixels of one exposure.

    Parameters
    ----------
    campaign : Campaign
        Campaign with the layout of the amplifiers and the masks.
    exposure : Exposure
        One of its exposures.

    Returns
    -------
    frames : tuple of AmplifierFrame
        One frame for each of ``campaign.amplifiers``, in their order.

    Raises
    ------
    RecordingError
        The file cannot be read, or has changed since the campaign was read.

    Notes
    -----
    The file is read extension by extension and closed
    (:func:`bfsensor.recording.raw.pixels.read_pixels`).  Frames take 5 bytes for each pixel: a
    float32 and a byte of mask.

    Examples
    --------
    >>> import tempfile
    >>> from astropy.io import fits
    >>> from bfsensor.recording import read_campaign
    >>> header = fits.Header({"IMGTYPE": "FLAT", "EXPTIME": 2.0, "DATASEC": "[1:8,1:6]"})
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     fits.PrimaryHDU(np.full((6, 10), 900, np.uint16), header).writeto(f"{folder}/a.fits")
    ...     campaign = read_campaign(folder)
    ...     (frame,) = read_exposure(campaign, campaign.exposures[0])
    >>> frame.image.shape, frame.serial_overscan.shape, float(frame.image.mean())
    ((6, 8), (6, 2), 900.0)
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
    """Assemble the image of a sensor from its amplifiers.

    Parameters
    ----------
    frames : sequence of AmplifierFrame
        Frames of one exposure.
    images : mapping of str to array_like, optional
        Image of each amplifier, in readout order and of the shape of its image section, such
        as one in electrons.  By default the raw pixels.

    Returns
    -------
    image : ndarray of float32, shape (ny, nx)
        Image from the lowest to the highest x and y of these amplifiers; nan in gaps.

    Raises
    ------
    RecordingError
        There are no frames, an amplifier has no DETSEC, two overlap, or an image has another
        shape.
    """
    if not frames:
        raise RecordingError("no amplifiers to put together")
    boxes = []
    for one in frames:
        box = one.layout.footprint()
        if box is None:
            raise RecordingError(
                f"{one.name}: no DETSEC, so that its place on the sensor is not known; state it in "
                "campaign.yaml: amplifiers: [{name: ..., detector: '[x1:x2,y1:y2]'}, ...]"
            )
        boxes.append(box)
    x0, y0 = min(b[0] for b in boxes), min(b[2] for b in boxes)
    shape = max(b[3] for b in boxes) - y0, max(b[1] for b in boxes) - x0
    out = np.full(shape, np.nan, np.float32)
    filled = np.zeros(shape, bool)
    for one, (left, right, low, high) in zip(frames, boxes, strict=True):
        image = one.image if images is None else np.asarray(images[one.name])
        if image.shape != one.layout.shape:
            raise RecordingError(
                f"{one.name}: an image of shape {image.shape}, not {one.layout.shape} as its "
                "image section"
            )
        place = np.s_[low - y0 : high - y0, left - x0 : right - x0]
        if filled[place].any():
            raise RecordingError(f"{one.name}: its DETSEC overlaps another amplifier's")
        filled[place] = True
        out[place] = to_sensor(one.layout, image)
    return out
