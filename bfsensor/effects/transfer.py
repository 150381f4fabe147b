"""Charge that stays behind when packets are shifted: shares that arrive late."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bfsensor.typing import FloatArray

LATEST = 6
"""Packets by which charge may be late: beyond, of 5e-5 times 4000 transfers, is less than 2e-5."""


def late_shares(transfers: ArrayLike, cti: float) -> FloatArray:
    r"""Shares of a packet that arrive 0, 1, ... packets late.

    Each transfer leaves ``cti`` behind, which the next packet takes along: the number of failures
    before n transfers have succeeded,
    :math:`p_d = \binom{n + d - 1}{d} (1 - c)^n c^d`.

    Parameters
    ----------
    transfers : array_like, shape (...)
        n.
    cti : float
        c.

    Returns
    -------
    shares : ndarray, shape (LATEST + 1, ...)

    Examples
    --------
    >>> late_shares(2, 0.1)[:3].round(4)
    array([0.81  , 0.162 , 0.0243])
    """
    n = np.asarray(transfers, float)
    shares = [(1.0 - cti) ** n]
    for late in range(1, LATEST + 1):
        shares.append(shares[-1] * cti * (n + late - 1) / late)
    return np.array(shares)


def leave_behind(frame: NDArray[Any], cti: float, axis: int) -> NDArray[Any]:
    """Transfer a frame along an axis, its first packet once, the second twice, and so on."""
    if cti == 0:
        return frame
    lines = np.moveaxis(frame, axis, -1).astype(float)
    shares = late_shares(np.arange(1, lines.shape[-1] + 1), cti)
    out = lines * shares[0]
    for late in range(1, min(LATEST, lines.shape[-1] - 1) + 1):
        out[..., late:] += lines[..., :-late] * shares[late][:-late]
    return np.moveaxis(out, -1, axis).astype(frame.dtype)


def behind_flat(
    k: FloatArray,
    packets: FloatArray,
    before: FloatArray,
    cti: float,
) -> FloatArray:
    """Part of a flat's level in the k-th packet after the last one with light.

    Parameters
    ----------
    k : ndarray
        From 1 on.
    packets, before : ndarray
        With light, and read before them without.
    cti : float
        Lost at each transfer.
    """
    out = np.zeros(np.broadcast_shapes(k.shape, packets.shape))
    for late in range(1, LATEST + 1):
        transfers = before + packets + k - late
        here = (k <= late) & (late < k + packets)
        out += np.where(here, late_shares(np.maximum(transfers, 1), cti)[late], 0.0)
    return out


def trail_covariances(c: FloatArray, share: FloatArray, axis: int) -> FloatArray:
    """Covariances after a part ``share`` of each pixel went to the next one, to first order."""
    part = share.reshape(-1, *(1,) * (c.ndim - 1))
    return np.asarray(c + part * (np.roll(c, 1, axis) + np.roll(c, -1, axis) - 2 * c))


def trail_image(
    images: FloatArray, share: float, backwards: float, axis: int
) -> FloatArray:
    """Images after a part ``share`` went to the pixel read next.

    ``backwards``: share of the images that are read against the axis.
    """
    later = (1 - backwards) * np.roll(images, 1, axis) + backwards * np.roll(
        images, -1, axis
    )
    return np.asarray(images + share * (later - images))
