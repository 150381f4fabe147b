"""Images of raw files in electrons: overscan subtracted, gain applied, bad pixels masked."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bfsensor.errors import RecordingError
from bfsensor.recording.raw.headers import FileScan
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
        True where saturated (header, or the end of an integer's range), masked or not finite,
        which a row without a finite overscan pixel is too.
    unit : str
        'electron', or 'adu' where no gain is known.
    gain : float
        [e-/ADU]; nan where not known.
    no_gain : str
        Why no gain is known; '' where one is.
    overscan : str
        How the overscan was subtracted; 'none' where it was not.
    overscan_level, overscan_noise : float
        Median of the overscan [ADU], and its scatter about its rows' medians as of a
        Gaussian [unit]; nan without overscan.
    overscan_pixels : int
        Overscan pixels of a row.
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
        The file's headers (:func:`bfsensor.recording.raw.headers.scan_file`), with what
        campaign.yaml says beside them.
    gain : float, optional
        [e-/ADU], for all amplifiers; by default each one's by campaign.yaml or header, as
        :func:`bfsensor.recording.raw.keywords.amplifier_quantity` finds it.  Without any the
        image stays in ADU, and says so.
    overscan : {'row median', 'row mean', 'median', None}
        Each row's median or mean over the overscan, the median of all of it, or nothing where
        there is none.  A row's level has an error, which all its pixels share: it adds
        sigma^2 / n (mean) or pi / 2 of that (median) to the variance and to the covariances
        at all lags in x, where n is the number of overscan pixels of a row.
    skip : int
        Overscan columns next to the image to leave out: charge deferred from the last pixels
        comes out there.
    masks : mapping of str to ndarray of bool, optional
        Pixels to leave out, by amplifier, in readout order.

    Returns
    -------
    amplifiers : tuple of AmplifierImage

    Raises
    ------
    RecordingError
        Names file, amplifier and card.

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
        raise RecordingError(f"skip = {skip} must not be negative")
    if gain is not None and not 0 < gain < np.inf:
        raise RecordingError(f"gain = {gain:g} e-/ADU must be above 0")
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
