"""Power: which effects are detected and where they are placed, against projected SNR.

``python -m validation.location.diagnose_power [--pixels N] [--nulls N] [--drawn N]`` takes ten effects
that the generator applies on pixels, one or two for each channel:

    trap_serial           serial overscan, one amplifier
    interpixel_coupling   covariances, lags (1, 0) and (0, 1)
    bf_nonlinear          covariances and spots, high flux
    correlated_noise      noise in readout order
    gain_nonlinearity     means against flux
    gain_drift            means against time
    tearing               map, one column boundary
    amp_crosstalk         amplifier against amplifier
    adc_bits              converter codes
    lateral_diffusion     spots at all conditions

*Signatures*: campaigns with and without the effect share all noise, so that the difference of
their residuals, the fit's parameters projected out, is what the effect does; its length is the
projected SNR, sqrt(2 Delta lnL).  What noise is left differs between two campaigns: SNR^2 is
the product of their signatures, and a channel counts only if both show it.  Two amplitudes tell
the power law.  *Trials*: residuals of fits of real nulls ('null') and noise drawn through the fit
('drawn'), plus the signature at a given SNR, judged.  *Pixels*: whole campaigns with the amplitude
that gives SNR 8, fitted anew.  What is there already in the results is not made again.
"""

from __future__ import annotations

import argparse
import time
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from astropy.stats import binom_conf_interval
from astropy.table import Table, vstack
from numpy.typing import NDArray

from bfsensor.diagnose.data.measure_channels import MeasuredChannels, measure_channels
from bfsensor.diagnose.detect.locate import ALARM, Locator, Mismatch
from bfsensor.diagnose.fit.baseline_fit import BaselineFit, fit_baseline
from bfsensor.diagnose.model.predictor import Predictor, used_channels
from bfsensor.diagnose.report.diagnosis_result import Diagnosis
from validation.common.virtual_source import VirtualSource, virtual_baseline
from validation.common.write_results import write_results
from validation.concealed.library import make_effect

FOLDER = Path(__file__).parents[1] / "results"
COMMAND = "python -m validation.location.diagnose_power"
FOLDS = ("fit", "select")
SEEDS = 31_000, 31_001
"""Campaigns that signatures are taken from."""
SNRS = (3.0, 5.0, 8.0, 12.0)
SHOWN = 0.05
"""Share of the signature's square from which a channel is one of the effect's own."""


class Case(NamedTuple):
    """An effect, and where it is.

    Parameters give a projected SNR of about 40; truths are those of physics, fluxes are the
    signature's own.
    """

    word: str
    parameters: dict[str, float]
    variant: str = ""
    lags: tuple[tuple[int, int], ...] = ()
    amps: tuple[int, ...] = (1, 2)
    x: tuple[int, int] | None = None
    all_exposures: bool = False


NEAR = ((0, 0), (1, 0), (0, 1), (1, 1))
CASES = (
    Case("trap_serial", {"size": 4.0, "tau": 1.5, "amp": 1}, amps=(2,)),
    Case("interpixel_coupling", {"ax": 8e-3, "ay": 8e-3}, lags=NEAR[1:3]),
    Case("bf_nonlinear", {"b": 6e-6}, lags=NEAR),
    Case("correlated_noise", {"rms": 1.6, "corr": 0.5}, "ar1"),
    Case("gain_nonlinearity", {"c2": 2.2e-3, "c3": 4.5e-4}),
    Case("gain_drift", {"slope": 5e-3}, all_exposures=True),
    Case("tearing", {"amp": 0.02, "length": 3.0, "column": 0.3}, x=(72, 82)),
    Case("amp_crosstalk", {"c": 1.5e-4}),
    Case("adc_bits", {"delta": 0.1, "bit": 4}),
    Case("lateral_diffusion", {"var": 0.02}),
)


@lru_cache(maxsize=64)
def fitted_null(seed: int) -> tuple[MeasuredChannels, BaselineFit]:
    """A campaign without effects, and its fit."""
    measured = measure_channels(VirtualSource(seed=seed))
    predictor = Predictor(measured, virtual_baseline())
    return measured, fit_baseline(predictor, used_channels(measured.channels, FOLDS))


@lru_cache(maxsize=64)
def locator(seed: int) -> Locator:
    """Judge of the residuals of one null."""
    return Locator(fitted_null(seed)[1], seed=seed)


def residuals_at(fit: BaselineFit, measured: MeasuredChannels) -> NDArray[np.float64]:
    """Residuals of a campaign, by the parameters and errors of another's fit."""
    predictor = Predictor(measured, virtual_baseline())
    values = dict(zip(fit.names, fit.values, strict=True))
    point = fit.values[: len(predictor.names)]
    out = []
    for channel, like in zip(
        used_channels(measured.channels, FOLDS), fit.channels, strict=True
    ):
        if (channel.word, len(channel)) != (like.word, len(like)):
            raise ValueError(f"{channel.word}: {len(channel)} values, the null {len(like)}")
        predicted = predictor.predict(channel, point)
        for name, column in predictor.linear(channel).items():
            predicted = predicted + values.get(name, 0.0) * column
        out.append(like.whiten(channel.values - predicted))
    return np.concatenate(out)


def without_parameters(fit: BaselineFit, residuals: NDArray) -> NDArray[np.float64]:
    """Take off what the fit would; the priors' rows come last."""
    whole = np.zeros(len(fit.basis))
    whole[: len(residuals)] = residuals
    return np.asarray(whole - fit.basis @ (fit.basis.T @ whole))


def scaled(case: Case, factor: float) -> Any:
    """The effect, its amplitude multiplied."""
    return make_effect(case.word, case.parameters, case.variant).scaled(factor)


class Signature(NamedTuple):
    """What an effect does to the residuals at SNR 1, and which amplitude that is.

    ``snr`` at ``factors``; ``cosine`` between the signatures of the two factors.
    """

    direction: NDArray[np.float64]
    factors: tuple[float, float]
    snr: tuple[float, float]
    cosine: float
    shares: dict[str, float]

    @property
    def power(self) -> float:
        """Of the amplitude, that the SNR goes with."""
        a, b = self.factors
        return float(np.log(self.snr[1] / self.snr[0]) / np.log(b / a))

    def factor_of(self, snr: float) -> float:
        """Amplitude in units of the case's, from the smaller one: larger ones bend the power law."""
        return float(
            self.factors[0] * (snr / self.snr[0]) ** (1 / max(round(self.power), 1))
        )


def take_signature(case: Case) -> Signature:
    """Take an effect's signature from twin campaigns at two amplitudes."""
    factors = 0.5, 1.0
    kept: list[NDArray] = []
    snr = []
    for factor in factors:
        both = []
        for seed in SEEDS:
            null, fit = fitted_null(seed)
            source = VirtualSource(seed=seed, effects=[scaled(case, factor)])
            change = residuals_at(
                fit, measure_channels(source, ghosts=False)
            ) - residuals_at(fit, null)
            both.append(without_parameters(fit, change))
        fit = fitted_null(SEEDS[0])[1]
        parts = {w: np.append(fit.of(w), np.zeros(len(fit.basis) - len(fit.residuals), bool))
                 for w in dict.fromkeys(c.word for c in fit.channels)}  # fmt: skip
        rows = np.zeros(len(fit.basis), bool)
        rows[len(fit.residuals) :] = True
        for part in parts.values():
            one, two = both[0][part], both[1][part]
            like = one @ two / max(np.sqrt((one @ one) * (two @ two)), 1e-300)
            # Of independent noise the cosine is 0 +- 1 / sqrt(n).
            if like > min(3 / np.sqrt(part.sum()), 0.9):
                rows |= part
        snr.append(float(np.sqrt(max(both[0][rows] @ both[1][rows], 0.0))))
        kept.append(np.where(rows, 0.5 * (both[0] + both[1]), 0.0))
    norms = [np.sqrt(k @ k) for k in kept]
    direction = kept[1] / norms[1]
    return Signature(
        direction,
        factors,
        (snr[0], snr[1]),
        float(kept[0] @ kept[1] / norms[0] / norms[1]),
        {w: float(direction[p] @ direction[p]) for w, p in parts.items()},
    )


def flux_of(fit: BaselineFit, gain: float, direction: NDArray) -> list[tuple[float, float]]:
    """Fluxes [e-] that hold the middle 90 % of the signature's square, in each channel of its own."""
    out = []
    for word in dict.fromkeys(c.word for c in fit.channels):
        name, scale = ("flux", 1.0) if word == "spot" else ("level", gain)
        flux, weight = [], []
        for channel, start in zip(fit.channels, fit.starts, strict=False):
            if channel.word == word and name in channel.axes:
                flux.append(channel.axes[name] * scale)
                weight.append(direction[start : start + len(channel)] ** 2)
        if not flux or (w := np.concatenate(weight)).sum() < SHOWN:
            continue
        f = np.concatenate(flux)
        order = np.argsort(f)
        low, high = np.searchsorted(np.cumsum(w[order]) / w.sum(), (0.05, 0.95))
        out.append((float(f[order][low]), float(f[order][high])))
    return out


def overlap(one: tuple[float, float], two: tuple[float, float]) -> float:
    """Intersection of two intervals over their union."""
    both = min(one[1], two[1]) - max(one[0], two[0])
    return max(both, 0.0) / max(max(one[1], two[1]) - min(one[0], two[0]), 1e-9)


def score(case: Case, signature: Signature, measured: MeasuredChannels, fit: BaselineFit,
          found: Mismatch) -> dict[str, float]:  # fmt: skip
    """Hold a location against the truth: 1 right, 0 wrong, nan where the effect has no such place."""
    told = Diagnosis("", "", measured, fit, found, np.nan)
    where = told.location()
    own = [w for w, s in signature.shares.items() if s > SHOWN]
    out = {
        "first_channel": float(bool(where["channels"]) and where["channels"][0] in own),
        "only_channels": float(bool(where["channels"]) and set(where["channels"]) <= set(own)),
        "amps": float(where["amps"] == list(case.amps)),
        "lags": np.nan, "x": np.nan, "flux": np.nan, "exposures": np.nan,
    }  # fmt: skip
    if case.lags:
        lags = [tuple(p) for p in where["lags"]]
        out["lags"] = float(bool(lags) and set(lags) <= set(case.lags))
    if case.x is not None:
        out["x"] = overlap(tuple(where["x"]), case.x) if where["x"] else 0.0
    fluxes = flux_of(fit, told.gain, signature.direction)
    given = where["flux_e"]
    # A place on the sensor has no flux: none told is none wrong.
    if fluxes and given:
        out["flux"] = max(overlap((given[0], given[1]), f) for f in fluxes)
    flats = [c.axes["exposure"] for c in fit.channels if c.word == "flat_mean"]
    span = float(min(f.min() for f in flats)), float(max(f.max() for f in flats))
    if case.all_exposures:
        given = where["exposures"]
        out["exposures"] = overlap((given[0], given[1]), span) if given else 0.0
    return out


def judge(
    residuals: NDArray, seed: int, case: Case, signature: Signature
) -> dict[str, float]:
    """Detection and, if so, location of residuals by the judge of a null."""
    measured, fit = fitted_null(seed)
    found = locator(seed).locate(residuals)
    row = {"p": found.p_value, "p_chi2": found.p_chi2, "p_scans": found.p_scans}
    return row | (score(case, signature, measured, fit, found) if found.detected else {})


def trials(
    case: Case, signature: Signature, snr: float, kind: str, count: int
) -> list[dict]:
    """Judge many residuals with the signature at one SNR."""
    n = len(fitted_null(SEEDS[0])[1].residuals)
    out = []
    rng = np.random.default_rng([int(snr), len(case.word), ord(kind[0])])
    for k in range(count):
        seed = SEEDS[0] + k if kind == "null" else SEEDS[k % 2]
        fit = fitted_null(seed)[1]
        noise = fit.residuals if kind == "null" else fit.draw(rng, 1)[0]
        # Another campaign's parameters span almost, not quite, the same.
        signal = without_parameters(fit, signature.direction[:n])[:n]
        out.append(judge(noise + snr * signal, seed, case, signature))
    return out


def summary(case: Case, kind: str, snr: float, rows: list[dict]) -> Table:
    """One row of results: detections with Wilson bounds, shares of right places of those detected."""
    out: dict[str, Any] = {
        "effect": case.word,
        "kind": kind,
        "snr": snr,
        "trials": len(rows),
    }
    for name, key in (("both", "p"), ("chi2", "p_chi2"), ("scans", "p_scans")):
        k = sum(r[key] < ALARM for r in rows)
        low, high = binom_conf_interval(k, len(rows), 0.95, interval="wilson")
        out |= {
            name: k,
            f"{name}_low": round(float(low), 4),
            f"{name}_high": round(float(high), 4),
        }
    for name in (
        "first_channel",
        "only_channels",
        "amps",
        "lags",
        "x",
        "flux",
        "exposures",
    ):
        values = [r[name] for r in rows if np.isfinite(r.get(name, np.nan))]
        out[name] = round(float(np.mean(values)), 3) if values else np.nan
    return Table({k: [v] for k, v in out.items()})


def pixel_campaign(case: Case, signature: Signature, seed: int) -> Table:
    """Take one campaign with the effect at SNR 8, fit and judge it."""
    begin = time.process_time()
    factor = signature.factor_of(8.0)
    measured = measure_channels(VirtualSource(seed=seed, effects=[scaled(case, factor)]))
    predictor = Predictor(measured, virtual_baseline())
    fit = fit_baseline(predictor, used_channels(measured.channels, FOLDS))
    found = Locator(fit, seed=seed).locate()
    row: dict[str, Any] = {"effect": case.word, "seed": seed, "factor": round(factor, 4)}
    n = len(fit.residuals)
    if n + len(predictor.space.prior_rows) == len(signature.direction):
        # The fitted amplitude of the signature: about 8 with an error of 1.
        row["seen"] = round(float(fit.residuals @ signature.direction[:n]), 2)
    row |= {"p": found.p_value, "p_chi2": found.p_chi2, "p_scans": found.p_scans}
    for name, value in score(case, signature, measured, fit, found).items():
        row[name] = round(value, 3) if found.detected else np.nan
    first = found.findings[0] if found.findings else None
    row["found"] = f"{first.word}: {first.family}" if first else ""
    row["cpu_s"] = round(time.process_time() - begin, 1)
    return Table({k: [v] for k, v in row.items()})


def append(name: str, row: Table) -> None:
    """Add rows to a file of results."""
    path = FOLDER / name
    if path.exists():
        old = Table.read(path, format="ascii.ecsv")
        for column in ("found", "effect", "kind"):
            for table in (old, row):
                if column in table.colnames:
                    table[column] = table[column].astype(object)
        row = vstack([old, row], metadata_conflicts="silent")
        for column in ("found", "effect", "kind"):
            if column in row.colnames:
                row[column] = row[column].astype(str)
    write_results(row, path, COMMAND, added=True)


def there(name: str, **values: Any) -> bool:
    """Whether a row is there."""
    path = FOLDER / name
    if not path.exists():
        return False
    table = Table.read(path, format="ascii.ecsv")
    return bool(np.any(np.logical_and.reduce([table[k] == v for k, v in values.items()])))


def main() -> None:
    """Make what is missing."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pixels", type=int, default=3, help="Campaigns of each effect.")
    parser.add_argument("--nulls", type=int, default=6, help="Real nulls.")
    parser.add_argument(
        "--drawn", type=int, default=100, help="Draws for each effect and SNR."
    )
    options = parser.parse_args()
    signatures: dict[str, Signature] = {}

    def signature(case: Case) -> Signature:
        if case.word not in signatures:
            signatures[case.word] = take_signature(case)
        return signatures[case.word]

    for case in CASES:
        if not there("diagnose_signatures.ecsv", effect=case.word):
            s = signature(case)
            row: dict[str, Any] = {
                "effect": case.word, "snr_half": round(s.snr[0], 2), "snr_whole": round(s.snr[1], 2),
                "power": round(s.power, 3), "cosine": round(s.cosine, 4),
                "factor_8": round(s.factor_of(8.0), 4),
            }  # fmt: skip
            row |= {w: round(v, 4) for w, v in s.shares.items()}
            append("diagnose_signatures.ecsv", Table({k: [v] for k, v in row.items()}))
            print(row, flush=True)
        for kind, count in (("drawn", options.drawn), ("null", options.nulls)):
            for snr in SNRS:
                if there("diagnose_power.ecsv", effect=case.word, kind=kind, snr=snr):
                    continue
                rows = trials(case, signature(case), snr, kind, count)
                append("diagnose_power.ecsv", line := summary(case, kind, snr, rows))
                print(*line[0].values(), flush=True)
    for turn in range(options.pixels):
        for number, case in enumerate(CASES):
            seed = 32_000 + 100 * number + turn
            if not there("diagnose_power_pixels.ecsv", effect=case.word, seed=seed):
                line = pixel_campaign(case, signature(case), seed)
                append("diagnose_power_pixels.ecsv", line)
                print(*line[0].values(), flush=True)


if __name__ == "__main__":
    main()
