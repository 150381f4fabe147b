"""Reduced recordings: units, axes and lacks are named; files give back what was written."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table

from bfsensor.errors import RecordingError
from bfsensor.recording.tables.area_changes import read_area_changes
from bfsensor.recording.tables.covariance_tables import read_covariances
from bfsensor.recording.tables.lsst_datasets import PhotonTransferDataset
from bfsensor.recording.tables.reduced import (
    find_reduced,
    holds_images,
    read_profile,
    read_spots,
)

DATA = Path(__file__).parents[2] / "data"
SHARED = Path(__file__).parents[3].parent / "shared"
A = {(0, 0): -1.7e-6, (1, 0): 1.0e-7, (0, 1): 2.7e-7, (1, 1): 6e-8}


def covariances(levels=(5e3, 2e4, 8e4), a=None):
    """C_ij to second order of some a_ij, in electrons."""
    rows = []
    for amp in ("A", "B"):
        for mu in levels:
            for (i, j), value in (a or A).items():
                c = value * mu**2 + (mu if i == j == 0 else 0.0)
                rows.append((amp, mu, i, j, c, mu / 300, 90_000, 4, 620.0, -60.0))
    return Table(
        rows=rows,
        names=(
            "amp",
            "mu_e",
            "i",
            "j",
            "cov",
            "sigma",
            "npix",
            "npair",
            "wavelength",
            "vbb",
        ),
    )


def write(table, path, **meta):
    table.meta = meta
    table.write(path, format="ascii.ecsv", overwrite=True)
    return path


def test_a_covariance_table(tmp_path):
    found = read_covariances(write(covariances(), tmp_path / "c.ecsv"))
    assert found.what == (
        "covariances, 24 rows, 2 amplifiers, 3 levels from 5000 to 80000 e-, lags to 1, 1"
    )
    (text,) = found.warnings
    assert text.startswith("no covariance matrix")
    np.testing.assert_allclose(found.error_matrix(), np.diag(found.error**2))
    at = (found.lag_x == 0) & (found.lag_y == 1) & (found.level == 8e4)
    np.testing.assert_allclose(found.covariance[at], 2.7e-7 * 6.4e9)


def test_writing_gives_the_same_back(tmp_path):
    first = read_covariances(write(covariances(), tmp_path / "c.ecsv"))
    n = len(first.level)
    matrix = np.diag(first.error**2) + 3.0
    given = replace(first, matrix=matrix, warnings=())
    given.write(tmp_path / "again.ecsv")
    again = read_covariances(tmp_path / "again.ecsv")
    for name in ("level", "lag_x", "lag_y", "covariance", "error", "pixels", "wavelength"):
        np.testing.assert_array_equal(getattr(again, name), getattr(first, name))
    np.testing.assert_array_equal(again.error_matrix(), matrix)
    assert again.warnings == () and again.amplifier.tolist() == first.amplifier.tolist()
    assert again.matrix.shape == (n, n)
    with pytest.raises(RecordingError, match="exists"):
        given.write(tmp_path / "again.ecsv")


@pytest.mark.parametrize("gain", [0.5, 2.2])
def test_adu_and_differences(tmp_path, gain):
    table = covariances()
    expected = read_covariances(write(table, tmp_path / "e.ecsv"))
    table["mu_adu"] = table["mu_e"] / gain
    table["cov"] *= 2 / gain**2
    table["sigma"] *= 2 / gain**2
    table.remove_column("mu_e")
    path = write(table, tmp_path / "adu.ecsv", unit="adu", gain=gain, difference=True)
    found = read_covariances(path)
    np.testing.assert_allclose(found.covariance, expected.covariance)
    np.testing.assert_allclose(found.error, expected.error)
    np.testing.assert_allclose(found.level, expected.level)
    assert len(found.warnings) == 1
    path = write(table, tmp_path / "adu.ecsv", unit="adu")
    with pytest.raises(RecordingError, match="in ADU, and no gain"):
        read_covariances(path)


@pytest.mark.parametrize("word", ["no", "false", 0, 2.0])
def test_a_difference_is_true_or_false(tmp_path, word):
    """Any text is true in Python, and covariances would be halved."""
    path = write(covariances(), tmp_path / "c.ecsv", difference=word)
    with pytest.raises(
        RecordingError, match=r"c.ecsv: header entry difference = .* is not true"
    ):
        read_covariances(path)


@pytest.mark.parametrize(
    ("factor", "words"),
    [(2.0, "of a difference of two flats"), (0.5, "halved twice"), (5.0, "ADU taken")],
)
def test_units_are_held_against_poisson(tmp_path, factor, words):
    table = covariances()
    table["cov"] *= factor
    said = [
        w
        for w in read_covariances(write(table, tmp_path / "c.ecsv")).warnings
        if words in w
    ]
    assert len(said) == 2 and said[0].startswith("A: C_00 over the level is")


def test_exchanged_axes_are_only_suspected(tmp_path):
    table = covariances()
    i, j = np.array(table["i"]), np.array(table["j"])
    table["i"], table["j"] = j, i
    said = read_covariances(write(table, tmp_path / "c.ecsv")).warnings
    assert any("x and y may be exchanged; exchanged axes cannot be seen" in w for w in said)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda t: t.remove_column("sigma"), "sigma missing"),
        (lambda t: t.remove_column("j"), "j missing"),
        (lambda t: t["cov"].__setitem__(3, np.nan), "1 rows of covariance are not finite"),
        (lambda t: t["sigma"].__setitem__(3, 0.0), "errors must be above 0"),
        (lambda t: t.replace_column("i", t["i"] + 0.5), "row 1: i = "),
    ],
)
def test_what_cannot_be_used_is_refused(tmp_path, change, words):
    table = covariances()
    change(table)
    path = write(table, tmp_path / "c.ecsv")
    with pytest.raises(RecordingError) as caught:
        read_covariances(path)
    assert str(caught.value).startswith(f"{path}: {words}")


def photon_transfer(side=3, gain=1.5, weights=True):
    """Two amplifiers, [j, i] in memory; the second pair of the first is masked."""
    levels = np.array([[4e3, 1e4, 3e4], [5e3, 1e4, 2e4]])
    j, i = np.mgrid[:side, :side]
    c = 1e-6 * levels[..., None, None] ** 2 / (1 + i + 3 * j) ** 2
    c[..., 0, 0] = levels / gain
    columns = {
        "AMPLIFIER_NAME": np.array(["C00", "C01"]), "PTC_FIT_TYPE": np.array(["PARTIAL"] * 2),
        "COV_MATRIX_SIDE": np.array([side] * 2), "EXP_ID_MASK": np.ones((2, 3), bool),
        "RAW_MEANS": levels, "RAW_VARS": levels / gain, "GAIN": np.array([gain, np.nan]),
        "NOISE": np.ones(2), "COVARIANCES": c, "A_MATRIX": np.zeros((2, side, side)),
        "NPIXEL_COVARIANCES": np.array([10_000, 10_000]),
    }  # fmt: skip
    columns["EXP_ID_MASK"][0, 1] = False
    if weights:
        columns["COVARIANCES_SQRT_WEIGHTS"] = np.full((2, 3, side, side), 0.1)
    return PhotonTransferDataset(columns)


def test_photon_transfer_datasets(tmp_path):
    dataset = photon_transfer()
    dataset.write(tmp_path / "ptc.fits")
    (found,) = find_reduced(tmp_path)
    assert set(found.amplifier) == {"C00"} and len(found.level) == 2 * 9
    np.testing.assert_allclose(np.unique(found.level), [4e3 * 1.5, 3e4 * 1.5])
    np.testing.assert_allclose(found.error, 1.5**2 / 0.1)
    # The file is [i][j]; what is larger along x there must be so here.
    at = {
        lag: found.covariance[(found.lag_x == lag[0]) & (found.lag_y == lag[1])][0]
        for lag in ((1, 0), (0, 1))
    }
    assert at[1, 0] == pytest.approx(4 * at[0, 1])
    assert any("no gain for C01" in w for w in found.warnings)
    photon_transfer(weights=False).write(tmp_path / "ptc.fits", overwrite=True)
    white = find_reduced(tmp_path / "ptc.fits")[0]
    first = white.level == white.level[0]
    variance = 4e3 / 1.5 * 1.5**2
    np.testing.assert_allclose(white.error[first][0], variance * (2 / 10_000) ** 0.5)
    np.testing.assert_allclose(white.error[first][1:], variance / 100)


def test_weights_of_photon_transfer_datasets_belong_to_their_pairs(tmp_path):
    """A pair that was kept but has no covariances is left out together with its weights."""
    dataset = photon_transfer()
    columns = {name: np.array(column) for name, column in dataset.columns.items()}
    columns["EXP_ID_MASK"][0] = True
    columns["COVARIANCES"][0, 1] = np.nan
    columns["COVARIANCES_SQRT_WEIGHTS"][0] = np.reshape([0.1, 0.2, 0.3], (3, 1, 1))
    PhotonTransferDataset(columns).write(tmp_path / "ptc.fits")
    (found,) = find_reduced(tmp_path)
    low, high = (found.level == level for level in np.unique(found.level))
    np.testing.assert_allclose(found.error[low], 1.5**2 / 0.1)
    np.testing.assert_allclose(found.error[high], 1.5**2 / 0.3)


def test_the_sum_rule_makes_the_centre_dependent(tmp_path):
    rows = [(i, j, 1e-7 / (1 + i + j) ** 3, 1e-8) for i in range(4) for j in range(4)]
    others = sum(r[2] * (1 + (r[0] > 0)) * (1 + (r[1] > 0)) for r in rows[1:])
    rows[0] = (0, 0, -others, 1e-8)
    names = ("i_serial", "j_parallel", "cov_per_e", "err_per_e")
    Table(rows=rows, names=names).write(tmp_path / "a.csv")
    found = read_area_changes(tmp_path / "a.csv")
    assert not found.independent[0, 0] and found.independent.sum() == 15
    assert any("a_00 was set by the sum" in w for w in found.warnings)
    # Off by one error of the sum it counts.
    rows[0] = (0, 0, -others + 5e-8, 1e-8)
    Table(rows=rows, names=names).write(tmp_path / "a.csv", overwrite=True)
    assert read_area_changes(tmp_path / "a.csv").independent.all()
    turned = ("j_parallel", "i_serial", "cov_per_e", "err_per_e")
    np.testing.assert_array_equal(
        read_area_changes(tmp_path / "a.csv", columns=turned).a,
        read_area_changes(tmp_path / "a.csv").a.T,
    )


@pytest.mark.parametrize(
    ("name", "centre", "y"), [("itl", -1.044e-6, 1.761e-7), ("e2v", -1.68e-6, 2.747e-7)]
)
def test_published_area_changes(name, centre, y):
    path = DATA / f"{name}_covariances_21oct19.csv"
    found = read_area_changes(path)
    assert found.a.shape == (9, 9) and not found.independent[0, 0]
    assert (found.a[0, 0], found.a[1, 0]) == (centre, y)


def test_spots_and_profiles(tmp_path):
    table = Table(
        {"amplifier": ["A"] * 5, "flux": np.arange(5) * 1e5, "sigma_x": np.ones(5),
         "sigma_y": np.ones(5), "sigma_x_error": np.full(5, 0.01)}
    )  # fmt: skip
    table.write(tmp_path / "spots.ecsv", format="ascii.ecsv")
    spots = read_spots(tmp_path / "spots.ecsv")
    assert set(spots.errors) == {"sigma_x"} and len(spots.warnings) == 2
    table.remove_column("flux")
    table.write(tmp_path / "none.ecsv", format="ascii.ecsv")
    with pytest.raises(RecordingError, match=r"none\.ecsv: .*flux or peak .*sigma_x"):
        read_spots(tmp_path / "none.ecsv")
    radius = np.arange(0.0, 300, 3)
    value = np.where(radius < 30, np.nan, np.sin(radius))
    np.savetxt(tmp_path / "rings.txt", np.c_[radius, value])
    rings = read_profile(tmp_path / "rings.txt", unit="percent")
    assert rings.radius[0] == 30 and len(rings.radius) == 90
    assert rings.warnings[-1].startswith("10 radii ")
    np.savetxt(tmp_path / "rings.txt", np.c_[radius[::-1], value])
    with pytest.raises(RecordingError, match=r"rings\.txt: .*ascend"):
        read_profile(tmp_path / "rings.txt")


def test_measured_tree_rings():
    folder = SHARED / "recordings" / "bnl_treerings"
    if not folder.is_dir():
        pytest.skip(f"no {folder}")
    rms = {}
    for volts in (0, 70):
        profile = read_profile(folder / f"e2v-260-{volts}V_save_points.txt", unit="percent")
        assert len(profile.radius) > 1700 and np.all(np.diff(profile.radius) >= 3 - 1e-9)
        # From ring to ring: the slow change of the illumination drops out.
        rms[volts] = float(np.std(np.diff(profile.value)[50:-50]))
    # The drift field of 70 V carries electrons past the rings: weaker by a factor of 2 to 5.
    assert 2 < rms[0] / rms[70] < 5


@pytest.mark.parametrize(
    ("names", "images"),
    [((), False), (("dataset",), False), (("image",), True), (("dataset", "image"), True)],
)
def test_a_folder_of_datasets_holds_no_images(tmp_path, names, images):
    dataset = fits.table_to_hdu(Table({"PAIR": np.arange(9.0)}))
    dataset.header["OBSTYPE"] = "PTC"
    for name in names:
        hdu = dataset if name == "dataset" else fits.ImageHDU(np.zeros((90, 90)))
        fits.HDUList([fits.PrimaryHDU(), hdu]).writeto(tmp_path / f"{name}.fits")
    assert holds_images(tmp_path) is images
