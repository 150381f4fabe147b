"""LSST's calibration datasets, read and written without the LSST stack.

The pipelines index every matrix of lags as [i][j], i along the serial direction, and store
it flattened; here all are [j, i].  Their files carry no units: columns without one are in the
units that the pipelines document (``UNITS``), and a column in another unit is refused.
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
from numpy.typing import NDArray

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
        Columns by the pipeline's names, a row for each amplifier.  Among them are
        ``AMPLIFIER_NAME``, ``RAW_MEANS`` [ADU], ``GAIN`` [e-/ADU], ``COVARIANCES`` (amplifier,
        pair, j, i) [ADU^2], ``A_MATRIX`` (amplifier, j, i) [1/e-], ``B_MATRIX`` and
        ``NOISE_MATRIX``.
    meta : mapping of str to value
        Values of the header by keyword.

    Examples
    --------
    Take one amplifier's covariances out of a dataset; a file gives one by
    ``PhotonTransferDataset.read(path)``.  To fit them, pass the arguments to
    ``bfsensor.measure.CovarianceCurve.from_arrays``.

    >>> one = np.ones(1)
    >>> dataset = PhotonTransferDataset(
    ...     {
    ...         "AMPLIFIER_NAME": np.array(["C10"]), "PTC_FIT_TYPE": np.array(["PARTIAL"]),
    ...         "COV_MATRIX_SIDE": np.array([2]), "EXP_ID_MASK": np.array([[True, False]]),
    ...         "RAW_MEANS": np.array([[5e3, 2e4]]), "RAW_VARS": np.array([[5e3, 2e4]]),
    ...         "GAIN": one, "NOISE": one, "COVARIANCES": np.zeros((1, 2, 2, 2)),
    ...         "A_MATRIX": np.zeros((1, 2, 2)),
    ...     }
    ... )
    >>> found = dataset.curve("C10")
    >>> found["levels"].tolist(), found["covariances"].shape
    ([5000.0], (1, 2, 2))
    """

    # The pipeline writes gains of 0 for amplifiers that it could not fit; who needs a gain says so.
    POSITIVE = ()
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
        """Names of the amplifiers, in the order of the rows."""
        return tuple(str(name) for name in self.columns["AMPLIFIER_NAME"])

    def row(self, amplifier: str) -> int:
        """Give the row of an amplifier.

        Parameters
        ----------
        amplifier : str
            Name of the amplifier.

        Returns
        -------
        row : int
            Its index in the columns, from 0.

        Raises
        ------
        RecordingError
            The dataset has no such amplifier.
        """
        if amplifier not in self.amplifiers:
            raise RecordingError(
                f"no amplifier {amplifier!r} among {', '.join(self.amplifiers)}"
            )
        return self.amplifiers.index(amplifier)

    def pairs_kept(self, amplifier: str) -> NDArray[np.bool_]:
        """Select the pairs that the pipeline kept and whose level and covariances are finite.

        Parameters
        ----------
        amplifier : str
            Name of an amplifier of the dataset.

        Returns
        -------
        kept : ndarray of bool, shape (pairs,)
            In the order of the dataset's pairs.
        """
        k = self.row(amplifier)
        kept = np.atleast_1d(self.columns["EXP_ID_MASK"][k]).astype(bool)
        finite = np.isfinite(np.atleast_1d(self.columns["RAW_MEANS"][k]))
        return kept & finite & np.isfinite(self.columns["COVARIANCES"][k]).all(axis=(1, 2))

    def curve(self, amplifier: str) -> dict[str, Any]:
        """Give levels and covariances of the pairs that the pipeline kept.

        Parameters
        ----------
        amplifier : str
            Name of the amplifier.

        Returns
        -------
        arguments : dict
            Arguments of :meth:`bfsensor.measure.CovarianceCurve.from_arrays`: ``levels`` [ADU],
            ``covariances`` (n, j, i) [ADU^2], ``unit``, ``region``, and ``pixels`` where the file
            has NPIXEL_COVARIANCES.  Pairs with covariances that are not finite are left out.

        Raises
        ------
        RecordingError
            The dataset has no such amplifier.
        """
        k = self.row(amplifier)
        levels = np.atleast_1d(self.columns["RAW_MEANS"][k])
        covariances = self.columns["COVARIANCES"][k]
        kept = self.pairs_kept(amplifier)
        out = {"levels": levels[kept], "covariances": covariances[kept],
               "unit": "adu", "region": amplifier}  # fmt: skip
        if "NPIXEL_COVARIANCES" in self.columns:
            out["pixels"] = int(self.columns["NPIXEL_COVARIANCES"][k])
        return out

    def noise(self, amplifier: str) -> float:
        """Give the read noise of an amplifier.

        Before version 1.9 of the format, full-covariance fits stored its square in NOISE.

        Parameters
        ----------
        amplifier : str
            Name of the amplifier.

        Returns
        -------
        noise : float
            Read noise [e-].

        Raises
        ------
        RecordingError
            The dataset has no such amplifier.
        """
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
        Columns by the pipeline's names, a row for each amplifier: ``AMPLIFIER``, ``GAIN``
        [e-/ADU], ``RAW_MEANS`` [ADU], ``RAW_XCORRS`` (amplifier, pair, j, i), ``MEAN_XCORRS``
        and ``KERNEL`` (amplifier, j, i), whose centre is in the middle.
    meta : mapping of str to value
        Values of the header by keyword.
    detectors : mapping of str to ndarray, shape (ny, nx)
        Kernels of whole detectors as [j, i], by the detector's name.

    Notes
    -----
    The kernels inherit [i][j] from the covariances from which they are solved.  ip_isr pull
    request 263 (May 2023) corrected their transposition: a kernel in an older file may have its
    axes exchanged.  Compare :meth:`larger_axis` with the covariances in the file.

    Examples
    --------
    >>> y, x = np.mgrid[-3:4, -3:4]
    >>> kernel = -1e-6 * np.exp(-(x**2 / 2 + y**2) / 2)
    >>> a = BrighterFatterKernel.area_changes(kernel)
    >>> a.shape, bool(a[0, 0] < 0), bool(a[1, 0] > a[0, 1])
    ((3, 3), True, True)
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
            raise RecordingError(
                "no column RAW_MEANS (before version 1.1: MEANS) of the flats' levels"
            )
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
                        f"{path}: the kernel of detector {name} has {flat.size} numbers, not "
                        f"{dx} x {dy} as KERNEL_DX and KERNEL_DY state"
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
        """Give the a_ij of a kernel, minus its Laplacian.

        Parameters
        ----------
        kernel : ndarray, shape (ny, nx)
            Kernel as [j, i], of odd sides, with its centre in the middle.

        Returns
        -------
        a : ndarray, shape (ny // 2, nx // 2)
            a_ij by lag [j, i] from (0, 0) [1/e-], up to the last lag at which the kernel has
            neighbours on all sides.

        References
        ----------
        Coulton et al. 2018, AJ 155, 258, section 2.
        """
        y, x = kernel.shape[0] // 2, kernel.shape[1] // 2
        k = kernel[y - 1 :, x - 1 :]
        around = k[2:, 1:-1] + k[:-2, 1:-1] + k[1:-1, 2:] + k[1:-1, :-2]
        return np.asarray(4 * k[1:-1, 1:-1] - around)

    def larger_axis(self, kernel: FloatArray) -> str:
        """Give the axis along which the neighbouring pixel gains more area.

        The kernel itself may be deeper along the other axis.

        Parameters
        ----------
        kernel : ndarray, shape (ny, nx)
            Kernel as [j, i], of odd sides of 5 at least.

        Returns
        -------
        axis : {'x', 'y'}
            'y', parallel, for most thick CCDs; 'x' suggests exchanged axes.
        """
        a = self.area_changes(kernel)
        return "y" if a[1, 0] > a[0, 1] else "x"


_FITTED = ("A_MATRIX_MODEL", "ATH", "ATH_MINUS_BETA", "A_N", "A_S", "A_E", "A_W")


@dataclass(frozen=True, eq=False)
class DistortionMatrix(CalibrationTable):
    """LSST's ElectrostaticBrighterFatterDistortionMatrix, after Astier & Regnault 2023.

    The table has one row, for a detector.

    Attributes
    ----------
    columns : mapping of str to ndarray
        Columns by the pipeline's names: ``A_MATRIX``, ``A_MATRIX_SIGMA``, ``USED_PIXELS`` and
        ``A_MATRIX_MODEL`` (1, j, i) [1/e-]; ``A_N``, ``A_S``, ``A_E``, ``A_W``, shifts of the four
        boundaries by lag, north towards larger j; ``FIT_PARAM_NAMES``, ``FIT_PARAMS`` and others.
    meta : mapping of str to value
        Values of the header by keyword.

    Notes
    -----
    ip_isr at commit 25d94e1 fills its own ``aMatrixModel`` from ``A_MATRIX_SIGMA`` when it reads a
    file; the column ``A_MATRIX_MODEL`` of the file is nevertheless that of the model.

    Examples
    --------
    >>> names = np.array([["thickness", "zq"]])
    >>> matrix = np.zeros((1, 4, 4))
    >>> columns = dict.fromkeys(DistortionMatrix.REQUIRED, matrix) | {
    ...     "INPUT_RANGE": np.array([4]), "FIT_RANGE": np.array([4]),
    ...     "FIT_PARAM_NAMES": names, "FIT_PARAMS": np.array([[100.0, 1.1]]),
    ... }
    >>> DistortionMatrix(columns).parameters
    {'thickness': 100.0, 'zq': 1.1}
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
