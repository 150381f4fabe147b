"""Forecasts of exposures that were not taken: channels, their derivatives by parameters, and noise."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from bfsensor.device.condition import Condition
from bfsensor.diagnose.data.channel_rows import rows_by_condition
from bfsensor.diagnose.data.channels import PER_ELECTRON, Channel
from bfsensor.diagnose.data.exposure_info import (
    NUMBERS,
    Axes,
    condition_at,
    label_of,
    numbers_of,
    zero_folds,
)
from bfsensor.diagnose.data.flat_channels import TAIL
from bfsensor.diagnose.data.map_channels import MapShare, block_side
from bfsensor.diagnose.data.map_noise import block_noise
from bfsensor.diagnose.fit.baseline_fit import BaselineFit
from bfsensor.diagnose.model.predictor import Predictor
from bfsensor.diagnose.plan.planned_exposures import Forecast, Planned
from bfsensor.errors import DiagnosisError
from bfsensor.measure.bartlett import bartlett_matrix
from bfsensor.typing import FloatArray
from bfsensor.units import to_celsius

SETTLED = 3
"""Number of fixed-point iterations for the mean of a flat, on which effects depend. Derived: effects
change the mean by a few per cent, so that each round leaves a few per cent of the error and three
less than 1e-4; twice as many change nothing visible."""

MAP = "planned"
"""Prefix of the names of maps of planned flats."""


class Forecaster:
    """Predicts the channels of exposures that were not taken.

    Parameters
    ----------
    predictor : Predictor
        Model of baseline and effects.
    fit : BaselineFit
        Its fit.
    """

    def __init__(self, predictor: Predictor, fit: BaselineFit) -> None:
        self.predictor, self.fit = predictor, fit
        self.measured = predictor.measured
        self.point = fit.values[: len(predictor.names)]
        self.values = dict(zip(fit.names, map(float, fit.values), strict=True))
        self.amps = len(self.measured.amplifiers)
        self.gains = self.point[: self.amps]
        self.usual = self._usual()
        flats = [c for c in fit.channels if c.word == "flat_mean"]
        self._lamp = (
            float(np.median(np.concatenate([c.axes["lamp"] for c in flats])))
            if flats
            else 1.0
        )
        levels = [float(c.axes["level"].max()) for c in flats if len(c)]
        self.brightest = float(self.gains.mean()) * max(levels) if levels else 0.0
        """Level of the campaign's brightest flats [e-]; 0 without flats."""
        self._spots_more: list[Condition] = []
        self._maps_more: dict[tuple[str, str], tuple[MapShare, ...]] = {}
        fluxes = [float(c.axes["flux"].max()) for c in fit.channels if c.word == "spot"]
        self.brightest_spot = max(fluxes, default=0.0)
        """Flux of the campaign's brightest spots [e-]; 0 without spots."""

    def _usual(self) -> Condition:
        """Condition of most covariances of flats, else of most spots, else of most values."""
        for words in (("flat_cov",), ("spot",), ()):
            count = Counter[Condition]()
            for channel in self.fit.channels:
                if channel.word in words or not words:
                    for condition, rows in rows_by_condition(channel).items():
                        if condition.wavelength is not None:
                            count[condition] += len(rows)
            if count:
                return count.most_common(1)[0][0]
        return Condition()

    def condition(self, planned: Planned) -> Condition:
        """Condition of planned exposures; settings that are nan are the campaign's usual ones."""
        given = planned.wavelength, planned.back_bias, planned.temperature
        return condition_at(
            own if np.isnan(v) else round(float(v), 2)
            for v, own in zip(given, numbers_of(self.usual), strict=True)
        )

    def seconds(self, planned: Planned) -> float:
        """Exposure time [s] of planned flats."""
        if np.isfinite(planned.seconds):
            return planned.seconds
        rate = self._rates(self.condition(planned))
        mean = float(np.mean(self.gains * rate)) * planned.rate * self._reading(planned)
        return planned.level / mean

    def _reading(self, planned: Planned) -> float:
        return planned.lamp if np.isfinite(planned.lamp) else self._lamp

    def _rates(self, condition: Condition) -> FloatArray:
        """Light by amplifier [ADU/s at a lamp reading of 1]; nan where it was not recorded."""
        names = [self._known(f"light {a} {label_of(condition)}") for a in range(self.amps)]
        return np.array([self.values.get(n, np.nan) for n in names])

    def _known(self, name: str) -> str:
        """The parameter itself, or for light that was not fitted, that of the same wavelength."""
        if name in self.values or not name.startswith("light "):
            return name
        start = name.split("/", 1)[0] + "/"
        return next((n for n in self.values if n.startswith(start)), name)

    def forecasts(self, planned: Sequence[Planned]) -> list[Forecast]:
        """Predict all channels of planned exposures that can be predicted.

        Raises
        ------
        DiagnosisError
            An unknown kind, or spots of a wavelength and temperature that the campaign lacks.
        """
        makers = {"flat": self._flats, "dark": self._darks, "bias": self._biases}
        out: list[Forecast] = []
        spots: dict[Condition, list[Planned]] = {}
        for one in planned:
            if one.kind == "spot":
                spots.setdefault(self.condition(one), []).append(one)
            elif one.kind in makers:
                out += makers[one.kind](one)
            else:
                raise DiagnosisError(
                    f"kind={one.kind} must be one of spot, {', '.join(makers)}"
                )
        # All fluxes of a condition together: the spot is grown once, up to the brightest.
        for ladder in spots.values():
            out += self._spots(ladder)
        return out

    def same(self, forecasts: Sequence[Forecast], other: Forecaster) -> list[Forecast]:
        """Predict, by this model, the channels that another forecaster predicted."""
        self._extend(other._spots_more, other._maps_more)
        return [self.forecast(f.channel) for f in forecasts]

    def _extend(
        self,
        spots: Sequence[Condition],
        maps: Mapping[tuple[str, str], tuple[MapShare, ...]],
    ) -> None:
        self.predictor = self.predictor.with_exposures(spots, maps)
        self._spots_more += spots
        self._maps_more.update(maps)

    def predicted(self, channel: Channel) -> FloatArray:
        """Prediction of a channel, with the linear parameters that were fitted."""
        out = self.predictor.predict(channel, self.point)
        for name, column in self.predictor.linear(channel).items():
            out = out + self.values.get(self._known(name), 0.0) * column
        return out

    def forecast(self, channel: Channel) -> Forecast:
        """Predict values and derivatives of a channel with given axes and errors."""
        predictor = self.predictor
        here = predictor.predict(channel, self.point)
        count = len(predictor.names)
        slopes = np.zeros((len(channel), len(self.fit.names)))
        for n in np.flatnonzero(predictor.depends(channel)):
            slopes[:, n] = predictor.slope(channel, self.point, int(n), here)
        places = {name: n for n, name in enumerate(self.fit.names) if n >= count}
        free = {}
        for name, column in predictor.linear(channel).items():
            known = self._known(name)
            if known in places:
                slopes[:, places[known]] += column
            if known != name or (known not in places and np.any(column)):
                free[name] = column
        values = here + slopes[:, count:] @ self.fit.values[count:]
        return Forecast(replace(channel, values=values), slopes, free)

    def _flats(self, planned: Planned) -> list[Forecast]:
        condition, segments = self.condition(planned), self.measured.segments
        if not segments or not self.amps:
            return []
        rate = self._rates(condition)
        seconds = self.seconds(planned)
        lit = bool(np.isfinite(rate).all() and np.isfinite(seconds))
        if not lit and not np.isfinite(planned.level):
            raise DiagnosisError(
                f"flats at {say_condition(condition)}: the campaign has none, so that their light is "
                "unknown; give level= [e-] instead of seconds= [s]"
            )
        if lit:
            mean = self._mean(planned, condition, seconds)
            levels = mean.channel.values
        else:
            levels = planned.level / self.gains
        out = [self._covariances(planned, condition, levels, seconds if lit else 0.0)]
        if lit:
            out.append(mean)
        for word in ("serial_overscan", "parallel_overscan"):
            out += self._overscan(word, planned, condition, levels, seconds if lit else 0.0)
        if condition != self.usual and lit:
            out += self._map(planned, condition, levels, seconds)
        return out

    def _mean(self, planned: Planned, condition: Condition, seconds: float) -> Forecast:
        """Mean level of all planned exposures together, one value for each amplifier."""
        noise = np.nan_to_num(np.array(self.measured.read_noise))
        pixels = np.array([s.rows * s.columns for s in self.measured.segments], float)
        own = planned.lamp_error
        error = own if np.isfinite(own) else self.measured.lamp_error
        last = max(self.measured.shots, key=lambda s: s.number, default=None)
        level = self._rates(condition) * planned.rate * seconds * self._reading(planned)
        for _ in range(SETTLED):
            axes = Axes()
            axes.add(self.amps, condition, amp=np.arange(self.amps), time=seconds,
                     lamp=planned.rate * self._reading(planned), level=level, mjd=np.nan,
                     exposure=1 + (last.number if last else 0))  # fmt: skip
            variance = level / self.gains / pixels + 3 * noise**2 / pixels
            block = np.diag(variance) + error**2 * np.outer(level, level)
            channel = Channel(
                "flat_mean", level, (block / planned.count,), axes.columns(), "adu"
            )
            level = self.predicted(channel)
        return self.forecast(channel)

    def _covariances(
        self,
        planned: Planned,
        condition: Condition,
        levels: FloatArray,
        seconds: float,
    ) -> Forecast:
        lags = max(
            (int(c.axes["i"].max()) for c in self.fit.channels
             if c.word == "flat_cov" and c.unit != PER_ELECTRON),
            default=4,
        )  # fmt: skip
        j, i = (index.ravel() for index in np.indices((lags + 1,) * 2))
        axes = Axes()
        for amp, level in enumerate(levels):
            axes.add(len(j), condition, amp=amp, time=seconds, level=float(level),
                     pairs=max(planned.count // 2, 1), i=i, j=j)  # fmt: skip
        unit = tuple(np.eye(len(j)) for _ in levels)
        bare = Channel("flat_cov", np.zeros(len(levels) * len(j)), unit, axes.columns(),
                       "adu2")  # fmt: skip
        values = self.predicted(bare).reshape(len(levels), lags + 1, lags + 1)
        blocks = []
        for segment, c in zip(self.measured.segments, values, strict=True):
            pairs = (segment.rows - j) * (segment.columns - i) * max(planned.count // 2, 1)
            blocks.append(bartlett_matrix(c, pairs.reshape(c.shape)))
        return self.forecast(
            Channel("flat_cov", values.ravel(), tuple(blocks), axes.columns(), "adu2")
        )

    def _overscan(
        self,
        word: str,
        planned: Planned,
        condition: Condition,
        levels: FloatArray,
        seconds: float,
    ) -> list[Forecast]:
        serial = word == "serial_overscan"
        axes, blocks = Axes(), []
        biases = self.measured.counts.get("bias", 0)
        zeros = sum("fit" in zero_folds(n, biases) for n in range(biases))
        for amp, segment in enumerate(self.measured.segments):
            own = segment.serial_overscan if serial else segment.parallel_overscan
            head = (planned.overscan or own) - TAIL
            if head <= 0:
                continue
            lines = segment.rows if serial else segment.columns
            noise = self.measured.read_noise[amp]
            variance = (noise if np.isfinite(noise) else 1.0) ** 2 / lines
            # The mean profile of the biases, which is subtracted, has noise, too.
            variance *= 1 / planned.count + (1 / zeros if zeros else 0.0)
            blocks.append(variance * (np.eye(head) + 1 / TAIL))
            axes.add(head, condition, amp=amp, time=seconds, level=float(levels[amp]),
                     k=np.arange(1, head + 1))  # fmt: skip
        if not blocks:
            return []
        count = sum(len(b) for b in blocks)
        channel = Channel(word, np.zeros(count), tuple(blocks), axes.columns(), "adu")
        return [self.forecast(channel)]

    def _map(
        self,
        planned: Planned,
        condition: Condition,
        levels: FloatArray,
        seconds: float,
    ) -> list[Forecast]:
        """Ratio of flats at another condition to flats at the usual one, against position."""
        if not any(c.word == "flat_map" for c in self.fit.channels):
            return []
        shares = tuple(
            MapShare(sign, where, seconds, float(levels.mean()))
            for sign, where in ((1.0, condition), (-1.0, self.usual))
        )
        ny, nx = self.measured.shape
        # Photon noise of both flats, taking as many of the usual condition as are planned.
        noise = 2 / (float((levels * self.gains).mean()) * planned.count)
        name = f"{MAP} {len(self._maps_more)}"
        side = block_side((ny, nx))
        shared = block_noise(np.ones((ny, nx), bool), side)
        y, x = ((v + 0.5) * side - 0.5 for v in np.divmod(shared.kept, nx // side))
        axes = Axes()
        for what, at in (
            ("column", {"x": np.arange(nx), "y": -1.0}), ("row", {"x": -1.0, "y": np.arange(ny)}),
            ("block", {"x": x, "y": y}),
        ):  # fmt: skip
            count = {"column": nx, "row": ny, "block": len(x)}[what]
            axes.add(count, condition, map=name, what=what, k=-1.0, **at)
        blocks = (*np.full((nx, 1, 1), noise / ny), *np.full((ny, 1, 1), noise / nx),
                  noise * shared.covariance)  # fmt: skip
        size = nx + ny + len(x)
        channel = Channel("flat_map", np.zeros(size), blocks, axes.columns(), "",
                          common=shared.common())  # fmt: skip
        self._extend([], {(channel.fold, name): shares})
        return [self.forecast(channel)]

    def _spots(self, ladder: Sequence[Planned]) -> list[Forecast]:
        """Spots of one condition, with the errors of recorded spots of the nearest flux."""
        condition = self.condition(ladder[0])
        like = next((c for c in self.fit.channels if c.word == "spot"), None)
        if like is None:
            return []
        what = list(dict.fromkeys(like.axes["what"]))
        axes, errors = Axes(), []
        light = self._spot_light(condition)
        for planned in ladder:
            flux = planned.flux
            if not np.isfinite(flux):
                flux = planned.seconds * self._reading(planned) * planned.rate * light
            near = np.abs(np.log(like.axes["flux"] / flux))
            for w in what:
                n = min(np.flatnonzero(like.axes["what"] == w), key=lambda n: near[n])
                scale = flux / like.axes["flux"][n] if w == "flux" else 1.0
                errors.append(scale * like.errors[n] / np.sqrt(planned.count))
            axes.add(len(what), condition, what=np.array(what), flux=flux, exposure=-1,
                     light=flux / light, time=planned.seconds)  # fmt: skip
        blocks = tuple(np.array([[e**2]]) for e in errors)
        channel = Channel("spot", np.zeros(len(errors)), blocks, axes.columns(), "")
        self._extend([condition], {})
        return [self.forecast(channel)]

    def _spot_light(self, condition: Condition) -> float:
        """Flux of a spot per second at a lamp reading of 1 [e-/s]; nan without spots."""
        names = [n for n in self.values if n.startswith("spot flux ")]
        own = f"spot flux {label_of(condition)}"
        colour = label_of(condition).split("/")[0]
        light = [n for n in names if n.split()[2].split("/")[0] == colour]
        chosen = own if own in names else next(iter(light or names), None)
        return self.values[chosen] if chosen else np.nan

    def _darks(self, planned: Planned) -> list[Forecast]:
        """Levels and columns of the mean of all planned darks."""
        if not self.measured.segments or not self.amps:
            return []
        condition, axes, blocks = self.condition(planned), Axes(), []
        common = {"time": planned.seconds, "after": planned.after / self.gains.mean()}
        for amp, segment in enumerate(self.measured.segments):
            noise = self.measured.read_noise[amp]
            variance = (noise if np.isfinite(noise) else 1.0) ** 2 / planned.count
            for what, x, lines in (
                ("level", np.array([-1]), segment.rows * segment.columns),
                ("column", np.arange(segment.columns), segment.rows),
            ):
                axes.add(len(x), condition, what=what, x=x, amp=amp, exposure=-1, **common)
                blocks += [np.array([[3 * variance / lines]])] * len(x)
        channel = Channel("dark_map", np.zeros(len(blocks)), tuple(blocks), axes.columns(),
                          "adu")  # fmt: skip
        return [self.forecast(channel)]

    def _biases(self, planned: Planned) -> list[Forecast]:
        """Channels of the recorded biases, with errors scaled to the planned number."""
        taken = max(self.measured.counts.get("bias", 0), 1)
        out = []
        for channel in self.fit.channels:
            if channel.word in ("bias_cov", "bias_level", "amp_cross") and len(channel):
                blocks = tuple(b * taken / planned.count for b in channel.blocks)
                out.append(self.forecast(replace(channel, blocks=blocks, fold="fit")))
        return out


def say_condition(condition: Condition) -> str:
    """Condition as text such as 'wavelength=620, back_bias=-60', with temperature in deg C."""
    wavelength, back_bias, temperature = numbers_of(condition)
    told = dict(zip(NUMBERS, (wavelength, back_bias, to_celsius(temperature)), strict=True))
    parts = [f"{name}={v:g}" for name, v in told.items() if np.isfinite(v)]
    return ", ".join(parts) or "an unknown condition"
