"""Effects of a diagnosis while a sensor exposes: what each stage needs of them."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import galsim
import numpy as np
from numpy.typing import NDArray

from bfsensor._kernels.counter_rng import uniforms
from bfsensor._kernels.photons import Light, Pattern
from bfsensor.effects.effect import Effect, Law, Layout, Segment, Shot
from bfsensor.errors import SensorError
from bfsensor.sensor.effect_edges import EdgeChange, Sides, find_change, mean_shifts
from bfsensor.sensor.effect_reports import STORED
from bfsensor.sensor.shift_maps import Stills, fine_stills
from bfsensor.typing import FloatArray
from bfsensor.units import to_celsius, to_kelvin

_ANYWHERE = (4096, 4096)
"""Sensor of effects that do not ask for places, where none is given."""

_KEPT, _HALO = 101, 102
"""Streams of random numbers of photons."""

_BY_PLACE = ("displacements", "light_map", "turbulence")
_AT_END = ("store", "shift")


class AppliedEffects:
    """Effects of the stages light, collect, store and shift on the images of one sensor.

    What effects say of a device's x and y is turned where the columns run along x.

    Parameters
    ----------
    effects : sequence of Effect
        Any; those at their neutral values and those of later stages are left out.
    conditions : mapping
        What is known of the exposures, of the fields of Shot, but the temperature in deg C.
    layout : Layout, or None
        Of the sensor that the effects were found on, in the frame of the device.
    usual : mapping
        Of a layout, where none is given.
    turned : bool
        Columns run along x in images.

    Raises
    ------
    SensorError
        An effect acts by place and there is no layout, or needs a condition that is not known.
    """

    def __init__(
        self,
        effects: Sequence[Effect],
        conditions: Mapping[str, Any],
        layout: Layout | None,
        usual: Mapping[str, Any],
        turned: bool,
    ) -> None:
        live = [e for e in effects if not (e.amplitudes() and e.is_neutral())]
        later = [e.name for e in live if e.stage not in STORED]
        if later:
            _warn(
                f"effects of the readout electronics are not in images: {', '.join(later)} left "
                "out"
            )
        self.effects = sorted(
            (e for e in live if e.stage in STORED), key=lambda e: STORED.index(e.stage)
        )
        self.layout, self.turned = layout, turned
        self._usual = dict(usual)
        values = {
            "kind": "spot", "number": 0, "seconds": np.nan,
            **dict(zip(("wavelength", "back_bias", "temperature"), self._assumed().reference,
                       strict=True)),
            **conditions,
        }  # fmt: skip
        if "temperature" in conditions:
            values["temperature"] = to_kelvin(conditions["temperature"])
        self.shot = Shot(**values)
        self.law = Law()
        for effect in self.effects:
            self.law = self.law.with_law(effect.law())
        self._check()
        self.spot_variance, self.halo = self._spot_light()
        self._stills: Stills | None = None
        self._still_map: dict[str, FloatArray | None] = {}
        self._warned = False

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_stills": None, "_still_map": {}}

    def _assumed(self, shape: tuple[int, int] = _ANYWHERE) -> Layout:
        if self.layout is not None:
            return self.layout
        ny, nx = shape
        return Layout(shape, (Segment(0, 0, nx, ny),), **self._usual)

    def _overriding(self, *methods: str) -> list[Effect]:
        """Effects that say something of their own at a step."""
        return [
            e
            for e in self.effects
            if any(getattr(type(e), m) is not getattr(Effect, m) for m in methods)
        ]

    def _check(self) -> None:
        placed = self._overriding(*_BY_PLACE)
        if placed and self.layout is None:
            raise SensorError(
                f"effects: {', '.join(e.name for e in placed)} act by place: the sensor's shape "
                "is needed, layout={'shape': (rows, columns)}"
            )
        law = self.law
        if not (law.loss >= 0 and np.isfinite(law.bend) and law.full_well > 0):
            raise SensorError(
                f"effects: {law} must have a finite bend, a loss of at least 0 and a full well "
                "above 0 e-"
            )
        # Whether anything is missing shows before hours of photons, on a small sensor.
        small = 64, 64
        layout = replace(
            self._assumed(), shape=small, segments=(Segment(0, 0, small[1], small[0]),)
        )
        rng = np.random.default_rng(1)
        for effect in self._overriding(*_AT_END, "light_map", "turbulence"):
            try:
                stored = effect.store(np.zeros(small), self.shot, layout, rng, {})
                for values in (
                    stored, effect.shift(stored, 0, layout),
                    effect.light_map(self.shot, layout),
                    effect.turbulence(self.shot, layout, rng),
                ):  # fmt: skip
                    good = values is None or np.isfinite(values).all()
                    if not good:
                        raise ValueError("values that are not finite")
            except ValueError as error:
                given = self.shot._replace(temperature=to_celsius(self.shot.temperature))
                known = {k: v for k, v in given._asdict().items() if v == v}
                raise SensorError(
                    f"effects: {effect.name} cannot act ({error}) under the conditions {known}; "
                    "conditions={'seconds': ...} may be what it needs"
                ) from None

    # -- light -------------------------------------------------------------------------

    def _spot_light(self) -> tuple[float, tuple[float, float]]:
        """Added variance [pixel^2], and share of light in a halo with its sigma [pixel]."""
        variance, halo = 0.0, (0.0, 1.0)
        shot = self.shot._replace(kind="spot")
        for effect in self.effects:
            more, share, sigma = effect.spot_light(shot, self._assumed())
            variance += more
            if share:
                if halo[0]:
                    raise SensorError("effects: more than one gives light a halo")
                halo = float(share), float(sigma)
        if not (variance >= 0 and 0 <= halo[0] <= 1 and halo[1] > 0):
            raise SensorError(
                f"effects: added variance = {variance:g} pixel^2 and share = {halo[0]:g} of a "
                "halo must not be negative, the share not above 1"
            )
        return variance, halo

    def light_map(self, kind: str, rng: np.random.Generator) -> FloatArray | None:
        """Factor on the light of one exposure by pixel of the sensor, as in images."""
        layout = self._assumed()
        shot = self.shot._replace(kind=kind)
        if kind not in self._still_map:
            still: FloatArray | None = None
            for effect in self._overriding("light_map"):
                one = effect.light_map(shot, layout)
                if one is not None:
                    still = one if still is None else still * one
            self._still_map[kind] = still
        total = self._still_map[kind]
        for effect in self._overriding("turbulence"):
            one = effect.turbulence(shot, layout, rng)
            if one is not None:
                total = one if total is None else total * one
        if total is None:
            return None
        # A factor may come as a row or a column.
        total = np.broadcast_to(total, layout.shape)
        if not (np.isfinite(total).all() and total.min() >= 0):
            raise SensorError("effects: the factor on the light is negative or not finite")
        return total.T if self.turned else total

    def change_light(
        self,
        light: Light,
        factor: FloatArray | None,
        corner: tuple[float, float],
        number: int,
        key: tuple[int, int],
    ) -> Light:
        """Photons less those that a factor takes away, with a share of them in the halo.

        Parameters
        ----------
        light : Light
            As it comes.
        factor : ndarray, optional
            By pixel of the sensor, that of the nearest outside; above 1 the flux is scaled.
        corner : tuple of float
            What takes positions to the sensor's frame, pixels from its lower left corner.
        number, key
            Of the first photon; of the exposure.
        """
        deviates = np.empty((light.x.size, 2))
        keys = np.uint32(key[0]), np.uint32(key[1])
        if factor is not None:
            uniforms(number, _KEPT, *keys, deviates)
            ny, nx = factor.shape
            column = np.clip(np.floor(light.x + corner[0]), 0, nx - 1).astype(np.int64)
            row = np.clip(np.floor(light.y + corner[1]), 0, ny - 1).astype(np.int64)
            share = factor[row, column]
            kept = np.where(deviates[:, 0] < share, np.maximum(share, 1.0), 0.0)
            light = light._replace(flux=light.flux * kept)
        share_of_halo, sigma = self.halo
        if share_of_halo:
            uniforms(number, _HALO, *keys, deviates)
            wide = np.nonzero(deviates[:, 0] < share_of_halo)[0]
            # The uniform that chose is uniform below the share.
            radius = sigma * np.sqrt(-2 * np.log(deviates[wide, 0] / share_of_halo))
            angle = 2 * np.pi * deviates[wide, 1]
            x, y = light.x.copy(), light.y.copy()
            x[wide] += radius * np.cos(angle)
            y[wide] += radius * np.sin(angle)
            light = light._replace(x=x, y=y)
        return light

    # -- collection --------------------------------------------------------------------

    def change_of_edges(self, sides: Sides, points: FloatArray) -> EdgeChange:
        """What effects do to the shifts of a table's sides, in the frame of the device."""
        effects = self._overriding("edges")
        shifts, layout = mean_shifts(sides, points), self._assumed()
        idle = [
            e.name
            for e in effects
            if all(map(np.array_equal, e.edges(*shifts, self.shot, layout), shifts))
        ]
        if idle and not self._warned:
            self._warned = True
            _warn(
                f"effects: {', '.join(idle)} change nothing at {self.shot.wavelength:g} nm, "
                f"{self.shot.back_bias:g} V, {to_celsius(self.shot.temperature):g} C: give conditions"
            )
        return find_change(effects, shifts, self.shot, layout)

    def add_stills(
        self, pattern: Pattern, shape: tuple[int, int], corner: tuple[float, float]
    ) -> Pattern:
        """Pattern with the standing displacements of edges around an image.

        Parameters
        ----------
        pattern : Pattern
            Of an image.
        shape : tuple of int
            Of the image.
        corner : tuple of float
            Its lower left corner, pixels from that of the sensor.
        """
        stills = self._find_stills()
        if stills is None:
            return pattern
        far = 2 + int(np.ceil(max(np.abs(s).max() for s in stills)))
        low = [int(np.floor(c)) - far for c in corner]
        high = [int(np.ceil(c)) + n + far for c, n in zip(corner, shape[::-1], strict=True)]
        x, y = fine_stills(stills, (low[1], high[1]), (low[0], high[0]))
        return pattern._replace(
            edge_x=x, edge_y=y, edge_0x=low[0] - corner[0], edge_0y=low[1] - corner[1]
        )

    def _find_stills(self) -> Stills | None:
        """Displacements of all edges of the sensor [pixel], as in images; kept."""
        if self._stills is None:
            layout = self._assumed()
            for effect in self._overriding("displacements"):
                moved = effect.displacements(self.shot, layout)
                if moved is None:
                    continue
                if not all(np.isfinite(m).all() for m in moved):
                    raise SensorError(
                        f"effects: {effect.name} gives displacements that are not finite under "
                        f"the conditions {self.shot}"
                    )
                x, y = (m.astype(np.float32) for m in moved)
                if self.turned:
                    x, y = y.T, x.T
                if self._stills is None:
                    self._stills = x, y
                else:
                    self._stills = self._stills[0] + x, self._stills[1] + y
        return self._stills

    # -- after collection --------------------------------------------------------------

    @property
    def acts_at_end(self) -> bool:
        """Whether images change after they are collected."""
        return bool(self._overriding(*_AT_END))

    def finish(
        self,
        charge: FloatArray,
        rng: np.random.Generator,
        memory: dict[str, NDArray],
    ) -> FloatArray:
        """Collected charge [e-] as it is stored and shifted out.

        Parameters
        ----------
        charge : ndarray, shape of the sensor
            As in images.
        rng : numpy.random.Generator
        memory : dict
            Kept from exposure to exposure.
        """
        out = charge.T if self.turned else charge
        if self.layout is not None and out.shape != self.layout.shape:
            raise SensorError(
                f"finish takes the image of the whole sensor, {self.layout.shape} rows and "
                f"columns, not of {out.shape}"
            )
        layout = self._assumed((out.shape[0], out.shape[1]))
        idle = []
        for effect in self._overriding("store"):
            try:
                before, out = out, effect.store(out, self.shot, layout, rng, memory)
            except ValueError as error:
                raise SensorError(f"effects: {effect.name} cannot act: {error}") from None
            if effect.word not in memory and np.array_equal(before, out):
                idle.append(effect.name)
        for effect in self._overriding("shift"):
            before, out = out, out.copy()
            for amp, segment in enumerate(layout.segments):
                part = np.s_[
                    segment.y : segment.y + segment.rows,
                    segment.x : segment.x + segment.columns,
                ]
                out[part] = _shifted(effect, before[part], amp, segment, layout)
            if np.array_equal(before, out):
                idle.append(effect.name)
        if idle and np.any(charge):
            _warn(f"effects: {', '.join(idle)} changed nothing in this image")
        return out.T if self.turned else out


def _shifted(
    effect: Effect, charge: NDArray, amp: int, segment: Segment, layout: Layout
) -> NDArray:
    """One amplifier's pixels after transfer; prescan and overscans are empty and cut off."""
    turn = np.s_[:: -1 if segment.flip_y else 1, :: -1 if segment.flip_x else 1]
    frame = np.pad(
        charge[turn],
        ((0, segment.parallel_overscan), (segment.prescan, segment.serial_overscan)),
    )
    frame = effect.shift(frame, amp, layout)
    first = segment.prescan
    return frame[: segment.rows, first : first + segment.columns][turn]


def _warn(text: str) -> None:
    warnings.warn(text, galsim.GalSimWarning, stacklevel=2)
