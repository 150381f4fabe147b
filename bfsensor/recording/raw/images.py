"""Images of raw files in electrons: overscan subtracted, gain applied, bad pixels masked."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bfsensor.errors import RecordingError
from bfsensor.recording.raw.headers import FileScan
from bfsensor.recording.raw.keywords import MEANINGS
from bfsensor.recording.raw.overscan import OVERSCANS, SKIP, subtract_overscan
from bfsensor.recording.raw.pixels import read_pixels
from bfsensor.typing import FloatArray


@dataclass(frozen=True, eq=False)
class AmplifierImage:
    """The data section of one amplifier in one exposure.

    Attributes
    ----------
    name : str
        EXTNAME, or the name given in campaign.yaml.
    image : ndarray, shape (ny, nx)
        Data section in readout order, overscan subtracted, in ``unit``.
    mask : ndarray of bool, shape (ny, nx)
        True where a pixel is saturated (by the header's level, or at the end of the integers'
        range), masked in campaign.yaml, or not finite.  A row whose overscan has no finite
        pixel is masked as a whole.
    unit : str
        'electron', or 'adu' where no gain is known.
    gain : float
        Gain [e-/ADU]; nan where not known.
    no_gain : str
        Why no gain is known; '' where one is.
    overscan : str
        Method by which the overscan was subtracted; 'none' where it was not.
    overscan_level : float
        Median of the overscan [ADU]; nan where it was not subtracted.
    overscan_noise : float
        Scatter of the overscan about the medians of its rows [unit]: 1.4826 times the median
        absolute deviation, the standard deviation of Gaussian noise; nan where it was not
        subtracted.
    overscan_pixels : int
        Number of overscan pixels of a row.

    Examples
    --------
    :func:`read_images` makes one; its example shows image, mean and unit.
    """

    name: str
    image: FloatArray
    mask: NDArray[np.bool_]
    unit: str
    gain: float
    no_gain: str
    overscan: str
    overscan_level: float
    overscan_noise: float
    overscan_pixels: int


def read_images(
    scan: FileScan,
    *,
    gain: float | None = None,
    overscan: str | None = "row median",
    skip: int = SKIP,
    masks: Mapping[str, NDArray[np.bool_]] | None = None,
) -> tuple[AmplifierImage, ...]:
    """Read the amplifiers of a raw file, in electrons where their gain is known.

    Parameters
    ----------
    scan : FileScan
        The file's headers and layout (:func:`bfsensor.recording.raw.headers.scan_file`).
    gain : float, optional
        Gain of all amplifiers [e-/ADU], 1e-4 to 1e4; by default each one's by campaign.yaml or
        header, as :func:`bfsensor.recording.raw.keywords.amplifier_quantity` finds it.  Without
        a gain the image stays in ADU, and its ``unit`` is 'adu'.
    overscan : {'row median', 'row mean', 'median', None}
        Level to subtract: each row's median or mean over the overscan, the median of all of it,
        or none.  A row's level has an error that all its pixels share: it adds sigma^2 / n
        (mean) or pi / 2 times that (median) to the variance and to the covariances at all
        lags in x, where sigma is the noise of one pixel and n the number of overscan pixels of
        a row.
    skip : int
        Number of overscan columns next to the image to leave out, not negative: charge deferred
        from the last pixels of the image appears there.
    masks : mapping of str to ndarray of bool, optional
        Pixels of the data section to leave out, by amplifier, in readout order.

    Returns
    -------
    amplifiers : tuple of AmplifierImage
        One for each amplifier, in the order of ``scan.amplifiers``.

    Raises
    ------
    RecordingError
        The file cannot be read, a gain, ``skip`` or ``overscan`` is not allowed, or there is
        no overscan to subtract.  The message names file, amplifier and keyword.

    Examples
    --------
    >>> import tempfile, pathlib
    >>> from astropy.io import fits
    >>> from bfsensor.recording.raw.headers import scan_file
    >>> data = np.full((20, 40), 1000, np.uint16)
    >>> data[:, :32] += 500
    >>> header = fits.Header(
    ...     {"DATASEC": "[1:32,1:20]", "BIASSEC": "[33:40,1:20]", "GAIN": 2.0}
    ... )
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = pathlib.Path(folder) / "raw.fits"
    ...     fits.PrimaryHDU(data, header).writeto(path)
    ...     (amplifier,) = read_images(scan_file(path))
    >>> amplifier.image.shape, float(amplifier.image.mean()), amplifier.unit
    ((20, 32), 1000.0, 'electron')
    """
    if overscan is not None and overscan not in OVERSCANS:
        raise RecordingError(
            f"overscan = {overscan!r} is not one of {', '.join(OVERSCANS)}, or None"
        )
    if skip < 0:
        raise RecordingError(f"skip = {skip} columns must be 0 or more")
    low, high = MEANINGS["gain"].low, MEANINGS["gain"].high
    if gain is not None and not low <= gain <= high:
        raise RecordingError(f"gain = {gain:g} e-/ADU must be from {low:g} to {high:g}")
    amplifiers = []
    for pixels, wrong in zip(
        read_pixels(scan.path, scan.amplifiers, masks, dtype=np.float64),
        scan.problems,
        strict=True,
    ):
        layout = pixels.layout
        image, level, noise, count = subtract_overscan(
            f"{scan.path}: {layout.name}", pixels.values, layout, method=overscan, skip=skip
        )
        own = layout.gain if gain is None else float(gain)
        scale = 1.0 if own is None else own
        amplifiers.append(
            AmplifierImage(
                name=layout.name,
                image=image * scale,
                mask=pixels.bad[layout.data] | ~np.isfinite(image),
                unit="adu" if own is None else "electron",
                gain=np.nan if own is None else own,
                no_gain=""
                if own is not None
                else wrong.get("gain", "no gain in the header"),
                overscan=overscan or "none",
                overscan_level=level,
                overscan_noise=noise * scale,
                overscan_pixels=count,
            )
        )
    return tuple(amplifiers)
