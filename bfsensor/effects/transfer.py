"""Charge transfer inefficiency: the fractions of a packet that arrive several packets late."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bfsensor.typing import FloatArray

LATEST = 6
"""Largest number of packets by which charge arrives late; later charge is neglected.

Derived from the negative binomial of :func:`late_shares`: the neglected fraction is 2e-9 for an
inefficiency of 5e-5 and 4000 transfers."""


def late_shares(transfers: ArrayLike, cti: float) -> FloatArray:
    r"""Give the fractions of a packet that arrive 0, 1, ... packets late.

    Each transfer leaves the fraction ``cti`` to the next packet.  The delay d of an electron is its
    number of failures before n transfers have succeeded, a negative binomial:
    :math:`p_d = \binom{n + d - 1}{d} (1 - c)^n c^d`.

    Parameters
    ----------
    transfers : array_like, shape (...)
        Number n of transfers, at least 1.
    cti : float
        Inefficiency c of one transfer, from 0 to below 1.

    Returns
    -------
    shares : ndarray, shape (LATEST + 1, ...)
        Fractions by delay; their sum is 1 up to the neglected delays.

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
    """Transfer a frame along an axis: its first packet once, the second twice, and so on.

    Parameters
    ----------
    frame : ndarray
        Charge in readout order [e-]; not changed.
    cti : float
        Inefficiency of one transfer; 0 returns the frame itself.
    axis : int
        Axis of the transfers.

    Returns
    -------
    frame : ndarray, same shape and type
        Charge as it is read; packets after the last one are lost.
    """
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
    """Give the fraction of a flat's level in the k-th packet after the last one with light.

    Parameters
    ----------
    k : ndarray
        Number of the packet, from 1.
    packets, before : ndarray
        Number of packets with light, and of packets without light that are read before them.
    cti : float
        Inefficiency of one transfer.

    Returns
    -------
    fraction : ndarray
    """
    out = np.zeros(np.broadcast_shapes(k.shape, packets.shape))
    for late in range(1, LATEST + 1):
        transfers = before + packets + k - late
        here = (k <= late) & (late < k + packets)
        out += np.where(here, late_shares(np.maximum(transfers, 1), cti)[late], 0.0)
    return out


def trail_covariances(c: FloatArray, share: FloatArray, axis: int) -> FloatArray:
    """Covariances after the fraction ``share`` of each pixel moved to the next, to first order."""
    part = share.reshape(-1, *(1,) * (c.ndim - 1))
    return np.asarray(c + part * (np.roll(c, 1, axis) + np.roll(c, -1, axis) - 2 * c))


def trail_image(
    images: FloatArray, share: float, backwards: float, axis: int
) -> FloatArray:
    """Images after the fraction ``share`` of each pixel moved to the pixel read next.

    ``backwards`` is the fraction of the images whose pixels are read in falling order.
    """
    later = (1 - backwards) * np.roll(images, 1, axis) + backwards * np.roll(
        images, -1, axis
    )
    return np.asarray(images + share * (later - images))
