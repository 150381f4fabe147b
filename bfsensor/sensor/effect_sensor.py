"""Base class of sensors that apply the effects of a diagnosis to their images."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Mapping
from typing import Any

import galsim
import numpy as np
from numpy.typing import NDArray

from bfsensor._kernels.photons import Light
from bfsensor.effects.effect import Effect, Layout
from bfsensor.errors import SensorError
from bfsensor.sensor.applied_effects import AppliedEffects
from bfsensor.sensor.base import EngineSensor, pixels_of
from bfsensor.sensor.effect_reports import (
    make_conditions,
    make_layout,
    read_effects,
    write_entries,
)
from bfsensor.sensor.image_exposure import ImageExposure
from bfsensor.sensor.options import check_flag
from bfsensor.units import to_celsius


class EffectSensor(EngineSensor):
    """Sensor that applies effects to light, during collection, and at the end of exposures.

    Effects on light and on collection act in :meth:`accumulate`.  Effects that act once an
    exposure, on stored charge (coupling, persistence, dark current) or during its transfer, act in
    :meth:`finish` only.
    """

    effects: tuple[Effect, ...] | None = None
    layout: Layout | None = None
    conditions: Mapping[str, Any] | None = None
    _memory: dict[str, NDArray]
    _finished: weakref.ref[Any] | None
    _closed: bool

    def _init_effects(
        self,
        effects: Any,
        layout: Any,
        conditions: Any,
        find_usual: Callable[[], dict[str, Any]],
        turned: bool,
    ) -> None:
        """Read effects, layout and conditions; ``turned`` as for :class:`AppliedEffects`."""
        self._memory = {}
        self._applied = None
        self.effects = self.layout = self.conditions = None
        found: tuple[Effect, ...] = ()
        if effects is not None:
            found, own = read_effects(effects)
            layout = own if layout is None else layout
        usual = {} if layout is None and not found else find_usual()
        if layout is not None:
            self.layout = make_layout(layout, usual)
        if conditions is not None:
            self.conditions = make_conditions(conditions)
        if not found:
            return
        self.effects = found
        if any(e.word == "tree_rings" for e in found) and self._has_rings():
            raise SensorError(
                "effects hold tree_rings and treering_func is given: the rings would act twice; "
                "give one of them"
            )
        applied = AppliedEffects(found, self.conditions or {}, self.layout, usual, turned)
        # With nothing but neutral effects the sensor must behave as without, bit for bit.
        self._applied = applied if applied.effects else None

    def _init_silicon(self) -> None:
        self._finished = None
        self._closed = False
        super()._init_silicon()

    def __getstate__(self) -> dict[str, Any]:
        state = super().__getstate__()
        state["_finished"] = None
        return state

    def _effects_repr(self) -> list[str]:
        """Parts of the repr: effects, layout and conditions, where they are given."""
        out = []
        if self.effects is not None:
            out.append(f"effects={write_entries(self.effects)!r}")
        if self.layout is not None:
            at = self.layout
            segments = [s._asdict() for s in at.segments]
            reference = (*at.reference[:2], to_celsius(at.reference[2]))
            out.append(
                f"layout={{'shape': {at.shape!r}, 'segments': {segments!r}, "
                f"'reference': {reference!r}, 'pixel': {at.pixel!r}, "
                f"'thickness': {at.thickness!r}, 'front': {at.front!r}}}"
            )
        if self.conditions is not None:
            out.append(f"conditions={self.conditions!r}")
        return out

    # -- exposing ----------------------------------------------------------------------

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
        galsim.GalSimError
            ``resume`` after :meth:`finish`, and as for :meth:`EngineSensor.accumulate`.
        """
        resume = check_flag("resume", resume)
        if resume and self._closed:
            raise galsim.GalSimError(
                "accumulate was called with resume after finish: the exposure is over"
            )
        added = super().accumulate(photons, image, orig_center, resume, recalc)
        if not resume:
            self._closed = False
            old = None if self._finished is None else self._finished()
            if old is not None and np.may_share_memory(old.array, image.array):
                self._finished = None
        return added

    def _expose(
        self,
        image: galsim.Image,
        array: NDArray[np.floating],
        orig_center: galsim.PositionI,
    ) -> ImageExposure:
        exposure = super()._expose(image, array, orig_center)
        if self._applied is not None:
            key = int(exposure.plan.key0), int(exposure.plan.key1)
            exposure.light_factor = self._applied.light_map(
                self._applied.shot.kind, np.random.default_rng(key)
            )
            exposure.to_sensor = orig_center.x - 0.5, orig_center.y - 0.5
        return exposure

    def _change_light(self, light: Light) -> Light:
        applied, exposure = self._applied, self._exposure
        if applied is None or exposure is None:
            return light
        if exposure.light_factor is None and not applied.halo:
            return light
        key = int(exposure.plan.key0), int(exposure.plan.key1)
        number = int(exposure.diagnostics["photons"])
        return applied.change_light(
            light, exposure.light_factor, exposure.to_sensor, number, key
        )

    def _place_pattern(self, image: galsim.Image, orig_center: galsim.PositionI) -> Any:
        pattern = super()._place_pattern(image, orig_center)
        if self._applied is None:
            return pattern
        corner = (
            image.bounds.xmin - 1 + orig_center.x,
            image.bounds.ymin - 1 + orig_center.y,
        )
        return self._applied.add_stills(pattern, image.array.shape, corner)

    # -- the end of an exposure --------------------------------------------------------

    @property
    def acts_at_end(self) -> bool:
        """Whether :meth:`finish` changes images."""
        return self._applied is not None and self._applied.acts_at_end

    def finish(self, image: galsim.Image) -> None:
        """End the exposure: apply the effects on stored charge and during its transfer.

        Call it once for each exposure, with the image of the whole sensor, when all its
        light is in it (sky and its noise too) and before the noise of the readout is added.
        GalSim's configuration calls it by itself.  Without effects at these stages the image
        stays the same bit for bit.  Persistence acts on later images that this sensor finishes.

        Parameters
        ----------
        image : galsim.Image
            Image of float32 or float64 [e-], changed in place; its first pixel is the sensor's.

        Raises
        ------
        SensorError
            No galsim.Image; or the image was finished before and not exposed again, holds values
            that are not finite, or has another shape than the layout.  The image is unchanged.

        Examples
        --------
        >>> import galsim
        >>> from bfsensor import BrighterFatterSensor
        >>> coupling = {"class": "interpixel_coupling", "parameters": {"ax": 0.01, "ay": 0.0}}
        >>> sensor = BrighterFatterSensor(effects=[coupling], rng=galsim.BaseDeviate(7))
        >>> image = galsim.ImageF(5, 5)
        >>> image[3, 3] = 1000.0
        >>> sensor.finish(image)
        >>> image.array[2].tolist()
        [0.0, 10.0, 980.0, 10.0, 0.0]
        """
        array = pixels_of(image)
        self._check_finite(array)
        if self._finished is not None and self._finished() is image:
            raise SensorError(
                "finish was called twice for one exposure: its effects would act twice"
            )
        if self.acts_at_end:
            assert self._applied is not None
            rng = np.random.default_rng(int(self.rng.raw()) & 0xFFFFFFFF)
            memory = dict(self._memory)
            array[...] = self._applied.finish(array.astype(float), rng, memory)
            self._memory = memory
        self._finished = weakref.ref(image)
        self._closed = True
