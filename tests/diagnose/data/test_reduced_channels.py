"""Reduced recordings and unknown sensors: one channel, near areas that float, pairs of unlike flats."""

import json
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from astropy.table import Table
from click.testing import CliRunner

from bfsensor.cli.main import main
from bfsensor.device.condition import Condition
from bfsensor.diagnose.data.flat_pairing import RISE, compare_unlike, describe_unlike
from bfsensor.diagnose.data.reduced_channels import measure_reduced
from bfsensor.diagnose.detect.scans import DEVICE_SCAN, make_fitted_templates
from bfsensor.diagnose.diagnosis import diagnose_measured
from bfsensor.diagnose.model.baseline import Baseline
from bfsensor.diagnose.model.free_baseline import SPREAD, free_baseline
from bfsensor.diagnose.model.open_baseline import find_baseline, find_reduced_recording
from bfsensor.errors import DiagnosisError
from bfsensor.measure.bartlett import bartlett_matrix
from bfsensor.measure.covariance_model import model_covariances
from bfsensor.recording.tables.area_changes import AreaChangeTable, read_area_changes
from bfsensor.recording.tables.covariance_tables import CovarianceTable
from bfsensor.response.edge_response import area_matrix
from tests.recording.tables.test_reduced import photon_transfer

AREAS = {"a10": 1.0e-7, "a01": 2.4e-7, "a20": 2.0e-8, "a02": 3.0e-8, "a11": 5.0e-8}


def baseline_of(areas):
    """Free areas at given values, with nothing left to float."""
    free = free_baseline()
    edges, _ = free.at(Condition(), areas)
    return Baseline("known", {(620.0, -60.0): edges}, {}, {}, (620.0, -60.0))


def area_table(tmp_path, *, seed, moved=0.0, sum_rule=True):
    """A table of a_ij to lags of 6 with errors, drawn about AREAS; a_10 moved by sigmas."""
    rng = np.random.default_rng(seed)
    edges, _ = baseline_of(AREAS).at(Condition())
    plane = area_matrix(*edges)
    n = len(plane) // 2
    a = np.zeros((7, 7))
    a[:6, :6] = plane[n:, n:]
    error = np.full(a.shape, 3e-9)
    a += rng.normal(0, error)
    a[0, 1] += moved * error[0, 1]
    if sum_rule:
        fold = np.where(np.arange(7) > 0, 2, 1)
        a[0, 0] -= (np.outer(fold, fold) * a).sum()
    j, i = np.indices(a.shape)
    path = tmp_path / "areas.csv"
    Table(
        {"i_serial": i.ravel(), "j_parallel": j.ravel(), "cov_per_e": a.ravel(),
         "err_per_e": error.ravel()}
    ).write(path, format="ascii.csv", overwrite=True)  # fmt: skip
    return path


@pytest.mark.parametrize("name", AREAS)
def test_each_free_area_is_that_area_alone(name):
    """Areas are conserved, mirrored, and no other lag has any."""
    edges, held = free_baseline().at(
        Condition(wavelength=480.0, back_bias=-60.0, temperature=173.0), {name: 1e-7}
    )
    a = area_matrix(*edges) * 1e7
    n = len(a) // 2
    i, j = int(name[1]), int(name[2])
    expected = np.zeros_like(a)
    for y, x in {(j, i), (-j, i), (j, -i), (-j, -i)}:
        expected[n + y, n + x] = 1.0
    expected[n, n] = -expected.sum()
    assert held
    np.testing.assert_allclose(a, expected, atol=1e-12)


def test_areas_as_a_campaign(tmp_path):
    table = read_area_changes(area_table(tmp_path, seed=31))
    measured = measure_reduced(table, reach=4)
    (channel,) = measured.channels
    assert len(channel) == 24 and channel.unit == "1/e-"
    assert (0, 0) not in set(zip(channel.axes["i"], channel.axes["j"], strict=True))
    assert any("24 values beyond lags of 4" in n for n in measured.notes)
    found = diagnose_measured(measured, baseline_of(AREAS), explain=False)
    ((square, dof),) = found.mismatch.chi2.values()
    assert dof == 24 and abs(square - 24) < 4 * np.sqrt(48)
    assert not found.mismatch.detected


def test_the_lag_that_misses_is_found(tmp_path):
    table = read_area_changes(area_table(tmp_path, seed=31, moved=9.0))
    found = diagnose_measured(
        measure_reduced(table, reach=4), baseline_of(AREAS), explain=False
    )
    assert found.mismatch.detected
    assert found.location()["lags"] == [[1, 0]]
    assert found.location()["x"] == [] and found.location()["amps"] == []


def test_free_areas_are_fitted_and_stay_above_0(tmp_path):
    table = read_area_changes(area_table(tmp_path, seed=35))
    found = diagnose_measured(
        measure_reduced(table, reach=4), free_baseline(), explain=False
    )
    errors = dict(zip(found.fit.names, found.fit.errors, strict=True))
    for name, truth in AREAS.items():
        z = (found.fit.pulls[name] * SPREAD - truth) / (errors[f"device {name}"] * SPREAD)
        assert abs(z) < 4, name
    # A neighbour that loses area is no brighter-fatter effect: it is held at 0 and stands out.
    a = table.a.copy()
    a[0, 1] = -1e-7
    turned = AreaChangeTable(table.path, a, table.errors, table.independent)
    found = diagnose_measured(
        measure_reduced(turned, reach=4), free_baseline(), explain=False
    )
    assert "a10" not in found.fit.pulls and "a01" in found.fit.pulls
    assert found.mismatch.detected and [1, 0] in found.location()["lags"]
    assert any("a10 held at 0" in n for n in found.notes)


def test_areas_that_only_have_a_bound_are_not_compared_with_a_nominal_value(tmp_path):
    table = read_area_changes(area_table(tmp_path, seed=35))
    free = free_baseline()
    measured = measure_reduced(table, reach=4)
    fit = diagnose_measured(measured, free, explain=False).fit
    assert fit.unknown == free.parameters
    assert DEVICE_SCAN not in {t.family for t in make_fitted_templates(fit)}
    # The same parameters with a nominal value each are compared with it.
    known = diagnose_measured(measured, replace(free, not_below=()), explain=False).fit
    assert DEVICE_SCAN in {t.family for t in make_fitted_templates(known)}


def covariances(seed, *, gain=1.0, noise=30.0, extra=0.0, side=1000, matrix=True):
    """Covariances of 8 levels by the package's other closed form, errors after Bartlett."""
    rng = np.random.default_rng(seed)
    edges, _ = baseline_of(AREAS).at(Condition())
    plane = area_matrix(*edges)
    n = len(plane) // 2
    levels = np.geomspace(3e3, 1.2e5, 8)
    true = model_covariances(levels, plane[n : n + 5, n : n + 5])
    true[:, 0, 0] += noise
    true[:, 0, 1] += extra * levels
    rows, blocks = [], []
    for level, c in zip(levels, true, strict=True):
        error = bartlett_matrix(c, np.full(c.shape, side**2))
        values = rng.multivariate_normal(c.ravel(), error).reshape(c.shape)
        for j, i in np.ndindex(c.shape):
            rows.append((level, i, j, values[j, i], np.sqrt(error[j * 5 + i, j * 5 + i])))
        blocks.append(error)
    level, i, j, cov, sigma = (np.array(c) for c in zip(*rows, strict=True))
    whole = np.zeros((len(cov),) * 2)
    for k, b in enumerate(blocks):
        whole[25 * k : 25 * k + 25, 25 * k : 25 * k + 25] = b
    none = np.full(len(cov), np.nan)
    return CovarianceTable(
        "covariances.ecsv", np.full(len(cov), "C00"), level / gain, i, j, cov / gain**2,
        sigma / gain**2, np.full(len(cov), side**2), np.ones(len(cov), int), none, none,
        whole / gain**4 if matrix else None,
    )  # fmt: skip


def test_covariances_as_a_campaign_float_gain_and_noise():
    found = diagnose_measured(
        measure_reduced(covariances(41, gain=1.03), reach=4), baseline_of(AREAS)
    )
    ((square, dof),) = found.mismatch.chi2.values()
    assert len(found.fit.channels[0].blocks) == 8
    assert 197 < dof < 199 and abs(square - dof) < 4 * np.sqrt(2 * dof)
    assert not found.mismatch.detected
    names = list(found.fit.names)
    for name, truth in (("gain 0", 1.03), ("noise 0", 30.0 / 1.03**2)):
        n = names.index(name)
        assert abs(found.fit.values[n] - truth) < 4 * found.fit.errors[n]


def test_a_covariance_that_goes_with_the_level_is_no_area():
    """Coupling of pixels adds C_10 in proportion to the level: free areas do not take it."""
    found = diagnose_measured(
        measure_reduced(covariances(43, extra=6e-3), reach=4), free_baseline()
    )
    assert found.mismatch.detected and [1, 0] in found.location()["lags"]
    found = diagnose_measured(
        measure_reduced(covariances(43), reach=4), free_baseline(), explain=False
    )
    assert not found.mismatch.detected


def test_command_on_a_file(tmp_path):
    path = area_table(tmp_path, seed=31, moved=9.0)
    runner = CliRunner()
    result = runner.invoke(
        main, ["diagnose", str(path), "--baseline", "none", "-o", str(tmp_path / "out")]
    )
    assert result.exit_code == 0, result.output
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["schema"] == "bfsensor-diagnosis-1" and "flat_cov" in report["channels"]
    assert "a_00 was set by the sum" in result.output
    assert report["exposures"] == {}
    (tmp_path / "more").mkdir()
    for name in ("a.csv", "b.csv"):
        (tmp_path / "more" / name).write_text(path.read_text())
    with pytest.raises(DiagnosisError, match=r"one table .* there are 2 of 2"):
        find_reduced_recording(tmp_path / "more")


def test_baselines_by_name():
    assert find_baseline("none").name.startswith("none")
    own = find_baseline("lsst_itl_50_8")
    assert own.reach == 4
    with pytest.raises(DiagnosisError, match="--baseline"):
        find_baseline(None)


def test_unknown_voltage_does_not_hide_the_wavelength():
    """GalSim's stems know no voltage: nan must not make the first wavelength the nearest."""
    shifts = {
        (w, np.nan): (np.full((3, 3), w), np.zeros((3, 3))) for w in (400.0, 620.0, 950.0)
    }
    baseline = Baseline("three", shifts, {}, {}, (620.0, np.nan))
    for wavelength in (410.0, 600.0, 900.0):
        near = min((400.0, 620.0, 950.0), key=lambda w: abs(w - wavelength))
        (kx, _), _ = baseline.at(Condition(wavelength=wavelength, back_bias=-60.0))
        assert kx[0, 0] == near


def unlike(rng, levels, *, pattern=0.0, serial=0.0, side=220):
    """Flats with a fixed pattern that saturates, and noise that a readout shares along x."""
    fixed = rng.normal(0, 1, (side // 8 + 1,) * 2).repeat(8, 0).repeat(8, 1)[:side, :side]
    images = []
    for n, level in enumerate(levels):
        noise = rng.normal(0, np.sqrt(level), (side, side))
        noise[:, 1:] += serial[n] * noise[:, :-1] if np.ndim(serial) else 0.0
        images.append((n, [level + noise + pattern * level**2 * 1e-7 * fixed]))
    return images


def test_fixed_pattern_between_unlike_flats_is_named():
    levels = [1e3, 2e3, 4e3, 8e3, 1.6e4, 3e4]
    quiet = unlike(np.random.default_rng(51), levels)
    loud = unlike(np.random.default_rng(51), levels, pattern=4.0)
    for images, seen in ((quiet, False), (loud, True)):
        pairs = [compare_unlike(a, b, lags=4) for a, b in pairwise(images)]
        assert all(p is not None for p in pairs)
        said = describe_unlike(pairs)
        assert bool(said) == seen
        assert pairs[-1].rises == seen and not pairs[0].rises
        if seen:
            assert "not the brighter-fatter effect" in said[0]
            assert pairs[-1].serial < 3 * pairs[-1].far
    assert compare_unlike(quiet[0], quiet[2], lags=4) is None  # levels too far apart


def test_a_correlation_that_changes_its_sign_is_named():
    images = unlike(
        np.random.default_rng(53), [1e3, 2e3, 4e3, 8e3], serial=[-0.05, -0.05, 0.05, 0.05]
    )
    pairs = [compare_unlike(images[k], images[k + 1], lags=4) for k in (0, 2)]
    (said,) = describe_unlike(pairs)
    assert "lag (1, 0) changes its sign" in said
    assert all(abs(p.serial) > RISE * p.near_error for p in pairs)
    assert describe_unlike(pairs[:1]) == []


def test_covariances_and_lssts_datasets_from_files(tmp_path):
    """Our ECSV keeps the error matrix; LSST's dataset is read in electrons with its own gain."""
    covariances(47).write(tmp_path / "c.ecsv")
    table = find_reduced_recording(tmp_path / "c.ecsv")
    found = diagnose_measured(
        measure_reduced(table, reach=4), baseline_of(AREAS), explain=False
    )
    assert not found.mismatch.detected and len(found.fit.channels[0].blocks) == 8
    photon_transfer(side=3).write(tmp_path / "ptc.fits")
    measured = measure_reduced(find_reduced_recording(tmp_path / "ptc.fits"), reach=4)
    (channel,) = measured.channels
    assert channel.unit == "electron2" and channel.axes["i"].max() == 2
    assert channel.axes["j"].max() == 2 and len(measured.amplifiers) >= 1
    diagnose_measured(measured, free_baseline(), explain=False)
