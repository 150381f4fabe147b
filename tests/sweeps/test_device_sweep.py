"""Sweeps of a device: response, light, refusals, file, figure."""

import dataclasses

import numpy as np
import pytest

from bfsensor.device.device import Device
from bfsensor.errors import SweepError
from bfsensor.response.edge_response import CHARGE, LEVEL, REFINE_Z
from bfsensor.sweeps.axes import parse_swept
from bfsensor.sweeps.device_sweep import partner_cells, sweep_device
from bfsensor.sweeps.points import (
    PointResponse,
    SweepPoint,
)
from bfsensor.sweeps.rows import DeviceSweep
from bfsensor.table.build import build_table
from bfsensor.table.table_plan import TablePlan

ITL = Device.load("itl_sta3800c")


def over(*given):
    return [parse_swept(*text.split("="), ITL) for text in given]


@pytest.fixture(scope="module")
def swept(tmp_path_factory):
    """Two biases and one that is not allowed, blue and red light; 8 cells, 12 CPU s."""
    folder = tmp_path_factory.mktemp("sweep")
    made = sweep_device(
        ITL, over("back_bias=-50V,-60V,5V", "wavelength=400nm,950nm"), cells=8,
        full_pixel=80_000.0, work=folder / "work", tables=folder / "tables",
    )  # fmt: skip
    return made, folder


@pytest.mark.parametrize("cells", [8, 12, 16, 24, 32, 48])
def test_the_mesh_that_measures_the_error_has_half_or_twice_the_cells(cells):
    """An error of second order is then 4 times as large, or 3 / 4 of the difference is the own."""
    ratio = partner_cells(cells) / cells
    assert ratio == (2.0 if cells < 16 else 0.5)


def test_a_row_for_every_point(swept):
    made, _ = swept
    assert list(made.rows["back_bias"]) == [-50, -50, -60, -60, 5, 5]
    assert list(made.rows["wavelength"]) == [400, 950] * 3
    assert made.rows["back_bias"].unit == "V" and made.rows["a_00"].unit == "electron-1"
    assert list(made.refused) == [False] * 4 + [True] * 2
    assert "back_bias = '5 V' must be at most 0 V" in made.rows["reason"][4]
    assert np.isnan(made.a[4:]).all() and np.isfinite(made.a[:4]).all()


def test_wavelengths_share_one_solution(swept):
    made, folder = swept
    # Two biases, the first of them the device as given, and the finer mesh.
    assert len(list((folder / "work").glob("*.npz"))) == 3
    # Light of 400 nm is gone after 1 um; of 950 nm a tenth arrives below 20 um.
    assert 0.85 < made.a[1, 0, 0] / made.a[0, 0, 0] < 0.99
    assert made.rows["full_well"][0] == made.rows["full_well"][1]


def test_response_is_that_of_a_table_about_the_level(swept):
    """Against a table that is planned by hand, with light that converts at the back surface."""
    made, _ = swept
    depths = (0.9, 5.0, 20.0, 100.0)
    table = build_table(
        TablePlan(ITL, (LEVEL, LEVEL + CHARGE), (LEVEL,), depths, 32, 4, 8, REFINE_Z, 1.5e5)
    )
    change = table.area_changes(charge=LEVEL + CHARGE, background=LEVEL, depth=100.0)
    # 400 nm: mean depth 0.2 um below the back, where the response changes by 1e-4 per um.
    np.testing.assert_allclose(made.a[0], change[4:7, 4:7] / (CHARGE * 100.0), rtol=5e-3)
    # The area that the full pixel lost is not what flats see: 80,000 e- on empty neighbours.
    assert abs(made.areas[0, 0, 0] / 8e6 / made.a[0, 0, 0] - 1) > 5e-3


def test_back_bias_weakens_the_centre(swept):
    """numerics.md, section 4, at 8 cells: -60 V instead of -50 V changes the centre by -8 %."""
    made, _ = swept
    assert made.areas[2, 0, 0] / made.areas[0, 0, 0] - 1 == pytest.approx(-0.08, abs=0.01)
    assert made.a[2, 0, 0] / made.a[0, 0, 0] - 1 == pytest.approx(-0.08, abs=0.01)


def test_errors_are_what_a_finer_mesh_changes(swept):
    made, _ = swept
    relative = made.errors[0] / np.abs(made.a[0])
    # 8 cells are coarse: 3 to 8 % at the centre (numerics.md, section 1), more at (0, 1).
    assert 0.02 < relative[0, 0] < 0.1 and 0.05 < relative[1, 0] < 0.2
    np.testing.assert_allclose(made.errors[2] / np.abs(made.a[2]), relative, rtol=1e-12)
    assert made.rows.meta["error_cells"] == 16
    assert np.all(made.rows["iteration_error"][:4] < 5e-3 * np.abs(made.a[:4, 2, 2]))


def test_tables_are_written(swept):
    from bfsensor.table.table import DistortionTable

    made, folder = swept
    names = sorted(p.name for p in (folder / "tables").iterdir())
    assert names == ["point_0000.fits", "point_0002.fits"]
    table = DistortionTable.read(folder / "tables" / "point_0002.fits")
    assert Device.from_toml(table.device_text).operating_point.back_bias == -60
    change = table.area_changes(charge=LEVEL + CHARGE, background=LEVEL, depth=100.0)
    assert change[4, 4] / (CHARGE * 100) == pytest.approx(made.a[2, 0, 0], rel=2e-3)


def test_written_and_read_back_equal(swept, tmp_path):
    made, _ = swept
    made.write(tmp_path / "sweep.ecsv")
    again = DeviceSweep.read(tmp_path / "sweep.ecsv")
    assert again == made
    assert "differential response" in again.rows.meta["definition"]
    assert again.rows.meta["level"] == LEVEL
    other = dataclasses.replace(made, rows=made.rows.copy())
    other.rows["a_11"][0] *= 1 + 1e-15
    assert other != made
    with pytest.raises(SweepError, match="exists"):
        made.write(tmp_path / "sweep.ecsv")
    (tmp_path / "other.ecsv").write_text("# %ECSV 1.0\n# ---\n# datatype:\n"
                                         "# - {name: a, datatype: int64}\na\n1\n")  # fmt: skip
    with pytest.raises(SweepError, match="schema None is not 'bfsensor-sweep-1'"):
        DeviceSweep.read(tmp_path / "other.ecsv")


def test_what_numpy_refuses_is_a_reason(monkeypatch):
    """At -1 V boundary lines between pixels are missing, and numpy refuses to interpolate."""
    import bfsensor.sweeps.points as library

    def fail(device, **options):
        raise ValueError("array of sample points is empty")

    monkeypatch.setattr(library, "solve_response", fail)
    found = library.solve_point(SweepPoint(ITL.to_toml(), LEVEL, 0.0, 8))
    assert found.reason == "ValueError: array of sample points is empty"
    assert np.isnan(found.a).all()


def test_two_gates_may_pass_one_another():
    """Gates change one by one, in the order in which every step is a device."""
    from bfsensor.sweeps.device_sweep import _device_at

    raised = _device_at(ITL, over("gate_low=3V", "gate_high=12V"), (0, 0))
    assert (raised.operating_point.gate_low, raised.operating_point.gate_high) == (3, 12)
    crossed = _device_at(ITL, over("gate_low=3V", "gate_high=2V"), (0, 0))
    assert isinstance(crossed, str) and "gate_low" in crossed


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"level": -1.0}, "level = -1 e-"),
        ({"full_pixel": np.nan}, "full pixel = nan e-"),
        ({"cells": 7}, "cells = 7"),
    ],
)
def test_wrong_requests_are_refused(tmp_path, options, message):
    with pytest.raises(SweepError) as caught:
        sweep_device(ITL, over("back_bias=-50V"), work=tmp_path / "work", **options)
    assert message in str(caught.value) and not (tmp_path / "work").exists()


def test_a_damaged_point_is_named(tmp_path):
    point = SweepPoint(ITL.to_toml(), LEVEL, 0.0, 8)
    (tmp_path / f"{point.key}.npz").write_bytes(b"PK\x03\x04 half of it")
    with pytest.raises(SweepError, match=rf"{point.key}\.npz"):
        PointResponse.read(tmp_path / f"{point.key}.npz")


def test_keys_tell_points_apart():
    point = SweepPoint(ITL.to_toml(), LEVEL, 0.0, 8)
    others = [
        dataclasses.replace(point, **change)
        for change in (
            {"level": 3e4}, {"full_pixel": 8e4}, {"cells": 16}, {"with_table": True},
            {"device_text": ITL.with_value("back_bias", "-51V").to_toml()},
        )
    ]  # fmt: skip
    assert len({p.key for p in [point, *others]}) == 6


# -- figure ------------------------------------------------------------------------------


def test_figure_shows_every_answer(swept):
    from bfsensor.plots.style import new_figure
    from bfsensor.plots.sweep import draw_sweep, figure_for_sweep

    made, _ = swept
    ax = new_figure(5, 4).add_subplot()
    draw_sweep(made, ax, against="back_bias")
    assert ax.get_xlabel() == "back bias [V]" and ax.get_yscale() == "log"
    lines = [line for line in ax.get_lines() if len(line.get_xdata()) == 2]
    assert len(lines) >= 12  # six lags in two colours of light
    first = lines[0]
    assert list(first.get_xdata()) == [-60, -50]  # and not 5 V
    np.testing.assert_allclose(first.get_ydata(), -1e6 * made.a[[2, 0], 0, 0], rtol=1e-12)
    figure = figure_for_sweep(made, against="wavelength")
    assert [a.get_xlabel() for a in figure.axes] == ["wavelength [nm]"] * 2
    changes = [line.get_ydata() for line in figure.axes[1].get_lines()]
    assert any(
        np.allclose(y, [0, 100 * (made.a[1, 0, 0] / made.a[0, 0, 0] - 1)]) for y in changes
    )
    with pytest.raises(SweepError, match=r"'gate_low' was not swept.*back_bias, wave"):
        draw_sweep(made, ax, against="gate_low")


# -- slow: the known dependence ------------------------------------------------------------


@pytest.mark.slow
def test_known_dependence_on_voltages(tmp_path):
    """numerics.md, section 4 (at 8 cells, another solver): -60 V: -8 %; one volt more of the
    high gate: -4.6 %; from there to -30 and -70 V the centre goes as the inverse of a field.

    The numbers there are rounded to a digit and belong to 80,000 e- in one pixel.
    """
    bias = sweep_device(
        ITL, over("back_bias=-30V:-70V:5"), cells=8, full_pixel=80_000.0, work=tmp_path
    )
    gate = sweep_device(
        ITL, over("gate_high=2V,3V"), cells=8, full_pixel=80_000.0, work=tmp_path
    )
    centre = bias.areas[:, 0, 0]
    assert centre[3] / centre[2] - 1 == pytest.approx(-0.08, abs=0.01)
    assert gate.areas[1, 0, 0] / gate.areas[0, 0, 0] - 1 == pytest.approx(-0.046, abs=0.005)
    for values in (centre, bias.a[:, 0, 0]):
        assert np.all(np.diff(np.abs(values)) < 0)
        assert np.all(np.diff(np.abs(values), 2) > 0)  # ever less for another ten volts
