"""Charge transfer inefficiency: which part of a packet arrives late, and how late."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import circulant
from scipy.signal import lfilter

from bfsensor.effects.effect import Axes, Effect, Image, Layout, Parameter
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


PIVOT = 5e4
"""Signal [e-] at which the parameter ``cti`` of traps is the fraction lost per transfer.

Chosen: the middle of usual ladders of flats, so that errors of ``cti`` and of the power of the
signal are nearly independent; the predictions do not depend on it."""

TRAPS = (
    Parameter("cti", "", 1e-7, 5e-6, amplitude=True),
    Parameter("power", "", 0.2, 1.2, law="flat", ends=(0.0, np.inf)),
    Parameter("tau", "packets", 0.3, 10.0),
)
"""Parameters of traps of one kind.  Ranges: those of the plain law; powers from 0.3 to 1 are
published (Massey et al. 2014 fit 0.48 to 0.58 to HST; 1 is proportional), a margin is added."""

SLOWER = (
    Parameter("slow", "", 0.02, 0.98, law="flat", ends=(0.0, 1.0)),
    Parameter("slow_tau", "packets", 2.0, 40.0),
)
"""Parameters of traps of a second kind: part of the late charge, and their release time.  Ranges
assumed: from a fiftieth of the charge, released within 2 to 40 packets; twice as long, the charge
leaves the overscans that are measured."""


class Traps(Effect):
    r"""Traps in every stage of a register: the loss grows with a power of the packet, and lasts.

    A packet of S electrons that had n transfers lacks
    :math:`D = n\, c\, S\, (S/S_0)^{p-1}` electrons, S_0 = :data:`PIVOT`; they arrive in the packets
    behind it, :math:`(1 - e^{-1/\tau})\, e^{-(d-1)/\tau}` of them d packets late.  The plain law,
    one packet late and proportional, is the limit p = 1 and tau = 0.  Subclasses choose the axis.
    """

    stage = "shift"
    axis: ClassVar[int] = 1
    """Axis of the frame along which packets move: 1 for rows, 0 for columns."""

    def _species(self) -> list[tuple[float, float]]:
        """Parts of the late charge, and what is left of each after a packet has passed."""
        parts = [(1.0, self["tau"])]
        if "slow" in self.values:
            slow = self["slow"]
            parts = [(1 - slow, self["tau"]), (slow, self["slow_tau"])]
        return [(part, float(np.exp(-1 / tau))) for part, tau in parts]

    def _released(self, late: NDArray[Any]) -> FloatArray:
        """Fraction of the late charge that is released exactly ``late`` packets late, from 1."""
        return np.asarray(
            sum(p * (1 - keep) * keep ** (late - 1.0) for p, keep in self._species())
        )

    def _lost(self, charge: NDArray[Any]) -> FloatArray:
        """Charge that one transfer of a packet leaves to later packets [e-]."""
        full = np.maximum(np.asarray(charge, float), 0.0) / PIVOT
        return np.asarray(self["cti"] * PIVOT * full ** self["power"])

    def _moved(self, images: NDArray[Any], transfers: FloatArray | float) -> FloatArray:
        """Lines along the last axis, first packet first, after ``transfers`` of each packet."""
        lost = self._lost(images) * transfers
        out = np.asarray(images - lost, float)
        for part, keep in self._species():
            out += lfilter([0.0, part * (1 - keep)], [1.0, -keep], lost)
        return out

    def _lit(self, layout: Layout, amp: NDArray[Any]) -> tuple[FloatArray, FloatArray]:
        """Packets with light, and packets read before them, by amplifier."""
        if self.axis == 0:
            rows = layout.of_amp("rows", amp)
            return rows, np.zeros_like(rows)
        return layout.of_amp("columns", amp), layout.of_amp("prescan", amp)

    def _mean_transfers(self, layout: Layout) -> float:
        """Mean number of transfers of the pixels of all amplifiers."""
        lit, before = self._lit(layout, np.arange(len(layout.segments)))
        return float(np.mean(before + (lit + 1) / 2))

    def shift(self, frame: Image, amp: int, layout: Layout) -> Image:
        if self["cti"] == 0:
            return frame
        lines = np.moveaxis(frame, self.axis, -1)
        moved = self._moved(lines, np.arange(1.0, lines.shape[-1] + 1))
        return np.moveaxis(moved, -1, self.axis).astype(frame.dtype)

    def _overscan(self, axes: Axes, layout: Layout) -> FloatArray:
        lit, before = self._lit(layout, axes["amp"])
        # All packets with light leave charge in the k-th one behind them: the last one most.
        left = sum(part * keep ** (axes["k"] - 1.0) for part, keep in self._species())
        return np.asarray(self._lost(axes["level"]) * (before + lit) * left)

    def covariances(self, c: FloatArray, axes: Axes, layout: Layout) -> FloatArray:
        lit, before = self._lit(layout, axes["amp"])
        # A fluctuation is delayed by the derivative of the loss.
        part = self["power"] * self._lost(axes["level"]) / np.maximum(axes["level"], 1.0)
        part = (part * (before + (lit + 1) / 2)).reshape(-1, 1, 1)
        size = c.shape[self.axis - 2]
        lags = np.arange(1, size // 2)
        late = np.zeros(size)
        late[lags] = self._released(lags)
        moved = circulant(late + np.roll(late[::-1], 1))
        moved[np.diag_indices(size)] -= 2
        return np.asarray(c + part * (c @ moved if self.axis else moved @ c))

    def spot_image(
        self, images: FloatArray, axes: Mapping[str, float], layout: Layout
    ) -> FloatArray:
        if self["cti"] == 0:
            return images
        level = axes.get("background", 0.0) * images.sum((-2, -1), keepdims=True)
        lines = np.moveaxis(np.maximum(images + level, 0.0), self.axis - 2, -1)
        mean = self._mean_transfers(layout)
        # The light beside the image leaves charge in it, too: only the change against it counts.
        flat = np.moveaxis(np.broadcast_to(level, images.shape), self.axis - 2, -1)
        one = self._moved(lines, mean) - self._moved(flat, mean)
        two = (self._moved(lines[..., ::-1], mean) - self._moved(flat[..., ::-1], mean))[
            ..., ::-1
        ]
        share = layout.backwards("x" if self.axis else "y")
        return np.asarray(np.moveaxis((1 - share) * one + share * two, -1, self.axis - 2))
