"""Kernels and distortion matrices from tables, and back from their files."""

from __future__ import annotations

import numpy as np
import pytest
from astropy.table import Table

from bfsensor.errors import TableError
from bfsensor.recording.tables.lsst_datasets import BrighterFatterKernel, DistortionMatrix
from bfsensor.table.lsst_format import make_distortion_matrix, make_kernel, solve_kernel
from bfsensor.table.quadrant_shifts import QuadrantShifts, quadrant_shifts
from tests.table.smooth_tables import make_rough_table, make_table, pull

GAINS = {"C00": 1.5, "C01": 1.6}


def flat_response(charge, background, depth):
    return 1.0 + 0 * (charge + background + depth)


def deep_response(charge, background, depth):
    return np.log(depth / 2.0) + 0 * (charge + background)


def table_of(**options):
    return make_table(response=flat_response, reach=3, vertices=32, **options)


def test_shifts_are_those_of_the_field():
    """Mean over an edge of the field, by Gauss's quadrature."""
    shifts = quadrant_shifts(table_of(), lags=4)
    nodes, weights = np.polynomial.legendre.leggauss(40)
    for j in range(4):
        for i in range(4):
            along = 10 * (i + nodes / 2)
            up = pull(along, np.full(40, 10 * (j + 0.5)))[:, 1] @ weights / 2
            along = 10 * (j + nodes / 2)
            right = pull(np.full(40, 10 * (i + 0.5)), along)[:, 0] @ weights / 2
            # Trapezia between 32 points: 1e-3 of the largest shift.
            assert shifts.north[j, i] * 1e6 == pytest.approx(up, abs=1e-4)
            assert shifts.east[j, i] * 1e6 == pytest.approx(right, abs=1e-4)


def test_areas_are_those_of_the_polygons():
    table = make_table(reach=3)
    for background in (0.0, 40_000.0):
        shifts = quadrant_shifts(table, background=background, lags=4)
        change = table.area_changes(
            charge=background + 1.0, background=background, depth=100.0
        )
        # Areas are linear in the charge to 1e-6 over 1 e-; shifts to 1e-3 over 100 e-.
        np.testing.assert_allclose(
            shifts.areas, change[3:, 3:] / 100, atol=2e-3 * np.abs(change).max() / 100
        )
    assert shifts.areas[0, 0] < 0 < shifts.areas[0, 1] < shifts.areas[1, 0]


def test_opposite_sides_mirror_one_another():
    shifts = quadrant_shifts(make_rough_table(5501, pitch=(10.0, 10.0)), lags=3)
    np.testing.assert_array_equal(shifts.south[0], shifts.north[0])
    np.testing.assert_array_equal(shifts.south[1:], -shifts.north[:-1])
    np.testing.assert_array_equal(shifts.west[:, 1:], -shifts.east[:, :-1])


def test_without_tail_the_areas_add_up_to_nothing():
    shifts = quadrant_shifts(table_of(), tail_slope=None)
    areas = shifts.areas
    twice = np.outer(*[np.where(np.arange(8) > 0, 2, 1)] * 2)
    assert areas[3, 0] != 0 and areas[4, 0] != 0
    assert not areas[5:].any() and not areas[:, 5:].any()
    assert np.sum(areas * twice) == pytest.approx(0, abs=1e-13 * np.abs(areas).max())


def test_a_tail_goes_on_as_the_power_that_it_is():
    """A field that is x, y times r^-2.7 comes back where the table does not reach."""

    def power(x, y):
        x, y = np.broadcast_arrays(x, y)
        return np.stack([-x, -y], -1) * ((x**2 + y**2 + 1e-9) ** -1.35)[..., None]

    wide = quadrant_shifts(table_of(field=power), lags=4)
    near = quadrant_shifts(make_table(response=flat_response, reach=2, field=power), lags=4)
    for one, other in zip(near, wide, strict=True):
        # The tail is taken at the middle of an edge, the table's is its mean: 3 % at
        # three pixels.
        np.testing.assert_allclose(one[3], other[3], rtol=0.06)


def test_light_converts_where_its_absorption_says():
    table = make_table(response=deep_response, reach=2)
    surface = quadrant_shifts(table, lags=3, tail_slope=None)
    blue = quadrant_shifts(
        table, wavelengths=[450.0], temperature=173.0, lags=3, tail_slope=None
    )
    red = quadrant_shifts(
        table, wavelengths=[1000.0], photons=[3.0], temperature=173.0, lags=3,
        tail_slope=None,
    )  # fmt: skip
    np.testing.assert_allclose(blue.north, surface.north, rtol=2e-3)
    # Cubics in log(z) of a response that is log(z); what converts below the first depth is left out.
    from bfsensor.device.silicon import absorption_length

    length = float(absorption_length(1000.0, 173.0))
    z = np.linspace(float(table.depths[0]), 100, 200_001)
    part = np.exp(-(100 - z) / length)
    mean = np.average(np.log(z / 2), weights=part) / np.log(50)
    np.testing.assert_allclose(red.north / surface.north, mean, rtol=1e-3)


def test_a_kernel_known_in_closed_form():
    """Products of cosines are eigenfunctions of the discrete Laplacian."""
    n = 8
    at = np.arange(-n, n + 1)
    wave = np.cos(np.pi * at / (2 * n))
    kernel = -1e-7 * np.outer(wave, wave)
    factor = 2 * (2 - 2 * np.cos(np.pi / (2 * n)))
    found = solve_kernel(factor * kernel[n:-1, n:-1])
    np.testing.assert_allclose(found, kernel, atol=1e-20)


def test_a_kernel_gives_back_its_areas():
    areas = quadrant_shifts(make_table(reach=3)).areas
    kernel = solve_kernel(areas)
    assert kernel.shape == (17, 17)
    assert not kernel[0].any() and not kernel[:, -1].any()
    np.testing.assert_allclose(
        BrighterFatterKernel.area_changes(kernel), areas, atol=1e-12 * abs(areas[0, 0])
    )
    forced = BrighterFatterKernel.area_changes(solve_kernel(areas, zero_sum=True))
    twice = np.outer(*[np.where(np.arange(8) > 0, 2, 1)] * 2)
    assert np.sum(areas * twice) != pytest.approx(0, abs=1e-4 * abs(areas[0, 0]))
    assert np.sum(forced * twice) == pytest.approx(0, abs=1e-12 * abs(areas[0, 0]))
    np.testing.assert_allclose(forced[1:], areas[1:], atol=1e-12 * abs(areas[0, 0]))


def test_files_come_back_equal(tmp_path):
    table = make_table(reach=3)
    shifts = quadrant_shifts(table)
    red = quadrant_shifts(table, wavelengths=[1000.0], temperature=173.0)
    kernel = make_kernel(shifts, GAINS, noises={"C01": 6.0}, meta={"DETECTOR": 94})
    kernel.write(tmp_path / "bfk.fits")
    assert BrighterFatterKernel.read(tmp_path / "bfk.fits") == kernel
    for name, filters in (("many", {"g_6": shifts, "y_10": red}), ("none", None)):
        matrix = make_distortion_matrix(
            shifts, GAINS, filters=filters, thickness=100.0, pitch=10.0
        )
        matrix.write(tmp_path / f"{name}.fits")
        assert DistortionMatrix.read(tmp_path / f"{name}.fits") == matrix
        assert matrix.parameters == {"thickness": 100.0, "pixelsize": 10.0}
        assert matrix.version == (1.1 if filters else 1.0)
    changed = make_kernel(QuadrantShifts(shifts.north * 1.000001, shifts.east), GAINS)
    assert changed != kernel


def test_exchanged_axes_are_noticed(tmp_path):
    """In the files the first axis is the serial lag; reading them as [j, i] exchanges axes."""
    shifts = quadrant_shifts(make_table(reach=3))
    assert shifts.areas[1, 0] > 1.2 * shifts.areas[0, 1]
    make_kernel(shifts, GAINS).write(tmp_path / "bfk.fits")
    make_distortion_matrix(shifts, GAINS, filters={"y_10": shifts}).write(
        tmp_path / "matrix.fits"
    )
    raw = Table.read(tmp_path / "bfk.fits", hdu=1, mask_invalid=False)
    assert raw.meta["bfk_VERSION"] == 1.1 and raw.meta["OBSTYPE"] == "bfk"
    flat = np.array(raw["KERNEL"][0]).reshape(17, 17)
    read = BrighterFatterKernel.read(tmp_path / "bfk.fits")
    np.testing.assert_array_equal(read.columns["KERNEL"][1], flat.T)
    assert read.larger_axis(flat.T) == "y" and read.larger_axis(flat) == "x"
    raw = Table.read(tmp_path / "matrix.fits", hdu=1, mask_invalid=False)
    assert raw.meta["BF_DISTORTION_MATRIX_VERSION"] == 1.1
    for name, side in (("A_N", shifts.north), ("A_E", shifts.east)):
        flat = np.array(raw[name][0]).reshape(8, 8)
        # [i][j]: of the upper edges those further up lie along the second axis.
        np.testing.assert_array_equal(flat, side.T)
        assert not np.allclose(flat, side, rtol=0.05, atol=0)
        band = np.array(raw[f"{name}_BY_FILTER"][0])
        assert band.shape == (
            1,
            8,
            8,
        )  # as LSST's reader wants it, which takes a row a filter
        np.testing.assert_array_equal(band[0], side.T)
    flat = np.array(raw["A_MATRIX"][0]).reshape(8, 8)
    assert flat[0, 1] == shifts.areas[1, 0] > flat[1, 0] == shifts.areas[0, 1]


def test_what_was_not_measured_is_not_made_up():
    shifts = quadrant_shifts(make_table(reach=3))
    kernel = make_kernel(shifts, GAINS).columns
    assert not kernel["EXP_ID_MASK"].any()
    for name in ("RAW_MEANS", "RAW_VARIANCES", "RAW_XCORRS", "NOISE"):
        assert np.isnan(kernel[name]).all()
    matrix = make_distortion_matrix(shifts, GAINS).columns
    for name in ("A_MATRIX_SIGMA", "ATH", "FIT_CHI2", "FIT_PARAM_ERRORS"):
        assert np.isnan(matrix[name]).all()
    assert make_kernel(shifts, GAINS).columns["VALID"].tolist() == [1, 1]
    away = QuadrantShifts(-shifts.north, -shifts.east)
    assert make_kernel(away, GAINS).columns["VALID"].tolist() == [0, 0]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda t: quadrant_shifts(t, lags=1), "lags = 1 must be a whole number from 2"),
        (
            lambda t: quadrant_shifts(t, tail_slope=-0.5),
            "tail_slope = -0.5 must be below -1",
        ),
        (lambda t: quadrant_shifts(t, background=1e6), "background = 1e\\+06 is outside"),
        (lambda t: quadrant_shifts(t, photons=[1.0]), "photons"),
        (lambda t: quadrant_shifts(t, wavelengths=[500.0]), "the table holds no device"),
        (
            lambda t: quadrant_shifts(
                t, wavelengths=[500.0, 600.0], photons=[1.0], temperature=173.0
            ),
            r"shapes \(2,\) and \(1,\)",
        ),
        (
            lambda t: quadrant_shifts(t, wavelengths=[1500.0], temperature=173.0),
            r"wavelengths = \[1500",
        ),
        (
            lambda t: quadrant_shifts(
                t, wavelengths=[500.0], photons=[-1.0], temperature=173.0
            ),
            "photons must be finite",
        ),
        (lambda t: solve_kernel(np.zeros((2, 3))), r"areas of shape \(2, 3\)"),
        (lambda t: make_kernel(quadrant_shifts(t), {}), "at least one amplifier"),
        (lambda t: make_kernel(quadrant_shifts(t), {"C00": 0.0}), "gain of C00 = 0.0"),
        (
            lambda t: make_distortion_matrix(
                quadrant_shifts(t), GAINS, filters={"y_10": quadrant_shifts(t, lags=4)}
            ),
            r"shifts of y_10 have the shape \(4, 4\), not \(8, 8\)",
        ),
    ],
)
def test_refusals(make, message):
    table = make_table(reach=2)
    with pytest.raises(TableError, match=message):
        make(table)


def test_tables_that_cannot_serve():
    with pytest.raises(TableError, match="reach = 0"):
        quadrant_shifts(make_table(reach=0))
    with pytest.raises(TableError, match="one depth"):
        quadrant_shifts(make_table(depths=[50.0]), wavelengths=[500.0], temperature=173.0)


def test_kernels_of_many_lags_are_solved_and_more_refused():
    """A thousand lags have a system of four million unknowns."""
    areas = np.zeros((400, 400))
    areas[0, 0] = -1e-6
    kernel = solve_kernel(areas)
    back = sum(np.roll(kernel, s, axis) for s in (1, -1) for axis in (0, 1)) - 4 * kernel
    assert back[400, 400] == pytest.approx(1e-6, rel=1e-9)
    back[400, 400] = 0.0
    assert np.abs(back[1:-1, 1:-1]).max() < 1e-18
    with pytest.raises(
        TableError, match="lags = 1001 must be a whole number from 2 to 1000"
    ):
        quadrant_shifts(make_table(), lags=1001)
