"""Our effects on the pixels of the virtual sensor, and what they change in its channels.

Predictions of effects are held against what the same effects do to pixels: two campaigns of the
virtual sensor share all noise and differ in the effect alone.  The sensor's own effects have the
same conventions and none of this code: the same comparison with them checks the laws as well.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bfsensor.diagnose.data.channels import Channel
from bfsensor.diagnose.data.measure_channels import MeasuredChannels, measure_channels
from bfsensor.diagnose.data.spot_ghosts import find_ghosts
from bfsensor.diagnose.fit.baseline_fit import BaselineFit, fit_baseline
from bfsensor.diagnose.model.predictor import Predictor, used_channels
from bfsensor.effects.effect import Effect, Layout, Segment, Shot
from bfsensor.units import to_kelvin
from validation.common.virtual_source import VirtualSource, virtual_baseline
from validation.concealed.electrostatics import EdgeShifts
from validation.concealed.plan import SIZES, Geometry
from validation.concealed.sensor import VirtualSensor

FOLDS = ("fit", "select")


class OnPixels:
    """One of our effects in the shape in which the virtual sensor takes effects."""

    def __init__(self, effect: Effect) -> None:
        self.effect = effect
        self.word = effect.name
        self._layout: Layout | None = None
        self._count = 0

    def _of(self, context: Any) -> tuple[Shot, Layout]:
        if self._layout is None:
            g = context.geometry
            segments = tuple(
                Segment(n * g.width, 0, g.width, g.pixels, n % 2 == 1, False, g.prescan,
                        g.serial_overscan, g.parallel_overscan)
                for n in range(g.amplifiers)
            )  # fmt: skip
            card = virtual_baseline().card
            self._layout = Layout(
                (g.pixels, g.pixels),
                segments,
                gains=tuple(context.electronics.gain),
                **card,
            )
        e = context.exposure
        shot = Shot(e.kind.lower(), e.sequence, e.seconds, e.wavelength, e.back_bias,
                    to_kelvin(e.temperature), e.hours)  # fmt: skip
        return shot, self._layout

    def device(self, device):
        return device

    def shifts(self, shifts: Any, context: Any) -> Any:
        shot, layout = self._of(context)
        return EdgeShifts(*self.effect.edges(shifts.kx, shifts.ky, shot, layout))

    def laws(self, context: Any) -> dict[str, Any]:
        law = self.effect.law()
        out: dict[str, Any] = {"curvature": law.bend, "loss": law.loss}
        if np.isfinite(law.full_well):
            out["full_well"] = law.full_well
        return {k: v for k, v in out.items() if v}

    def spot_light(self, context: Any) -> dict[str, float]:
        variance, parts = self.effect.spot_light(*self._of(context))
        out = {"variance": variance} if variance else {}
        if not parts:
            return out
        # That engine draws one Gaussian.
        ((halo, wide),) = parts
        return out | {"halo": halo, "halo_sigma": wide}

    def light(self, scene: Any, context: Any) -> None:
        shot, layout = self._of(context)
        for factor in (
            self.effect.light_map(shot, layout),
            self.effect.turbulence(shot, layout, context.stream(self.word)),
        ):
            if factor is not None:
                scene.scale(factor.astype(np.float32))

    def displaced(self, context: Any) -> Any:
        moved = self.effect.displacements(*self._of(context))
        return None if moved is None else tuple(m.astype(np.float32) for m in moved)

    def store(self, charge: Any, context: Any) -> Any:
        shot, layout = self._of(context)
        stream = context.stream(self.word)
        return self.effect.store(charge, shot, layout, stream, context.memory)

    def shift(self, frames: Any, context: Any) -> Any:
        layout = self._of(context)[1]
        return [self.effect.shift(f, n, layout) for n, f in enumerate(frames)]

    def amplifier(self, frames: Any, context: Any) -> Any:
        return self.effect.amplify(frames, *self._of(context))

    def noise(self, frames: Any, context: Any) -> Any:
        return self.effect.noise(frames, self._of(context)[1], context.stream(self.word))

    def gain(self, context: Any) -> float:
        return 1.0

    def converter(self, levels: Any, context: Any) -> Any:
        return [self.effect.convert(level) for level in levels]

    def truth(self) -> dict[str, Any]:
        return {"class": self.effect.word, "parameters": dict(self.effect.values)}


def residuals(
    fit: BaselineFit,
    measured: MeasuredChannels,
    effects: Sequence[Effect],
    by: Sequence[Channel],
    chance: Sequence[Effect] = (),
) -> dict[str, NDArray[np.float64]]:
    """Channels less what is predicted with effects, all else as in a null's fit, by errors.

    Linear parameters are left out: they are the same with and without effects.  ``by``: the
    channels that errors are taken from; those are wider by what ``chance`` leaves open.
    """
    baseline = virtual_baseline()
    count = len(Predictor(measured, baseline).names)
    predictor = Predictor(measured, baseline).with_effects(effects, fit.values)
    point = np.concatenate([fit.values[:count], predictor.start[count:]])
    random = Predictor(measured, baseline).with_effects(chance, fit.values)
    out: dict[str, list[NDArray]] = {}
    channels = used_channels(measured.channels, FOLDS)
    for like, channel in zip(by, channels, strict=True):
        if len(like) != len(channel):
            raise ValueError(f"{like.word}: {len(channel)} values, the null {len(like)}")
        left = like.whiten(channel.values - predictor.predict(channel, point))
        out.setdefault(channel.word, []).append(_widened(left, like, random))
    return {w: np.concatenate(v) for w, v in out.items()}


def compare(
    effect: Effect, seed: int = 31_000, size: Any = "S", own: Any = None
) -> dict[str, tuple[float, float, float]]:
    """Hold an effect's prediction against pixels.

    Parameters
    ----------
    effect : Effect
        Ours.
    seed, size
        Of the campaigns.
    own : optional
        Effect of the virtual sensor to be on its pixels instead of ours.

    Returns
    -------
    dict of str to (float, float, float)
        By channel, the baseline's parameters taken off: length of the prediction [standard
        deviations], factor on it that fits the pixels best, and its error from what noise the
        two campaigns do not share.  Where nothing is predicted: 0, 0 and the length seen.
        Errors are those that the channels of the campaign with the effect have.
    """
    source = VirtualSource(seed=seed, size=size, effects=[own or OnPixels(effect)])
    # Both campaigns use the same frames.
    haunted = find_ghosts(source.exposures, source.read)
    null, fit = null_campaign(seed, size, haunted)
    other = measure_channels(source, ghosts=haunted)
    by = used_channels(other.channels, FOLDS)
    before, bare, after = (
        residuals(fit, m, e, by, (effect,))
        for m, e in ((null, ()), (other, ()), (other, (effect,)))
    )
    random = Predictor(other, virtual_baseline()).with_effects((effect,), fit.values)
    basis = _basis(fit, by, random)
    seen = _without_parameters(fit, basis, {w: bare[w] - before[w] for w in bare})
    said = _without_parameters(fit, basis, {w: bare[w] - after[w] for w in bare})
    out = {}
    for word in seen:
        p, s = said[word], seen[word]
        norm = float(np.sqrt(p @ p))
        factor = float(p @ s) / max(norm, 1e-9) ** 2 if norm > SHADOW else 0.0
        left = s - factor * p
        # Noise that is not shared is where the effect is, and large where it is strong.
        error = float(np.sqrt((p * left) @ (p * left)))
        out[word] = (
            norm,
            factor,
            error / norm**2 if norm > SHADOW else float(np.sqrt(left @ left)),
        )
    return out


SHADOW = 0.1
"""Length [standard deviations] below which a channel has no part in an effect."""


def _widened(
    left: NDArray[np.float64], channel: Channel, random: Predictor
) -> NDArray[np.float64]:
    """Whitened values over errors that hold what random effects leave to chance."""
    modes = random.modes(channel, random.start)
    if not modes.shape[1]:
        return left
    shapes, sizes, _ = np.linalg.svd(channel.whiten(modes), full_matrices=False)
    wider = 1 - 1 / np.sqrt(1 + sizes**2)
    wide = shapes * wider
    return np.asarray(left - wide @ (shapes.T @ left))


def _basis(
    fit: BaselineFit, by: Sequence[Channel], random: Predictor
) -> NDArray[np.float64]:
    """What the baseline's parameters span where errors are others'."""
    columns = fit.basis.copy()
    for like, channel, start in zip(fit.channels, by, fit.starts, strict=False):
        rows = slice(start, start + len(like))
        moved = channel.whiten(like.unwhiten(fit.basis[rows]))
        columns[rows] = _widened(moved, channel, random)
    return np.asarray(np.linalg.qr(columns)[0])


def _without_parameters(
    fit: BaselineFit, basis: NDArray[np.float64], changes: dict[str, NDArray[np.float64]]
) -> dict[str, NDArray[np.float64]]:
    """Changes less what the baseline's parameters would take of them, by channel word."""
    whole = np.zeros(len(basis))
    for word, change in changes.items():
        whole[: len(fit.residuals)][fit.of(word)] = change
    left = whole - basis @ (basis.T @ whole)
    return {w: left[: len(fit.residuals)][fit.of(w)] for w in changes}


_NULLS: dict[Any, tuple[MeasuredChannels, BaselineFit]] = {}


def null_campaign(
    seed: int, size: Any, ghosts: Mapping[int, list[NDArray[np.bool_]]] | None = None
) -> tuple[MeasuredChannels, BaselineFit]:
    """A campaign without effects, and its fit, at the sensor's own gains; kept.

    Gains are known from flats to 2e-3, and an effect of more than 500 errors is predicted better.
    ``ghosts``: frames to set apart, for comparisons with a campaign in which spots left some.
    """
    key = seed, repr(size), tuple(ghosts or ())
    if key not in _NULLS:
        pixels = (SIZES[size] if isinstance(size, str) else size).pixels
        sensor = VirtualSensor(Geometry(pixels), seed=seed)
        measured = measure_channels(
            VirtualSource(seed=seed, size=size), ghosts=ghosts or True
        )
        predictor = Predictor(measured, virtual_baseline())
        fit = fit_baseline(predictor, used_channels(measured.channels, FOLDS))
        values = fit.values.copy()
        for n, gain in enumerate(sensor.electronics.gain):
            values[fit.names.index(f"gain {n}")] = gain
        _NULLS[key] = measured, replace(fit, values=values)
    return _NULLS[key]
