"""Raw FITS images: sections, overscan and gain, to arrays in electrons with conditions."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import numpy as np
from astropy.io import fits
from numpy.typing import ArrayLike, NDArray

from bfsensor.errors import RecordingError
from bfsensor.recording.raw.fits_sections import (
    end_of_range,
    find_saturated,
    number_of,
    parse_section,
    subtract_overscan,
)
from bfsensor.recording.raw.open_fits import open_fits
from bfsensor.typing import FloatArray

OVERSCANS = ("row median", "row mean", "median")
GAIN_KEYS = ("GAIN", "E-GAIN", "EGAIN")
EXPOSURE_KEYS = ("EXPTIME", "EXPOSURE", "DARKTIME")


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
        True where saturated (header, or the end of an integer's range) or not finite, which a
        row without a finite overscan pixel is too.
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
    image: FloatArray
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
            end = end_of_range(hdu.header)  # before the data are read and scaled
            mask = find_saturated(np.asarray(hdu.data), cards, end)
            for part, (data, over) in parts.items():
                where = f"{path}: {part}"
                sizes = (where, hdu.data.shape)
                area = parse_section("DATASEC", data, *sizes)
                # Where no overscan is wanted the card may say anything.
                wanted = overscan is not None and over is not None
                strip = parse_section("BIASSEC", over, *sizes) if wanted else None
                image, level, noise, count = subtract_overscan(
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
                        exposure_time=number_of(cards, EXPOSURE_KEYS),
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
) -> dict[str, FloatArray]:
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
    total: dict[str, FloatArray] = {}
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


def _bias_of(
    where: str, bias: ArrayLike | Mapping[str, ArrayLike] | None, part: str,
    shape: tuple[int, ...],
) -> FloatArray | float:  # fmt: skip
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
    value = number_of(cards, GAIN_KEYS) if gain is None else float(gain)
    unknown = gain is None and np.isnan(value)
    if not unknown and not (0 < value < np.inf):
        raise RecordingError(f"{where}: gain = {value:g} e-/ADU must be above 0")
    return value
