"""Boundary shifts that fall off more slowly with distance than the electrostatic baseline's."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from bfsensor.effects.effect import Effect, Layout, Parameter, Seen, Shot
from bfsensor.typing import Edges, FloatArray

REACH = 30
"""Largest lag [pixel] at which areas change.

Chosen: at power 2, twice as large, the sum of all area gains, and with it the loss of the central
pixel, grows by 2 pi ln 2 = 4.4 ``amp``, a fifth of it."""


class BrighterFatterLongRange(Effect):
    r"""Each electron adds to the relative area at r pixels from it a power times an exponential.

    .. math:: \mathrm{amp}\; r^{-p}\; e^{-(r - 1) n}

    ``power`` p and ``near`` n: 2 and 0 for an inverse square, 0 and 1 over the length for an
    exponential, as of a field that an undepleted layer screens.
    The pixel that holds the charge loses the area that the others, up to 30 pixels away, gain.
    The shifts are the gradient of a potential on the lattice: they have no curl.

    Parameters
    ----------
    values : mapping of str to float
        Plausible ranges: ``amp`` [1/e-]: 5e-09 to 1e-07 (0 changes nothing); ``power``: 0 to 3;
        ``near`` [1/pixel]: 0 to 1.

    Examples
    --------
    >>> BrighterFatterLongRange({"amp": 2e-08, "power": 2.0}).law_name
    'power'
    """

    word = "bf_long_range"
    stage = "collect"
    parameters = (
        Parameter("amp", "1/e-", 5e-9, 1e-7, amplitude=True),
        Parameter("power", "", 0.0, 3.0, law="flat"),
        Parameter("near", "1/pixel", 0.0, 1.0, law="flat", plain=0.0, ends=(0.0, np.inf)),
    )
    touches = ("flat_cov", "spot")
    source = (
        "What is left far out where the back plane's image or the thickness are wrong: Rasmussen et al. "
        "2016; field of a charge between planes: Astier & Regnault 2023, A&A 670, A118; through an "
        "undepleted layer: Holland et al. 2014, JINST 9, C03057; range assumed"
    )

    @property
    def law_name(self) -> str:
        """'exponential' if at ten pixels the exponential has cut the tail more than the power has."""
        return "exponential" if 9 * self["near"] > self["power"] * np.log(10.0) else "power"

    @classmethod
    def starts(cls, layout: Layout, seen: Sequence[Seen] = ()) -> list[dict[str, float]]:
        return [
            {"amp": 2e-8, "power": power, "near": near}
            for power, near in ((1.7, 0.0), (2.3, 0.0), (0.0, 0.15), (0.0, 0.4))
        ]

    def edges(self, kx: FloatArray, ky: FloatArray, shot: Shot, layout: Layout) -> Edges:
        del shot
        if self["amp"] == 0.0:
            return kx, ky
        # At most half of a small sensor: farther, a charge would act on itself around the rim.
        half = max(min(REACH, min(layout.shape) // 2 - 2), kx.shape[0] // 2)
        moved = []
        for old, new in zip(
            (kx, ky), shifts_of_tail(self["power"], half, self["near"]), strict=True
        ):
            margin = half - old.shape[0] // 2
            moved.append(np.pad(old, margin) + self["amp"] * new)
        return moved[0], moved[1]


@lru_cache(maxsize=32)
def shifts_of_tail(power: float, reach: int, near: float = 0.0) -> Edges:
    """Shifts of right and upper edges that make areas grow by r^-power exp(-(r - 1) near).

    Charge is conserved.

    Parameters
    ----------
    power : float
        Power of the distance.
    reach : int
        Largest lag in x and y [pixel].
    near : float
        Inverse length of the exponential [1/pixel].

    Returns
    -------
    kx, ky : ndarray, shape (2 reach + 1, 2 reach + 1)
        Shifts [pixel for an area change of 1 at distance 1], row dy, column dx.  Edges beyond do
        not move, which changes areas at the outermost lags only.
    """
    lag = np.arange(-reach, reach + 1)
    r = np.hypot(lag, lag[:, None])
    # The pixel itself loses what all others gain.
    r[reach, reach] = 1.0
    area = r**-power * np.exp(-near * (r - 1))
    area[reach, reach] = 0.0
    area[reach, reach] = -area.sum()
    # Shifts are differences of a potential whose lattice Laplacian is the area change.  The
    # lattice is periodic, and twice as wide so that its images lie beyond the part that is kept.
    side = 4 * (reach + 1)
    turn = 2 * np.pi * np.fft.fftfreq(side)
    modes = 2 * np.cos(turn) + 2 * np.cos(turn)[:, None] - 4
    # The mean of a potential moves nothing.
    modes[0, 0] = 1.0
    spectrum = np.fft.fft2(area, s=(side, side)) / modes
    potential = np.fft.ifft2(spectrum).real
    kept = np.s_[: 2 * reach + 1, : 2 * reach + 1]
    kx = (np.roll(potential, -1, 1) - potential)[kept]
    ky = (np.roll(potential, -1, 0) - potential)[kept]
    for shifts in (kx, ky):
        shifts.flags.writeable = False
    return kx, ky
