"""GalSim configuration: options of BrighterFatterSensor, and a noise type that ends exposures.

GalSim ends an image by adding sky and noise.  Effects that act on stored charge belong between
the noise of the light and that of the readout; the noise type of this module wraps the one of the
configuration and finishes the image between the two.  Image types that add noise stamp by stamp
(Single, and Tiled without overlap) finish each stamp as a sensor of its own.  For sensors that are
not built by the configuration (type Eval) write ``image.noise`` as
``{type: BrighterFatter, noise: {...}}``; ``modules: [bfsensor.sensor.config]`` registers the type.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from galsim import GaussianNoise
from galsim.config.noise import NoiseBuilder, RegisterNoiseType, valid_noise_types
from galsim.config.sensor import SimpleSensorBuilder
from galsim.config.value import GetAllParams, ParseValue
from galsim.errors import GalSimConfigError

from bfsensor.sensor.effect_sensor import EffectSensor
from bfsensor.sensor.imsim import choose_options

NOISE = "BrighterFatter"
"""Name of the noise type; its ``noise`` is any other of GalSim's."""

_INTERNAL = ("index_key", "rng_num", "rng_index_key")
"""Keys that GalSim adds to a dict of the configuration."""


class EffectSensorBuilder(SimpleSensorBuilder):
    """Builds a sensor from a configuration in which ``effects`` may be a file, dict or list."""

    def getKwargs(self, config: Any, base: Any, logger: Any) -> dict[str, Any]:  # noqa: N802
        """Return the options of the sensor, with values inside ``conditions`` evaluated."""
        config = choose_options(self.init_func, config, base, logger)
        given = config.get("effects")
        inline = isinstance(given, list | dict) and "type" not in given
        if inline:
            # GalSim would take a list or dict for a description of how to choose the value.
            config = {k: v for k, v in config.items() if k != "effects"}
        kwargs: dict[str, Any] = super().getKwargs(config, base, logger)
        if inline:
            kwargs["effects"] = _plain(given)
        if "layout" in kwargs:
            kwargs["layout"] = _plain(kwargs["layout"])
        if "conditions" in kwargs:
            conditions = kwargs["conditions"]
            kwargs["conditions"] = {
                k: ParseValue(conditions, k, base, str if k == "kind" else float)[0]
                for k in conditions
                if k not in _INTERNAL
            }
        return kwargs

    def buildSensor(self, config: Any, base: Any, logger: Any) -> Any:  # noqa: N802
        """Build the sensor; if it acts at the end of exposures, wrap the image's noise."""
        sensor = super().buildSensor(config, base, logger)
        if isinstance(sensor, EffectSensor) and sensor.acts_at_end:
            image = base.get("image")
            if isinstance(image, dict):
                noise = image.get("noise")
                if not (isinstance(noise, Mapping) and noise.get("type") == NOISE):
                    image["noise"] = {"type": NOISE, **({"noise": noise} if noise else {})}
        return sensor


def _plain(given: Any) -> Any:
    """Copy of a value without the keys that GalSim adds."""
    if isinstance(given, Mapping):
        return {k: _plain(v) for k, v in given.items() if k not in _INTERNAL}
    return [_plain(v) for v in given] if isinstance(given, list | tuple) else given


class FinishingNoiseBuilder(NoiseBuilder):
    """Noise type that adds noise of the light, effects at the end, and noise of the readout."""

    def addNoise(  # noqa: N802
        self, config: Any, base: Any, im: Any, rng: Any, current_var: float,
        draw_method: str, logger: Any,
    ) -> float:  # fmt: skip
        """Add the configuration's noise to an image, with the effects between light and readout.

        Parameters
        ----------
        config, base, im, rng, current_var, draw_method, logger
            As for GalSim's noise builders.

        Returns
        -------
        var : float
            Variance of the noise that was added.

        Raises
        ------
        galsim.GalSimConfigError
            The image has no sensor of type BrighterFatter, or the noise type is not known.
        """
        sensor = base.get("sensor")
        if not isinstance(sensor, EffectSensor):
            raise GalSimConfigError(
                f"noise of type {NOISE} needs an image.sensor of type BrighterFatter"
            )
        inner = self._inner(config)
        kind, gain, sigma = inner.get("type"), 1.0, 0.0
        if kind == "CCD":
            values = GetAllParams(
                {k: inner[k] for k in ("gain", "read_noise") if k in inner}, base,
                opt={"gain": float, "read_noise": float},
            )[0]  # fmt: skip
            gain, sigma = values.get("gain", 1.0), values.get("read_noise", 0.0)
            inner = {**inner, "read_noise": 0.0}
        var = 0.0
        light = kind in ("CCD", "Poisson")
        if light:
            var = self._add(inner, base, im, rng, current_var, draw_method, logger)
        if gain != 1.0:
            im *= gain
        sensor.finish(im)
        if gain != 1.0:
            im /= gain
        if sigma:
            im.addNoise(GaussianNoise(rng, sigma=sigma / gain))
            var = var + (sigma / gain) ** 2
        if kind and not light:
            var = self._add(inner, base, im, rng, current_var, draw_method, logger)
        return var

    def getNoiseVariance(self, config: Any, base: Any, full: bool = False) -> Any:  # noqa: N802
        """Return the variance of the configuration's noise."""
        inner = self._inner(config)
        if not inner:
            return 0.0
        return valid_noise_types[inner["type"]].getNoiseVariance(inner, base, full=full)

    def addNoiseVariance(  # noqa: N802
        self, config: Any, base: Any, im: Any, include_obj_var: bool, logger: Any
    ) -> None:
        """Add the variance of the configuration's noise to a weight image."""
        inner = self._inner(config)
        if inner:
            builder = valid_noise_types[inner["type"]]
            builder.addNoiseVariance(inner, base, im, include_obj_var, logger)

    @staticmethod
    def _inner(config: Any) -> dict[str, Any]:
        """Dict of the wrapped noise with its type, empty where there is none."""
        noise = config.get("noise") or {}
        if not isinstance(noise, dict):
            raise GalSimConfigError("image.noise is not a dict.")
        kind = noise.get("type", "Poisson") if noise else None
        if kind and kind not in valid_noise_types:
            raise GalSimConfigError(f"Invalid noise.type {kind!r}.")
        return {**noise, "type": kind} if kind else {}

    @staticmethod
    def _add(
        inner: Any, base: Any, im: Any, rng: Any, var: float, draw_method: str, logger: Any
    ) -> float:
        """Add the wrapped noise; returns its variance."""
        builder = valid_noise_types[inner["type"]]
        return float(builder.addNoise(inner, base, im, rng, var, draw_method, logger))


RegisterNoiseType(NOISE, FinishingNoiseBuilder())
