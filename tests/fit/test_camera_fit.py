"""Image charges fitted to a camera's a_ij: files, known devices, what determines what, refusals."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from astropy.table import Table

from bfsensor.device.device import Device
from bfsensor.errors import MeasurementError, RecordingError
from bfsensor.fit.camera_areas import CameraAreas, read_camera_areas
from bfsensor.fit.camera_device import stand_in_device, with_fit
from bfsensor.fit.camera_fit import fit_camera, misfits
from bfsensor.measure.covariance_model import model_covariances
from bfsensor.simulate.charge_field import ImageCharge
from bfsensor.simulate.image_charge import area_changes

BASE = ImageCharge(
    0.5, 1.5, 2.5, 3.0, 3.0, 200.0, 15.0, 15.0, ((0.0, 0.6), (200.0, 0.4))
)  # fmt: skip
TRUE = dataclasses.replace(
    BASE, charge_height=0.7, row_height=2.1, column_height=4.2, half_width_x=2.5,
    half_width_y=4.0,
)  # fmt: skip
STRENGTH = 1.2


def truth(reach=4):
    return STRENGTH * area_changes(TRUE, depth=200.0, reach=reach)[reach:, reach:]


def areas_of(a, errors):
    return CameraAreas(a, errors, np.isfinite(a), "simulated")


@pytest.fixture(scope="module")
def exact():
    a = truth()
    return fit_camera(areas_of(a, 1e-3 * np.abs(a)), base=BASE, model_error=0.0)


def test_a_known_device_comes_back(exact):
    """Errors of 0.1 % a lag: heights of boundaries and dipole to percents, without bias."""
    errors = exact.fit.parameter_errors
    for name in ("row_height", "column_height"):
        found = getattr(exact.model, name)
        # The prior pulls by less than the error that data and prior leave.
        assert abs(found - getattr(TRUE, name)) < 1.5 * errors[name] < 0.15 * found
        assert exact.determined_by(name) == "data"
    assert exact.fit.dipole[0] == pytest.approx(STRENGTH * TRUE.charge_height, rel=0.05)
    assert exact.chi2 < 5 and exact.error_scale == 1.0
    a = area_changes(exact.model, depth=200.0, reach=4)[4:, 4:]
    assert a == pytest.approx(truth(), rel=3e-3)
    assert 3 < exact.effective < 6


def test_poor_data_leave_parameters_to_their_priors():
    a = truth(1)
    found = fit_camera(areas_of(a, np.abs(a)), base=BASE)
    shares = found.shares()
    assert min(shares["half_width_x"], shares["half_width_y"]) > 0.9
    assert found.determined_by("half_width_x") == "prior"
    assert 0 < found.effective < 2


def test_a_wrong_lag_is_named_and_scales_the_errors(exact):
    a = truth()
    spoilt = a.copy()
    spoilt[0, 2] *= 1.5
    found = fit_camera(areas_of(spoilt, 1e-2 * np.abs(a)), base=BASE, model_error=0.0)
    assert found.error_scale > 2
    assert misfits(found.fit, 1.0)[0][:2] == (2, 0)
    areas = areas_of(spoilt, 1e-2 * np.abs(a)).select(lags=4, without=[(2, 0)])
    left_out = fit_camera(areas, base=BASE, model_error=0.0)
    assert left_out.error_scale == 1.0
    assert left_out.fit.ratio[0, 2] == pytest.approx(1 / 1.5, rel=0.03)


def test_a_matrix_of_independent_errors_changes_nothing():
    a = truth(2)
    errors = 0.02 * np.abs(a)
    plain = fit_camera(areas_of(a, errors), base=BASE)
    matrix = dataclasses.replace(areas_of(a, errors), matrix=np.diag(errors.ravel() ** 2))
    again = fit_camera(matrix, base=BASE)
    assert again.fit.values == pytest.approx(plain.fit.values, rel=1e-4)


def test_too_few_lags_are_refused():
    a = truth(1)
    with pytest.raises(MeasurementError, match="2 lags can be fitted; at least 3"):
        fit_camera(
            areas_of(a, np.abs(a)).select(lags=1, without=[(0, 0), (1, 1)]), base=BASE
        )


def test_an_offset_is_found_and_stays_out_of_the_model():
    a = truth() + 2e-9
    found = fit_camera(areas_of(a, np.full(a.shape, 1e-10)), base=BASE, offset=True,
                       model_error=0.0)  # fmt: skip
    assert found.fit.offset == pytest.approx(2e-9, rel=0.2)
    a = area_changes(found.model, depth=200.0, reach=4)[4:, 4:]
    assert a == pytest.approx(truth(), rel=0.02)


# -- files -------------------------------------------------------------------------------


def write(path, header, rows):
    path.write_text("\n".join([header, *(",".join(map(str, row)) for row in rows)]) + "\n")
    return path


def lags(n=3):
    return [(i, j) for j in range(n) for i in range(n)]


@pytest.mark.parametrize(
    "columns", ["i,j,a,error", "i_serial,j_parallel,cov_per_e,err_per_e"]
)
def test_tables_of_a_ij_are_read_with_i_along_x(tmp_path, columns):
    a = truth(2)
    rows = [(i, j, a[j, i], 1e-9) for i, j in lags()]
    found = read_camera_areas(write(tmp_path / "a.csv", "# a comment\n" + columns, rows))
    assert found.a == pytest.approx(a, rel=1e-12) and found.matrix is None
    assert found.a[1, 0] > found.a[0, 1] and not found.notes
    assert found.transposed().a[0, 1] == found.a[1, 0]


@pytest.mark.parametrize("gain", [None, 2.5])
def test_covariances_of_levels_become_the_a_ij_that_made_them(tmp_path, gain):
    """Higher powers of the level are taken off: 5 % of a_01 at 30,000 e- if they were not."""
    a, levels, noise = truth(2), np.array([1e4, 3e4, 5e4]), 36.0
    c = model_covariances(levels, a)
    c[:, 0, 0] += noise
    g = gain or 1.0
    rows = [
        (i, j, m / g, c[n, j, i] / g**2, 2.0 / g**2, g)
        for n, m in enumerate(levels) for i, j in lags()
    ]  # fmt: skip
    header = f"i,j,{'mu_adu' if gain else 'mu_e'},cov,sigma,gain"
    found = read_camera_areas(write(tmp_path / "c.csv", header, rows))
    assert found.a == pytest.approx(a, rel=1e-3)
    assert found.used.all() and np.all(found.errors > 0)
    naive = c[1, 1, 0] / levels[1] ** 2
    assert abs(naive / a[1, 0] - 1) > 0.03


def test_the_output_of_measure_flats_is_read(tmp_path):
    """Rows by pair and amplifier, as `bfsensor measure flats -o` writes them."""
    a, rows = truth(2), []
    for name, noise in (("A", 25.0), ("B", 64.0)):
        for m in (8e3, 2e4, 4e4, 5e4):
            c = model_covariances([m], a)[0]
            c[0, 0] += noise
            rows += [
                {"first": "1.fits", "second": "2.fits", "amplifier": name, "unit": "electron",
                 "level": m, "lag_x": i, "lag_y": j, "covariance": c[j, i], "error": 3.0}
                for i, j in lags()
            ]  # fmt: skip
    Table(rows=rows).write(tmp_path / "flats.ecsv")
    found = read_camera_areas(tmp_path / "flats.ecsv")
    assert found.a == pytest.approx(a, rel=1e-3) and found.used.all()
    assert "4 levels, 8000 to 50000 e-" in found.source


def test_variances_alone_become_a_00(tmp_path):
    """A table of the lag (0, 0) only, whose sum of a_ij is a_00 itself."""
    levels, noise, a = np.array([1e4, 2e4, 3e4, 5e4]), 25.0, np.array([[-2e-6]])
    c = model_covariances(levels, a)[:, 0, 0] + noise
    rows = [(0, 0, m, variance, 3.0) for m, variance in zip(levels, c, strict=True)]
    found = read_camera_areas(write(tmp_path / "c.csv", "i,j,mu_e,cov,sigma", rows))
    assert found.a[0, 0] == pytest.approx(a[0, 0], rel=1e-3) and found.used[0, 0]


def test_one_level_says_nothing_of_a_00(tmp_path):
    a = truth(2)
    c = model_covariances([3e4], a)[0]
    rows = [(i, j, 3e4, c[j, i], 3.0) for i, j in lags()]
    found = read_camera_areas(write(tmp_path / "c.csv", "i,j,mu_e,cov,sigma", rows))
    assert not found.used[0, 0] and found.used.sum() == 8
    assert any("a_00 is not fitted" in note for note in found.notes)
    assert found.a == pytest.approx(a, rel=1e-3)
    no_variance = [row for row in rows if row[:2] != (0, 0)]
    less = read_camera_areas(write(tmp_path / "d.csv", "i,j,mu_e,cov,sigma", no_variance))
    # a_00 is then taken from the sum of the lags, which is near it: 0.8 % of a_01.
    assert less.a[1, 0] == pytest.approx(a[1, 0], rel=0.02)


@pytest.mark.parametrize(
    ("header", "rows", "message"),
    [
        (
            "i,j,value",
            [(0, 1, 2)],
            "neither a_ij .* nor covariances .* its columns are i, j",
        ),
        ("i,j,a,error", [(0, 1, 1e-7, 0)], "row 1: error = 0 must be a number above 0"),
        ("i,j,a,error", [(0, 1, 1e-7, 1e-9), (0, 1, 1e-7, 1e-9)], "given twice"),
        ("i,j,a,error", [(0.5, 1, 1e-7, 1e-9)], "i = 0.5 must be a whole number"),
        ("i,j,a,error", [(-1, 1, 1e-7, 1e-9)], "i = -1 must be a whole number from 0"),
        ("i,j,cov,sigma", [(0, 1, 9, 1)], "level missing"),
        ("i,j,mu_e,cov", [(0, 1, 3e4, 9)], "error missing"),
        ("i,j,mu_adu,cov,sigma", [(0, 1, 3e4, 9, 1)], "gain missing"),
        ("i,j,mu_adu,cov,sigma,gain", [(0, 1, 3e4, 9, 1, 0)], "gain must be above 0"),
        ("i,j,mu_e,cov,sigma", [(0, 1, 3e4, "nan", 1)], "covariance holds values"),
        ("i,j,mu_e,cov,sigma", [(0, 1, -3e4, 9, 1)], "levels and errors must be above 0"),
        (
            "lag_x,lag_y,level,covariance,error,unit",
            [(0, 1, 3e4, 9, 1, "adu")],
            "in adu, not electrons: measure them again with --gain",
        ),
        (
            "i,j,mu_e,cov,sigma",
            [(0, 0, 1e8, -1e12, 1), (0, 1, 1e8, 1e12, 1)],
            "do not settle|not finite",
        ),
    ],
)
def test_files_that_cannot_be_used_are_refused(tmp_path, header, rows, message):
    path = write(tmp_path / "bad.csv", header, rows)
    with pytest.raises((RecordingError, MeasurementError), match=message) as caught:
        read_camera_areas(path)
    assert "bad.csv" in str(caught.value)


# -- devices -----------------------------------------------------------------------------


def test_the_device_says_what_is_stated_guessed_and_fitted(exact):
    template = Device.load("itl_sta3800c")
    settings = [("thickness", "200um"), ("pitch_x", "15um"), ("pitch_y", "15um")]
    device = stand_in_device(template, "mine", settings)
    assert device.operating_point.back_bias == 2 * template.operating_point.back_bias
    doping = template.silicon.background_doping
    assert device.silicon.background_doping == pytest.approx(doping / 4)
    known = device.provenance
    assert known["silicon.thickness"].source == "stated with the covariances"
    assert known["operating_point.gate_low"].origin == "guessed"
    fitted = with_fit(device, exact)
    assert fitted.origin == "fitted to covariances" != device.origin
    assert Device.from_toml(fitted.to_toml()) == fitted
    model = ImageCharge.of_device(fitted)
    assert model.row_height == pytest.approx(exact.model.row_height, rel=1e-12)
    assert model.drift_at(100.0) == pytest.approx(0.5 / exact.fit.strength, rel=1e-9)
    said = fitted.provenance["image_charge.row_height"]
    assert said.origin == "fitted" and said.source.endswith("determined by data")
    assert "fitted to covariances" in str(fitted)
