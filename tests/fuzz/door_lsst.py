"""Doors of LSST's calibration datasets: photon transfer curves, kernels, distortion matrices."""

from __future__ import annotations

import io
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits
from astropy.table import Table

from bfsensor.recording.tables.covariance_tables import from_photon_transfer
from bfsensor.recording.tables.lsst_datasets import (
    PhotonTransferDataset,
)
from bfsensor.table.lsst_format import make_distortion_matrix, make_kernel
from bfsensor.table.quadrant_shifts import QuadrantShifts
from tests.fuzz.mutations import mutate_bytes, mutate_text, pick, short
from tests.fuzz.outcomes import Case, Door


def make_dataset() -> PhotonTransferDataset:
    """Make a dataset of three amplifiers, four pairs and two lags."""
    rng = np.random.default_rng(4127)
    levels = np.array([2e3, 8e3, 2e4, 4e4])
    c = np.zeros((3, 4, 2, 2))
    c[:, :, 0, 0] = levels
    c += rng.normal(0, 1, c.shape)
    return PhotonTransferDataset(
        {
            "AMPLIFIER_NAME": np.array(["C00", "C01", "C02"]),
            "PTC_FIT_TYPE": np.array(["FULLCOVARIANCE"] * 3),
            "COV_MATRIX_SIDE": np.array([2] * 3), "EXP_ID_MASK": np.ones((3, 4), bool),
            "RAW_MEANS": np.tile(levels, (3, 1)), "RAW_VARS": np.tile(levels, (3, 1)),
            "GAIN": np.array([1.5, 1.6, 1.7]), "NOISE": np.full(3, 6.0), "COVARIANCES": c,
            "COVARIANCES_SQRT_WEIGHTS": np.full_like(c, 0.1),
            "A_MATRIX": -1e-6 * rng.random((3, 2, 2)),
        }
    )  # fmt: skip


class Datasets(Door):
    """Files of three kinds as FITS and ECSV; columns are read again by astropy."""

    name = "lsst"

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        shifts = QuadrantShifts(np.full((2, 2), -1e-7), np.full((2, 2), -1e-7))
        whole = (
            make_dataset(), make_kernel(shifts, {"C00": 1.6}),
            make_distortion_matrix(shifts, {"C00": 1.6}),
        )  # fmt: skip
        self.files = []
        for one in whole:
            for end in ("fits", "ecsv"):
                path = folder / f"whole.{end}"
                one.write(path, overwrite=True)
                assert type(one).read(path) == one
                self.files.append((type(one), end, path.read_bytes()))

    def make(self, rng: np.random.Generator) -> Case:
        """Mutate a file: its bytes or lines, a keyword, or a column."""
        kind, end, data = pick(rng, self.files)
        if end == "ecsv":
            words, data, _ = mutate_text(rng, data.decode(), int(rng.choice([0, 20])))
        elif rng.random() < 0.4:
            words, data, _ = mutate_bytes(rng, data)
        else:
            words, data = _change(rng, data)
        path = self.write(f"set.{end}", data)

        def load() -> Any:
            made, said = kind.read(path), ""
            if kind is PhotonTransferDataset:
                said = " ".join(from_photon_transfer(made, path).warnings)
            return made, said

        return Case(
            f"{kind.__name__}, {end}: {words}", load, lambda made: _judge(*made, path),
            (f"set.{end}",),
        )  # fmt: skip


def _change(rng: np.random.Generator, data: bytes) -> tuple[str, bytes]:
    """Change a keyword, or a column of the table."""
    hdus = fits.open(io.BytesIO(data))
    table = hdus[1]
    column = pick(rng, table.columns.names)
    way = int(rng.integers(4))
    if way == 0:
        values = np.array(table.data[column])
        if values.dtype.kind in "fi" and values.size:
            new = pick(rng, (0, -1, 1e30, np.nan, np.inf, 99999999))
            with np.errstate(all="ignore"), warnings.catch_warnings():
                warnings.simplefilter("ignore")
                values.flat[int(rng.integers(values.size))] = (
                    new
                    if values.dtype.kind == "f" or (np.isfinite(new) and new < 1e9)
                    else -1
                )
            table.data[column] = values
        words = f"a value of {column} changes"
    elif way == 1:
        table.columns.del_col(column)
        words = f"column {column} is deleted"
    elif way == 2:
        table.data = table.data[: int(rng.integers(len(table.data) + 1))]
        words = f"{len(table.data)} rows are left"
    else:
        key = pick(
            rng, ("OBSTYPE", "KERNEL_DX", "KERNEL_DY", "PTC_VERSION", "TDIM9", "TFORM5")
        )
        value = pick(rng, (0, -1, 3, 99999999, "word", "", "(2,2)", "1E", True))
        if key in table.header:
            table.header[key] = value
        words = f"keyword {key} becomes {short(value)}"
    out = io.BytesIO()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            hdus.writeto(out, output_verify="ignore")
    except Exception:  # what astropy cannot write is no input
        return "nothing", data
    return words, out.getvalue()


def _judge(made: Any, said: str, path: Path) -> str:
    """Compare columns with those that astropy reads; numbers with units must be in range."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            if path.suffix == ".ecsv":
                table = Table.read(path, format="ascii.ecsv")
                read = {
                    name: np.ma.filled(np.ma.asarray(table[name].data))
                    for name in table.colnames
                }
            else:
                with fits.open(path) as hdus:
                    hdus.verify("silentfix")
                    read = {
                        name: np.array(hdus[1].data[name]) for name in hdus[1].columns.names
                    }
        except Exception as error:
            return f"astropy does not read it: {short(str(error))}"
    for name, there in read.items():
        own = np.asarray(made.columns[name])
        there = there if own.size else own
        if own.dtype.kind in "fib":
            a, b = (np.sort(np.asarray(v, float).ravel()) for v in (own, there))
            # Empty cells are nan.
            if not np.array_equal(a, b, equal_nan=True) and not np.isnan(a).any():
                return f"column {name} differs"
    gains = np.asarray(made.columns.get("GAIN", np.ones(1)), float)
    # Amplifiers that a dataset of photon transfer curves has no gain for are named.
    if "no gain for" not in said and (np.any(gains <= 0) or np.any(np.isinf(gains))):
        return f"GAIN = {gains.ravel().tolist()[:3]} was accepted"
    for name in type(made).REQUIRED:
        if name not in made.columns:
            return f"{name} is missing"
    return ""
