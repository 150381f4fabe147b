"""Every channel from one set of parameters: device, gains, noise, lamp, pixel response."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from bfsensor.diagnose.baseline import Baseline
from bfsensor.diagnose.channels import PER_ELECTRON, Channel
from bfsensor.diagnose.conditions import Condition
from bfsensor.diagnose.extract import Measured
from bfsensor.diagnose.predict_flats import flat_covariances_of
from bfsensor.diagnose.predict_spots import predict_spots

MAP_ORDER = 4
"""Order of the polynomial in x and y that the light on the sensor may have."""

REDUCED_LEVEL = 40_000.0
"""Background [e-] at which a_ij without a level are predicted: halfway to a flat of 80,000 e-, at
which published covariances are quoted."""

PHASES = 12
"""Spots whose positions stand for those of an exposure."""


class Predictor:
    """Predicts the channels of a campaign; what may float honestly is a parameter.

    Non-linear parameters: gain of each amplifier [e-/ADU], variance of its read noise [ADU^2],
    the device's parameters in units of their spread, widths of the spots without charge for
    each wavelength.  Linear ones, as columns of :meth:`linear`: light by amplifier and
    condition, dark current, shape of the light, levels of bias and noise, flux of the spots.

    Parameters
    ----------
    measured : Measured
        The campaign, for its amplifiers, conditions and positions of spots.
    baseline : Baseline
        Boundary shifts.
    """

    def __init__(self, measured: Measured, baseline: Baseline) -> None:
        self.measured, self.baseline = measured, baseline
        self._amps = len(measured.amplifiers)
        self._kept: dict[int, tuple[Channel, dict[tuple[str, ...], NDArray[np.int64]]]] = {}
        self._spot_conditions: list[tuple[str, ...]] = []
        self._spot_of: dict[tuple[str, ...], Condition] = {}
        # Optics know of the wavelength, not of voltages or the silicon's temperature.
        self._widths: list[str] = []
        self._phases: dict[tuple[str, ...], NDArray[np.float64]] = {}
        self.notes: list[str] = []
        start_sigma: list[float] = []
        exposure = 0
        for channel in measured.channels:
            if channel.word != "spot":
                continue
            rows = np.nonzero(channel.axes["what"] == "sigma_x")[0]
            for row in rows:
                condition = _condition(channel, row)
                phases = measured.phases[exposure]
                exposure += 1
                if condition.key not in self._spot_of:
                    self._spot_conditions.append(condition.key)
                    self._spot_of[condition.key] = condition
                    if condition.key[0] not in self._widths:
                        self._widths.append(condition.key[0])
                        both = channel.values[row], channel.values[row + 1]
                        start_sigma += [float(v) for v in both]
                    self._phases[condition.key] = phases
                else:
                    self._phases[condition.key] = np.concatenate(
                        [self._phases[condition.key], phases]
                    )
        for key, phases in self._phases.items():
            order = (
                np.linspace(0, len(phases) - 1, min(PHASES, len(phases)))
                .round()
                .astype(int)
            )
            self._phases[key] = phases[order]
        noise = [0.0 if not np.isfinite(n) else n**2 for n in measured.read_noise]
        self.names = (
            *(f"gain {a}" for a in range(self._amps)),
            *(f"noise {a}" for a in range(self._amps)),
            *(f"device {p}" for p in baseline.parameters),
            *(f"sigma_{axis} {wavelength}" for wavelength in self._widths for axis in "xy"),
        )
        self.start = np.array([
            *measured.gains, *noise, *(0.0 for _ in baseline.parameters), *start_sigma,
        ])  # fmt: skip
        self.steps = np.array([
            *(1e-3 * g for g in measured.gains), *(0.01 * max(n, 0.1) for n in noise),
            *(0.1 for _ in baseline.parameters), *(2e-3 for _ in start_sigma),
        ])  # fmt: skip
        n, p = 2 * self._amps, len(baseline.parameters)
        self.prior_rows = np.arange(n, n + p)
        """Parameters with a prior of mean 0 and width 1."""
        self._noise_told = _noise_told(measured)
        if not self._noise_told.all():
            names = [
                a
                for a, told in zip(measured.amplifiers, self._noise_told, strict=True)
                if not told
            ]
            self.notes.append(
                f"read noise of {', '.join(names)} taken as {np.sqrt(noise[0]):.3g} ADU: no biases, "
                "and flats of one level cannot tell it from the gain"
            )
        exact = {
            key: baseline.at(_condition(c, rows[0]))[1]
            for c in measured.channels if c.word in ("flat_cov", "spot")
            for key, rows in self._rows(c).items()
        }  # fmt: skip
        for key, held in exact.items():
            if not held:
                self.notes.append(
                    f"baseline has no shifts at {'/'.join(key)}: the nearest condition's are taken"
                )

    def predict(
        self,
        channel: Channel,
        parameters: NDArray[np.float64],
        *,
        only: str | None = None,
    ) -> NDArray[np.float64]:
        """What a channel should read, linear terms left out.

        Parameters
        ----------
        channel : Channel
            Its axes say where.
        parameters : ndarray
            In the order of ``names``.
        only : str, optional
            Predict spots of this wavelength alone.
        """
        a = self._amps
        gains, noise = parameters[:a], parameters[a : 2 * a]
        count = len(self.baseline.parameters)
        device = {
            name: float(value) * self.baseline.spread[name]
            for name, value in zip(
                self.baseline.parameters, parameters[2 * a : 2 * a + count], strict=True
            )
        }
        if channel.word == "flat_cov":
            return self._flat_cov(channel, gains, noise, device)
        if channel.word == "spot":
            return self._spots(channel, gains, device, parameters[2 * a + count :], only)
        out = np.zeros(len(channel))
        if channel.word == "bias_cov":
            own = noise[channel.axes["amp"].astype(int)]
            out = np.where(channel.axes["lag"] == 0, own, 0.0)
        return out

    def _rows(self, channel: Channel) -> dict[tuple[str, ...], NDArray[np.int64]]:
        """Rows of each condition, found once: channels do not change."""
        kept = self._kept.get(id(channel))
        if kept is None or kept[0] is not channel:
            kept = self._kept[id(channel)] = channel, _by_condition(channel)
        return kept[1]

    def depends(self, channel: Channel) -> NDArray[np.bool_]:
        """Which parameters a channel can depend on: the others need no derivative."""
        a = self._amps
        names = np.array(self.names)
        device = np.char.startswith(names, "device")
        sigma = np.char.startswith(names, "sigma")
        gain = np.char.startswith(names, "gain")
        noise = np.char.startswith(names, "noise")
        noise[a : 2 * a] &= self._noise_told
        if channel.word == "flat_cov":
            return device if channel.unit == PER_ELECTRON else gain | noise | device
        if channel.word == "spot":
            return gain | device | sigma
        return noise if channel.word == "bias_cov" else np.zeros(len(names), bool)

    def slope(
        self,
        channel: Channel,
        parameters: NDArray[np.float64],
        n: int,
        here: NDArray[np.float64],
    ) -> NDArray[np.float64]:
        """Derivative of a channel by one parameter, given the prediction there."""
        step = parameters.copy()
        step[n] += self.steps[n]
        if channel.word == "spot" and self.names[n].startswith("sigma"):
            # Of one wavelength's width the others know nothing.
            first = self.names.index(next(m for m in self.names if m.startswith("sigma")))
            only = self._widths[(n - first) // 2]
            moved = self.predict(channel, step, only=only)
            out = np.zeros(len(channel))
            for key, rows in self._rows(channel).items():
                if key[0] == only:
                    out[rows] = (moved[rows] - here[rows]) / self.steps[n]
            return out
        return (self.predict(channel, step) - here) / self.steps[n]

    def linear(self, channel: Channel) -> dict[str, NDArray[np.float64]]:
        """Columns of the linear parameters, by name; the same name is the same parameter."""
        make = {
            "flat_mean": self._mean_columns, "flat_map": self._map_columns,
            "dark_map": self._dark_columns, "spot": self._spot_columns,
        }.get(channel.word)  # fmt: skip
        return {} if make is None else make(channel)

    def _flat_cov(
        self,
        channel: Channel,
        gains: NDArray[np.float64],
        noise: NDArray[np.float64],
        device: dict[str, float],
    ) -> NDArray[np.float64]:
        x = channel.axes
        i, j = x["i"].astype(int), x["j"].astype(int)
        amp = x["amp"].astype(int)
        lags = int(max(i.max(), j.max()))
        out = np.empty(len(channel))
        for key, rows in self._rows(channel).items():
            del key
            if channel.unit == PER_ELECTRON:
                where = _condition(channel, rows[0])
                a = self.baseline.areas_on(where, device, REDUCED_LEVEL)
                y, x0 = (n // 2 for n in a.shape)
                out[rows] = 0.5 * (
                    a[y + j[rows], x0 + i[rows]] + a[y - j[rows], x0 + i[rows]]
                )
                continue
            pairs = np.stack([amp[rows], x["level"][rows]], axis=1)
            groups, index = np.unique(pairs, axis=0, return_inverse=True)
            own = gains[groups[:, 0].astype(int)]
            levels = own * groups[:, 1]
            a = self.baseline.flat_areas(_condition(channel, rows[0]), device, levels)
            c = flat_covariances_of(a, levels, lags=lags) / own[:, None, None] ** 2
            c[:, 0, 0] += noise[groups[:, 0].astype(int)]
            out[rows] = c[index.ravel(), j[rows], i[rows]]
        return out

    def _spots(
        self,
        channel: Channel,
        gains: NDArray[np.float64],
        device: dict[str, float],
        sigmas: NDArray[np.float64],
        only: str | None,
    ) -> NDArray[np.float64]:
        x = channel.axes
        # Images were put on the scale of electrons with rough gains.
        scale = float(np.mean(gains / np.array(self.measured.gains)))
        out = np.zeros(len(channel))
        for key in self._spot_conditions:
            rows = self._rows(channel).get(key, np.zeros(0, int))
            if not len(rows) or (only is not None and key[0] != only):
                continue
            n = self._widths.index(key[0])
            (kx, ky), _ = self.baseline.at(self._spot_of[key], device)
            found = predict_spots(
                kx, ky, sigma=(float(sigmas[2 * n]), float(sigmas[2 * n + 1])),
                phases=self._phases[key], fluxes=scale * x["flux"][rows],
            )  # fmt: skip
            for what, values in found.items():
                here = x["what"][rows] == what
                out[rows[here]] = values[here]
        return out

    def _mean_columns(self, channel: Channel) -> dict[str, NDArray[np.float64]]:
        x = channel.axes
        out = {}
        light = x["time"] * x["lamp"]
        for key, rows in self._rows(channel).items():
            for amp in np.unique(x["amp"][rows]):
                here = rows[x["amp"][rows] == amp]
                column = np.zeros(len(channel))
                column[here] = light[here]
                out[f"light {int(amp)} {'/'.join(key)}"] = column
        for amp in np.unique(x["amp"]):
            out[f"dark {int(amp)}"] = np.where(x["amp"] == amp, x["time"], 0.0)
        return out

    def _dark_columns(self, channel: Channel) -> dict[str, NDArray[np.float64]]:
        x = channel.axes
        out = {}
        level, column = x["what"] == "level", x["what"] == "column"
        for amp in np.unique(x["amp"]):
            here = x["amp"] == amp
            out[f"dark {int(amp)}"] = np.where(here & level, x["time"], 0.0)
            out[f"dark level {int(amp)}"] = np.where(here & level, 1.0, 0.0)
            out[f"dark column {int(amp)}"] = np.where(here & column, 1.0, 0.0)
        return out

    def _map_columns(self, channel: Channel) -> dict[str, NDArray[np.float64]]:
        x = channel.axes
        ny, nx = self.measured.shape
        out: dict[str, NDArray[np.float64]] = {}
        u, v = 2 * (x["x"] + 0.5) / nx - 1, 2 * (x["y"] + 0.5) / ny - 1
        for name in dict.fromkeys(x["map"]):
            here = x["map"] == name
            for what in ("column", "row", "block"):
                rows = here & (x["what"] == what)
                for p in range(MAP_ORDER + 1):
                    for q in range(MAP_ORDER + 1 - p):
                        # The mean of a power of what is summed over is part of other columns.
                        if (what == "column" and q) or (what == "row" and p):
                            continue
                        basis = np.zeros(len(channel))
                        basis[rows] = u[rows] ** p * v[rows] ** q
                        out[f"map {name} {what} {p}{q}"] = basis
            ring = here & (x["what"] == "ring")
            if ring.any():
                # Sizes of pixels, and the effect, which evens the pixels' response out: more at
                # some levels and conditions than at others, so that ratios keep of it.
                for power in (2, 4):
                    out[f"map {name} rings k{power}"] = np.where(ring, x["k"] ** power, 0.0)
            if name == "all" and ring.any():
                out["map rings white"] = np.where(ring, 1.0, 0.0)
            for amp, (flip, origin) in enumerate(
                zip(self.measured.flips, self.measured.origins, strict=True)
            ):
                del flip
                if amp == 0:
                    continue
                # Amplifiers were divided by their means: steps between them are free.
                side = here & (x["what"] != "ring") & (x["what"] != "row")
                beyond = (
                    side & (x["x"] >= origin[0]) if origin[0] > 0 else np.zeros_like(side)
                )
                if beyond.any():
                    for what in ("column", "block"):
                        out[f"map {name} {what} amp {amp}"] = np.where(
                            beyond & (x["what"] == what), 1.0, 0.0
                        )
        return out

    def _spot_columns(self, channel: Channel) -> dict[str, NDArray[np.float64]]:
        x = channel.axes
        out = {}
        for key, rows in self._rows(channel).items():
            for what in ("flux", "skew_x", "skew_y", "wings"):
                here = rows[x["what"][rows] == what]
                column = np.zeros(len(channel))
                column[here] = x["light"][here] if what == "flux" else 1.0
                out[f"spot {what} {'/'.join(key)}"] = column
        return out


def _noise_told(measured: Measured) -> NDArray[np.bool_]:
    """Of which amplifiers biases, or flats of several levels, tell the read noise."""
    count = len(measured.amplifiers)
    told = np.zeros(count, bool)
    levels: list[set[float]] = [set() for _ in range(count)]
    for channel in measured.channels:
        if channel.word not in ("bias_cov", "flat_cov") or channel.unit == PER_ELECTRON:
            continue
        for n in np.unique(channel.axes["amp"]).astype(int):
            own = channel.axes["amp"] == n
            told[n] |= channel.word == "bias_cov"
            if channel.word == "flat_cov":
                levels[n] |= set(channel.axes["time"][own].tolist())
    flats = any(levels)
    return told | np.array([len(v) > 1 or not flats for v in levels], bool)


def _by_condition(channel: Channel) -> dict[tuple[str, ...], NDArray[np.int64]]:
    """Rows of each condition."""
    columns = np.column_stack([channel.axes[n].astype(float) for n in Condition._fields])
    # nan equals nan here.
    _, first, index = np.unique(
        np.nan_to_num(columns, nan=-1e99), axis=0, return_index=True, return_inverse=True
    )
    return {
        Condition(*(float(v) for v in columns[row])).key: np.nonzero(index.ravel() == n)[0]
        for n, row in enumerate(first)
    }


def _condition(channel: Channel, row: int | np.integer) -> Condition:
    return Condition(*(float(channel.axes[n][row]) for n in Condition._fields))


def used_channels(channels: Sequence[Channel], folds: Sequence[str]) -> list[Channel]:
    """Channels of some folds."""
    return [c for c in channels if c.fold in folds]
