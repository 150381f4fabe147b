"""Files of measurements: whole, refused unless known, and read whatever their age."""

import numpy as np
import pytest
from astropy.table import Table

from bfsensor.errors import MeasurementError
from bfsensor.measure.covariance_fit import CovarianceFit, fit_covariances
from bfsensor.measure.covariance_model import model_covariances
from bfsensor.measure.curve import (
    CovarianceCurve,
)
from bfsensor.measure.ecsv import read_ecsv, square_lags, write_ecsv
from bfsensor.measure.flat_pairs import FlatCovariances, flat_covariances
from bfsensor.measure.slopes import BFSlope, bf_slopes

COLUMNS = {
    "x": (np.array([1.5, np.nan, -3.0]), "pix", "a place"),
    "name": (np.array(["used", "", "far off"]), None, ""),
    "pairs": (np.arange(12).reshape(3, 2, 2), None, ""),
}


def written(path, **changes):
    write_ecsv(
        path, "test 1", COLUMNS, {"level": np.float64(7), "held": ("c",)}, overwrite=False
    )
    text = path.read_text()
    for old, new in changes.items():
        assert old in text
        text = text.replace(old, new)
    path.write_text(text)
    return path


def test_values_units_and_texts_come_back(tmp_path):
    path = written(tmp_path / "a.ecsv")
    columns, meta = read_ecsv(path, "test 1", tuple(COLUMNS), ("level", "held"))
    for name, (values, unit, _) in COLUMNS.items():
        np.testing.assert_array_equal(columns[name], values)
        assert Table.read(path)[name].unit == unit
    assert type(columns["x"]) is np.ndarray and meta == {"level": 7.0, "held": ["c"]}


def test_a_file_that_is_there_stays(tmp_path):
    path = written(tmp_path / "a.ecsv")
    before = path.read_bytes()
    with pytest.raises(MeasurementError, match=r"a\.ecsv exists; say overwrite"):
        write_ecsv(path, "test 1", {"x": ([2.0], None, "")}, {}, overwrite=False)
    assert path.read_bytes() == before
    write_ecsv(path, "test 1", {"x": ([2.0], None, "")}, {}, overwrite=True)
    assert read_ecsv(path, "test 1", ("x",), ())[0]["x"].tolist() == [2.0]
    slope = bf_slopes(np.arange(1, 9) * 1e4, np.linspace(1, 1.01, 8), np.full(8, 1e-4))
    slope.write(tmp_path / "slope.ecsv")
    with pytest.raises(MeasurementError, match="say overwrite"):
        slope.write(tmp_path / "slope.ecsv")
    slope.write(tmp_path / "slope.ecsv", overwrite=True)
    assert BFSlope.read(tmp_path / "slope.ecsv") == slope
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.ecsv", "slope.ecsv"]


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("test 1", "test 2", "its schema is 'test 2', not 'test 1'"),
        ("{schema: test 1}", "{about: test 1}", "its schema is None"),
        ("1.5 used", '"" used', "column x has empty cells"),
        ("{name: x,", "{nome: x,", "not readable as ECSV"),
        ("datatype: float64", "datatype: float65", "not readable as ECSV"),
        ("# %ECSV 1.0", "", "not readable as ECSV"),
        ("level:", "niveau:", "level missing"),
    ],
)
def test_damage_is_one_error_that_names_the_file(tmp_path, old, new, words):
    path = written(tmp_path / "a.ecsv", **{old: new})
    with pytest.raises(MeasurementError) as caught:
        read_ecsv(path, "test 1", tuple(COLUMNS), ("level", "held"))
    assert words in str(caught.value) and str(path) in str(caught.value)


def test_files_whose_header_says_kind_are_read(tmp_path):
    """As curves and fits of flats were written before 0.1.0."""
    rng = np.random.default_rng(90210)
    pair = flat_covariances(*rng.poisson(900.0, (2, 60, 50)), lags=2, region="C07")
    path = tmp_path / "pair.ecsv"
    pair.write(path)
    path.write_text(path.read_text().replace("{schema: bf", "{kind: bf"))
    assert FlatCovariances.read(path) == pair


def test_lags_in_any_order_and_missing_ones(tmp_path):
    levels, a = np.linspace(5e3, 8e4, 12), np.array([[-1e-6, 2e-7], [3e-7, 5e-8]])
    curve = CovarianceCurve.from_arrays(
        levels, model_covariances(levels, a, noise=np.diag([25.0, 0.0])), pixels=250_000
    )
    result = fit_covariances(curve)
    path = tmp_path / "result.ecsv"
    result.write(path, overwrite=True)
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines[:-4], *lines[:-5:-1]]) + "\n")
    assert CovarianceFit.read(path) == result
    path.write_text("\n".join(lines[:-1]) + "\n")
    with pytest.raises(MeasurementError, match="lags do not fill a square"):
        CovarianceFit.read(path)


def test_squares_keep_further_axes():
    j, i = (index.ravel() for index in np.indices((3, 3)))
    values = np.stack([10 * j + i, -(10 * j + i)], 1)
    order = np.random.default_rng(31).permutation(9)
    columns = {"i": i[order], "j": j[order], "v": values[order]}
    found = square_lags("here", columns)
    assert list(found) == ["v"] and found["v"].shape == (3, 3, 2)
    assert found["v"][2, 1].tolist() == [21, -21]
