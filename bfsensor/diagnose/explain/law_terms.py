"""Terms that give an effect another law: its own change times functions of channels' coordinates."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from bfsensor.diagnose.data.channels import Channel
from bfsensor.diagnose.detect.model_error import charge
from bfsensor.diagnose.explain.pursuit import Choice, Dictionary
from bfsensor.diagnose.explain.terms import Family, Term
from bfsensor.diagnose.fit.baseline_fit import BaselineFit
from bfsensor.diagnose.model.predictor import Predictor
from bfsensor.effects.effect import Effect
from bfsensor.files import Cache
from bfsensor.typing import FloatArray

GROUP = "law of "
"""Beginning of the group's name; the effect's name and the channel follow."""

AXES = (
    "wavelength", "back_bias", "temperature", "amp", "other", "map", "step", "time", "after", "flux",
    "k", "i", "j", "lag", "bit", "code", "x", "y",
)  # fmt: skip
"""Coordinates that laws of effects are functions of: conditions, amplifiers, levels, and places in
readout order and on the sensor.  Single exposures are none: no law knows them."""

LEVELS = ("step", "time", "flux")
"""Coordinates that laws are smooth in the logarithm of."""

Function = Callable[[Channel], FloatArray]


class OwnChange:
    """Change of channels' predictions by one effect of a model, at its fitted parameters.

    Parameters
    ----------
    predictor : Predictor
        Predictor of the model.
    values : ndarray
        Fitted values of its parameters.
    effects : sequence of Effect
        Effects of the model with their fitted parameters, the effect in question last.
    """

    def __init__(
        self, predictor: Predictor, values: FloatArray, effects: Sequence[Effect]
    ) -> None:
        self.effect = effects[-1]
        self._both = predictor.with_effects(effects, values)
        self._others = predictor.with_effects(effects[:-1], values)
        self._kept = Cache()

    def __call__(self, channel: Channel) -> FloatArray:
        """Change of a channel, in its unit, shape (n,)."""
        return self._kept.get(channel, lambda: self._made(channel))

    def _made(self, channel: Channel) -> FloatArray:
        if channel.word not in self.effect.touches:
            return np.zeros(len(channel))
        both, others = self._both, self._others
        return np.asarray(
            both.predict(channel, both.start) - others.predict(channel, others.start)
        )

    def whitened(self, fit: BaselineFit) -> FloatArray:
        """Whitened change of all values of a fit, shape (n,)."""
        return np.concatenate([np.zeros(0), *(c.whiten(self(c)) for c in fit.channels)])


def law_choices(
    change: OwnChange, fit: BaselineFit, without: Collection[str] = ()
) -> list[Choice]:
    """Other laws of an effect that a fit's residuals ask for, one choice of terms for each channel.

    Every law of the class acts where the effect acts: a term is the effect's change times a
    function of one coordinate of the channel (a slope, a curvature, or one of its values), so that it
    vanishes where the effect does.  Terms are chosen by
    :class:`~bfsensor.diagnose.explain.pursuit.Dictionary`, with its charge for the best of many;
    together they may not be larger than the effect's own change of the channel.

    Parameters
    ----------
    change : OwnChange
        Change by the effect.
    fit : BaselineFit
        Fit with the effect.
    without : collection of str
        Names of terms that are in the fit.

    Returns
    -------
    choices : list of Choice
        The one of greatest score first.
    """
    out = []
    for word in dict.fromkeys(c.word for c in fit.channels):
        if word not in change.effect.touches:
            continue
        family = law_family(change, fit, word, without)
        choice = Dictionary(family, fit).choose() if family.terms else None
        if choice is None or choice.score <= 0:
            continue
        # A correction that is larger than the effect itself is no law of it.
        own = sum(
            float(np.square(c.whiten(change(c))).sum())
            for c in fit.channels
            if c.word == word
        )
        if float(choice.template @ choice.template) <= own:
            out.append(choice)
    return sorted(out, key=lambda c: -c.score)


def law_family(
    change: OwnChange, fit: BaselineFit, word: str, without: Collection[str] = ()
) -> Family:
    """Family of the terms of an effect's law in the channels of one name."""
    channels = [c for c in fit.channels if c.word == word]
    squares = [c.whiten(change(c)) ** 2 for c in channels]
    group = f"{GROUP}{change.effect.name} in {word}"
    # A part of the effect whose own change gains less than one term's charge would have to be wrong
    # by more than all of itself to be worth a term.
    least = charge(1, 1)
    terms = []
    for name, function, simple in _functions(channels):
        inside = sum(
            float(s @ (function(c) != 0)) for c, s in zip(channels, squares, strict=True)
        )
        if inside > least and f"{group}: {name}" not in without:
            terms.append(
                Term(f"{group}: {name}", {"effect": change.effect.name},
                     _product(change, function, word), simple=simple)
            )  # fmt: skip
    return Family(group, tuple(terms), (word,))


def _product(
    change: OwnChange, function: Function, word: str
) -> Callable[[Channel], FloatArray | None]:
    """Column of a term: None in channels of other names."""
    return partial(_times, change, function, word)


def _times(
    change: OwnChange, function: Function, word: str, channel: Channel
) -> FloatArray | None:
    return change(channel) * function(channel) if channel.word == word else None


def _functions(channels: Sequence[Channel]) -> Iterator[tuple[str, Function, bool]]:
    """Functions of the coordinates of channels, with their names, and whether they are smooth."""
    kinds: list[str | None] = [None]
    if all("what" in c.axes for c in channels):
        kinds = [*sorted({str(w) for c in channels for w in c.axes["what"]})]
    seen: set[bytes] = set()
    for kind in kinds:
        label = f"{kind} " if kind else ""
        if len(kinds) > 1:
            yield f"{label}as a whole", _inside(kind), True
        for axis in AXES:
            if not all(axis in c.axes for c in channels):
                continue
            values = _distinct(channels, axis, kind)
            if len(values) < 2:
                continue
            # Two names of one coordinate, such as a step and its exposure time, count once.
            code = np.concatenate([np.searchsorted(values, c.axes[axis]) for c in channels])
            if code.tobytes() in seen:
                continue
            seen.add(code.tobytes())
            if values.dtype.kind in "fiu":
                for degree in range(1, min(len(values), 3)):
                    yield (
                        f"{label}{axis}, degree {degree}",
                        _smooth(kind, axis, values, degree),
                        True,
                    )
            for value in values:
                yield f"{label}{axis} = {value}", _at(kind, axis, value), False


def _distinct(channels: Sequence[Channel], axis: str, kind: str | None) -> NDArray:
    """Values of a coordinate that occur; none where it is not defined for all."""
    parts = [c.axes[axis][_of(c, kind)] for c in channels]
    values = np.unique(np.concatenate(parts))
    numeric = values.dtype.kind in "fiu"
    return values if not numeric or np.isfinite(values).all() else values[:0]


def _of(channel: Channel, kind: str | None) -> NDArray[np.bool_]:
    return np.ones(len(channel), bool) if kind is None else channel.axes["what"] == kind


def _inside(kind: str | None) -> Function:
    return partial(_is_of, kind)


def _is_of(kind: str | None, channel: Channel) -> FloatArray:
    """1 for values of a kind."""
    return _of(channel, kind).astype(float)


def _at(kind: str | None, axis: str, value: object) -> Function:
    return partial(_equals, kind, axis, value)


def _equals(kind: str | None, axis: str, value: object, channel: Channel) -> FloatArray:
    """1 for values of a kind at one value of a coordinate."""
    # A planned recording may lack the coordinate: nothing is known of the law there.
    if axis not in channel.axes:
        return np.zeros(len(channel))
    return (_of(channel, kind) & (channel.axes[axis] == value)).astype(float)


def _smooth(kind: str | None, axis: str, values: NDArray, degree: int) -> Function:
    """Legendre polynomial of a coordinate, or of its logarithm for levels, over its range."""
    logarithm = axis in LEVELS and float(values.min()) > 0
    low, high = (float(v) for v in (values.min(), values.max()))
    if logarithm:
        low, high = np.log(low), np.log(high)
    return partial(_polynomial, kind, axis, (low, high), logarithm, degree)


def _polynomial(
    kind: str | None,
    axis: str,
    ends: tuple[float, float],
    logarithm: bool,
    degree: int,
    channel: Channel,
) -> FloatArray:
    """Legendre polynomial between two ends, for values of a kind."""
    if axis not in channel.axes:
        return np.zeros(len(channel))
    low, high = ends
    x = channel.axes[axis].astype(float)
    x = np.log(np.maximum(x, 1e-300)) if logarithm else x
    u = np.clip(2 * (x - low) / (high - low) - 1, -1, 1)
    shape = np.polynomial.legendre.Legendre.basis(degree)
    return np.where(_of(channel, kind), shape(u), 0.0)
