"""LSST's datasets: tables laid out as its code lays them out, written here by hand."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table

from bfsensor.errors import RecordingError
from bfsensor.measure.covariance_fit import fit_covariances
from bfsensor.measure.covariance_model import model_covariances
from bfsensor.measure.curve import CovarianceCurve
from bfsensor.recording.tables.lsst_datasets import (
    BrighterFatterKernel,
    DistortionMatrix,
    PhotonTransferDataset,
)

AMPS = ("C00", "C01")
SIDE, FITTED, PAIRS = 5, 4, 14
MEANS = np.linspace(2e3, 6e4, PAIRS)
GAIN = 1.6


def lags(side):
    """i and j as LSST indexes matrices: the first axis is the serial lag."""
    return np.meshgrid(np.arange(side), np.arange(side), indexing="ij")


def lsst_a(side):
    """A matrix [i][j]: the neighbour in y, (0, 1), is the stronger."""
    i, j = lags(side)
    r2 = np.maximum(i**2 + j**2, 1)
    a = 3e-7 * (1 + 0.5 * (j > i)) / r2**1.5
    a[0, 0] = -2e-6
    return a


def photon_transfer_table(version=2.6):
    a = lsst_a(FITTED)
    noise = np.zeros((SIDE, SIDE))
    noise[0, 0] = 36.0
    wide = np.pad(a.T, (0, SIDE - FITTED))
    ours = model_covariances(MEANS, wide, gain=GAIN, noise=noise)
    covariances = ours.transpose(0, 2, 1)
    mask = np.ones(PAIRS, bool)
    mask[-1] = False
    rows = [
        {
            "AMPLIFIER_NAME": amp,
            "PTC_FIT_TYPE": "FULLCOVARIANCE",
            "COV_MATRIX_SIDE": SIDE,
            "COV_MATRIX_SIDE_FULL_COV_FIT": FITTED,
            "INPUT_EXP_ID_PAIRS": np.arange(2 * PAIRS).reshape(PAIRS, 2),
            "EXP_ID_MASK": mask,
            "RAW_MEANS": MEANS,
            "RAW_VARS": ours[:, 0, 0],
            "GAIN": GAIN,
            "NOISE": 6.0 if version >= 1.9 else 36.0,
            "A_MATRIX": a.ravel(),
            "B_MATRIX": np.full(FITTED**2, np.nan),
            "NOISE_MATRIX": np.zeros(FITTED**2),
            "BAD_AMPS": np.array([], dtype="U3"),
            "NPIXEL_COVARIANCES": 900_000,
            "COVARIANCES": covariances.ravel(),
            "COVARIANCES_MODEL": covariances[:, :FITTED, :FITTED].ravel(),
            "COVARIANCES_SQRT_WEIGHTS": np.ones(covariances.size),
            "FINAL_MEANS": np.where(mask, MEANS, np.nan),
            "PTCAUX_TEMPERATURE": np.full(PAIRS, -100.5),
        }
        for amp in AMPS
    ]
    table = Table(rows)
    table.meta = {
        "OBSTYPE": "PTC", "PTC_SCHEMA": "Gen3 Photon Transfer Curve",
        "PTC_VERSION": version, "INSTRUME": "LSSTCam", "DETECTOR": 94, "FILTER": "",
    }  # fmt: skip
    return table


def kernel_tables(shape=(7, 7)):
    i, j = np.indices(shape)
    x, y = i - shape[0] // 2, j - shape[1] // 2
    kernel = -1e-7 / (1 + x**2 + 2.0 * y**2)
    side = (shape[0] - 1) // 2
    meta = {"OBSTYPE": "bfk", "bfk_SCHEMA": "Brighter-fatter kernel", "bfk_VERSION": 1.1,
            "LEVEL": "AMP", "KERNEL_DX": shape[0], "KERNEL_DY": shape[1]}  # fmt: skip
    first = Table(
        {
            "AMPLIFIER": list(AMPS),
            "EXP_ID_MASK": np.ones((2, PAIRS), bool),
            "RAW_MEANS": np.tile(MEANS, (2, 1)),
            "RAW_VARIANCES": np.tile(MEANS, (2, 1)) / GAIN,
            "RAW_XCORRS": np.tile(lsst_a(side).ravel(), (2, PAIRS)),
            "GAIN": [GAIN, GAIN],
            "NOISE": [6.0, 6.1],
            "MEAN_XCORRS": np.tile(kernel.ravel(), (2, 1)),
            "KERNEL": np.tile(kernel.ravel(), (2, 1)),
            "VALID": [1, 0],
        }
    )
    second = Table({"DETECTOR": ["R22_S11"], "KERNEL": [kernel.ravel()]})
    first.meta = second.meta = meta
    return kernel, [first, second]


def distortion_table(filters=("g_6", "y_10")):
    i, _ = lags(FITTED)
    north = 1e-7 * (1 + i)
    row = {
        "AMPNAMES": list(AMPS), "INPUT_RANGE": SIDE, "FIT_RANGE": FITTED,
        "BAD_AMPS": ["C10"], "GAIN": [GAIN, GAIN], "A_MATRIX": lsst_a(SIDE).ravel(),
        "A_MATRIX_SIGMA": np.full(SIDE**2, 1e-9), "A_MATRIX_MODEL": lsst_a(FITTED).ravel(),
        "A_MATRIX_SUM": 1e-9, "MODEL_NORMALIZATION": [1.0, 0.0],
        "USED_PIXELS": np.ones(SIDE**2, bool),
        "FIT_PARAM_NAMES": ["thickness", "zq", "zsh"], "FIT_PARAMS": [100.0, 1.1, 2.2],
        "FIT_CHI2": 17.5, "A_N": north.ravel(), "A_S": north.ravel(), "A_E": north.ravel(),
        "A_W": north.ravel(), "AVAILABLE_FILTERS": list(filters),
        "A_N_BY_FILTER": [north + k for k in range(len(filters))],
    }  # fmt: skip
    table = Table([row])
    table.meta = {"OBSTYPE": "BF_DISTORTION_MATRIX", "BF_DISTORTION_MATRIX_VERSION": 1.1}
    return north, table


def write_as_lsst(path, *tables):
    """Write as LSST's pipelines do: a primary without data, tables with headers, no units."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        hdus = [fits.table_to_hdu(table) for table in tables]
        fits.HDUList([fits.PrimaryHDU(), *hdus]).writeto(path)
    return path


def test_matrices_turn_to_y_first(tmp_path):
    path = write_as_lsst(tmp_path / "ptc.fits", photon_transfer_table())
    found = PhotonTransferDataset.read(path)
    assert found.amplifiers == AMPS
    a = found.columns["A_MATRIX"]
    assert a.shape == (2, FITTED, FITTED)
    # (i, j) = (0, 1): one row up.  Without the transposition the two would be exchanged.
    assert a[0, 1, 0] == lsst_a(FITTED)[0, 1] > lsst_a(FITTED)[1, 0] == a[0, 0, 1]
    assert found.columns["COVARIANCES"].shape == (2, PAIRS, SIDE, SIDE)
    assert found.columns["COVARIANCES_MODEL"].shape == (2, PAIRS, FITTED, FITTED)
    assert np.all(
        found.columns["COVARIANCES"][:, 1:, 1, 0]
        > found.columns["COVARIANCES"][:, 1:, 0, 1]
    )
    assert found.columns["FINAL_MEANS"][0, -1] != found.columns["FINAL_MEANS"][0, -1]


def test_the_pipelines_covariances_can_be_fitted(tmp_path):
    path = write_as_lsst(tmp_path / "ptc.fits", photon_transfer_table())
    arguments = PhotonTransferDataset.read(path).curve("C01")
    assert len(arguments["levels"]) == PAIRS - 1
    fit = fit_covariances(CovarianceCurve.from_arrays(**arguments), lags=FITTED - 1)
    # No noise was added: what is left is the fit's tolerance, 1e-6 of chi-square.
    np.testing.assert_allclose(fit.a, lsst_a(FITTED).T, atol=2e-11)
    assert fit.gain == pytest.approx(GAIN, rel=1e-6)


@pytest.mark.parametrize(("version", "stored"), [(1.8, 36.0), (2.6, 6.0)])
def test_noise_is_in_electrons_whatever_the_version(tmp_path, version, stored):
    path = write_as_lsst(tmp_path / "ptc.fits", photon_transfer_table(version))
    found = PhotonTransferDataset.read(path)
    assert found.columns["NOISE"][0] == stored
    assert found.noise("C00") == pytest.approx(6.0)


@pytest.mark.parametrize("ending", ["fits", "ecsv"])
def test_photon_transfer_round_trip(tmp_path, ending):
    path = write_as_lsst(tmp_path / "lsst.fits", photon_transfer_table())
    found = PhotonTransferDataset.read(path)
    found.write(tmp_path / f"ours.{ending}")
    again = PhotonTransferDataset.read(tmp_path / f"ours.{ending}")
    assert again == found
    changed = dict(found.columns)
    changed["GAIN"] = changed["GAIN"] * 1.000001
    assert PhotonTransferDataset(changed, found.meta) != found


def test_what_is_written_has_the_pipelines_layout(tmp_path):
    original = photon_transfer_table()
    found = PhotonTransferDataset.read(write_as_lsst(tmp_path / "lsst.fits", original))
    found.write(tmp_path / "ours.fits")
    table = Table.read(tmp_path / "ours.fits", hdu=1, mask_invalid=False)
    for name in ("A_MATRIX", "COVARIANCES", "COVARIANCES_MODEL"):
        np.testing.assert_array_equal(table[name], original[name])
    assert table["COVARIANCES"].unit is None
    assert table.meta["PTC_VERSION"] == 2.6
    found.write(tmp_path / "ours.ecsv")
    assert Table.read(tmp_path / "ours.ecsv")["COVARIANCES"].unit == "adu2"


@pytest.mark.parametrize("shape", [(7, 7), (17, 17)])
def test_kernels(tmp_path, shape):
    kernel, tables = kernel_tables(shape)
    found = BrighterFatterKernel.read(write_as_lsst(tmp_path / "bfk.fits", *tables))
    # LSST's second axis is y; this kernel is steeper along it.
    np.testing.assert_array_equal(found.columns["KERNEL"][0], kernel.T)
    np.testing.assert_array_equal(found.detectors["R22_S11"], kernel.T)
    assert found.larger_axis(found.detectors["R22_S11"]) == "y"
    assert found.larger_axis(kernel) == "x"
    side = (shape[0] - 1) // 2
    assert found.columns["RAW_XCORRS"].shape == (2, PAIRS, side, side)
    found.write(tmp_path / "again.fits")
    assert BrighterFatterKernel.read(tmp_path / "again.fits") == found
    with pytest.raises(RecordingError, match=r"again\.ecsv: .*one table, not 2.*FITS"):
        found.write(tmp_path / "again.ecsv")


@pytest.mark.parametrize("filters", [("g_6", "y_10"), ()])
def test_distortion_matrix(tmp_path, filters):
    north, table = distortion_table(filters)
    if not filters:
        table.remove_columns(["AVAILABLE_FILTERS", "A_N_BY_FILTER"])
    found = DistortionMatrix.read(write_as_lsst(tmp_path / "bf.fits", table))
    np.testing.assert_array_equal(found.columns["A_N"][0], north.T)
    assert found.columns["A_MATRIX"].shape == (1, SIDE, SIDE)
    assert (
        found.columns["A_MATRIX_MODEL"][0, 1, 0] > found.columns["A_MATRIX_MODEL"][0, 0, 1]
    )
    assert found.parameters == {"thickness": 100.0, "zq": 1.1, "zsh": 2.2}
    if filters:
        assert found.columns["A_N_BY_FILTER"].shape == (1, 2, FITTED, FITTED)
        np.testing.assert_array_equal(found.columns["A_N_BY_FILTER"][0, 1], north.T + 1)
    for ending in ("fits", "ecsv"):
        found.write(tmp_path / f"again.{ending}")
        assert DistortionMatrix.read(tmp_path / f"again.{ending}") == found
        written = Table.read(tmp_path / f"again.{ending}")
        for name in set(table.colnames) & set(DistortionMatrix.MATRICES):
            np.testing.assert_array_equal(written[name], table[name])


def broken(tmp_path, change):
    table = photon_transfer_table()
    change(table)
    return write_as_lsst(tmp_path / "ptc.fits", table)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda t: t.remove_columns(["COVARIANCES", "GAIN"]),
            "GAIN, COVARIANCES missing; ",
        ),
        (lambda t: t.meta.update(OBSTYPE="bfk"), "its OBSTYPE is 'bfk', not 'PTC'"),
        (lambda t: t.meta.pop("OBSTYPE"), "its OBSTYPE is None, not 'PTC'"),
        (
            lambda t: t.replace_column("COV_MATRIX_SIDE", [6, 6]),
            f"COVARIANCES has {PAIRS * 25} numbers a row, not {PAIRS} x 6 x 6 "
            "(pairs, side, side)",
        ),
        (
            lambda t: setattr(t["COVARIANCES"], "unit", "adu"),
            "COVARIANCES is in adu, not in adu2",
        ),
    ],
)
def test_refusals(tmp_path, change, message):
    path = broken(tmp_path, change)
    with pytest.raises(RecordingError) as caught:
        PhotonTransferDataset.read(path)
    assert str(caught.value).startswith(f"{path}: {message}")


def test_refusals_of_files(tmp_path):
    with pytest.raises(RecordingError, match=r"none\.fits: cannot be read: "):
        PhotonTransferDataset.read(tmp_path / "none.fits")
    fits.PrimaryHDU(np.zeros((3, 3))).writeto(tmp_path / "image.fits")
    with pytest.raises(RecordingError, match=r"image\.fits: holds no table"):
        PhotonTransferDataset.read(tmp_path / "image.fits")
    path = write_as_lsst(tmp_path / "ptc.fits", photon_transfer_table())
    found = PhotonTransferDataset.read(path)
    with pytest.raises(RecordingError, match=r"ptc\.fits exists.*overwrite"):
        found.write(path)
    with pytest.raises(RecordingError, match="no amplifier 'C17' among C00, C01"):
        found.curve("C17")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["image.fits", "ptc.fits"]
