"""LSST's calibration datasets by column name, without the LSST stack.

The pipelines index every matrix of lags as [i][j], i along the serial direction, and store
it flattened; here all are [j, i].  Their files carry no units: columns without one are
taken in the units that the pipelines document (``UNITS``), a different unit is refused.
Formats: ip_isr, ``ptcDataset.py`` (to version 2.6), ``brighterFatterKernel.py`` (1.1) and
``electrostaticBrighterFatter.py`` (1.1).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import numpy as np
from astropy.table import Table

from bfsensor.errors import RecordingError
from bfsensor.recording.tables.calibration_tables import (
    CalibrationTable,
    Columns,
    Sides,
    look_up,
    plain,
    require,
    same,
)
from bfsensor.typing import FloatArray


@dataclass(frozen=True, eq=False)
class PhotonTransferDataset(CalibrationTable):
    """LSST's PhotonTransferCurveDataset: photon transfer curves and covariances.

    Attributes
    ----------
    columns : mapping of str to ndarray
        Among others ``AMPLIFIER_NAME``, ``RAW_MEANS`` [ADU], ``GAIN`` [e-/ADU],
        ``COVARIANCES`` (amplifier, pair, j, i) [ADU^2], ``A_MATRIX`` (amplifier, j, i)
        [1/e-], ``B_MATRIX``, ``NOISE_MATRIX``.
    meta : mapping of str to value
        Cards of the header.

    Examples
    --------
    Refit what the pipeline measured (``path`` a calibration file)::

        dataset = PhotonTransferDataset.read(path)
        curve = CovarianceCurve.from_arrays(**dataset.curve("C10"), pixels=900_000)
        fit = fit_covariances(curve)
    """

    OBSTYPE = "PTC"
    SCHEMA = "Gen3 Photon Transfer Curve"
    VERSION = 2.6
    REQUIRED = (
        "AMPLIFIER_NAME", "PTC_FIT_TYPE", "COV_MATRIX_SIDE", "EXP_ID_MASK", "RAW_MEANS",
        "RAW_VARS", "GAIN", "NOISE", "COVARIANCES", "A_MATRIX",
    )  # fmt: skip
    MATRICES = MappingProxyType(
        {
            "COVARIANCES": ("pairs", "side", "side"),
            "COVARIANCES_SQRT_WEIGHTS": ("pairs", "side", "side"),
            "COVARIANCES_MODEL": ("pairs", "fitted side", "fitted side"),
            "COVARIANCES_MODEL_NO_B": ("pairs", "fitted side", "fitted side"),
            "A_MATRIX": ("fitted side", "fitted side"),
            "B_MATRIX": ("fitted side", "fitted side"),
            "NOISE_MATRIX": ("fitted side", "fitted side"),
            "A_MATRIX_NO_B": ("fitted side", "fitted side"),
            "NOISE_MATRIX_NO_B": ("fitted side", "fitted side"),
        }
    )
    UNITS = MappingProxyType(
        {
            "RAW_EXP_TIMES": "s",
            "RAW_MEANS": "adu",
            "RAW_VARS": "adu2",
            "GAIN": "electron / adu",
            "GAIN_ERR": "electron / adu",
            "COVARIANCES": "adu2",
            "COVARIANCES_MODEL": "adu2",
            "COVARIANCES_MODEL_NO_B": "adu2",
            "A_MATRIX": "1 / electron",
            "B_MATRIX": "1 / electron",
            "A_MATRIX_NO_B": "1 / electron",
            "NOISE_MATRIX": "electron2",
            "NOISE_MATRIX_NO_B": "electron2",
            "FINAL_MEANS": "adu",
            "FINAL_VARS": "adu2",
            "FINAL_MODEL_VARS": "adu2",
            "PTC_TURNOFF": "adu",
        }
    )

    @classmethod
    def _sides(cls, columns: Columns, meta: Mapping[str, Any]) -> Sides:
        side = int(columns["COV_MATRIX_SIDE"][0])
        # Version 1.5 fits fewer lags than it measures.
        fitted = columns.get("COV_MATRIX_SIDE_FULL_COV_FIT", columns["COV_MATRIX_SIDE"])
        pairs = columns["RAW_MEANS"].reshape(len(columns["RAW_MEANS"]), -1).shape[1]
        return {"pairs": pairs, "side": side, "fitted side": int(fitted[0])}

    @property
    def amplifiers(self) -> tuple[str, ...]:
        """Names, in the order of the rows."""
        return tuple(str(name) for name in self.columns["AMPLIFIER_NAME"])

    def row(self, amplifier: str) -> int:
        """Give the row of an amplifier."""
        if amplifier not in self.amplifiers:
            raise RecordingError(
                f"no amplifier {amplifier!r} among {', '.join(self.amplifiers)}"
            )
        return self.amplifiers.index(amplifier)

    def curve(self, amplifier: str) -> dict[str, Any]:
        """Levels and covariances of the pairs that the pipeline kept, and their names.

        Returns
        -------
        arguments : dict
            ``levels`` [ADU], ``covariances`` (n, j, i) [ADU^2], ``unit``, ``region``: what
            ``CovarianceCurve.from_arrays`` takes, with ``pixels`` where the file has it.
        """
        k = self.row(amplifier)
        levels = np.atleast_1d(self.columns["RAW_MEANS"][k])
        covariances = self.columns["COVARIANCES"][k]
        kept = np.atleast_1d(self.columns["EXP_ID_MASK"][k]).astype(bool)
        kept = kept & np.isfinite(levels) & np.isfinite(covariances).all(axis=(1, 2))
        out = {"levels": levels[kept], "covariances": covariances[kept],
               "unit": "adu", "region": amplifier}  # fmt: skip
        if "NPIXEL_COVARIANCES" in self.columns:
            out["pixels"] = int(self.columns["NPIXEL_COVARIANCES"][k])
        return out

    def noise(self, amplifier: str) -> float:
        """Read noise [e-]; before version 1.9 full-covariance fits stored its square."""
        k = self.row(amplifier)
        value = float(self.columns["NOISE"][k])
        squared = str(self.columns["PTC_FIT_TYPE"][k]).startswith("FULLCOVARIANCE")
        return value**0.5 if squared and self.version < 1.9 else value


@dataclass(frozen=True, eq=False)
class BrighterFatterKernel(CalibrationTable):
    """LSST's BrighterFatterKernel, after Coulton et al. 2018.

    Attributes
    ----------
    columns : mapping of str to ndarray
        ``AMPLIFIER``, ``GAIN`` [e-/ADU], ``RAW_MEANS``, ``RAW_XCORRS`` (amplifier, pair,
        j, i), ``MEAN_XCORRS`` and ``KERNEL`` (amplifier, j, i), centre in the middle.
    detectors : mapping of str to ndarray, shape (ny, nx)
        Kernels of whole detectors, [j, i].

    Notes
    -----
    The kernels inherit [i][j] from the covariances they are solved from; ip_isr pull
    request 263 (May 2023) mended their transposition, so one in an older file may have its
    axes exchanged: compare with the covariances beside it (:meth:`larger_axis`).
    """

    detectors: Mapping[str, FloatArray] = field(default_factory=dict)

    OBSTYPE = "bfk"
    SCHEMA = "Brighter-fatter kernel"
    VERSION = 1.1
    REQUIRED = (
        "AMPLIFIER", "RAW_XCORRS", "GAIN", "NOISE", "MEAN_XCORRS", "KERNEL", "VALID",
    )  # fmt: skip
    MATRICES = MappingProxyType(
        {
            "RAW_XCORRS": ("pairs", "side", "side"),
            "MEAN_XCORRS": ("KERNEL_DX", "KERNEL_DY"),
            "KERNEL": ("KERNEL_DX", "KERNEL_DY"),
        }
    )
    UNITS = MappingProxyType(
        {"GAIN": "electron / adu", "RAW_MEANS": "adu", "RAW_VARIANCES": "adu2"}
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "detectors", MappingProxyType(dict(self.detectors)))
        kernels = [*self.columns["KERNEL"], *self.detectors.values()]
        if kernels:
            ny, nx = np.shape(kernels[0])
            meta = {**self.meta, "KERNEL_DX": nx, "KERNEL_DY": ny}
            object.__setattr__(self, "meta", MappingProxyType(meta))

    def __eq__(self, other: object) -> bool:
        equal = super().__eq__(other)
        if equal is True and isinstance(other, BrighterFatterKernel):
            return same(self.detectors, other.detectors)
        return equal

    __hash__ = None

    @classmethod
    def _sides(cls, columns: Columns, meta: Mapping[str, Any]) -> Sides:
        dx, dy = (int(look_up(meta, f"KERNEL_D{axis}", 17)) for axis in "XY")
        means = columns.get("RAW_MEANS", columns.get("MEANS"))
        if means is None:
            raise RecordingError("RAW_MEANS (before version 1.1: MEANS) is missing")
        pairs = means.reshape(len(means), -1).shape[1]
        return {"KERNEL_DX": dx, "KERNEL_DY": dy, "side": (dx - 1) // 2, "pairs": pairs}

    @classmethod
    def _from_tables(cls, path: str, tables: list[Table]) -> BrighterFatterKernel:
        meta = tables[0].meta
        detectors = {}
        if len(tables) > 1:
            require(f"{path}: second table", tables[1].colnames, ("DETECTOR", "KERNEL"))
            dx, dy = (int(look_up(meta, f"KERNEL_D{axis}", 17)) for axis in "XY")
            for name, kernel in zip(
                plain(np.asarray(tables[1]["DETECTOR"])), tables[1]["KERNEL"], strict=True
            ):
                flat = np.asarray(kernel, float)
                if flat.size != dx * dy:
                    raise RecordingError(
                        f"{path}: detector kernel of {flat.size} numbers, not {dx} x {dy}"
                    )
                detectors[str(name)] = flat.reshape(dx, dy).T.copy()
        return cls(cls._unfold(path, tables[0]), meta, detectors)

    def _to_tables(self) -> list[Table]:
        first = self._fold()
        if not self.detectors:
            return [first]
        flat = [kernel.T.ravel() for kernel in self.detectors.values()]
        second = Table({"DETECTOR": list(self.detectors), "KERNEL": flat})
        second.meta = dict(first.meta)
        return [first, second]

    @staticmethod
    def area_changes(kernel: FloatArray) -> FloatArray:
        """Give the a_ij [1/e-] that a kernel stands for: minus its Laplacian.

        Parameters
        ----------
        kernel : ndarray, shape (ny, nx)
            [j, i], of odd sides, zero beyond them.

        Returns
        -------
        a : ndarray, shape (ny // 2, nx // 2)
            By lag [j, i] from (0, 0), up to where the kernel still has neighbours.

        References
        ----------
        Coulton et al. 2018, AJ 155, 258, section 2.
        """
        y, x = kernel.shape[0] // 2, kernel.shape[1] // 2
        k = kernel[y - 1 :, x - 1 :]
        around = k[2:, 1:-1] + k[:-2, 1:-1] + k[1:-1, 2:] + k[1:-1, :-2]
        return np.asarray(4 * k[1:-1, 1:-1] - around)

    def larger_axis(self, kernel: FloatArray) -> str:
        """Give the axis, 'x' or 'y', whose next pixel gains the larger area.

        The kernel itself may be the deeper along the other one.
        """
        a = self.area_changes(kernel)
        return "y" if a[1, 0] > a[0, 1] else "x"


_FITTED = ("A_MATRIX_MODEL", "ATH", "ATH_MINUS_BETA", "A_N", "A_S", "A_E", "A_W")


@dataclass(frozen=True, eq=False)
class DistortionMatrix(CalibrationTable):
    """LSST's ElectrostaticBrighterFatterDistortionMatrix, after Astier & Regnault 2023.

    One row for a detector.

    Attributes
    ----------
    columns : mapping of str to ndarray
        ``A_MATRIX``, ``A_MATRIX_SIGMA``, ``USED_PIXELS``, ``A_MATRIX_MODEL`` (1, j, i)
        [1/e-], ``A_N``, ``A_S``, ``A_E``, ``A_W``: shifts of the four boundaries, north
        towards larger j; ``FIT_PARAM_NAMES``, ``FIT_PARAMS`` and more.

    Notes
    -----
    ip_isr 25d94e1 fills its own ``aMatrixModel`` from ``A_MATRIX_SIGMA`` when it reads; the
    column in the file is the model's.
    """

    OBSTYPE = "BF_DISTORTION_MATRIX"
    SCHEMA = "ELectrostatic brighter-fatter pixel distortion model"
    VERSION = 1.1
    REQUIRED = (
        "INPUT_RANGE", "FIT_RANGE", "A_MATRIX", "A_MATRIX_SIGMA", "A_MATRIX_MODEL",
        "A_N", "A_S", "A_E", "A_W", "FIT_PARAM_NAMES", "FIT_PARAMS",
    )  # fmt: skip
    MATRICES = MappingProxyType(
        dict.fromkeys(("A_MATRIX", "A_MATRIX_SIGMA", "USED_PIXELS"), ("INPUT_RANGE",) * 2)
        | dict.fromkeys(_FITTED, ("FIT_RANGE",) * 2)
        | {f"{name}_BY_FILTER": ("filters", *("FIT_RANGE",) * 2) for name in _FITTED}
    )
    UNITS = MappingProxyType(
        dict.fromkeys(("A_MATRIX", "A_MATRIX_SIGMA", "A_MATRIX_MODEL"), "1 / electron")
    )

    @classmethod
    def _sides(cls, columns: Columns, meta: Mapping[str, Any]) -> Sides:
        filters = columns.get("AVAILABLE_FILTERS")
        return {
            "INPUT_RANGE": int(columns["INPUT_RANGE"][0]),
            "FIT_RANGE": int(columns["FIT_RANGE"][0]),
            "filters": 0 if filters is None else filters.size // len(filters),
        }

    @property
    def parameters(self) -> dict[str, float]:
        """Fitted electrostatic parameters by name."""
        names, values = self.columns["FIT_PARAM_NAMES"], self.columns["FIT_PARAMS"]
        return {
            str(name): float(value)
            for name, value in zip(names.ravel(), values.ravel(), strict=True)
        }
