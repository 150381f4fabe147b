"""Scans of residuals that assume no effect: patterns by lag, level, amplifier, column, time, ..."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from bfsensor.diagnose.data.channels import PER_ELECTRON, Channel, step_of
from bfsensor.diagnose.detect.scan_shapes import boundaries, boxes, frames, own_shapes
from bfsensor.diagnose.detect.scan_templates import Group, Pattern, Template
from bfsensor.diagnose.fit.baseline_fit import BaselineFit
from bfsensor.effects.dark_hot import warmth

POWERS = (0, 1, 2, 3)
"""Powers of the signal level with which covariances are scanned.  Chosen: noise is constant, shot
noise goes with the first, the brighter-fatter effect with the second and, next, third power; twice
as many powers are nearly degenerate with these and raise the deviate of an alarm slightly."""

OCTAVES = 4
"""Number of widths of strips: 1/4, 1/8, 1/16 and 1/32 of a side, each at steps of half a width.
Chosen: each further width has twice as many strips; with 8, strips of 1/512 of a side are narrower
than the columns of most maps."""

DEVICE, DEVICE_SCAN = "device", "device parameter away from its nominal value"
"""Name that stands for a channel, and family, of the scan of the device's parameters."""

DEVICE_SEEN = "flat_cov", "spot"
"""Channels that the device's parameters change."""


def make_templates(channels: Sequence[Channel]) -> Iterator[Template]:
    """Make all templates that channels allow, whatever is fitted to them, one after another.

    Every template is a pattern in the unit of its channel over all folds: a power of the flux
    at one lag, a step in time, a strip of columns.

    Parameters
    ----------
    channels : sequence of Channel
        Channels of a fit.

    Yields
    ------
    template : Template
        Whitened.
    """
    makers = {
        "flat_cov": _covariances, "flat_mean": _means, "flat_map": _maps,
        "serial_overscan": _overscan, "parallel_overscan": _overscan, "bias_cov": _noise,
        "bias_level": _levels, "dark_map": _darks, "spot": _spots, "amp_cross": _single,
        "code_hist": _codes,
    }  # fmt: skip
    for group in _groups(channels):
        yield from group.templates(makers[group.word](group))


def make_fitted_templates(fit: BaselineFit) -> Iterator[Template]:
    """Make the templates that depend on a fit: shape of the predicted covariances, device.

    Parameters
    ----------
    fit : BaselineFit
        The fit.

    Yields
    ------
    template : Template
        Whitened.
    """
    for group in _groups(fit.channels):
        if group.word == "flat_cov" and group.members[0][0].unit != PER_ELECTRON:
            yield from group.templates(own_shapes(group, fit.residuals))
    yield from _device(fit)


def _groups(channels: Sequence[Channel]) -> list[Group]:
    """Channels of one name each, with the index at which their values begin."""
    by_word: dict[str, list[tuple[Channel, int]]] = {}
    start = 0
    for channel in channels:
        by_word.setdefault(channel.word, []).append((channel, start))
        start += len(channel)
    return [Group(word, members) for word, members in by_word.items()]


def _device(fit: BaselineFit) -> Iterator[Template]:
    """Yield the derivatives of all values by each device parameter, as templates.

    The fit moves these parameters against their priors.  A device far from nominal therefore
    leaves residuals along the derivative, in proportion to the pull, and noise a known amount.
    A parameter that only has a bound has no nominal value to differ from.
    """
    for n, name in enumerate(fit.names[: fit.slopes.shape[1]]):
        quantity = name.removeprefix("device ")
        if quantity != name and quantity not in fit.unknown:
            rows = np.nonzero(fit.slopes[:, n])[0]
            if len(rows):
                where = {"device": quantity}
                yield Template(DEVICE_SCAN, DEVICE, rows, fit.slopes[rows, n], where)


def _areas(g: Group) -> Iterator[Pattern]:
    """Single lags and sets of lags, for reduced a_ij, which have no signal level."""
    i, j = g.axes["i"].astype(int), g.axes["j"].astype(int)
    for a, b in zip(i.tolist(), j.tolist(), strict=True):
        yield "lags", np.where((i == a) & (j == b), 1.0, 0.0), {"lags": [(a, b)]}
    for name, here in _lags_together(i, j).items():
        chosen = sorted(zip(i[here].tolist(), j[here].tolist(), strict=True))
        yield "lags together", np.where(here, 1.0, 0.0), {"lags": chosen, "set": name}


def _lags_together(
    i: NDArray[np.int64], j: NDArray[np.int64]
) -> dict[str, NDArray[np.bool_]]:
    """Masks of sets of lags, by name: rows, columns, near and far ones."""
    radius = np.hypot(i, j)
    return {
        "row of lags": (j == 0) & (i > 0), "column of lags": (i == 0) & (j > 0),
        "first neighbours": radius == 1,
        "near lags": (radius > 0) & (radius < 1.5), "far lags": radius > 2.5,
    }  # fmt: skip


def _covariances(g: Group) -> Iterator[Pattern]:
    """Patterns of single lags and sets of lags by power of the level, level, amplifier, condition."""
    if g.members[0][0].unit == PER_ELECTRON:
        yield from _areas(g)
        return
    x = g.axes
    i, j, level = x["i"].astype(int), x["j"].astype(int), x["level"].astype(float)
    unit = level / level.max()
    lags = sorted(set(zip(i.tolist(), j.tolist(), strict=True)))
    low, high = float(level.min()), float(level.max())
    for a, b in lags:
        here = (i == a) & (j == b)
        base = {"lags": [(a, b)], "level": (low, high)}
        for p in POWERS:
            yield "lag x power", np.where(here, unit**p, 0.0), {**base, "power": p}
        for condition in dict.fromkeys(g.condition):
            own = here & (g.condition == condition)
            rest = here & ~own
            if rest.any():
                yield (
                    "lag x condition", np.where(own, unit**2, 0.0), {**base, "condition": condition}
                )  # fmt: skip
        for amp in np.unique(x["amp"]):
            yield (
                "lag x amplifier", np.where(here & (x["amp"] == amp), unit**2, 0.0),
                {**base, "amp": int(amp)},
            )  # fmt: skip
        for time in np.unique(step_of(x)):
            own = here & (step_of(x) == time)
            span = (float(level[own].min()), float(level[own].max()))
            yield "lag x level", np.where(own, 1.0, 0.0), {"lags": [(a, b)], "level": span}
    for name, here in _lags_together(i, j).items():
        chosen = sorted(set(zip(i[here].tolist(), j[here].tolist(), strict=True)))
        for p in POWERS:
            yield "lags together", np.where(here, unit**p, 0.0), {
                "lags": chosen, "level": (low, high), "power": p, "set": name,
            }  # fmt: skip


def _means(g: Group) -> Iterator[Pattern]:
    """Patterns of means by power of the level, exposure, steps and slopes in time, by amplifier."""
    x = g.axes
    level = x["level"].astype(float)
    unit = level / level.max()
    order = x["exposure"].astype(float)
    span = (float(level.min()), float(level.max()))
    for name, here in _amplifiers(x):
        for p in (0, 2, 3, 4):
            yield (
                "mean x power",
                np.where(here, unit**p, 0.0),
                {"amp": name, "level": span, "power": p},
            )
        for time in np.unique(step_of(x)):
            own = here & (step_of(x) == time)
            if own.any():
                yield "mean x level", np.where(own, unit, 0.0), {
                    "amp": name, "level": (float(level[own].min()), float(level[own].max())),
                }  # fmt: skip
        for cut in np.unique(order)[1::2]:
            yield "mean, step in time", np.where(here & (order >= cut), unit, 0.0), {
                "amp": name, "exposure": (int(cut), int(order.max())),
            }  # fmt: skip
        yield "mean, slope in time", np.where(here, unit * (order - order.mean()), 0.0), {
            "amp": name, "exposure": (int(order.min()), int(order.max())),
        }  # fmt: skip
        for one in np.unique(order):
            yield "mean, one exposure", np.where(here & (order == one), unit, 0.0), {
                "amp": name, "exposure": (int(one), int(one)),
            }  # fmt: skip


def _maps(g: Group) -> Iterator[Pattern]:
    """Patterns of maps: columns, rows, boxes, rings, texture and chess patterns."""
    yield from _lines(g)
    x = g.axes
    for name in dict.fromkeys(x["map"]):
        here = x["map"] == name
        yield from boxes(x, here, str(name))
        rows = here & (x["what"] == "ring")
        for k in np.unique(x["k"][rows]):
            yield "rings", np.where(rows & (x["k"] == k), 1.0, 0.0), {
                "map": str(name), "what": "ring", "period": 1 / float(k),
            }  # fmt: skip
        if rows.any():
            yield "rings", np.where(rows, 1.0, 0.0), {"map": str(name), "what": "ring"}
        yield from _fine_patterns(x, here, str(name))


def _lines(g: Group) -> Iterator[Pattern]:
    """Strips, edges, boundaries and waves in columns and rows."""
    x = g.axes
    for name in dict.fromkeys(x["map"]):
        here = x["map"] == name
        for what, axis in (("column", "x"), ("row", "y")):
            rows = here & (x["what"] == what)
            if not rows.any():
                continue
            place = x[axis].astype(float)
            n = int(place[rows].max()) + 1
            common = {"map": str(name), "what": what}
            for one in range(n):
                yield f"{what}s", np.where(rows & (place == one), 1.0, 0.0), {
                    **common, axis: (one, one + 1),
                }  # fmt: skip
            for octave in range(2, OCTAVES + 2):
                width = n / 2**octave
                for k in range(2 ** (octave + 1) - 1):
                    lo, hi = 0.5 * k * width, (0.5 * k + 1) * width
                    yield f"{what} strips", np.where(rows & (place >= lo) & (place < hi), 1.0, 0.0), {
                        **common, axis: (int(lo), int(np.ceil(hi))),
                    }  # fmt: skip
            for length in (2.0, 5.0, 12.0):
                for side, distance in (("low", place), ("high", n - 1 - place)):
                    reach = int(3 * length)
                    yield f"{what} edges", np.where(rows, np.exp(-distance / length), 0.0), {
                        **common, axis: (0, reach) if side == "low" else (n - reach, n),
                    }  # fmt: skip
            if name == "all":
                yield from boundaries(rows, place, common, axis)
            for cycles in range(3, n // 2):
                phase = 2 * np.pi * cycles * (place + 0.5) / n
                for wave in (np.cos, np.sin):
                    yield f"{what} waves", np.where(rows, wave(phase), 0.0), {
                        **common, "period": n / cycles,
                    }  # fmt: skip
        if name == "all":
            for family, pattern, where in frames(x, here):
                yield family, pattern, {"map": str(name), **where}


def _fine_patterns(
    x: Mapping[str, NDArray], here: NDArray[np.bool_], name: str
) -> Iterator[Pattern]:
    """Waves in the covariance of the texture along x, in the same and the next row; chess patterns."""
    dx = x["x"].astype(float)
    for dy in (0, 1):
        rows = here & (x["what"] == "texture") & (x["y"] == dy)
        if not rows.any():
            continue
        for period in np.geomspace(2.0, dx[rows].max(), 40):
            phase = 2 * np.pi * dx / period
            for wave in (np.cos, np.sin)[: dy + 1]:
                yield "texture waves", np.where(rows, wave(phase), 0.0), {
                    "map": name, "what": "texture", "period": float(period),
                }  # fmt: skip
    rows = here & (x["what"] == "chess")
    if rows.any():
        strips = np.unique(dx[rows])
        width = 2 * float(strips[0]) + 1
        for part in (1, 2, 4):
            for own in np.array_split(strips, part):
                span = (int(own[0] + 0.5 - width / 2), int(own[-1] + 0.5 + width / 2))
                yield "chess pattern", np.where(rows & np.isin(dx, own), 1.0, 0.0), {
                    "map": name, "what": "chess", "x": span,
                }  # fmt: skip


def _overscan(g: Group) -> Iterator[Pattern]:
    """Patterns of overscans: single pixels and exponential tails by level and amplifier."""
    x = g.axes
    k, level = x["k"].astype(float), x["level"].astype(float)
    unit = level / level.max()
    span = (float(level.min()), float(level.max()))
    for name, here in _amplifiers(x):
        for one in np.unique(k):
            for p in (0, 1):
                yield "overscan pixel x power", np.where(here & (k == one), unit**p, 0.0), {
                    "amp": name, "k": (int(one), int(one)), "level": span, "power": p,
                }  # fmt: skip
        for length in (1.0, 2.0, 4.0, 8.0):
            tail = np.exp(-(k - 1) / length)
            for p in (0, 1):
                yield "overscan tail x power", np.where(here, tail * unit**p, 0.0), {
                    "amp": name, "k": (1, int(k.max())), "length": length, "level": span, "power": p,
                }  # fmt: skip
            for time in np.unique(step_of(x)):
                own = here & (step_of(x) == time)
                yield "overscan tail x level", np.where(own, tail, 0.0), {
                    "amp": name, "k": (1, int(k.max())), "length": length,
                    "level": (float(level[own].min()), float(level[own].max())),
                }  # fmt: skip


def _noise(g: Group) -> Iterator[Pattern]:
    """Patterns of noise covariances in readout order: single lags, tails, waves, by amplifier."""
    x = g.axes
    lag = x["lag"].astype(float)
    for name, here in _amplifiers(x):
        for one in np.unique(lag):
            yield (
                "noise lag",
                np.where(here & (lag == one), 1.0, 0.0),
                {"amp": name, "k": (int(one), int(one))},
            )
        for length in (1.0, 2.0, 4.0, 8.0, 1e9):
            yield "noise tail", np.where(here & (lag > 0), np.exp(-lag / length), 0.0), {
                "amp": name, "k": (1, int(lag.max())), "length": length,
            }  # fmt: skip
        for period in np.geomspace(2.0, lag.max(), 24):
            yield "noise wave", np.where(here & (lag > 0), np.cos(2 * np.pi * lag / period), 0.0), {
                "amp": name, "period": float(period),
            }  # fmt: skip


def _levels(g: Group) -> Iterator[Pattern]:
    """Patterns of bias levels by amplifier and exposure."""
    x = g.axes
    for what in (w for w in dict.fromkeys(x["what"]) if w != "usual rows"):
        for name, here in _amplifiers(x):
            rows = here & (x["what"] == what)
            yield "bias", np.where(rows, 1.0, 0.0), {"amp": name, "what": str(what)}
            for one in np.unique(x["exposure"][rows]):
                yield "bias, one exposure", np.where(rows & (x["exposure"] == one), 1.0, 0.0), {
                    "amp": name, "what": str(what), "exposure": (int(one), int(one)),
                }  # fmt: skip


def _darks(g: Group) -> Iterator[Pattern]:
    """Patterns of darks: current, current after light, struck pixels, single columns."""
    x = g.axes
    after = x["after"].astype(float)
    for name, here in _amplifiers(x):
        if name == -1:
            continue  # tracks are counted in all amplifiers together
        level, struck = (here & (x["what"] == w) for w in ("level", "struck"))
        if after.max() > 0:
            yield (
                "dark after light",
                np.where(level, after / after.max(), 0.0),
                {"amp": name, "what": "after light"},
            )
        if (x["what"] == "usual").any():
            yield (
                "dark current",
                np.where(level, x["time"] * warmth(x["temperature"]), 0.0),
                {"amp": name, "what": "level"},
            )
        yield "struck pixels", np.where(struck, 1.0, 0.0), {"amp": name, "what": "struck"}
    yield "tracks", np.where(x["what"] == "tracks", 1.0, 0.0), {"what": "tracks"}
    # Columns belong to one amplifier, also where there is no other.
    for amp in np.unique(x["amp"]):
        column = (x["amp"] == amp) & (x["what"] == "column")
        for one in np.unique(x["x"][column]):
            yield "dark columns", np.where(column & (x["x"] == one), 1.0, 0.0), {
                "amp": int(amp), "x": (int(one), int(one) + 1), "what": "column",
            }  # fmt: skip


def _spots(g: Group) -> Iterator[Pattern]:
    """Patterns of spots' widths, wings and fluxes by power of the flux, condition and exposure."""
    x = g.axes
    flux = x["flux"].astype(float)
    unit = flux / flux.max()
    sizes = np.isin(x["what"], ("sigma_x", "sigma_y"))
    named = {str(w): x["what"] == w for w in dict.fromkeys(x["what"])}
    for what, here in {**named, "sizes": sizes}.items():
        if not here.any():
            continue
        for p in (0, 1, 2, 3):
            yield "spots x power", np.where(here, unit**p, 0.0), {
                "what": what, "level": (float(flux.min()), float(flux.max())), "power": p,
            }  # fmt: skip
        for condition in dict.fromkeys(g.condition):
            own = here & (g.condition == condition)
            for p in (0, 1):
                yield "spots x condition", np.where(own, unit**p, 0.0), {
                    "what": what, "condition": condition, "power": p,
                }  # fmt: skip
        for one in np.unique(x["exposure"][here]):
            yield "spots, one exposure", np.where(here & (x["exposure"] == one), 1.0, 0.0), {
                "what": what, "exposure": (int(one), int(one)),
            }  # fmt: skip


def _codes(g: Group) -> Iterator[Pattern]:
    """Patterns of the histogram of converter codes: bits, single codes, codes below high bits."""
    x = g.axes
    code, multiple = x["code"].astype(int), x["bit"].astype(int)
    for name, amp in _amplifiers(x):
        here = amp & (code >= 0)
        bit = 1
        while bit <= code.max():
            yield "code bits", np.where(here, np.where(code & bit, 1.0, -1.0), 0.0), {
                "amp": name, "bit": bit,
            }  # fmt: skip
            bit *= 2
        for one in np.unique(code[here]):
            yield (
                "codes",
                np.where(here & (code == one), 1.0, 0.0),
                {"amp": name, "code": int(one)},
            )
        for power, below in sorted(
            set(zip(multiple[code < 0], code[code < 0], strict=True))
        ):
            yield "codes below high bits", np.where(
                amp & (multiple == power) & (code == below), 1.0, 0.0
            ), {"amp": name, "bit": 2 ** int(power), "code": int(below)}  # fmt: skip


def _single(g: Group) -> Iterator[Pattern]:
    """Every value alone: crosstalk of each pair of amplifiers."""
    x = g.axes
    for n in range(g.size):
        yield "amplifiers", np.eye(g.size)[n], {
            "amp": int(x["amp"][n]), "other": int(x["other"][n]), "what": str(x["what"][n]),
        }  # fmt: skip


def _amplifiers(x: Mapping[str, NDArray]) -> list[tuple[object, NDArray[np.bool_]]]:
    """Masks of all amplifiers together, and of each alone."""
    amps = np.unique(x["amp"])
    out: list[tuple[object, NDArray[np.bool_]]] = [("all", np.ones(len(x["amp"]), bool))]
    return out + ([(int(a), x["amp"] == a) for a in amps] if len(amps) > 1 else [])
