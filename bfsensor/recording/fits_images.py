"""Raw FITS images: sections, overscan and gain, to arrays in electrons with conditions."""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import numpy as np
from astropy.io import fits
from astropy.utils.exceptions import AstropyUserWarning
from numpy.typing import ArrayLike, NDArray

from bfsensor.errors import RecordingError

MAD_TO_SIGMA = 1.4826022185056018
"""Standard deviation of a Gaussian over its median absolute deviation."""

OVERSCANS = ("row median", "row mean", "median")
GAIN_KEYS = ("GAIN", "E-GAIN", "EGAIN")
EXPOSURE_KEYS = ("EXPTIME", "EXPOSURE", "DARKTIME")
SATURATION_KEYS = ("SATURATE", "SATLEVEL")


@dataclass(frozen=True, eq=False)
class AmplifierImage:
    """What one amplifier read out of one exposure.

    Attributes
    ----------
    name : str
        EXTNAME, or the name given to the section.
    image : ndarray, shape (ny, nx)
        Data section, bias subtracted, in ``unit``; axis 0 along y.
    mask : ndarray of bool, shape (ny, nx)
        True where saturated (header, or the end of an integer's range) or not finite.
    unit : str
        'electron', or 'adu' where no gain is known.
    gain : float
        [e-/ADU]; nan where not known.
    exposure_time : float
        [s]; nan where the header has none.
    overscan : str
        How the overscan was subtracted; 'none' where it was not.
    overscan_level, overscan_noise : float
        Median of the overscan [ADU], and its scatter about its rows' medians as of a
        Gaussian [unit], too small by about one part in n for n pixels a row; nan without
        overscan.
    overscan_pixels : int
        Overscan pixels of a row.
    conditions : mapping of str to value
        Cards of the header, the extension's over the primary's.
    """

    name: str
    image: NDArray[np.float64]
    mask: NDArray[np.bool_]
    unit: str
    gain: float
    exposure_time: float
    overscan: str
    overscan_level: float
    overscan_noise: float
    overscan_pixels: int
    conditions: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "conditions", MappingProxyType(dict(self.conditions)))

    @property
    def scale(self) -> float:
        """What the image was multiplied by [unit/ADU]: the gain, or 1 without one."""
        return self.gain if self.unit == "electron" else 1.0


def read_raw(
    path: str | os.PathLike[str],
    *,
    gain: float | Mapping[str, float] | None = None,
    overscan: str | None = "row median",
    skip: int = 2,
    sections: Mapping[str, tuple[str, str | None]] | None = None,
    bias: ArrayLike | Mapping[str, ArrayLike] | None = None,
    extensions: Sequence[int | str] | None = None,
) -> tuple[AmplifierImage, ...]:
    """Read a raw FITS file, with one extension for each amplifier or one image.

    Parameters
    ----------
    path : path-like
        The file.
    gain : float or mapping of str to float, optional
        [e-/ADU], for all or by amplifier; by default from the header (GAIN, E-GAIN or
        EGAIN: some cameras write a setting there, not a gain).  Without either the images
        stay in ADU, and say so.
    overscan : {'row median', 'row mean', 'median', None}
        Each row's median or mean over BIASSEC, the median of all of it, or nothing where
        there is none.  A row's level has an error, which all its pixels share: it adds
        sigma^2 / n (mean) or pi / 2 of that (median) to the variance and to the covariances
        at all lags in x, where n is the number of overscan pixels of a row.
    skip : int
        First columns of the overscan to leave out: charge deferred from the last pixels
        comes out there.
    sections : mapping of str to (str, str or None), optional
        DATASEC and BIASSEC for each amplifier of a single image, such as
        ``{"left": ("[1:512,1:1000]", "[1025:1056,1:1000]")}``.  By default the header's;
        without DATASEC the whole image.
    bias : array_like or mapping of str to array_like, optional
        Bias of the data section [ADU], of the overscan's level freed, subtracted.
    extensions : sequence, optional
        Numbers or names of extensions; by default all that hold images.

    Returns
    -------
    amplifiers : tuple of AmplifierImage

    Raises
    ------
    RecordingError
        Names file, extension and card.

    Notes
    -----
    Sections are FITS's: from 1, x first, ends included.  One that runs backwards stands for
    an axis read the other way; which way the charge moved matters here, so it is refused
    rather than flipped in silence.

    Examples
    --------
    >>> import tempfile, pathlib
    >>> data = np.full((20, 40), 1000, np.uint16)
    >>> data[:, :32] += 500
    >>> header = fits.Header({"DATASEC": "[1:32,1:20]", "BIASSEC": "[33:40,1:20]"})
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = pathlib.Path(folder) / "raw.fits"
    ...     fits.PrimaryHDU(data, header).writeto(path)
    ...     (amplifier,) = read_raw(path, gain=2.0)
    >>> amplifier.image.shape, float(amplifier.image.mean()), amplifier.unit
    ((20, 32), 1000.0, 'electron')
    """
    if overscan is not None and overscan not in OVERSCANS:
        raise RecordingError(
            f"overscan = {overscan!r} is not one of {', '.join(OVERSCANS)}, or None"
        )
    if skip < 0:
        raise RecordingError(f"skip = {skip} must not be negative")
    with open_fits(path) as hdus:
        images = _images(path, hdus, extensions)
        if sections is not None and len(images) > 1:
            raise RecordingError(
                f"{path}: sections are for a single image; name one of its {len(images)} by "
                "extensions"
            )
        names = [str(hdu.header.get("EXTNAME", "")) for hdu in images]
        amplifiers: list[AmplifierImage] = []
        for number, hdu in enumerate(images):
            cards = {**header_cards(hdus[0].header), **header_cards(hdu.header)}
            name = names[number] or "image"
            if names.count(names[number]) > 1:
                name = f"{name} {number + 1}"
            parts: Mapping[str, tuple[Any, Any]] = sections or {
                name: (cards.get("DATASEC"), cards.get("BIASSEC"))
            }
            mask = _saturated(hdu, cards)
            for part, (data, over) in parts.items():
                where = f"{path}: {part}"
                sizes = (where, hdu.data.shape)
                area = _parse_section("DATASEC", data, *sizes)
                strip = None if over is None else _parse_section("BIASSEC", over, *sizes)
                image, level, noise, count = _subtract_overscan(
                    where, np.asarray(hdu.data, float), area, strip, overscan, skip
                )
                image = image - _bias_of(where, bias, part, image.shape)
                factor = _gain_of(where, gain, part, cards)
                known = np.isfinite(factor)
                scale = factor if known else 1.0
                amplifiers.append(
                    AmplifierImage(
                        name=part,
                        image=image * scale,
                        mask=mask[area] | ~np.isfinite(image),
                        unit="electron" if known else "adu",
                        gain=factor,
                        exposure_time=_number(cards, EXPOSURE_KEYS),
                        overscan=overscan or "none",
                        overscan_level=level,
                        overscan_noise=noise * scale,
                        overscan_pixels=count,
                        conditions=cards,
                    )
                )
    return tuple(amplifiers)


def read_bias(
    paths: Sequence[str | os.PathLike[str]], **options: Any
) -> dict[str, NDArray[np.float64]]:
    """Average bias frames, by amplifier, for the ``bias`` of :func:`read_raw`.

    Parameters
    ----------
    paths : sequence of path-like
        Bias frames of one camera.
    **options
        Of :func:`read_raw`, those that the flats are read with; no gain, no bias.

    Returns
    -------
    bias : dict of str to ndarray, shape (ny, nx)
        Mean of the frames [ADU]: its noise, 1/n of theirs, drops out of pair differences.

    Raises
    ------
    RecordingError
        No frames, or frames of different amplifiers or shapes.
    """
    total: dict[str, NDArray[np.float64]] = {}
    for path in paths:
        found = {one.name: one.image / one.scale for one in read_raw(path, **options)}
        if total and {k: v.shape for k, v in total.items()} != {
            k: v.shape for k, v in found.items()
        }:
            raise RecordingError(f"{path}: not the amplifiers and shapes of {paths[0]}")
        total = {name: image + total.get(name, 0.0) for name, image in found.items()}
    if not total:
        raise RecordingError("no bias frame was given")
    return {name: image / len(paths) for name, image in total.items()}


@contextmanager
def open_fits(path: str | os.PathLike[str]) -> Iterator[fits.HDUList]:
    """Open a file and let the harmless faults of old cameras' cards pass."""
    with warnings.catch_warnings():
        # Lower-case exponents, null padding: read correctly, warned about.
        warnings.simplefilter("ignore", AstropyUserWarning)
        try:
            with fits.open(path, memmap=False) as hdus:
                hdus.verify("silentfix")
                yield hdus
        except OSError as error:
            raise RecordingError(f"{path}: cannot be read: {error}") from None


def _images(
    path: str | os.PathLike[str], hdus: fits.HDUList, names: Sequence[int | str] | None
) -> list[Any]:
    """Find the extensions that hold images, or those asked for."""
    if names is None:
        found = [hdu for hdu in hdus if hdu.is_image and hdu.header.get("NAXIS", 0) == 2]
        if not found:
            raise RecordingError(f"{path}: holds no two-dimensional image")
        return found
    found = []
    for name in names:
        try:
            hdu = hdus[name]
        except (KeyError, IndexError):
            there = ", ".join(f"{k} {h.name!r}" for k, h in enumerate(hdus))
            raise RecordingError(f"{path}: no extension {name!r}; it has {there}") from None
        if not hdu.is_image or hdu.header.get("NAXIS", 0) != 2:
            raise RecordingError(f"{path}: extension {name!r} is no two-dimensional image")
        found.append(hdu)
    return found


def header_cards(header: fits.Header) -> dict[str, Any]:
    """Cards with a value, by keyword; comments and history are left out."""
    skipped = ("COMMENT", "HISTORY", "", "SIMPLE", "XTENSION", "BITPIX", "BSCALE", "BZERO")
    return {
        card.keyword: card.value
        for card in header.cards
        if card.keyword not in skipped and not isinstance(card.value, fits.card.Undefined)
    }


def _number(cards: Mapping[str, Any], keys: Sequence[str]) -> float:
    """Give the first of some cards that is a number; nan without one."""
    for key in keys:
        if isinstance(cards.get(key), int | float):
            return float(cards[key])
    return float("nan")


def _saturated(hdu: Any, cards: Mapping[str, Any]) -> NDArray[np.bool_]:
    """Find pixels at the header's saturation level, or at the end of an integer's range."""
    data = np.asarray(hdu.data)
    limit = _number(cards, SATURATION_KEYS)
    if data.dtype.kind in "iu":
        top = float(np.iinfo(data.dtype).max)
        limit = min(limit, top) if np.isfinite(limit) else top
    return np.asarray(data >= limit) if np.isfinite(limit) else np.zeros(data.shape, bool)


def _parse_section(
    card: str, text: Any, where: str, shape: tuple[int, int]
) -> tuple[slice, slice]:
    """Read '[x1:x2,y1:y2]' as slices of rows and columns; None is the whole image."""
    if text is None:
        return slice(0, shape[0]), slice(0, shape[1])
    match = re.fullmatch(r"\s*\[\s*(\d+):(\d+)\s*,\s*(\d+):(\d+)\s*\]\s*", str(text))
    if match is None:
        raise RecordingError(f"{where}: {card} = {text!r} is not like '[1:512,1:2000]'")
    x1, x2, y1, y2 = (int(number) for number in match.groups())
    if x1 > x2 or y1 > y2:
        raise RecordingError(
            f"{where}: {card} = {text!r} runs backwards; flip the image and say so yourself"
        )
    if min(x1, y1) < 1 or x2 > shape[1] or y2 > shape[0]:
        raise RecordingError(
            f"{where}: {card} = {text!r} leaves the image, {shape[1]} x {shape[0]} pixels"
        )
    return slice(y1 - 1, y2), slice(x1 - 1, x2)


def _subtract_overscan(
    where: str, pixels: NDArray[np.float64], area: tuple[slice, slice],
    strip: tuple[slice, slice] | None, method: str | None, skip: int,
) -> tuple[NDArray[np.float64], float, float, int]:  # fmt: skip
    """Data section less overscan; level and noise of it, pixels in a row of it."""
    image = pixels[area]
    if method is None:
        return image, float("nan"), float("nan"), 0
    if strip is None:
        raise RecordingError(
            f"{where}: BIASSEC is missing; give sections, or say overscan=None and a bias"
        )
    rows, columns = strip
    columns = slice(columns.start + skip, columns.stop)
    over = pixels[rows, columns]
    if over.shape[1] < 1:
        raise RecordingError(f"{where}: skip = {skip} leaves nothing of BIASSEC")
    by_row = np.median(over, axis=1, keepdims=True)
    level = float(np.median(over))
    noise = MAD_TO_SIGMA * float(np.median(np.abs(over - by_row)))
    if method == "median":
        return image - level, level, noise, over.shape[1]
    if rows.start > area[0].start or rows.stop < area[0].stop:
        raise RecordingError(
            f"{where}: BIASSEC has the rows {rows.start + 1} to {rows.stop}, not all of "
            f"{area[0].start + 1} to {area[0].stop}; overscan='median' needs no rows"
        )
    if method == "row mean":
        by_row = over.mean(axis=1, keepdims=True)
    first = area[0].start - rows.start
    return image - by_row[first : first + len(image)], level, noise, over.shape[1]


def _bias_of(
    where: str, bias: ArrayLike | Mapping[str, ArrayLike] | None, part: str,
    shape: tuple[int, ...],
) -> NDArray[np.float64] | float:  # fmt: skip
    """Bias of one amplifier's data section [ADU]."""
    if bias is None:
        return 0.0
    if isinstance(bias, Mapping):
        if part not in bias:
            raise RecordingError(f"{where}: no bias for it among {', '.join(bias)}")
        bias = bias[part]
    array = np.asarray(bias, float)
    if array.ndim and array.shape != shape:
        raise RecordingError(
            f"{where}: bias of shape {array.shape} for a data section of {shape}"
        )
    return array


def _gain_of(
    where: str, gain: float | Mapping[str, float] | None, part: str,
    cards: Mapping[str, Any],
) -> float:  # fmt: skip
    """Gain [e-/ADU] as given, or of the header; nan where neither says."""
    if isinstance(gain, Mapping):
        if part not in gain:
            raise RecordingError(f"{where}: no gain for it among {', '.join(gain)}")
        gain = gain[part]
    value = _number(cards, GAIN_KEYS) if gain is None else float(gain)
    if not np.isnan(value) and not (0 < value < np.inf):
        raise RecordingError(f"{where}: gain = {value:g} e-/ADU must be above 0")
    return value
