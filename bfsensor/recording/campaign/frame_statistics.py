"""Levels, noise and pedestals of an exposure's amplifiers, and variances of pairs of flats."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class FrameStatistics:
    """Level, pedestal and noise of one amplifier in one exposure.

    Attributes
    ----------
    exposure : int
        Number of the exposure.
    amplifier : str
        Name of the amplifier.
    level : float
        Mean of the pixels within 5 sigma of the median in a box in the middle of the image,
        less the pedestal [ADU].
    pedestal : float
        Mean of the serial overscan [ADU]; without overscan the median level of the biases; nan
        without either.
    noise : float
        Standard deviation of the serial overscan [ADU]; nan without overscan.
    not_finite, saturated, top : float
        Fractions of the image's pixels, from 0 to 1, that are not finite, that are saturated,
        and that equal the largest finite value.
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
    """Level and variance of one amplifier in a pair of flats.

    Attributes
    ----------
    first, second : int
        Numbers of the exposures.
    amplifier : str
        Name of the amplifier.
    level : float
        Mean level of the two flats [ADU].
    variance : float
        Half the variance of the difference in a box in the middle of the image, of pixels
        within 5 sigma of its median [ADU^2]; nan with fewer than 100 pixels.
    pixels : int
        Number of pixels of the variance; 0 where it is nan.
    mismatch : float
        Difference of the second level from the first over their mean; 0 where it is below 5 ADU,
        which errors of the pedestals explain.
    """

    first: int
    second: int
    amplifier: str
    level: float
    variance: float
    pixels: int
    mismatch: float
