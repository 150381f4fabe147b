"""Charge arrives in steps of an exposure, while the charge already stored moves the pixels' edges.

In one step of length dt the light of brightness L arrives.  Every edge stands ``d`` pixels away
from its nominal place: fixed patterns plus the sum over all charges of shift per electron times
charge.  Light between the nominal and the moved edge changes sides,

    flow = dt (F d + G d^2 / 2),        F, G: brightness and its slope across the edge,

and what leaves one pixel enters the next, so that the sum over the sensor stays as it was.  The
step's electrons are Poisson with these means.

The scheme is of second order in dt.  Edges follow the charge predicted for the middle of the step.
The *fluctuation* of a step's own electrons moves edges during the second half of that step; this
half is added to the source of the next step (and once more after the last one), where the light is
the same.  Without it covariances would be low by 1/steps.  `tests/validation/test_foreign.py`
holds means and covariances against twice as many steps and against the closed form
P = (exp(2 a mu) - 1) / (2 a) of the linear-noise limit (Astier et al. 2019, eq. 16 ff.).

The sensor continues periodically, but for the smooth shape of the charge: light that falls towards
the sensor's rims makes no step there.  No edge of the sensor is modelled here.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft2, rfft2
from scipy.special import ndtr

Image = NDArray[np.float32]

GAUSS_FROM = 16.0
"""Mean [e-] from which Poisson numbers are drawn as a normal one with the Poisson's skewness.

The draw mean + sqrt(mean - 1/18) z + (z^2 - 1) / 6 has the right mean and variance and, to order
1/mean, the right third moment.  Below, the same normal number is turned into a uniform one and
Poisson's distribution inverted, so that each pixel uses one random number whatever its mean.
Chosen: at twice this mean spot images take 5 % longer, and no moment above changes.
"""

ELECTRONS_PER_STEP = 3000.0
"""Mean electrons of the brightest light in one step.

Chosen: at 1.2e5 e- (40 steps, a_00 = -3.6e-6/e-) the variance is off by -0.02 %, C_01 and C_10 by
+0.08 %; with twice as many electrons in a step four times as much.  Derived from the scheme's own
recursion of second moments, mode by mode, against the closed form.  By 6000 the mean change of
brighter-fatter covariances with charge was off by half a standard deviation in 119 nulls.
"""

FEWEST_STEPS = 6

SMOOTHEST = 6
"""Largest order in x and y together of the polynomial that makes no shifts.

Chosen: vignetting of fourth order on light with a slope is of fifth; twice as many orders would hold
patterns of a sixth of the sensor's side, whose shifts are 1e-3 of their own charge's.
"""


class Term(NamedTuple):
    """A part of the edges' law: shifts per electron, and the charge that they answer to.

    ``source`` is None for the stored charge itself.
    """

    kx: NDArray[np.float64]
    ky: NDArray[np.float64]
    source: Callable[[Image], Image] | None = None


@dataclass
class Light:
    """What falls on the sensor in one exposure.

    Attributes
    ----------
    rate : ndarray, shape (ny, nx)
        Mean electrons per second in each nominal pixel.
    across_x, across_y : ndarray
        Brightness at each pixel's right and upper edge [e-/s per pixel of shift].
    slope_x, slope_y : ndarray or None
        Change of that brightness with the distance across the edge, for sharp images.
    seconds : float or ndarray
        Time that the light is on, maybe by pixel.
    """

    rate: Image
    across_x: Image
    across_y: Image
    slope_x: Image | None = None
    slope_y: Image | None = None
    seconds: float | Image = 1.0

    @classmethod
    def smooth(cls, rate: Image, seconds: float) -> Light:
        """Light that changes little from pixel to pixel: edges see the mean of their neighbours."""
        across_x = 0.5 * (rate + np.roll(rate, -1, 1))
        across_y = 0.5 * (rate + np.roll(rate, -1, 0))
        return cls(rate, across_x, across_y, None, None, seconds)

    def scaled(self, factor: Image) -> Light:
        """The same light times a map of response, taken at the edges as the mean of neighbours."""
        factor = np.asarray(factor, np.float32)
        fx = 0.5 * (factor + np.roll(factor, -1, 1))
        fy = 0.5 * (factor + np.roll(factor, -1, 0))
        return Light(
            self.rate * factor,
            self.across_x * fx,
            self.across_y * fy,
            None if self.slope_x is None else self.slope_x * fx,
            None if self.slope_y is None else self.slope_y * fy,
            self.seconds,
        )

    def plus(self, rate: Image) -> Light:
        """Add a smooth light [e-/s] to it."""
        more = Light.smooth(np.asarray(rate, np.float32), 1.0)
        return Light(
            self.rate + more.rate,
            self.across_x + more.across_x,
            self.across_y + more.across_y,
            self.slope_x,
            self.slope_y,
            self.seconds,
        )


@dataclass
class Edges:
    """Law by which charge moves edges, with fixed shifts added; all in pixels.

    Attributes
    ----------
    terms : sequence of Term
        Summed.
    fixed_x, fixed_y : ndarray or None
        Shift of right and upper edges that does not depend on charge.
    modulation : callable, optional
        Takes (dx, dy, charge) and returns what the charge's shifts really are; for odd laws.
    """

    shape: tuple[int, int]
    terms: Sequence[Term]
    fixed_x: Image | None = None
    fixed_y: Image | None = None
    modulation: Callable[[Image, Image, Image], tuple[Image, Image]] | None = None
    _spectra: list = field(default_factory=list, repr=False)

    def __post_init__(self) -> None:
        for term in self.terms:
            self._spectra.append(
                (spectrum(term.kx, self.shape), spectrum(term.ky, self.shape), term.source)
            )

    def shifts(self, charge: Image) -> tuple[Image, Image]:
        """Shifts [pixel] that stored charge [e-] causes, without the fixed ones."""
        dx = dy = None
        for hat_x, hat_y, source in self._spectra:
            q = rfft2(without_shape(charge if source is None else source(charge)))
            x = irfft2(q * hat_x, s=self.shape, overwrite_x=True)
            y = irfft2(q * hat_y, s=self.shape, overwrite_x=True)
            dx, dy = (x, y) if dx is None else (dx + x, dy + y)
        if self.modulation is not None:
            dx, dy = self.modulation(dx, dy, charge)
        return dx, dy


def without_shape(charge: Image) -> Image:
    """Charge less its polynomial of least squares up to order :data:`SMOOTHEST`.

    Shifts by so long waves are negligible, but for steps at the rims of a periodic sensor.

    Examples
    --------
    >>> y, x = np.mgrid[0:32, 0:24].astype(np.float32) / 32
    >>> bool(np.abs(without_shape(3 * x - y**4 + 5)).max() < 1e-5)
    True
    """
    up, across = (_polynomials(n) for n in charge.shape)
    order = np.add.outer(np.arange(up.shape[1]), np.arange(across.shape[1]))
    size = np.where(order <= SMOOTHEST, up.T @ charge @ across, np.float32(0))
    return charge - up @ size @ across.T


@cache
def _polynomials(n: int) -> NDArray[np.float32]:
    """Orthonormal polynomials on n pixels, shape (n, orders)."""
    x = np.linspace(-1, 1, n)
    orders = np.arange(min(SMOOTHEST + 1, n))
    return np.linalg.qr(x[:, None] ** orders)[0].astype(np.float32)


_SPECTRA: dict = {}


def spectrum(kernel: NDArray, shape: tuple[int, int]) -> NDArray:
    """Transform of a kernel whose middle is the origin, on a periodic sensor; kept by content."""
    key = (kernel.tobytes(), shape)
    if key not in _SPECTRA:
        if len(_SPECTRA) > 64:
            _SPECTRA.clear()
        frame = np.zeros(shape, np.float64)
        half = kernel.shape[0] // 2
        for j, row in enumerate(kernel):
            for i in np.flatnonzero(row):
                frame[(j - half) % shape[0], (i - half) % shape[1]] += row[i]
        _SPECTRA[key] = rfft2(frame).astype(np.complex64)
    return _SPECTRA[key]


def poisson(mean: Image, rng: np.random.Generator) -> Image:
    """Draw Poisson numbers; above :data:`GAUSS_FROM` by a normal number with the same skewness.

    Examples
    --------
    >>> n = poisson(np.full((200, 200), 900.0, np.float32), np.random.default_rng(3))
    >>> bool(abs(n.mean() - 900) < 0.6), bool(abs(n.var() / 900 - 1) < 0.03)
    (True, True)
    """
    z = rng.standard_normal(mean.shape, np.float32)
    n = mean + np.sqrt(np.maximum(mean - np.float32(1 / 18), 0)) * z
    n += (z * z - 1) * np.float32(1 / 6)
    low = mean < GAUSS_FROM
    if low.any():
        n[low] = _inverted(np.maximum(mean[low], 0).astype(np.float64), ndtr(z[low]))
    return n


def _inverted(mean: NDArray, uniform: NDArray) -> NDArray:
    """Smallest numbers whose cumulative Poisson probability reaches a uniform number."""
    out = np.zeros(mean.shape)
    probability = np.exp(-mean)
    total = probability.copy()
    at = np.flatnonzero(uniform > total)
    k = 0
    while at.size and k < 80:
        k += 1
        probability[at] *= mean[at] / k
        total[at] += probability[at]
        out[at] = k
        at = at[uniform[at] > total[at]]
    return out


def divergence(flow_x: Image, flow_y: Image) -> Image:
    """What pixels gain when light crosses their right and upper edges; sums to zero."""
    out = flow_x + flow_y
    out[:, 1:] -= flow_x[:, :-1]
    out[:, 0] -= flow_x[:, -1]
    out[1:] -= flow_y[:-1]
    out[0] -= flow_y[-1]
    return out


def steps_for(light: Light, most: int = 48) -> int:
    """Number of steps that keeps a step's brightest mean below :data:`ELECTRONS_PER_STEP`."""
    # the brightest pixels but for single hot ones
    peak = float(np.quantile(light.rate[::4, ::4], 0.98)) * float(np.mean(light.seconds))
    peak = max(peak, 0.25 * float(light.rate.max()) * float(np.mean(light.seconds)))
    return int(np.clip(np.ceil(peak / ELECTRONS_PER_STEP), FEWEST_STEPS, most))


def collect(
    light: Light,
    edges: Edges,
    rng: np.random.Generator,
    *,
    efficiency: Callable[[Image], Image] | None = None,
    steps: int | None = None,
    noise: bool = True,
) -> Image:
    """Collect an exposure's charge.

    Parameters
    ----------
    light : Light
    edges : Edges
    rng : numpy Generator
    efficiency : callable, optional
        Fraction collected at a stored charge, pixel by pixel; 1 by default.
    steps : int, optional
        By default :func:`steps_for`.
    noise : bool
        False for the mean without Poisson noise.

    Returns
    -------
    charge : ndarray of float32, shape (ny, nx)
        Electrons stored in each pixel.

    Examples
    --------
    >>> from validation.foreign.device import Device, edge_shifts
    >>> edges = Edges((64, 64), [Term(*edge_shifts(Device(), 620))])
    >>> flat = Light.smooth(np.full((64, 64), 1000, np.float32), 50.0)
    >>> q = collect(flat, edges, np.random.default_rng(5))
    >>> bool(abs(q.mean() / 5e4 - 1) < 1e-3), bool(0.5 < q.var() / q.mean() < 0.9)
    (True, True)
    """
    steps = steps_for(light) if steps is None else steps
    dt = np.asarray(light.seconds, np.float32) / np.float32(steps)
    mean_light = light.rate * dt
    fx, fy = light.across_x * dt, light.across_y * dt
    sharp = light.slope_x is not None
    if sharp:
        gx, gy = 0.5 * light.slope_x * dt, 0.5 * light.slope_y * dt
    # light moved by fixed edges is the same in all steps
    fixed = edges.fixed_x is not None
    charge = np.zeros(edges.shape, np.float32)
    expected = mean_light
    excess: Image | None = None
    for _ in range(steps):
        ahead = charge + np.float32(0.5) * expected
        if excess is not None:
            ahead += np.float32(0.5) * excess
        dx, dy = edges.shifts(ahead)
        if fixed:
            dx, dy = dx + edges.fixed_x, dy + edges.fixed_y
        flow_x, flow_y = fx * dx, fy * dy
        if sharp:
            flow_x += gx * dx * dx
            flow_y += gy * dy * dy
        expected = mean_light + divergence(flow_x, flow_y)
        if efficiency is not None:
            expected = expected * efficiency(ahead)
        if noise:
            arrived = poisson(expected, rng)
            excess = arrived - expected
            charge += arrived
        else:
            charge += expected
    if noise and excess is not None:
        # a term with its own source answers to the charge as a whole: take the difference
        if all(t.source is None for t in edges.terms) and edges.modulation is None:
            dx, dy = edges.shifts(np.float32(0.5) * excess)
        else:
            x1, y1 = edges.shifts(charge)
            x0, y0 = edges.shifts(charge - np.float32(0.5) * excess)
            dx, dy = x1 - x0, y1 - y0
        charge += divergence(fx * dx, fy * dy)
    return charge
