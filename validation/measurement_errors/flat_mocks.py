"""Mock flats with known a, b, noise and gain, and what the measurement returns of them.

``python -m validation.measurement_errors.flat_mocks [--kind fields|pixels|both] [--mocks N]`` makes
campaigns of flat pairs, measures and fits them with ``bfsensor.measure``, and writes a row for each
parameter to ``validation/results/flat_mocks.ecsv``: truth, mean, scatter, stated error,
pulls, and how often the truth lies within 1 and 1.96 stated errors.  The pulls of every mock are
in ``validation/results/flat_pulls.ecsv``, one row a mock, one column a parameter.

Neither kind of mock shares the fit's series in the level.  ``fields``: Gaussian flats whose
spectrum is the integral of dC/dm = 1 + 2 (a + c m) C, mode by mode, by quadrature.
``pixels``: every pixel collects Poisson numbers step by step, about areas that follow the
charge collected so far; the mean level is all that is put in by hand.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from astropy.table import Table, vstack
from numpy.typing import NDArray
from scipy.fft import irfft2, rfft2

from bfsensor.measure.bartlett import image_weights, unfold
from bfsensor.measure.covariance_fit import CovarianceFit, fit_covariances
from bfsensor.measure.curve import CovarianceCurve, measure_curve
from validation.common.write_results import write_results

RESULTS = Path(__file__).parents[1] / "results" / "flat_mocks.ecsv"
PULLS = "flat_pulls.ecsv"
COMMAND = "python -m validation.measurement_errors.flat_mocks"


@dataclass(frozen=True)
class Truth:
    """A sensor: a [1/e-] and b [1/e-] by lag [j, i], white noise [e-], gain [e-/ADU]."""

    a: NDArray[np.float64]
    b: NDArray[np.float64]
    noise: float = 6.0
    gain: float = 1.4
    levels: NDArray[np.float64] = field(
        default_factory=lambda: np.repeat(np.geomspace(2e3, 1.2e5, 15), 2)
    )

    @property
    def c(self) -> NDArray[np.float64]:
        """Product c = a b [1/e-^2]."""
        return self.a * self.b

    def noise_matrix(self, quantised: bool) -> NDArray[np.float64]:
        """Covariance of the noise [e-^2], with that of whole ADU where rounded."""
        out = np.zeros_like(self.a)
        out[0, 0] = self.noise**2 + (self.gain**2 / 12 if quantised else 0.0)
        return out


def make_truth(lags: int = 2, *, strength: float = 1.0) -> Truth:
    """Make a sensor twice as strong as the E2V CCD250: a_00 = -3.1e-6, more to y.

    Charge is conserved at every level: the sums of a and of c = a b over the lags are zero.
    b is a growth of some 3 % at 1e5 e-, of 6 % along y.
    """
    j, i = np.indices((lags + 1, lags + 1))
    r = np.hypot(i, j)
    a = 4e-7 * strength * np.where(r > 0, 1 / np.maximum(r, 1) ** 3.2, 0.0)
    a[1, 0] *= 1.6
    a[0, 0] = -(image_weights(lags) * a).sum()
    b = np.full_like(a, 2e-7)
    b[1, 0] = 6e-7
    b[0, 0] = 0.0
    if strength:
        b[0, 0] = -(image_weights(lags) * a * b).sum() / a[0, 0]
    return Truth(a, b)


def solve_spectrum(
    truth: Truth, level: float, shape: tuple[int, int], nodes: int = 48
) -> NDArray[np.float64]:
    """Power of each Fourier mode at a level [e-]: the integral of its growth.

    C = int_0^m exp[2 a (m - s) + c (m^2 - s^2)] ds, by Gauss and Legendre, exact here to
    round-off: the exponent is below one.
    """
    planes = []
    for quadrant in (truth.a, truth.c):
        plane = np.zeros(shape)
        lags = quadrant.shape[0] - 1
        at = np.arange(-lags, lags + 1)
        plane[at[:, None], at[None]] = unfold(quadrant)
        planes.append(rfft2(plane).real)
    x, w = np.polynomial.legendre.leggauss(nodes)
    s = 0.5 * level * (x + 1)
    out = np.zeros_like(planes[0])
    for one, weight in zip(s, w, strict=True):
        exponent = 2 * planes[0] * (level - one) + planes[1] * (level**2 - one**2)
        out += 0.5 * level * weight * np.exp(exponent)
    return out


def draw_field_pairs(
    truth: Truth, side: int, seed: int, *, drift: float = 0.003
) -> Iterator[tuple[NDArray, NDArray]]:
    """Draw pairs of Gaussian flats [ADU], at every level of the truth; the lamp drifts."""
    rng = np.random.default_rng(seed)
    for level in truth.levels:
        pair = []
        spectrum = None
        for factor in (1.0, 1.0 + drift * rng.standard_normal()):
            if spectrum is None:
                spectrum = solve_spectrum(truth, level, (side, side), 12)
            # The spectrum of a level a third of a per cent off is this one's, scaled, to
            # a_00 mu times that: 1e-3 of the effect.
            white = rfft2(rng.standard_normal((side, side)))
            electrons = irfft2(white * np.sqrt(factor * spectrum), s=(side, side))
            electrons += factor * level + truth.noise * rng.standard_normal((side, side))
            pair.append(electrons / truth.gain)
        yield pair[0], pair[1]


def draw_pixel_flat(
    truth: Truth, level: float, side: int, rng: np.random.Generator, *, step: float = 2000.0
) -> NDArray[np.float64]:
    """Collect a flat step by step on a torus, areas by the charge so far [e-].

    Charge that a step draws above or below its mean acts on average through half of that
    step.  Without that the covariances lack a part step / level of the effect; put off to
    the next step, a_ij step^2 at every level, which a fit takes for noise.
    """
    planes = []
    for quadrant in (truth.a, truth.c):
        lags = quadrant.shape[0] - 1
        plane = np.zeros((side, side))
        at = np.arange(-lags, lags + 1)
        plane[at[:, None], at[None]] = unfold(quadrant)
        planes.append(rfft2(plane))
    steps = int(np.ceil(level / step))
    each = level / steps
    charge = np.zeros((side, side))
    for n in range(steps):
        middle = (n + 0.5) * each
        kernel = planes[0] + planes[1] * middle
        area = 1 + irfft2(rfft2(charge) * kernel, s=(side, side))
        area = 1 + irfft2(rfft2(charge + 0.5 * each * area) * kernel, s=(side, side))
        drawn = rng.poisson(each * area)
        excess = rfft2(drawn - each * area)
        charge += drawn + 0.5 * each * irfft2(excess * kernel, s=(side, side))
    return charge


def draw_pixel_pairs(
    truth: Truth, side: int, seed: int, *, step: float = 2000.0
) -> Iterator[tuple[NDArray, NDArray]]:
    """Draw pairs of flats pixel by pixel, in whole ADU."""
    rng = np.random.default_rng(seed)
    for level in truth.levels:
        pair = []
        for _ in range(2):
            electrons = draw_pixel_flat(truth, level, side, rng, step=step)
            electrons += truth.noise * rng.standard_normal((side, side))
            pair.append(np.rint(electrons / truth.gain))
        yield pair[0], pair[1]


def measure_mock(kind: str, truth: Truth, side: int, seed: int) -> CovarianceFit:
    """Draw, measure and fit one campaign, as one would a real one."""
    draw = draw_field_pairs if kind == "fields" else draw_pixel_pairs
    curve: CovarianceCurve = measure_curve(
        draw(truth, side, seed), lags=truth.a.shape[0] - 1, unit="adu"
    )
    return fit_covariances(curve)


def parameters_of(fit: CovarianceFit) -> tuple[dict[str, float], dict[str, float]]:
    """Values and stated errors by name; names carry (i, j), i the lag in x."""
    values, errors = {"gain": fit.gain}, {"gain": fit.gain_error}
    for name in ("a", "c", "noise"):
        matrix, error = getattr(fit, name), getattr(fit, f"{name}_errors")
        for j in range(matrix.shape[0]):
            for i in range(matrix.shape[1]):
                values[f"{name}_{i}{j}"] = float(matrix[j, i])
                errors[f"{name}_{i}{j}"] = float(error[j, i])
    values["sum_a"], errors["sum_a"] = fit.sum_rule
    return values, errors


def truth_of(truth: Truth, kind: str) -> dict[str, float]:
    """The same names, with the truth."""
    out = {"gain": truth.gain, "sum_a": 0.0}
    noise = truth.noise_matrix(kind == "pixels")
    for name, matrix in (("a", truth.a), ("c", truth.c), ("noise", noise)):
        for (j, i), value in np.ndenumerate(matrix):
            out[f"{name}_{i}{j}"] = float(value)
    return out


def summarise(kind: str, truth: Truth, fits: list[CovarianceFit], side: int) -> Table:
    """Make a row for each parameter."""
    known = truth_of(truth, kind)
    both = [parameters_of(fit) for fit in fits]
    rows = []
    for name, value in known.items():
        found = np.array([values[name] for values, _ in both])
        error = np.array([errors[name] for _, errors in both])
        pull = (found - value) / error
        rows.append(
            {
                "kind": kind, "side": side, "pairs": len(truth.levels), "mocks": len(fits),
                "parameter": name, "truth": value, "mean": found.mean(),
                "mean_error": found.std(ddof=1) / np.sqrt(len(fits)),
                "scatter": found.std(ddof=1), "stated_error": np.sqrt((error**2).mean()),
                "pull_mean": pull.mean(), "pull_rms": np.sqrt((pull**2).mean()),
                "within_1_sigma": (np.abs(pull) < 1).mean(),
                "within_1.96_sigma": (np.abs(pull) < 1.959964).mean(),
            }
        )  # fmt: skip
    return Table(rows)


def seed_of(mock: int) -> int:
    """Seed of a mock by its number."""
    return 61_000 + 7 * mock


def pulls_of(kind: str, truth: Truth, fit: CovarianceFit) -> dict[str, float]:
    """Pull of every parameter of one mock, by name."""
    values, errors = parameters_of(fit)
    known = truth_of(truth, kind)
    return {name: (values[name] - known[name]) / errors[name] for name in known}


def list_pulls(kind: str, truth: Truth, fits: list[CovarianceFit]) -> Table:
    """Make a row for each mock."""
    rows = []
    for mock, fit in enumerate(fits):
        row: dict[str, object] = {"kind": kind, "mock": mock}
        pulls = pulls_of(kind, truth, fit)
        rows.append(row | {name: float(f"{pull:.6g}") for name, pull in pulls.items()})
    return Table(rows)


def replace_kind(path: Path, table: Table, kind: str) -> Table:
    """Rows of the file with those of one kind replaced."""
    if not path.exists():
        return table
    old = Table.read(path, format="ascii.ecsv")
    return vstack([old[old["kind"] != kind], table], metadata_conflicts="silent")


def main() -> None:
    """Make the mocks, print and write what they give."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kind", choices=("fields", "pixels", "both"), default="both")
    parser.add_argument("--mocks", type=int, default=200)
    parser.add_argument("--side", type=int, default=160)
    parser.add_argument("-o", "--output", default=str(RESULTS))
    options = parser.parse_args()
    truth = make_truth()
    path = Path(options.output)
    for kind in ("fields", "pixels") if options.kind == "both" else (options.kind,):
        began = time.process_time()
        fits = [
            measure_mock(kind, truth, options.side, seed_of(k))
            for k in range(options.mocks)
        ]
        table = summarise(kind, truth, fits, options.side)
        table["chi2_per_dof"] = np.mean([fit.chi2 / fit.dof for fit in fits])
        table["dropped"] = sum(len(fit.dropped) for fit in fits)
        table["turnoffs"] = sum(fit.range_reason == "found" for fit in fits)
        table["cpu_s"] = round(time.process_time() - began, 1)
        command = f"{COMMAND} --mocks {options.mocks} --side {options.side}"
        write_results(replace_kind(path, table, kind), path, command, added=True)
        where = path.with_name(PULLS)
        listed = list_pulls(kind, truth, fits)
        write_results(replace_kind(where, listed, kind), where, command, added=True)
    wanted = ["kind", "parameter", "truth", "mean", "scatter", "stated_error", "pull_mean"]
    Table.read(path, format="ascii.ecsv")[
        [*wanted, "pull_rms", "within_1_sigma", "within_1.96_sigma"]
    ].pprint_all()


if __name__ == "__main__":
    main()
