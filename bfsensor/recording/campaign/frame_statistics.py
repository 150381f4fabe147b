"""Levels, noise and pedestals of an exposure's amplifiers, and variances of pairs of flats."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class FrameStatistics:
    """One amplifier in one exposure.

    Attributes
    ----------
    exposure, amplifier : int, str
        Which.
    level : float
        Mean of the box in the middle, cut at 5 sigma, above the pedestal [ADU].
    pedestal, noise : float
        Mean of the serial overscan and the scatter in it [ADU]; without overscan the biases'
        mean, and no scatter; nan without either.
    not_finite, saturated, top : float
        Shares of the image's pixels: not finite, saturated, and equal to the largest one.
    """

    exposure: int
    amplifier: str
    level: float
    pedestal: float
    noise: float
    not_finite: float
    saturated: float
    top: float


@dataclass(frozen=True)
class PairStatistics:
    """One amplifier in a pair of flats.

    Attributes
    ----------
    first, second : int
        Numbers of the exposures.
    amplifier : str
        Which.
    level : float
        Mean of both [ADU].
    variance : float
        Half the variance of the difference in the box, cut at 5 sigma [ADU^2].
    pixels : int
        Used.
    mismatch : float
        Relative difference of the two levels.
    """

    first: int
    second: int
    amplifier: str
    level: float
    variance: float
    pixels: int
    mismatch: float
