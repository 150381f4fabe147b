"""Detection of full well in flats (photon-transfer turn-off): the level where variance collapses."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bfsensor.diagnose.data.channels import PER_ELECTRON, Channel

COLLAPSED = 0.5
"""Variance over that expected from fainter flats below which pixels are full.  Chosen, to be
derived: the brighter-fatter effect takes a fifth at most at a full well of 1e5 e-; with 1 every
flat with that effect would count as full."""

WEAK = 0.4
"""Part of the levels, the lowest, whose median of variance over level is the expected one.
Chosen, to be derived: with 0.8 levels at full well may be among them, and make the expected
variance too low."""

NEARLY = 0.8
"""Part of the full well that the peak of a spot may reach to be fitted.  Chosen, to be derived: the
peak is estimated as flux / (2 pi sigma_x sigma_y); with 1.6 spots with full pixels would be
fitted."""


class TurnOff(NamedTuple):
    """Level of each amplifier at which the variance of flats collapses.

    Attributes
    ----------
    levels : dict of int to float
        Lowest level whose variance has collapsed, by amplifier [ADU].
    electrons : float
        The lowest of them [e-], by the gain from the faintest levels.
    """

    levels: dict[int, float]
    electrons: float

    @property
    def said(self) -> str:
        """Sentence for the report."""
        lowest = min(self.levels.values())
        return (
            f"the variance of flats collapses at {lowest:.0f} ADU (near {self.electrons:.3g} e-): "
            "the baseline is fitted to fainter flats and spots, and compared with all"
        )


def find_turn_off(channels: Sequence[Channel]) -> TurnOff | None:
    """Find the level at which the variance of flats collapses.

    Parameters
    ----------
    channels : sequence of Channel
        Measured channels, of which 'flat_cov' is used.

    Returns
    -------
    TurnOff or None
        None if the variance collapses in no amplifier.
    """
    levels: dict[int, float] = {}
    electrons = np.inf
    for channel in channels:
        if channel.word != "flat_cov" or channel.unit == PER_ELECTRON:
            continue
        x = channel.axes
        for amp in np.unique(x["amp"]):
            here = (x["i"] == 0) & (x["j"] == 0) & (x["amp"] == amp)
            level, variance = x["level"][here], channel.values[here]
            weak = level <= np.quantile(level, WEAK)
            ratio = float(np.median(variance[weak] / level[weak]))
            full = ~weak & (variance < COLLAPSED * ratio * level)
            if full.any() and ratio > 0:
                lowest = float(level[full].min())
                key = int(amp)
                levels[key] = min(levels.get(key, np.inf), lowest)
                electrons = min(electrons, lowest / ratio)
    return TurnOff(levels, float(electrons)) if levels else None


def below(channels: Sequence[Channel], off: TurnOff) -> list[Channel]:
    """Channels without the flats and spots that reach full well."""
    return [c.take(_faint(c, off)) for c in channels]


def _faint(channel: Channel, off: TurnOff) -> NDArray[np.bool_]:
    x = channel.axes
    keep = np.ones(len(channel), bool)
    if channel.word in ("flat_cov", "flat_mean") and "level" in x:
        ends = np.array([off.levels.get(int(a), np.inf) for a in x["amp"]])
        # Chosen: just below full well part of the pixels are full; 3 % are a few standard
        # deviations of a pixel at 1e4 e- and more.
        keep = x["level"] < 0.97 * ends
    elif channel.word == "spot":
        narrow = [channel.values[x["what"] == f"sigma_{d}"] for d in "xy"]
        width = float(np.prod([v.min() for v in narrow if v.size]))
        keep = x["flux"] / (2 * np.pi * width) < NEARLY * off.electrons
    return keep
