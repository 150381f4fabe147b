r"""Tree rings measured at eight wavelengths and two back biases, against rings of any depth.

Radial profiles of flats of LSST sensors, measured at BNL and published with imSim (BSD-3;
``SHARED/recordings/bnl_treerings``): ITL-098 at 400 to 950 nm, e2v-260 at 0 and 70 V.  GalSim's
and imSim's rings know neither wavelength nor back bias: they are the baseline.

The model.  A ripple of the doping of wave number k, the same at all heights, between gates and
back surface at fixed potentials, adds
:math:`\phi_k(z) \propto 1 - \cosh k(z - L/2) / \cosh(kL/2)`, whose transverse field pulls an electron
sideways while it drifts in the field E of the device:

.. math:: s_k(z) \propto \int_0^z \phi_k(z') / E(z')\, dz', \qquad
    A(\lambda) = \int p(z \mid f\, \ell(\lambda))\, s_k(z)\, dz,

with the absorption length :math:`\ell` of :mod:`bfsensor.device.silicon` and a factor f on it: 1 is
silicon at the card's temperature, 0 the baseline, all light converting at the back.  No ripple is
fitted: amplitudes of one band of periods are ratios of products of profiles.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq, minimize_scalar
from scipy.signal import butter, sosfiltfilt

from bfsensor.device import silicon
from bfsensor.device.device import Device
from bfsensor.sensor.drift_field import solve_drift

WAVELENGTHS = (400, 500, 550, 650, 700, 770, 800, 950)
PERIODS = 28.0, 90.0
"""Of the rings used [pixel]: longer ones are mixed with the light's shape, shorter with noise."""
RADII = 3000.0, 5820.0
"""From the wafer's centre [pixel]: rings are faint inside, the light falls off at the ends."""
PARTS = 16
"""Ranges of the radius; errors are from leaving each out in turn."""
REFERENCE = WAVELENGTHS.index(700)
START = 2.0
"""Height at which the drift ends in the wells [um]."""
STEP = 3.0
"""Of the published radii [pixel]."""
PITCH = 10.0
"""[um]"""

Values = NDArray[np.float64]


def read_profiles(folder: Path, names: Sequence[str]) -> Values:
    """Modulations [percent] within :data:`RADII`, shape (names, radii); all share their radii."""
    read = np.array([np.genfromtxt(folder / f"{n}_save_points.txt") for n in names])
    radius = read[0, :, 0]
    inside = (radius >= RADII[0]) & (radius <= RADII[1])
    return np.asarray(read[:, inside, 1])


def pass_rings(profiles: Values) -> Values:
    """Keep the band :data:`PERIODS` of profiles, without shift of phase."""
    x = np.linspace(-1, 1, profiles.shape[1])
    design = np.vander(x, 4)
    smooth = design @ np.linalg.lstsq(design, profiles.T, rcond=None)[0]
    edges = sorted(1 / np.array(PERIODS))
    filtered = butter(4, edges, "bandpass", fs=1 / STEP, output="sos")
    return np.asarray(sosfiltfilt(filtered, profiles - smooth.T, axis=1))


@dataclass(frozen=True)
class Amplitudes:
    """Amplitudes of the rings in profiles over that in one of them.

    Attributes
    ----------
    values : ndarray, shape (n,)
    covariance : ndarray, shape (n, n)
        From leaving out parts of the radius.
    wave_number : float
        Mean of the rings, weighted by their power [1/um].
    """

    values: Values
    covariance: Values
    wave_number: float

    @property
    def errors(self) -> Values:
        """Standard errors."""
        return np.sqrt(np.diag(self.covariance))


def measure_amplitudes(profiles: Values, reference: int) -> Amplitudes:
    """Measure the rings' amplitudes relative to a profile.

    Noise of profiles is independent, so that their products with a third keep the rings alone:
    for each profile the others' mean stands for the rings (for two profiles the reference
    itself, whose own noise makes the ratio a little too small).
    """
    rings = pass_rings(profiles)
    n = rings.shape[1] // PARTS
    parts = rings[:, : n * PARTS].reshape(len(rings), PARTS, n)
    products = np.einsum("ipx,jpx->pij", parts, parts)

    def ratios(power: Values) -> Values:
        out = []
        for k in range(len(power)):
            by = [m for m in range(len(power)) if m not in (k, reference)] or [reference]
            out.append(power[k, by].sum() / power[reference, by].sum())
        return np.array(out)

    left_out = np.array([ratios(products.sum(0) - one) for one in products])
    off = left_out - left_out.mean(0)
    power = np.abs(np.fft.rfft(rings[reference])) ** 2
    mean = float((power * np.fft.rfftfreq(rings.shape[1], STEP)).sum() / power.sum())
    return Amplitudes(
        ratios(products.sum(0)), (PARTS - 1) / PARTS * off.T @ off, 2 * np.pi * mean / PITCH
    )


def drift_field(device: Device) -> tuple[Values, Values]:
    """Heights [um] and the drift field there, averaged over a pixel [V/um]."""
    drift = solve_drift(device.to_toml(), device.operating_point.temperature, START)
    return drift.heights, drift.field


def shift_by_height(height: Values, field: Values, wave_number: float) -> Values:
    """What a ripple shifts an electron that converts at each height [arbitrary, common to all].

    Raises no error where the field turns round: electrons from above that height are shifted
    without limit (inf), for they do not drift to the gates.
    """
    half = 0.5 * height[-1]
    pull = 1 - np.cosh(wave_number * (height - half)) / np.cosh(wave_number * half)
    drifts = (height >= START) & (np.cumprod((field > 0) | (height < START)) > 0)
    # Below the start of the drift the wells' own field takes over.
    product = np.where(drifts, pull / np.where(drifts, field, 1.0), 0.0)
    shift = np.concatenate(
        [[0.0], np.cumsum(0.5 * height[1] * (product[1:] + product[:-1]))]
    )
    return np.where((height < START) | drifts, shift, np.inf)


def mean_shift(height: Values, shift: Values, length: float) -> float:
    """Mean shift of light that enters at the back, passes once, and is absorbed over a length [um]."""
    if length <= 0:
        return float(shift[-1])
    depth = np.linspace(0.0, height[-1], 20001)
    light = np.exp(-depth / length)
    return float(np.interp(height[-1] - depth, height, shift) @ light / light.sum())


def relative_shifts(
    field: Values, height: Values, wave_number: float, factor: float, temperature: float
) -> Values:
    """Amplitudes at :data:`WAVELENGTHS` over that at :data:`REFERENCE`."""
    shift = shift_by_height(height, field, wave_number)
    lengths = factor * silicon.absorption_length(np.array(WAVELENGTHS, float), temperature)
    every = np.array([mean_shift(height, shift, float(v)) for v in lengths])
    return np.asarray(every / every[REFERENCE])


@dataclass(frozen=True)
class DepthFit:
    """Factor on the absorption length that amplitudes ask for, in one drift field.

    Attributes
    ----------
    factor, error : float
        1 is silicon's at the card's temperature, 0 achromatic rings.
    chi2 : mapping of str to float
        'achromatic', 'silicon' (factor 1) and 'fitted', of the values other than the reference.
    predicted : ndarray
        Amplitudes by the fitted factor.
    """

    factor: float
    error: float
    chi2: dict[str, float]
    predicted: Values


def fit_depths(
    found: Amplitudes, device: Device, *, without: int | None = None
) -> dict[str, DepthFit]:
    """Fit the factor in the card's drift field ('card') and in an even one ('even field').

    Errors of amplitudes are taken as independent, though all share the reference's rings.
    """
    height, field = drift_field(device)
    temperature = device.operating_point.temperature
    use = [n for n in range(len(WAVELENGTHS)) if n not in (REFERENCE, without)]

    def one(own: Values) -> DepthFit:
        def chi2(factor: float) -> float:
            model = relative_shifts(own, height, found.wave_number, factor, temperature)
            return float((((found.values - model)[use] / found.errors[use]) ** 2).sum())

        best = minimize_scalar(
            chi2, bounds=(0.2, 3.0), method="bounded", options={"xatol": 1e-3}
        )
        f, least = float(best.x), float(best.fun)
        bend = (chi2(f + 0.05) + chi2(f - 0.05) - 2 * least) / 0.05**2
        told = {"achromatic": chi2(0.0), "silicon": chi2(1.0), "fitted": least}
        model = relative_shifts(own, height, found.wave_number, f, temperature)
        return DepthFit(f, float(np.sqrt(2 / bend)), told, model)

    return {"card": one(field), "even field": one(np.ones_like(height))}


def temperatures(found: Amplitudes, device: Device) -> tuple[float, float, float]:
    """Temperatures [K] at which silicon's own length fits: within 1 of the least, and the best."""
    height, field = drift_field(device)
    use = [n for n in range(len(WAVELENGTHS)) if n != REFERENCE]
    grid = np.arange(150.0, 320.0, 2.0)
    chi2 = np.array([
        float((((found.values - relative_shifts(field, height, found.wave_number, 1.0, t))
                / np.maximum(found.errors, 1e-9))[use] ** 2).sum())
        for t in grid
    ])  # fmt: skip
    good = grid[chi2 < chi2.min() + 1]
    return float(good.min()), float(good.max()), float(grid[np.argmin(chi2)])


def field_slope(doping: float) -> float:
    """Change of the field [V/um] by 1 um in silicon of so many acceptors [1e12 / cm^3]."""
    charge, permittivity = 1.602e-19, 11.7 * 8.854e-12
    return charge * doping * 1e18 / permittivity * 1e-12


def bias_law(
    bias: Values, volts: float, doping: float, wave_number: float, thickness: float = 100.0
) -> Values:
    """Shift of light from the back surface at each back bias [V, positive], arbitrary unit."""
    z = np.linspace(0.0, thickness, 257)
    bent = field_slope(doping) * (0.5 * thickness - z)
    fields = ((v + volts) / thickness + bent for v in bias)
    return np.array([float(shift_by_height(z, f, wave_number)[-1]) for f in fields])


def volts_of_gates(
    ratio: float, error: float, doping: float, wave_number: float, thickness: float = 100.0
) -> tuple[float, float]:
    r"""Volts that gates add to the back bias, for a ratio of the rings at 70 V to those at 0 V.

    In the field :math:`(V + V_0) / L + (q N / \epsilon)(L/2 - z)` of evenly doped silicon.

    Parameters
    ----------
    ratio, error : float
        Measured.
    doping : float
        Acceptors [1e12 / cm^3].
    wave_number : float
        Of the rings [1/um].
    thickness : float
        [um]
    """

    def of(volts: float) -> float:
        ends = bias_law(np.array([0.0, 70.0]), volts, doping, wave_number, thickness)
        return float(ends[1] / ends[0])

    # Below this the silicon is not depleted without bias.
    low = field_slope(doping) * thickness**2 / 2 * 1.001 + 1e-3
    found = [
        float(brentq(lambda v, r=r: of(v) - r, low, 80.0)) for r in (ratio, ratio + error)
    ]
    return found[0], found[1] - found[0]
