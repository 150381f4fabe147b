"""BrighterFatterSensor: GalSim sensor that applies a distortion table to photons."""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import galsim
import numpy as np
from numpy.typing import NDArray

from bfsensor._kernels.photons import Light, Medium
from bfsensor.effects.effect import Layout
from bfsensor.errors import SensorError, SensorTypeError
from bfsensor.sensor.base import check_rings, make_rng
from bfsensor.sensor.boundary_shifts import make_shifts
from bfsensor.sensor.drift_field import solve_drift
from bfsensor.sensor.effect_sensor import EffectSensor
from bfsensor.sensor.image_exposure import Physics
from bfsensor.sensor.options import (
    LARGEST,
    check_diffusion,
    check_flag,
    check_full_well,
    check_instance,
    check_number,
    check_path,
    check_reach,
    check_surroundings,
    check_table,
    check_word,
    find_table,
    load_table,
    outside_charge,
    read_device,
    shown,
    truth_as_number,
)
from bfsensor.sensor.shift_maps import ShiftMap
from bfsensor.simulate.mean_field import STEPS
from bfsensor.table.table import DistortionTable
from bfsensor.typing import FloatArray

_WAVELENGTHS = np.arange(250.0, 1451.0, 1.0)
"""Vacuum wavelengths of the table of absorption lengths [nm].

Chosen: the range of the measured absorption (Green 2008) in steps of 1 nm, ten times finer than its
own; at 2 nm the linear interpolation between them would be four times worse."""

_TRANSPARENT = 1e30
"""Absorption length [um] that stands for infinity.

Chosen: any length far above the thickness means that all light crosses; at infinity itself the
interpolation between wavelengths would give nan."""

_COVERED = 0.9
"""Part of the thickness that a table's depths must reach, and part of the lowest depth to which light
may convert; a sensor warns, or refuses, below it.

Chosen: with the shifts of 95, 80 and 30 um in place of those of 100 um, area changes are wrong by
up to 0.03, 0.6 and 17 % at the nearest lags and by 2, 7 and 17 % at (2, 2) (measured with the tables
of ITL and E2V)."""

_DEEP = 0.01
"""Part of the light of a wavelength that may convert too low for a table's lowest depth; a sensor
warns, or refuses, above it.

Chosen: where shifts of that part were wrong altogether, those of all the light would be by 1 %, as the
factors of a table are; a table that begins where charge is stored leaves 0.4 % at most."""


class BrighterFatterSensor(EffectSensor):
    r"""GalSim sensor for thick CCDs with the brighter-fatter effect of a distortion table.

    The charge of every pixel moves the boundaries around it by the shifts that the distortion
    table of the device holds for that charge, for the charge of the pixel's neighbours, and for
    the height at which each photon converts.  Boundaries are evaluated only where electrons
    land; no state but the charge is stored.  The charge that acts is the one expected in the
    middle of each block of ``nrecalc`` electrons.  Wavelengths and angles are used where photons
    carry them.

    Every piece of physics can be switched off: ``charge_response=False``,
    ``background=False``, ``depth=False``, ``red='kept'``, ``diffusion_factor=0``,
    ``full_well=inf``, ``predict=False``, ``strength=0``.

    Parameters
    ----------
    name : str
        A built-in device (``bfsensor devices``) or the path of a table made by
        ``bfsensor table``.
    strength : float
        Factor on all shifts.
    rng : galsim.BaseDeviate, optional
        Source of the key of the random numbers.  The same key and photons give the same
        result bit for bit for any number of threads and any chunking with ``resume``.
    diffusion_factor : float
        Factor on the width of the diffusion, at least 0; 0 switches it off.
    qdist : int, optional
        Largest distance [pixel] at which charge acts, up to the table's reach, the default.
    nrecalc : float
        Electrons in the image between two renewals of the charge that acts, at least 0; 0: it is
        renewed by ``recalc`` only.  With ``predict`` the first block has a 64th of it, and blocks
        double up to it.
    treering_func : galsim.LookupTable, optional
        Radial shift of the boundaries [pixel], for conversion at the back surface.
    treering_center : galsim.PositionD
        Centre of the rings in original image coordinates.
    transpose : bool
        Whether the columns of the device run along x in images.
    shift_map : ShiftMap or str, optional
        Fixed shifts of any shape, or the file that holds them.
    charge_response : bool
        Whether the response depends on the charge; otherwise that of a small charge among empty
        pixels holds for every charge on every background, and ``background`` has no effect.
    background : bool
        Whether the response depends on the charge of the neighbours.
    depth : bool
        Whether shifts depend on the height of conversion; otherwise those of the back surface
        hold for all photons.
    red : {'lost', 'kept'}
        Photons that would cross the silicon are lost, or convert 1 um above the gates.
    absorption : {'law', 'galsim'}
        Absorption length by wavelength and temperature (:mod:`bfsensor.device.silicon`), or
        GalSim's table at one temperature.
    temperature : float, optional
        Temperature of the silicon [K], 77 to 400; by default the device's.
    diffusion : {'device', 'einstein'} or float
        Width over that by Einstein's relation in the device's drift field: the one that the device
        states (``[transport] diffusion``; 1.92 for the devices of LSST, as in GalSim), 1, or a
        number, at least 0.  A device that states none has Einstein's, which is logged once.
    full_well : float, optional
        Charge at which a pixel spills along its column [e-], above 0; by default the table's;
        inf: never.
    beyond : {'hold', 'error'}
        Behaviour where the table ends: charges beyond it without a full well; light above its last
        depth if that is below nine tenths of the thickness; light below nine tenths of its first depth,
        more than 1 % of that of the photons' largest wavelength; wavelengths without absorption
        length.  'hold' uses the last level, depth or length (one warning each with the number;
        :attr:`diagnostics` counts charges), 'error' refuses.
    predict : bool
        Whether the charge expected in the middle of a block acts, or that at its start.
    conversion_depth : float
        Depth below the back surface [um] at which photons without wavelengths convert, 0 to the
        thickness; 1 um as in GalSim.
    surroundings : {'none', 'mirrored'} or float
        Charge beyond the image, which moves the boundaries of the pixels near its sides: none; that of
        the image mirrored at its sides, as it is at each renewal; or the same charge [e-] in every
        pixel, at least 0, from the beginning to the end of the exposure.  Electrons that land there
        are lost.  A sky or flat without a frame of small pixels needs 'mirrored', or its level.
    threads : int, optional
        Largest number of threads of one call, at least 1; the result does not depend on it.  By
        default as many as ``galsim.get_omp_threads()`` says at each call of 65,536 photons or
        more, otherwise 1.  Blocks of few photons use fewer.
    table : DistortionTable, optional
        A table in memory, in place of ``name``.
    effects : path-like, mapping or sequence, optional
        Effects that a diagnosis found: the report.json of ``bfsensor diagnose``, its content, its
        list of effects, or :class:`bfsensor.effects.effect.Effect` objects.  See Notes.
    conditions : mapping, optional
        Conditions of the exposures that effects may depend on: ``wavelength`` of the light [nm],
        ``back_bias`` [V], ``temperature`` [C], exposure time ``seconds``, ``hours`` since the first
        exposure, ``number`` of the exposure, ``kind`` ('spot', or 'flat' for effects that only
        flats show).  By default those of the layout's reference.
    layout : Layout or mapping, optional
        Sensor that the effects were found on, by default the report's: ``shape`` (rows, columns),
        its first pixel being (1, 1) of the original image; ``segments`` (by default one amplifier
        covers it); ``reference``, the wavelength [nm], back bias [V] and temperature [C; of a
        Layout K] for which the effects' parameters hold, by default 620 nm and the device's own.

    Notes
    -----
    In :meth:`accumulate` effects act on photons before they enter the silicon (light is thinned,
    or its flux scaled where a factor is above 1; halos), on the boundaries (factors on every
    vertex of the table, shifts of its edges, fixed displacements), on electrons that meet charge
    (loss) and through the full well.  Effects that act once on stored charge, or during its
    transfer, act in :meth:`finish`.  The wavelengths of photons change no effect.  Shifts are added
    up to 7 pixels from a charge, equally at all heights, and saturate as the table's do.  Effects
    of amplifiers and converters are left out, with one warning.

    Raises
    ------
    SensorError
        A value that is not allowed, or a table without a device or of too small a depth; the
        message names the argument and the limit.  For a value of another type it is a
        SensorTypeError, which is a TypeError too.

    Examples
    --------
    >>> import galsim
    >>> sensor = BrighterFatterSensor("e2v_ccd250", rng=galsim.BaseDeviate(4171))
    >>> star = galsim.Gaussian(sigma=0.2, flux=5e5)
    >>> def size(sensor):
    ...     image = star.drawImage(nx=25, ny=25, scale=0.2, method="phot", sensor=sensor,
    ...                            rng=galsim.BaseDeviate(4172))
    ...     return galsim.utilities.unweighted_moments(image)["Myy"]
    >>> off = BrighterFatterSensor("e2v_ccd250", strength=0.0, rng=galsim.BaseDeviate(4171))
    >>> bool(1.015 < size(sensor) / size(off) < 1.03)
    True

    An effect that a diagnosis found, carried into an image; ``effects="report.json"`` does the
    same.

    >>> loss = {"class": "charge_loss", "parameters": {"q": {"value": 1e-6}}}
    >>> found = BrighterFatterSensor(effects=[loss], rng=galsim.BaseDeviate(4171))
    >>> image = star.drawImage(nx=25, ny=25, scale=0.2, method="phot", sensor=found,
    ...                        rng=galsim.BaseDeviate(4172))
    >>> found.finish(image)
    >>> bool(0.95 < image.array.sum() / 5e5 < 0.99)
    True
    """

    _opt_params = {  # noqa: RUF012
        "name": str, "strength": float, "diffusion_factor": float, "qdist": int,
        "nrecalc": float, "treering_func": galsim.LookupTable,
        "treering_center": galsim.PositionD, "transpose": bool, "shift_map": str,
        "charge_response": bool, "background": bool, "depth": bool, "red": str,
        "absorption": str, "temperature": float, "diffusion": str, "full_well": float,
        "beyond": str, "predict": bool, "conversion_depth": float, "threads": int,
        "surroundings": str,
        "effects": str, "conditions": dict, "layout": dict,
    }  # fmt: skip
    _takes_rng = True

    def __init__(
        self,
        name: str = "itl_sta3800c",
        strength: float = 1.0,
        rng: galsim.BaseDeviate | None = None,
        diffusion_factor: float = 1.0,
        qdist: int | None = None,
        nrecalc: float = 10000,
        treering_func: galsim.LookupTable | None = None,
        treering_center: galsim.PositionD = galsim.PositionD(0, 0),  # noqa: B008
        transpose: bool = False,
        *,
        shift_map: ShiftMap | str | None = None,
        charge_response: bool = True,
        background: bool = True,
        depth: bool = True,
        red: Literal["lost", "kept"] = "lost",
        absorption: Literal["law", "galsim"] = "law",
        temperature: float | None = None,
        diffusion: Literal["device", "einstein"] | float = "device",
        full_well: float | None = None,
        beyond: Literal["hold", "error"] = "hold",
        predict: bool = True,
        conversion_depth: float = 1.0,
        surroundings: Literal["none", "mirrored"] | float = "none",
        threads: int | None = None,
        table: DistortionTable | None = None,
        effects: Any = None,
        conditions: Mapping[str, Any] | None = None,
        layout: Layout | Mapping[str, Any] | None = None,
    ) -> None:
        self._take_table(name, table)
        self.strength = check_number(
            "strength", truth_as_number(strength), low=-LARGEST, high=LARGEST
        )
        self.rng = make_rng(rng)
        self.diffusion_factor = check_number(
            "diffusion_factor", truth_as_number(diffusion_factor), low=0.0, high=LARGEST
        )
        self.qdist = check_reach(qdist, self.table, self.name)
        self.nrecalc = check_number("nrecalc", truth_as_number(nrecalc), low=0.0)
        check_rings(treering_func, treering_center)
        self.treering_func, self.treering_center = treering_func, treering_center
        self.transpose = check_flag("transpose", transpose)
        self.shift_map = _read_map(shift_map)
        self.charge_response = check_flag("charge_response", charge_response)
        self.background = check_flag("background", background)
        self.depth = check_flag("depth", depth)
        self.predict = check_flag("predict", predict)
        self.red = check_word("red", red, ("lost", "kept"))
        self.absorption = check_word("absorption", absorption, ("law", "galsim"))
        self.diffusion = check_diffusion(diffusion)
        self.beyond = check_word("beyond", beyond, ("hold", "error"))
        self.conversion_depth = check_number(
            "conversion_depth", conversion_depth, low=0.0, high=self.table.thickness
        )
        self.surroundings = check_surroundings(surroundings)
        self.threads = threads
        self._device = read_device(self.table, self.name)
        if temperature is None:
            temperature = self._device.operating_point.temperature
        self.temperature = check_number("temperature", temperature, low=77.0, high=400.0)
        self.full_well = check_full_well(full_well, self.table)
        self._said: set[str] = set()
        self._check_depths()
        self._init_effects(effects, layout, conditions, self._usual, self.transpose)
        self._init_silicon()

    def _take_table(self, name: str, table: DistortionTable | None) -> None:
        """Keep the table, read by name unless it is given."""
        what = "a built-in device or the path of a table"
        self.name = check_path("name", name, what) if table is None else "table"
        self._table_name = f"table of {self.name}" if table is None else "given table"
        # A table that was read is pickled as its path, not as its 18 MB.
        self._source = find_table(self.name) if table is None else None
        self.table = load_table(*self._source) if self._source else check_table(table)

    def _usual(self) -> dict[str, Any]:
        """Return the fields of a layout that hold where the user gives none."""
        from bfsensor.device.silicon import absorption_length

        waves = np.arange(300.0, 1101.0, 10.0)
        lengths = np.asarray(absorption_length(waves, self.temperature), float)
        bias = float(self._device.operating_point.back_bias)
        return {
            "reference": (620.0, bias, self.temperature),
            "pixel": float(self.table.pitch[0]),
            "thickness": float(self.table.thickness),
            "front": Layout.front,
            "absorption": dict(zip(waves.tolist(), lengths.tolist(), strict=True)),
        }

    @property
    def _well(self) -> float:
        """The lower of the sensor's full well and that of effects [e-]."""
        if self._applied is None:
            return self.full_well
        return min(self.full_well, self._applied.law.full_well)

    @property
    def effective_nrecalc(self) -> float:
        """Electrons in the image between two renewals of the charge that acts."""
        return self.nrecalc

    def __getstate__(self) -> dict[str, Any]:
        state = super().__getstate__()
        if self._source is not None:
            del state["table"]
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        if "table" not in state:
            state["table"] = load_table(*state["_source"])
        super().__setstate__(state)

    def _make_physics(self) -> tuple[Physics, FloatArray]:
        table = self.table
        factors, edges = make_shifts(
            table, charge_response=self.charge_response, background=self.background,
            depth=self.depth, strength=self.strength, transpose=self.transpose,
            reach=self.qdist, applied=self._applied,
        )  # fmt: skip
        self.residual = factors.residual
        # Below the lowest height that was traced the wells hold the electrons: no diffusion.
        start = table.depths[1] if len(table.depths) > 1 else 0.0
        drift = solve_drift(
            table.device_text, self.temperature, float(start), tuple(table.drift_field)
        )
        sigma = self.diffusion_factor and self.diffusion_factor * self._width()
        pitch = table.pitch[::-1] if self.transpose else table.pitch
        lengths, first, step = self._lengths()
        variance, wider = sigma**2 * drift.variance, 0.0
        if self._applied is not None:
            wider = self._applied.spot_variance * pitch[0] * pitch[1]
            variance = variance + wider
        medium = Medium(
            thickness=table.thickness,
            pitch_x=pitch[0],
            pitch_y=pitch[1],
            lengths=lengths,
            wavelength_0=first,
            wavelength_step=step,
            surface_path=self.conversion_depth,
            kept_path=table.thickness - 1.0 if self.red == "kept" else math.inf,
            kept_slanted=False,
            variance=variance,
            diffuse=sigma > 0 or wider > 0,
        )
        # A whole number, so that spilling keeps images of whole electrons whole.
        well = math.floor(self._well) if math.isfinite(self._well) else math.inf
        physics = Physics(
            edges, factors.response, medium, float(well), not self.transpose, self.nrecalc,
            self.predict, 0.0 if self._applied is None else self._applied.law.loss,
            outside_charge(self.surroundings),
        )  # fmt: skip
        return physics, drift.ripple if self.depth else np.ones(STEPS + 1)

    def _width(self) -> float:
        """Width of the diffusion over that by Einstein's relation."""
        if self.diffusion == "device":
            return self._device.diffusion
        return 1.0 if self.diffusion == "einstein" else float(self.diffusion)

    def _lengths(self) -> tuple[FloatArray, float, float]:
        """Absorption lengths [um] on equal steps of the wavelength [nm]."""
        if self.absorption == "law":
            from bfsensor.device.silicon import absorption_length

            lengths = np.asarray(absorption_length(_WAVELENGTHS, self.temperature), float)
            return np.minimum(lengths, _TRANSPARENT), float(_WAVELENGTHS[0]), 1.0
        path = Path(galsim.meta_data.share_dir) / "sensors" / "abs_length.dat"
        data = np.loadtxt(path, skiprows=1)
        return data[:, 1].copy(), float(data[0, 0]), float(data[1, 0] - data[0, 0])

    def _check_charge(self, image: NDArray[np.floating]) -> None:
        if self.beyond == "error":
            self._refuse_beyond(float(image.max(initial=0.0)))

    def _refuse_beyond(self, highest: float) -> None:
        """Refuse, with beyond='error', more charge in a pixel [e-] than the table holds."""
        last = float(self.table.charges[-1])
        if self.beyond == "error" and highest > max(last, self._table_well()):
            raise SensorError(
                f"a pixel holds {highest:.0f} e-; the {self._table_name} ends at "
                f"{max(last, self._table_well()):.0f} e-"
            )

    def _table_well(self) -> float:
        """Full well of the table [e-], 0 where it is not known."""
        well = self.table.full_well
        return well if math.isfinite(well) else 0.0

    def accumulate(
        self,
        photons: galsim.PhotonArray,
        image: galsim.Image,
        orig_center: galsim.PositionI = galsim.PositionI(0, 0),  # noqa: B008
        resume: bool = False,
        recalc: bool = False,
    ) -> float:
        """Collect photons in an image.

        Parameters
        ----------
        photons, image, orig_center, resume, recalc
            As for :meth:`EngineSensor.accumulate`.

        Returns
        -------
        added_flux : float
            Flux that was collected in the image [e-].

        Raises
        ------
        SensorError
            As :meth:`EngineSensor.accumulate`; also, with ``beyond='error'``, if a pixel would
            hold more charge than the table.  The image is unchanged after any error.
        """
        if self.beyond == "hold":
            added = super().accumulate(photons, image, orig_center, resume, recalc)
            self._warn_beyond()
            return added
        check_instance("image", image, galsim.Image, "a galsim.Image")
        before = image.array.copy()
        kept = None if self._exposure is None else self._exposure.copy()
        last = self._last_image
        try:
            added = super().accumulate(photons, image, orig_center, resume, recalc)
            self._refuse_beyond(float(image.array.max(initial=0.0)))
        except SensorError:
            image.array[...] = before
            self._exposure, self._last_image = kept, last
            raise
        return added

    def _outside(self, what: str, text: str, used: str, remedy: str = "") -> None:
        """Say once what lies outside the table and what is used there; refuse with beyond='error'."""
        if self.beyond == "error":
            raise SensorError(text + remedy)
        if what not in self._said:
            self._said.add(what)
            warnings.warn(
                f"{text}: {used} (beyond='error' refuses)",
                galsim.GalSimWarning,
                stacklevel=4,
            )

    def _check_light(self, light: Light) -> None:
        """Look for wavelengths without absorption length, and light below the table's first depth."""
        waves = light.wavelength
        if not waves.size:
            return
        medium, thickness = self._physics.medium, self.table.thickness
        known = medium.wavelength_0 + medium.wavelength_step * np.arange(
            len(medium.lengths)
        )
        low, high = float(waves.min()), float(waves.max())
        if not (known[0] <= low and high <= known[-1]):
            # Photons without flux may have any; light of infinite wavelength crosses the silicon.
            used = waves[np.isfinite(waves) & (light.flux != 0)]
            if not used.size:
                return
            low, high = float(used.min()), float(used.max())
        if low < known[0] or high > known[-1]:
            self._outside(
                "wavelengths",
                f"photons have wavelengths from {low:g} to {high:g} nm; absorption lengths are known "
                f"from {known[0]:g} to {known[-1]:g} nm",
                "those at the ends are used",
            )
        first = float(self.table.depths[0])
        # Light that is kept where it would cross converts 1 um above the gates.
        if not self.depth or (self.red == "kept" and first <= 1.0):
            return
        length = float(np.interp(high, known, medium.lengths))
        floor = _COVERED * first
        deep = math.exp((floor - thickness) / length)
        deep -= math.exp(-thickness / length) if self.red == "lost" else 0.0
        if deep > _DEEP:
            self._outside(
                "deep light",
                f"{100 * deep:.2g} % of light of {high:g} nm converts below {floor:g} um; the lowest "
                f"depth of the {self._table_name} is {first:g} um",
                "its shifts are used below it",
                ": make one with lower depths",
            )

    def _check_depths(self) -> None:
        """Look for light without wavelengths below the table's first depth, and far above its last."""
        height = self.table.thickness - self.conversion_depth
        first = float(self.table.depths[0])
        if self.depth and height < _COVERED * first:
            from bfsensor.response.light import storage_height

            # Where charge is stored nothing moves, and below it neither.
            if first > storage_height(self._device) + 1.0:
                self._outside(
                    "deep light",
                    f"light converts {height:g} um above the gates; the {self._table_name} begins "
                    f"at {first:g} um",
                    "its shifts are used below it",
                    ": make one with lower depths",
                )
        last = float(self.table.depths[-1])
        if last >= _COVERED * self.table.thickness:
            return
        text = (
            f"light converts up to {self.table.thickness:g} um above the gates; the "
            f"{self._table_name} ends at {last:g} um"
        )
        self._outside(
            "high light", text, "its shifts are used above it",
            f": make one with the depth {self.table.thickness:g} um",
        )  # fmt: skip

    def _warn_beyond(self) -> None:
        """Warn once of pixels with more charge than the table holds."""
        assert self._exposure is not None
        if "charge" in self._said or not self._exposure.beyond_table:
            return
        if math.isfinite(self._well) and self._well <= self._table_well():
            return
        self._said.add("charge")
        warnings.warn(
            f"pixels hold more charge than the {self._table_name}, which ends at "
            f"{max(self.table.charges[-1], self._table_well()):.0f} e-: the response of the last "
            "level is used (diagnostics counts such pixels; beyond='error' refuses)",
            galsim.GalSimWarning,
            stacklevel=3,
        )

    def _key(self) -> tuple[Any, ...]:
        return (
            self.table, self.effects, self.layout, self.conditions,
            *(getattr(self, key) for key in _COMPARED),
        )  # fmt: skip

    def __str__(self) -> str:
        return f"bfsensor.BrighterFatterSensor({self.name!r})"

    def __repr__(self) -> str:
        parts = [f"{k}={getattr(self, k)!r}" for k in ("name", *_COMPARED)]
        parts.insert(2, f"rng={self.rng!r}")
        parts += self._effects_repr()
        return f"bfsensor.BrighterFatterSensor({', '.join(parts)})"


def _read_map(given: Any) -> ShiftMap | None:
    """Return a map of fixed shifts, read from its file where a path is given."""
    if given is None or isinstance(given, ShiftMap):
        return given
    if not isinstance(given, str | os.PathLike):
        raise SensorTypeError(
            f"shift_map = {shown(given)} must be a ShiftMap, the path of its file, or None"
        )
    try:
        return ShiftMap.read(given)
    except SensorError as error:
        raise SensorError(f"shift_map: {error}") from None


_COMPARED = (
    "strength", "diffusion_factor", "qdist", "nrecalc", "treering_func", "treering_center",
    "transpose", "shift_map", "charge_response", "background", "depth", "red", "absorption",
    "temperature", "diffusion", "full_well", "beyond", "predict", "conversion_depth", "threads",
    "surroundings",
)  # fmt: skip
"""Attributes that equal sensors share, in the order of the repr."""
