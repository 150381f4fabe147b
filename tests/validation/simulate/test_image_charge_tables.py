"""The two engines beside each other, and the fit that brings the analytic one to a table."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from bfsensor.simulate.charge_field import ImageCharge
from bfsensor.simulate.image_charge import area_changes
from validation.image_charge.image_charge import FITTED, NAMES, compare, fit_lags

TRUTH = ImageCharge(
    0.7, 1.5, 3.3, 2.0, 3.0, drift_field=((0.0, 0.73), (100.0, 0.36)), plane_height=0.2
)


@pytest.mark.parametrize(
    ("free", "depths"), [(None, (95.0,)), ("plane_height", (95.0, 10.0))]
)
def test_a_fit_returns_the_truth(free, depths):
    observed = area_changes(TRUTH, depth=depths, reach=FITTED)[:, FITTED:, FITTED:]
    base = TRUTH if free is None else dataclasses.replace(TRUTH, plane_height=-0.1)
    model, _, rms = fit_lags(observed, depths, base, free)
    assert rms < 1e-6
    # Nine lags tell half sides from heights only weakly: 1e-6 becomes up to 1e-3.
    for name in [*NAMES, *([free] if free else [])]:
        assert getattr(model, name) == pytest.approx(getattr(TRUTH, name), rel=1e-3), name


@pytest.mark.slow
def test_errors_are_those_of_many_fits():
    """Lags with errors of 0.1 %: the scatter of fits is what the fits say."""
    depths = (95.0, 10.0)
    exact = area_changes(TRUTH, depth=depths, reach=FITTED)[:, FITTED:, FITTED:]
    rng = np.random.default_rng(5150)
    found, said = [], []
    for _ in range(24):
        noise = 1 + 1e-3 * rng.standard_normal(exact.shape)
        model, errors, _ = fit_lags(exact * noise, depths, TRUTH)
        found.append([model.charge_height, model.column_height])
        said.append([errors["charge_height"], errors["column_height"]])
    # The scatter of 24 is known to 15 %, what the fits say to 20 % each: three sigma.
    ratio = np.std(found, axis=0, ddof=1) / np.mean(said, axis=0)
    assert np.all((ratio > 0.5) & (ratio < 1.6))


@pytest.mark.parametrize("device", ["itl_sta3800c", "e2v_ccd250"])
def test_the_poisson_solver_and_images_agree(device):
    """With the device's own drift field, heights fitted to the nearest lags at two depths.

    Lags 3 and 4 and depths 20 and 40 um are predicted.  In the flat the table's own round-off
    is 1e-10 of an area, so its far lags at 10 um count for nothing.
    """
    rows, fits = compare(device)
    chosen = [row for row in rows if row["model"] == "device, plane free"]
    off = {
        (row["state"], row["depth_um"], row["i"], row["j"]): abs(row["ratio"] - 1)
        for row in chosen
    }
    assert len(off) == 2 * 4 * 25
    pixel = {key[1:]: value for key, value in off.items() if key[0].startswith("one")}
    assert max(pixel.values()) < 0.08  # at (1, 1), where the corner's shape counts
    assert max(v for (_, i, j), v in pixel.items() if (i, j) == (0, 0)) < 0.02
    assert max(v for (_, i, j), v in pixel.items() if max(i, j) > FITTED) < 0.06
    # A uniform drift field misses the far field by 10 % and more: the test is not a weak one.
    uniform = [
        row["ratio"]
        for row in rows
        if row["model"] == "uniform, free"
        and row["depth_um"] == 95.0
        and row["i"] == row["j"] == 4
    ]
    assert max(uniform) < 0.9
    assert all(fit["rms_ratio"] < 0.035 for fit in fits)
