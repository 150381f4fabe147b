"""Recordings of real sensors, diagnosed: flats of another camera, and measured a_ij beside tables.

``python -m validation.real.real_location SHARED`` reads ``SHARED/recordings/sbig_flats`` (two runs of
an SBIG ST-7-type CCD, Astr480/CCDChar @ ccdc2a3) and ``SHARED/reference/*_covariances_21oct19.csv``
(a_ij of LSST's two vendors, Poisson_CCD repository @ 876adb8).  Four tables go to
``validation/results``: ``real_location.ecsv``, a row for each diagnosis and channel;
``real_unlike.ecsv``, flats of unlike exposure of the first; ``real_lags.ecsv``, lags of the second;
``real_nulls.ecsv``, p-values of drawn covariances that the baseline 'none' describes.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from astropy.table import Table
from scipy.linalg import block_diag
from scipy.stats import chi2 as chi2_distribution

from bfsensor.diagnose.data.reduced_channels import measure_reduced
from bfsensor.diagnose.diagnosis import diagnose, diagnose_measured
from bfsensor.diagnose.model.baseline import Baseline
from bfsensor.diagnose.model.free_baseline import free_baseline
from bfsensor.diagnose.model.open_baseline import CampaignSource, find_baseline
from bfsensor.diagnose.report.diagnosis_result import Diagnosis
from bfsensor.measure.bartlett import bartlett_matrix, image_weights
from bfsensor.measure.covariance_model import model_covariances
from bfsensor.recording.campaign.campaign import read_campaign
from bfsensor.recording.tables.area_changes import AreaChangeTable, read_area_changes
from bfsensor.recording.tables.covariance_tables import CovarianceTable
from validation.common.write_results import write_results

RESULTS = Path(__file__).parents[1] / "results"
COMMAND = "python -m validation.real.real_location SHARED"
RIM = ["[1:16,1:495]", "[642:657,1:495]", "[1:657,1:16]", "[1:657,480:495]"]
"""Left out of the SBIG frames: dark or masked in places."""

BASELINES = {
    "itl": ("lsst_itl_50_32", "lsst_itl_32", "itl_sta3800c", "itl_sta3800c_60", "none"),
    "e2v": ("lsst_e2v_50_32", "lsst_e2v_32", "e2v_ccd250", "e2v_ccd250_70", "none"),
}  # fmt: skip
"""Tables of GalSim (-50 V, -60 V) and ours (-50 V, and -60 or -70 V); near a_ij that float."""


def sbig_baselines() -> dict[str, Baseline]:
    """White noise alone, and with any near brighter-fatter effect."""
    free = free_baseline()
    return {"white noise": free.without(free.parameters), "none": free}


def diagnose_sbig(folders: Sequence[Path], baseline: Baseline, *, rim: bool) -> Diagnosis:
    """Diagnose the frames of one run, or of several as one campaign; without their rim."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for one in folders:
            for path in one.glob("*.FIT"):
                (folder / f"{one.name}-{path.name}").symlink_to(path.resolve())
        masks = "".join(f"  - '{section}'\n" for section in RIM)
        (folder / "campaign.yaml").write_text(
            "schema: bfsensor-campaign-1\n" + (f"masks:\n{masks}" if rim else "")
        )
        return diagnose(CampaignSource(read_campaign(folder)), baseline, explain=False)


def diagnose_areas(table: AreaChangeTable, name: str, *, scaled: bool = False) -> Diagnosis:
    """Hold measured a_ij against a baseline, with stated errors or with those of far lags."""
    predicted = find_baseline(name)
    return diagnose_measured(
        measure_reduced(table, reach=predicted.reach),
        predicted,
        explain=False,
        scaled=scaled,
    )


def exchanged(table: AreaChangeTable) -> AreaChangeTable:
    """The table with its axes exchanged, as real pipelines had them."""
    return AreaChangeTable(table.path, table.a.T, table.errors.T, table.independent.T)


def draw_covariances(seed: int, areas: dict[str, float]) -> CovarianceTable:
    """Covariances of eight levels to 120,000 e- with given near areas, noise after Bartlett.

    By the series of Astier et al. (2019), which the diagnosis does not use.
    """
    rng = np.random.default_rng(seed)
    a = np.zeros((5, 5))
    for name, value in areas.items():
        a[int(name[2]), int(name[1])] = value
    a[0, 0] = -(image_weights(4) * a).sum()
    levels = np.geomspace(3e3, 1.2e5, 8)
    true = model_covariances(levels, a)
    true[:, 0, 0] += 30.0
    blocks = [bartlett_matrix(c, np.full(c.shape, 1_000_000)) for c in true]
    values = [
        rng.multivariate_normal(c.ravel(), m) for c, m in zip(true, blocks, strict=True)
    ]
    matrix = block_diag(*blocks)
    j, i = (np.tile(index.ravel(), len(levels)) for index in np.indices((5, 5)))
    n = len(matrix)
    return CovarianceTable(
        Path(f"drawn {seed}"), np.full(n, "one"), np.repeat(levels, 25), i, j,
        np.concatenate(values), np.sqrt(np.diag(matrix)), np.full(n, 1_000_000),
        np.ones(n, int), np.full(n, np.nan), np.full(n, np.nan), matrix,
    )  # fmt: skip


def diagnose_nulls(count: int) -> list[dict]:
    """P-values of draws with the areas of a thick CCD, and with none: at the bound of all."""
    thick = {"a10": 1.0e-7, "a01": 2.4e-7, "a20": 2.0e-8, "a02": 3.0e-8, "a11": 5.0e-8}
    out = []
    for areas, values in (("thick CCD", thick), ("none", dict.fromkeys(thick, 0.0))):
        for seed in range(9000, 9000 + count):
            measured = measure_reduced(draw_covariances(seed, values), reach=4)
            found = diagnose_measured(measured, free_baseline(), seed=seed, explain=False)
            out.append(
                {"areas": areas, "seed": seed, "p": found.mismatch.p_value,
                 "held": len(thick) - len(found.fit.pulls)}
            )  # fmt: skip
    return out


def rows_of(found: Diagnosis, recording: str, baseline: str) -> list[dict]:
    """A row for each channel of a diagnosis."""
    out = []
    for word, (square, dof) in found.mismatch.chi2.items():
        own = [
            f
            for f in found.mismatch.findings
            if f.word == word and f.family != "chi-square"
        ]
        single = [f for f in own if len(f.where.get("lags", [])) == 1]
        first = (single or own or [None])[0]
        lags = None if first is None else first.where.get("lags")
        out.append(
            {
                "recording": recording, "baseline": baseline, "family_p": found.mismatch.p_value,
                "channel": word, "values": int(found.fit.of(word).sum()),
                "chi2": round(square, 2), "dof": round(dof, 2),
                "p": float(chi2_distribution.sf(square, dof)),
                "found": "" if first is None else first.family + (f": {lags[0]}" if lags else ""),
                "z": 0.0 if first is None else round(first.z, 2),
            }
        )  # fmt: skip
    return out


def lags_of(found: Diagnosis, recording: str, baseline: str) -> list[dict]:
    """A row for each lag of measured a_ij."""
    (channel,) = found.fit.channels
    left = found.fit.residuals * channel.errors
    return [
        {
            "recording": recording, "baseline": baseline, "x": int(i), "y": int(j),
            "measured": v, "error": e, "predicted": v - d, "pull": round(d / e, 2),
        }
        for i, j, v, e, d in zip(
            channel.axes["i"], channel.axes["j"], channel.values, channel.errors, left, strict=True
        )
    ]  # fmt: skip


def serial_models(
    level: np.ndarray, rho: np.ndarray, error: np.ndarray
) -> dict[str, tuple]:
    """Chi-square and degrees of freedom of a lag's correlation against level.

    White noise; in proportion to the level, as the brighter-fatter effect, not below 0; a
    cubic in the square root of the level.
    """
    root = np.sqrt(level / level.max())
    designs = {
        "white noise": np.zeros((len(level), 0)),
        "in proportion to the level": level[:, None],
        "any smooth response": np.vander(root, 4),
    }
    out = {}
    for name, design in designs.items():
        whitened = design / error[:, None]
        fit = np.linalg.lstsq(whitened, rho / error, rcond=None)[0]
        if name.startswith("in proportion"):
            fit = np.maximum(fit, 0.0)
        left = (rho / error) - whitened @ fit
        out[name] = float(left @ left), len(level) - design.shape[1]
    return out


def main() -> None:
    """Diagnose everything, write the tables, print what they say."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("shared", type=Path)
    shared = parser.parse_args().shared
    rows, unlike, lags = [], [], []
    sbig = [shared / "recordings" / "sbig_flats" / n for n in ("langford", "bergeson")]
    campaigns = {"langford": sbig[:1], "bergeson": sbig[1:], "both runs": sbig}
    for name, folders in campaigns.items():
        for word, baseline in sbig_baselines().items():
            found = diagnose_sbig(folders, baseline, rim=True)
            rows += rows_of(found, f"SBIG {name}", word)
            print(f"SBIG {name}, {word}: {found.said()}")
            if word == "none":
                print(*(f"  {n}" for n in found.notes[found.read :]), sep="\n")
                if name != "both runs":
                    unlike += [{"recording": f"SBIG {name}", **vars(p), "rises": p.rises}
                               for p in found.measured.unlike]  # fmt: skip
    for kind, names in BASELINES.items():
        table = read_area_changes(shared / "reference" / f"{kind}_covariances_21oct19.csv")
        for name in names:
            found = diagnose_areas(table, name)
            rows += rows_of(found, f"a_ij {kind}", name)
            lags += lags_of(found, f"a_ij {kind}", name)
            found = diagnose_areas(table, name, scaled=True)
            rows += rows_of(found, f"a_ij {kind}, errors scaled", name)
        found = diagnose_areas(exchanged(table), names[3])
        rows += rows_of(found, f"a_ij {kind}, axes exchanged", names[3])
    table, ladder, areas = Table(rows), Table(unlike), Table(lags)
    for column in ladder.colnames[3:-1]:
        ladder[column].info.format = ".5g"
    for column in ("measured", "error", "predicted"):
        areas[column].info.format = ".5g"
    for column in ("family_p", "p"):
        table[column].info.format = ".3g"
    nulls = Table(diagnose_nulls(120))
    nulls["p"].info.format = ".4g"
    for made, name in (
        (table, "real_location"),
        (ladder, "real_unlike"),
        (areas, "real_lags"),
        (nulls, "real_nulls"),
    ):
        write_results(made, RESULTS / f"{name}.ecsv", COMMAND)
    table.pprint_all()
    for name in [*dict.fromkeys(ladder["recording"]), ""]:
        quiet = ladder[~np.array(ladder["rises"], bool)]
        if name:
            quiet = quiet[quiet["recording"] == name]
        for lag in ("serial", "parallel"):
            columns = (np.array(quiet[c]) for c in ("level", lag, "near_error"))
            print(name or "both runs", lag, serial_models(*columns))


if __name__ == "__main__":
    main()
