"""SiliconSensor: a drop-in for ``galsim.SiliconSensor`` on bfsensor's kernels."""

from __future__ import annotations

import math
import os
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import galsim
import numpy as np

from bfsensor._kernels.charge import Response
from bfsensor._kernels.photons import Medium
from bfsensor._kernels.shifts import Edges
from bfsensor.device.shipped import did_you_mean, tables_dir
from bfsensor.errors import SensorError, TableError
from bfsensor.sensor.base import EngineSensor, check_rings, make_rng, read_numbers
from bfsensor.sensor.edge_weights import make_edges, transpose_sides
from bfsensor.sensor.image_exposure import Physics
from bfsensor.sensor.options import (
    LARGEST,
    check_flag,
    check_number,
    check_path,
    check_surroundings,
    check_whole,
    galsim_folder,
    outside_charge,
    shown,
    truth_as_number,
)
from bfsensor.simulate.mean_field import STEPS
from bfsensor.table.galsim_format import read_sides
from bfsensor.typing import FloatArray

_DEPTH_SCALE = 12.0
"""Height [um] by which shifts grow as tanh(z / 12 um): published, an empirical fit of GalSim's
SiliconSensor."""

_SURFACE_PATH = 1.0
"""Depth of conversion below the back surface [um] of photons without wavelengths: published, that
of GalSim's SiliconSensor."""

_EXTRA_COLLECT, _EXTRA_BARRIER = 12.0, 15.0
# Potential of the channel above that of the collecting and of the barrier gates [V]: published,
# estimates of GalSim's SiliconSensor.

_WIDTH = 0.27**-0.5
"""Width of the diffusion over that by Einstein's relation: published, GalSim's SiliconSensor, whose
factor 0.27 on the mobility was found by hand on X-ray clusters of LSST's sensors."""

_KEYS = (
    "NumVertices", "PixelBoundaryNx", "PixelBoundaryNy", "PixelSizeX", "SensorThickness",
    "CollectedCharge_0_0", "NumPhases", "CollectingPhases", "ChannelStopWidth",
    "FieldOxideTaper", "Vbb", "Vparallel_lo", "Vparallel_hi", "qfh", "CCDTemperature",
)  # fmt: skip
"""Keys that a .cfg file must hold, each with a finite number."""

_ABOVE_0 = (
    "NumVertices", "PixelBoundaryNx", "PixelBoundaryNy", "PixelSizeX", "SensorThickness",
    "CollectedCharge_0_0", "NumPhases", "CCDTemperature",
)  # fmt: skip
"""Keys of which the number is above 0."""


class SiliconSensor(EngineSensor):
    r"""Drop-in for ``galsim.SiliconSensor`` with its signature, files and documented physics.

    Shifts are linear in charge and do not depend on the background; they scale with the
    height of conversion as :math:`\tanh(z / 12\,\mu m)`; boundaries are renewed every
    ``nrecalc`` electrons; photons with angles that would cross the silicon convert 1 um
    above the gates, others are lost.  Unlike GalSim's, the edges at the right and the top
    of an image move as well, the depth scaling acts on all photons and on tree rings,
    files are read without evaluating them, and ``qdist`` beyond the table is refused.
    Random numbers differ from GalSim's: images agree with its own in distribution only.

    Parameters
    ----------
    name : str
        Stem of the .cfg and .dat files: a path, or one of those shipped with GalSim.
    strength : float
        Factor on all shifts, from -1e6 to 1e6.
    rng : galsim.BaseDeviate, optional
        Source of the key of the random numbers.
    diffusion_factor : float
        Factor on the width of the diffusion, at least 0 (GalSim takes negative ones as well).
    qdist : int
        Largest distance [pixel] at which charge acts, up to the table's reach (4 in GalSim's).
    nrecalc : float
        Electrons in the image between renewals of the boundaries, divided by the size of
        ``strength``, at least 0 (GalSim takes negative ones as well); 0 or inf: they are renewed by
        ``recalc`` only.
    treering_func : galsim.LookupTable, optional
        Radial shift of the boundaries [pixel], by radius [pixel].
    treering_center : galsim.PositionD
        Centre of the rings in original image coordinates.
    transpose : bool
        Whether x and y of the table are exchanged.
    surroundings : {'none', 'mirrored'} or float
        Charge beyond the image, which moves the boundaries of the pixels near its sides: none; that of
        the image mirrored at its sides, as it is at each renewal; or the same charge [e-] in every
        pixel, at least 0, from the beginning to the end of the exposure.  Electrons that land there
        are lost.  A sky or flat without a frame of small pixels needs 'mirrored', or its level.
    threads : int, optional
        Largest number of threads of one call, at least 1; the result does not depend on it.  By
        default as many as ``galsim.get_omp_threads()`` says at each call of 65,536 photons or
        more, otherwise 1.  Blocks of few photons use fewer.

    Raises
    ------
    SensorError
        A value outside the range that is stated above; of another type, a SensorTypeError, which is a
        TypeError too.
    OSError
        The files are missing or cannot be read as a table; the message names them.
    galsim.GalSimRangeError
        ``qdist`` is beyond the table.

    Examples
    --------
    >>> import galsim
    >>> sensor = SiliconSensor(rng=galsim.BaseDeviate(815))
    >>> star = galsim.Gaussian(sigma=0.4, flux=1e5)
    >>> image = star.drawImage(nx=17, ny=17, scale=0.3, method="phot", sensor=sensor,
    ...                        rng=galsim.BaseDeviate(816))
    >>> bool(abs(image.array.sum() / 1e5 - 1) < 0.02)
    True
    """

    _opt_params = {  # noqa: RUF012
        **galsim.SiliconSensor._opt_params, "surroundings": str, "threads": int,
    }  # fmt: skip

    def __init__(
        self,
        name: str = "lsst_itl_50_8",
        strength: float = 1.0,
        rng: galsim.BaseDeviate | None = None,
        diffusion_factor: float = 1.0,
        qdist: int = 3,
        nrecalc: float = 10000,
        treering_func: galsim.LookupTable | None = None,
        treering_center: galsim.PositionD = galsim.PositionD(0, 0),  # noqa: B008
        transpose: bool = False,
        *,
        surroundings: Literal["none", "mirrored"] | float = "none",
        threads: int | None = None,
    ) -> None:
        self.name = check_path("name", name, "the stem of a .cfg and a .dat file")
        self.surroundings = check_surroundings(surroundings)
        self.strength = check_number(
            "strength", truth_as_number(strength), low=-LARGEST, high=LARGEST
        )
        self.rng = make_rng(rng)
        self.diffusion_factor = check_number(
            "diffusion_factor", truth_as_number(diffusion_factor), low=0.0, high=LARGEST
        )
        self.qdist = check_whole("qdist", truth_as_number(qdist))
        self.nrecalc = check_number(
            "nrecalc", truth_as_number(nrecalc), low=0.0, infinite=True
        )
        check_rings(treering_func, treering_center)
        self.treering_func = treering_func
        self.treering_center = treering_center
        self.transpose = check_flag("transpose", transpose)
        self.threads = threads
        self.config_file, self.vertex_file = _find(self.name)
        try:
            self.config = read_numbers(self.config_file)
            self.config.update(_defaults(self.config, self.config_file))
            self._changed = tuple(
                Path(p).stat().st_mtime_ns for p in (self.config_file, self.vertex_file)
            )
            sides, _points = _read(self.config_file, self.vertex_file, self._changed)
        except (TableError, SensorError) as error:
            raise OSError(str(error)) from None
        reach = sides[0].shape[0] // 2
        if not 0 <= self.qdist <= reach:
            raise galsim.GalSimRangeError(
                f"qdist: the table of {name} holds charge up to {reach} pixels away",
                self.qdist, 0, reach,
            )  # fmt: skip
        self._read_absorption()
        self._init_silicon()

    def _read_absorption(self) -> None:
        """Read GalSim's table of absorption lengths [um] by wavelength [nm]."""
        path = os.path.join(galsim.meta_data.share_dir, "sensors", "abs_length.dat")
        data = np.loadtxt(path, skiprows=1)
        self.abs_length_table = galsim.LookupTable(
            x=data[:, 0], f=data[:, 1], interpolant="linear"
        )

    @property
    def effective_nrecalc(self) -> float:
        """Electrons in the image between renewals: ``nrecalc`` over the size of the strength."""
        return self.nrecalc / abs(self.strength) if self.strength else self.nrecalc

    def _diffusion(self) -> float:
        """Width of the diffusion of electrons from the back surface [um], as GalSim estimates it.

        It is Einstein's relation in a uniform field, with GalSim's factor on the variance.
        """
        c = self.config
        stop = (c["ChannelStopWidth"] + 2 * c["FieldOxideTaper"]) / c["PixelSizeX"]
        collecting = c["CollectingPhases"] / c["NumPhases"]
        front = stop * c["qfh"] + (1 - stop) * (
            collecting * (c["Vparallel_hi"] + _EXTRA_COLLECT)
            + (1 - collecting) * (c["Vparallel_lo"] + _EXTRA_BARRIER)
        )
        voltage = max(front - c["Vbb"], 1.0)
        # GalSim's kT/q, 0.026 V at 298 K.
        kt = 0.026 * c["CCDTemperature"] / 298.0
        return float(_WIDTH * np.sqrt(2 * kt / voltage) * c["SensorThickness"])

    def _make_physics(self) -> tuple[Physics, FloatArray]:
        c = self.config
        thickness = float(c["SensorThickness"])
        steps = np.linspace(0.0, 1.0, STEPS + 1)
        scale = np.tanh(steps * thickness / _DEPTH_SCALE)
        edges = _edges(
            self.config_file, self.vertex_file, self._changed,
            self.strength / (float(c["CollectedCharge_0_0"]) * c["PixelSizeX"]),
            self.transpose, self.qdist, thickness,
        )  # fmt: skip
        lengths = np.asarray(self.abs_length_table.f, float)
        wavelengths = np.asarray(self.abs_length_table.x, float)
        sigma = self.diffusion_factor * self._diffusion()
        medium = Medium(
            thickness=thickness,
            pitch_x=float(c["PixelSizeX"]),
            pitch_y=float(c["PixelSizeX"]),
            lengths=lengths,
            wavelength_0=float(wavelengths[0]),
            wavelength_step=float(wavelengths[1] - wavelengths[0]),
            surface_path=_SURFACE_PATH,
            kept_path=thickness - 1.0,
            kept_slanted=True,
            variance=sigma**2 * steps,
            diffuse=sigma > 0,
        )
        none = np.zeros((0, 0), np.float32)
        physics = Physics(
            edges, Response(none, none[..., None], 1.0, 1.0, np.inf, np.inf), medium, np.inf,
            not self.transpose, self.effective_nrecalc, False,
            surroundings=outside_charge(self.surroundings),
        )  # fmt: skip
        return physics, scale

    def _key(self) -> tuple[Any, ...]:
        return (
            self.config, self.strength, self.diffusion_factor, self.qdist, self.nrecalc,
            self.treering_func, self.treering_center, self.transpose, self.surroundings,
            self.threads,
        )  # fmt: skip

    def __str__(self) -> str:
        parts = [repr(self.name)]
        for key, neutral in (("strength", 1.0), ("diffusion_factor", 1.0)):
            if getattr(self, key) != neutral:
                parts.append(f"{key}={getattr(self, key):g}")
        if self.transpose:
            parts.append("transpose=True")
        return f"bfsensor.SiliconSensor({', '.join(parts)})"

    def __repr__(self) -> str:
        keys = (
            "name", "strength", "rng", "diffusion_factor", "qdist", "nrecalc",
            "treering_func", "treering_center", "transpose", "surroundings", "threads",
        )  # fmt: skip
        parts = [f"{key}={getattr(self, key)!r}" for key in keys]
        return f"bfsensor.SiliconSensor({', '.join(parts)})"


@lru_cache(maxsize=16)
def _read(
    cfg: str, dat: str, changed: tuple[int, ...]
) -> tuple[tuple[FloatArray, FloatArray], FloatArray]:
    """Read a table; ``changed`` is part of the cache's key, so that changed files are read again."""
    return read_sides(cfg, dat)


@lru_cache(maxsize=16)
def _edges(
    cfg: str, dat: str, changed: tuple[int, ...], per_electron: float, transpose: bool,
    reach: int, thickness: float,
) -> Edges:  # fmt: skip
    """Pack a table for the kernels, once for all sensors with the same arguments."""
    sides, points = _read(cfg, dat, changed)
    if transpose:
        sides = transpose_sides(*sides)
    scale = np.tanh(np.linspace(0.0, 1.0, STEPS + 1) * thickness / _DEPTH_SCALE)
    # Where the factor is 1 to single precision, edges are looked up faster.
    scale[scale > 1 - 5e-7] = 1.0
    return make_edges(
        [(per_electron * sides[0][None], per_electron * sides[1][None])], points,
        np.array([thickness]), reach, scale=scale,
    )  # fmt: skip


def _find(name: str) -> tuple[str, str]:
    """Find the two files of a stem, here or among those of GalSim."""
    shipped = str(galsim_folder() / name)
    for stem in (name, shipped):
        if os.path.isfile(stem + ".cfg"):
            if not os.path.isfile(stem + ".dat"):
                raise OSError(f"cannot find the vertex file {stem}.dat")
            return stem + ".cfg", stem + ".dat"
    if name.endswith((".fits", ".fits.gz")) or os.path.isfile(
        tables_dir() / name / "table.fits"
    ):
        raise OSError(
            f"{name} is a table of bfsensor: give it to BrighterFatterSensor; SiliconSensor takes "
            "the stem of GalSim's .cfg and .dat files"
        )
    known = sorted(path.stem for path in galsim_folder().glob("*.cfg"))
    raise OSError(
        f"name = {shown(name)}: neither here nor in {galsim_folder()} is there a file of this name "
        f"and .cfg{did_you_mean(name, known)}"
    )


def _defaults(config: dict[str, Any], path: str) -> dict[str, Any]:
    """Refuse a configuration in which a key of ``_KEYS`` holds no finite number, or one below 0."""
    if "PixelSizeX" not in config and "PixelSize" in config:
        config["PixelSizeX"] = config["PixelSize"]
    for key in _KEYS:
        value = config.get(key)
        low = 0.0 if key in _ABOVE_0 else -math.inf
        if not isinstance(value, int | float) or not low < value < math.inf:
            kind = "above 0" if key in _ABOVE_0 else "finite"
            raise SensorError(f"{path}: {key} = {shown(value)} must be a number, {kind}")
    return {}
