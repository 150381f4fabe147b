"""Terms of nonparametric models: their definition, the fit they see, and covariances by single lag."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bfsensor.device.condition import Condition
from bfsensor.diagnose.data.channel_rows import rows_by_condition
from bfsensor.diagnose.data.channels import PER_ELECTRON, Channel
from bfsensor.diagnose.fit.fitted_model import Model
from bfsensor.diagnose.model.effect_parameters import fitted
from bfsensor.diagnose.model.flat_predictions import flat_response, periodic_covariances
from bfsensor.effects.effect import Effect
from bfsensor.files import Cache
from bfsensor.typing import FloatArray

SCALE = 1e5
"""Signal [e-] at which coefficients of its powers are given.  Defined: the unit in report.json."""

SINGLE = "single values"
"""Group of terms that change one measured a_ij each, of one table or alike in all."""

ALL_TABLES = "all tables"
"""Entry 'of' of the terms that are alike in all tables, in place of the name of one."""

AREA_UNIT = 1e-8
"""Change of an a_ij for a coefficient of 1 [1/e-].  Defined: the unit in report.json."""

LAG_POWERS = (0, 1, 2, 3)
"""Powers of the level in the covariance at one lag.  Chosen: noise, light, and two orders of
brighter-fatter response; higher ones are so alike over a ladder that none is preferred."""


@dataclass(frozen=True, eq=False)
class Term:
    """One column of a nonparametric model.

    Attributes
    ----------
    name : str
        Name of the coefficient, a key of report.json.
    where : mapping
        Numbers that define the term, such as 'lag', 'power' or 'period'.
    column : callable
        Takes a channel and gives its change for a coefficient of 1, in the channel's unit; None
        where the term does not change it.  A function of a module, or a partial one of it, so that
        a finished stage with the term can be stored.
    rough : callable, optional
        Faster approximation of ``column``, for searches.
    more : tuple of Term
        Terms of second order that go with it, each with a coefficient of its own.
    simple : bool
        Whether it is preferred to others that explain as much.
    """

    name: str
    where: Mapping[str, Any]
    column: Callable[[Channel], FloatArray | None]
    rough: Callable[[Channel], FloatArray | None] | None = None
    more: tuple[Term, ...] = ()
    simple: bool = False


@dataclass(frozen=True, eq=False)
class Family:
    """Terms of one kind, among which a few are chosen.

    Attributes
    ----------
    group : str
        Group of nonparametric terms, as in report.json.
    terms : tuple of Term
        Terms to choose from.
    words : tuple of str
        Channels that the search uses; the fit uses all.
    tried : int
        Number of terms that an earlier search chose these from, where it is larger: the noise
        threshold counts them all.
    """

    group: str
    terms: tuple[Term, ...]
    words: tuple[str, ...]
    tried: int = 0


@dataclass(frozen=True, eq=False)
class Flats:
    """Flats of one condition in a channel of covariances.

    ``rows``: values of the channel; ``flat``: index of the flat that each belongs to.  By flat:
    ``gain`` [e-/ADU], ``level`` [e-], area changes ``a`` [1/e-], and covariances ``c`` [e-^2] at all
    lags of a periodic array.
    """

    condition: Condition
    rows: NDArray[np.int64]
    flat: NDArray[np.int64]
    gain: FloatArray
    level: FloatArray
    a: FloatArray
    c: FloatArray


@dataclass(eq=False)
class Scene:
    """A fitted model with cached predictions that nonparametric terms share.

    Attributes
    ----------
    model : Model
        Model whose residuals are to be explained.
    kept : Cache
        Cached results, by a name and the object they belong to.
    """

    model: Model
    kept: Cache = field(default_factory=Cache)

    def __reduce__(self) -> tuple[Any, ...]:
        # What is cached can be calculated again.
        return Scene, (self.model,)

    @property
    def gains(self) -> FloatArray:
        """Fitted gains of the amplifiers [e-/ADU]."""
        count = len(self.model.predictor.measured.amplifiers)
        return np.asarray(self.model.fit.values[:count])

    @property
    def device(self) -> dict[str, float]:
        """Fitted device parameters less their nominal values, by name."""
        p, baseline = self.model.predictor, self.model.predictor.baseline
        return {
            name: float(self.model.fit.values[row]) * baseline.spread[name]
            for name, row in zip(baseline.parameters, p.space.prior_rows, strict=True)
        }

    def changed_by(self, effect: Effect, channel: Channel) -> FloatArray:
        """Change of a channel's prediction by an effect, in the channel's unit."""
        p = self.model.predictor
        point = self.model.fit.values[: len(p.names)]
        more = p.with_effects((*p.effects, effect), point)
        both = np.concatenate([point, more.start[len(more.names) - len(fitted(effect)) :]])
        return np.asarray(more.predict(channel, both) - self.here(channel))

    def here(self, channel: Channel) -> FloatArray:
        """Prediction of a channel by the model, without the linear parameters; cached."""
        p = self.model.predictor
        point = self.model.fit.values[: len(p.names)]
        return self.kept.get(("here", channel), lambda: p.predict(channel, point))

    def responses(self, flats: Flats, p: int) -> FloatArray:
        """Derivative of flats' power spectra by a response that goes with the level to the power p."""
        return self.kept.get(
            ("response", flats, p), lambda: flat_response(flats.a, flats.level, power=p)
        )

    def flats(self, channel: Channel) -> list[Flats]:
        """Flats of a channel of covariances by condition, without changes that effects make."""
        return self.kept.get(("flats", channel), lambda: self._found_flats(channel))

    def _found_flats(self, channel: Channel) -> list[Flats]:
        out, x = [], channel.axes
        predictor = self.model.predictor
        chain = predictor.chain(self.model.fit.values[: len(predictor.names)])
        for where, rows in rows_by_condition(channel).items():
            pairs = np.stack([x["amp"][rows].astype(float), x["level"][rows]], axis=1)
            flats, index = np.unique(pairs, axis=0, return_inverse=True)
            gain = self.gains[flats[:, 0].astype(int)]
            level = gain * flats[:, 1]
            a = predictor.baseline.flat_areas(where, self.device, level)
            law = {} if chain is None else {"law": chain.law}
            c = periodic_covariances(a, level, **law)
            out.append(Flats(where, rows, index.ravel(), gain, level, a, c))
        return out


def at_lags(
    c: FloatArray, flat: NDArray[np.int64], i: NDArray[np.int64], j: NDArray[np.int64]
) -> FloatArray:
    """Periodic covariances by flat, at lags: the mean of (i, j) and (i, -j)."""
    return np.asarray(0.5 * (c[flat, j, i] + c[flat, -j, i]))


def lag_family(scene: Scene) -> Family | None:
    """Family of covariances at single lags: by power of the level, or single values of a_ij."""
    channels = [c for c in scene.model.fit.channels if c.word == "flat_cov"]
    if not channels:
        return None
    if channels[0].unit == PER_ELECTRON:
        return _single_values(channels)
    lags = sorted({
        (int(i), int(j)) for c in channels
        for i, j in zip(c.axes["i"], c.axes["j"], strict=True)
    })  # fmt: skip

    terms = tuple(
        Term(f"covariance ({i}, {j}) x S^{p}", {"lags": [(i, j)], "power": p},
             partial(_at_lag, scene, (i, j), p))
        for i, j in lags for p in LAG_POWERS
    )  # fmt: skip
    return Family("covariances by lag", terms, ("flat_cov",))


def _at_lag(
    scene: Scene, lag: tuple[int, int], p: int, channel: Channel
) -> FloatArray | None:
    """Change of the covariance at one lag that goes with the level to the power p."""
    if channel.word != "flat_cov":
        return None
    x = channel.axes
    gain = scene.gains[x["amp"].astype(int)]
    here = (x["i"] == lag[0]) & (x["j"] == lag[1])
    level = gain * x["level"] / SCALE
    return np.where(here, level**p / gain**2, 0.0)


def _single_values(channels: list[Channel]) -> Family:
    """Family of changes of one measured a_ij, of a table or of all alike; unit 1e-8 / e-."""
    terms = []
    for c in channels:
        lags = list(zip(c.axes["i"].tolist(), c.axes["j"].tolist(), strict=True))
        groups: list[tuple[tuple[int, ...], str]] = [
            ((row,), f"table {int(c.axes['table'][row]) + 1}") for row in range(len(c))
        ]
        if len(np.unique(c.axes["table"])) > 1:
            alike = {lag: [n for n, own in enumerate(lags) if own == lag] for lag in lags}
            groups += [
                (tuple(rows), ALL_TABLES) for rows in alike.values() if len(rows) > 1
            ]
        terms += [
            Term(
                f"a_{lags[rows[0]][0]}{lags[rows[0]][1]} of {where}",
                {"lags": [lags[rows[0]]], "rows": rows, "of": where,
                 "relative": AREA_UNIT / float(np.mean(c.values[list(rows)]))},
                partial(_of_rows, c, rows),
            )
            for rows, where in groups
        ]  # fmt: skip
    return Family(SINGLE, tuple(terms), ("flat_cov",))


def _of_rows(chosen: Channel, rows: tuple[int, ...], channel: Channel) -> FloatArray | None:
    """Equal change of the values of some rows of a channel."""
    # A channel that was stored and read again is another object with the same values.
    if channel.word != chosen.word or not np.array_equal(channel.values, chosen.values):
        return None
    if not np.array_equal(channel.axes["table"], chosen.axes["table"]):
        return None
    return np.where(np.isin(np.arange(len(channel)), rows), AREA_UNIT, 0.0)
