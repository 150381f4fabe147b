"""Effects of a diagnosis, applied to a sensor's light, boundaries and stored charge."""

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
from bfsensor.effects.effect import Effect, Halo, Law, Layout, Segment, Shot
from bfsensor.errors import SensorError
from bfsensor.sensor.effect_edges import EdgeChange, Sides, find_change, mean_shifts
from bfsensor.sensor.effect_reports import STORED
from bfsensor.sensor.shift_maps import Stills, fine_stills
from bfsensor.typing import FloatArray
from bfsensor.units import to_celsius, to_kelvin

_ANYWHERE = (4096, 4096)
"""Rows and columns of the sensor that effects are given where the user gave no layout.

Chosen: one amplifier of a common science CCD; effects that depend on the place are refused without
a layout, and the others take nothing from the size."""

_KEPT, _HALO = 101, 102
"""Streams of random numbers for thinning the light and for its halo.

Chosen: numbers that the kernels do not use for the same photons."""

_BY_PLACE = ("displacements", "light_map", "turbulence")
"""Methods of effects that depend on the place on the sensor."""

_AT_END = ("store", "shift")
"""Methods of effects that act once, when an exposure has ended."""


class AppliedEffects:
    """Effects of the stages light, collect, store and shift on the images of one sensor.

    Effects use the x and y of the device; where the columns of an image run along x, their
    arrays are transposed.

    Parameters
    ----------
    effects : sequence of Effect
        Any; effects at their neutral values are left out, and so are, with a warning, those of
        the readout electronics.
    conditions : mapping
        Known conditions of the exposures: fields of :class:`bfsensor.effects.effect.Shot` by name,
        the temperature in deg C.
    layout : Layout or None
        Sensor that the effects were found on, in the frame of the device.
    usual : mapping
        Fields of a layout that hold where none is given.
    turned : bool
        Whether the columns of the device run along x in images.

    Raises
    ------
    SensorError
        An effect depends on the place and there is no layout, or it needs a condition that is not
        known.
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
                "a sensor does not simulate the readout electronics: the effects "
                f"{', '.join(later)} are left out"
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
        """Layout that was given, or else one amplifier of a shape."""
        if self.layout is not None:
            return self.layout
        ny, nx = shape
        return Layout(shape, (Segment(0, 0, nx, ny),), **self._usual)

    def _overriding(self, *methods: str) -> list[Effect]:
        """Effects whose class overrides one of some methods of Effect."""
        return [
            e
            for e in self.effects
            if any(getattr(type(e), m) is not getattr(Effect, m) for m in methods)
        ]

    def _check(self) -> None:
        """Refuse effects that lack a layout or a condition, or whose parameters are not allowed."""
        unable = [e.name for e in self.effects if not e.in_images]
        if unable:
            raise SensorError(
                f"effects: a sensor cannot draw {', '.join(unable)}, which a diagnosis predicts only"
            )
        placed = self._overriding(*_BY_PLACE)
        if placed and self.layout is None:
            raise SensorError(
                f"effects: {', '.join(e.name for e in placed)} depend on the place on the sensor: "
                "give its shape, layout={'shape': (rows, columns)}"
            )
        law = self.law
        if not (law.loss >= 0 and np.isfinite(law.bend) and law.full_well > 0):
            raise SensorError(
                f"effects: {law} must have a finite growth with charge, a loss of at least 0 and "
                "a full well above 0 e-"
            )
        # Each effect acts once on a small empty sensor, so that a missing condition is refused
        # here and not after hours of photons.
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

    def _spot_light(self) -> tuple[float, Halo]:
        """Added variance [pixel^2], and the halo that a part of the light is in."""
        variance = 0.0
        halo: Halo = ()
        shot = self.shot._replace(kind="spot")
        for effect in self.effects:
            more, parts = effect.spot_light(shot, self._assumed())
            variance += more
            if any(share for share, _ in parts):
                if halo:
                    raise SensorError("effects: at most one effect may give light a halo")
                halo = tuple((float(share), float(sigma)) for share, sigma in parts)
        share = sum(part for part, _ in halo)
        proper = all(part >= 0 and sigma > 0 for part, sigma in halo)
        if not (variance >= 0 and proper and share <= 1):
            raise SensorError(
                f"effects: added variance = {variance:g} pixel^2 and share = {share:g} of a "
                "halo must not be negative, the share not above 1"
            )
        return variance, halo

    def light_map(self, kind: str, rng: np.random.Generator) -> FloatArray | None:
        """Return the factor on the light of one exposure.

        Parameters
        ----------
        kind : str
            Kind of the exposure, 'spot' or 'flat'.
        rng : numpy.random.Generator
            Source of the turbulence.

        Returns
        -------
        factor : ndarray or None
            Factor, at least 0, by pixel of the sensor in the frame of images; None: 1 everywhere.

        Raises
        ------
        SensorError
            The factor is negative or not finite.
        """
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
        # Effects may return a factor that varies along one axis only.
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
        """Thin photons by a factor on the light, and move a share of them into the halo.

        Parameters
        ----------
        light : Light
            Photons before they enter the silicon.
        factor : ndarray, optional
            Factor by pixel of the sensor; the nearest pixel's holds outside.  A photon is kept
            with that probability; where the factor is above 1 its flux is multiplied instead.
        corner : tuple of float
            Offset that is added to positions to count pixels from the sensor's lower left corner.
        number : int
            Number of the first photon within the exposure.
        key : tuple of int
            Key of the exposure's random numbers.

        Returns
        -------
        Light
            All photons, those that are lost with flux 0.
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
        if self.halo:
            uniforms(number, _HALO, *keys, deviates)
            shares, sigmas = np.array(self.halo).T
            ends = np.cumsum(shares)
            wide = np.nonzero(deviates[:, 0] < ends[-1])[0]
            own = np.searchsorted(ends, deviates[wide, 0], side="right")
            # Given that it is within a share, the uniform is uniform in it: no second draw.
            within = 1 - (ends[own] - deviates[wide, 0]) / shares[own]
            # Rounding may leave 0 or less at the lower end of a share, which has no radius.
            within = np.maximum(within, np.finfo(float).tiny)
            radius = sigmas[own] * np.sqrt(-2 * np.log(within))
            angle = 2 * np.pi * deviates[wide, 1]
            x, y = light.x.copy(), light.y.copy()
            x[wide] += radius * np.cos(angle)
            y[wide] += radius * np.sin(angle)
            light = light._replace(x=x, y=y)
        return light

    # -- collection --------------------------------------------------------------------

    def change_of_edges(self, sides: Sides, points: FloatArray) -> EdgeChange:
        """Return the change of a table's sides by effects, in the frame of the device.

        Warns once of effects that change nothing under the given conditions.

        Parameters
        ----------
        sides : pair of ndarray
            Vertical and horizontal sides, as for
            :func:`bfsensor.sensor.effect_edges.mean_shifts`.
        points : ndarray
            Nominal positions along a side, from 0 to 1.

        Returns
        -------
        EdgeChange
        """
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
        """Add the displacements of edges that do not depend on charge to an image's pattern.

        Parameters
        ----------
        pattern : Pattern
            Fixed shifts of an image.
        shape : tuple of int
            Rows and columns of the image.
        corner : tuple of float
            Its lower left corner (x, y), in pixels from that of the sensor.

        Returns
        -------
        Pattern
            With the displacements in the image and around it.
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
        """Fixed displacements of all edges of the sensor [pixel], in the frame of images; cached."""
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
        """Whether any effect acts on stored charge or during its transfer."""
        return bool(self._overriding(*_AT_END))

    def finish(
        self,
        charge: FloatArray,
        rng: np.random.Generator,
        memory: dict[str, NDArray],
    ) -> FloatArray:
        """Apply the effects that act on stored charge and during its transfer.

        Parameters
        ----------
        charge : ndarray, shape of the sensor
            Collected charge [e-], in the frame of images.
        rng : numpy.random.Generator
            Random numbers of the effects that differ from exposure to exposure.
        memory : dict
            State that effects pass on from exposure to exposure (persistence); changed in place.

        Returns
        -------
        charge : ndarray
            Charge [e-] after transfer, same shape.

        Raises
        ------
        SensorError
            The image has another shape than the layout, or an effect needs a condition that is
            not known.
        """
        out = charge.T if self.turned else charge
        if self.layout is not None and out.shape != self.layout.shape:
            raise SensorError(
                f"finish needs the image of the whole sensor, {self.layout.shape} rows and "
                f"columns, not {out.shape}"
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
    """One amplifier's pixels after transfer, with empty prescan and overscans around them."""
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
