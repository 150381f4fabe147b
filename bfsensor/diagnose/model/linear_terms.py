"""Columns of a baseline's linear parameters: light, dark current, light's shape, fluxes, odd codes."""

from __future__ import annotations

import numpy as np

from bfsensor.diagnose.data.channel_rows import Rows
from bfsensor.diagnose.data.channels import Channel
from bfsensor.diagnose.data.cosmetics import BRIDGED, Cosmetic, reach_of
from bfsensor.diagnose.data.exposure_info import label_of
from bfsensor.diagnose.data.measure_channels import MeasuredChannels
from bfsensor.diagnose.model.map_shapes import Places
from bfsensor.effects.dark_hot import warmth
from bfsensor.typing import FloatArray

MAP_ORDER, LIGHT_ORDER = 4, 8
"""Largest total order of the polynomial in x and y that describes the ratio of two maps; and the largest
number of half waves on the sensor that describes the light beyond it.  Chosen: with 8 half waves the
light may vary over a quarter of the sensor; twice as many take up rings of an eighth of it."""

KNOTS, EACH = 6, 8
"""Largest number of times between which the light of a lamp without a monitor drifts linearly, and
number of flats for each.  Chosen: light that changes at random by s a flat departs from a line over
n flats by s (n / 6)^(1/2), 3.7e-4 for s = 2e-4 in a campaign of 100 flats; with 12 knots, 2.5e-4."""


def linear_columns(
    channel: Channel, rows: Rows, measured: MeasuredChannels
) -> dict[str, FloatArray]:
    """Make the columns of a channel's linear parameters: its change for a unit of each, by name.

    Parameters are the light by amplifier and condition, the dark current, the shape of the light,
    the flux of the spots, the bias structure, pulses of the noise and the excess of even codes;
    the same name is the same parameter in all channels.

    Parameters
    ----------
    channel : Channel
        Channel to make columns for.
    rows : dict
        Indices of its values by condition.
    measured : MeasuredChannels
        Channels of the campaign, for its amplifiers.

    Returns
    -------
    dict of str to ndarray
        Columns in the channel's unit; empty for channels without linear parameters.
    """
    if channel.word == "flat_mean":
        return _mean_columns(channel, rows) | _drift_columns(channel, measured)
    if channel.word == "flat_map":
        return _map_columns(channel, measured)
    if channel.word == "dark_map":
        return _dark_columns(channel)
    if channel.word == "spot":
        return _spot_columns(channel, rows)
    if channel.word in ("bias_cov", "flat_cov"):
        return _pulse_columns(channel) | _row_columns(channel)
    if channel.word == "bias_level":
        return _level_columns(channel) | _row_columns(channel)
    if channel.word == "code_hist":
        return _code_columns(channel)
    return {}


def _code_columns(channel: Channel) -> dict[str, FloatArray]:
    """Excess of even codes by amplifier.

    The lowest bit of every converter, and ties that rounding turns to even codes, make odd and even
    codes unequally frequent; millions of pixels show a thousandth of it, which says nothing else.
    """
    even = np.where(channel.axes["code"].astype(int) % 2 == 0, 1.0, -1.0)
    amps = channel.axes["amp"]
    return {f"codes even {int(a)}": np.where(amps == a, even, 0.0) for a in np.unique(amps)}


def _mean_columns(channel: Channel, rows_of: Rows) -> dict[str, FloatArray]:
    x = channel.axes
    out = {}
    light = x["time"] * x["lamp"]
    setting = x.get("setting", np.zeros(len(channel)))
    for condition, rows in rows_of.items():
        for amp in np.unique(x["amp"][rows]):
            here = (x["amp"] == amp) & np.isin(np.arange(len(channel)), rows)
            column = np.where(here, light, 0.0)
            out[f"light {int(amp)} {label_of(condition)}"] = column
        # One factor between the lamp's settings, whatever the amplifier.
        for n in np.unique(setting[rows][setting[rows] > 0]):
            here = (setting == n) & np.isin(np.arange(len(channel)), rows)
            column = np.where(here, x["level"], 0.0)
            out[f"lamp {int(n)} {label_of(condition)}"] = column
    for amp in np.unique(x["amp"]):
        out[f"dark {int(amp)}"] = np.where(x["amp"] == amp, x["time"], 0.0)
    return out


def _drift_columns(channel: Channel, measured: MeasuredChannels) -> dict[str, FloatArray]:
    """Slow drift of a lamp that no monitor records, piecewise linear in the order of exposures."""
    x = channel.axes
    unknown = ~x.get("monitored", np.ones(len(channel))).astype(bool)
    if not unknown.any():
        return {}
    flats = [c.axes["exposure"] for c in measured.channels if c.word == "flat_mean"]
    every = np.unique(np.concatenate(flats))
    count = min(KNOTS, len(every) // EACH)
    knots = np.linspace(float(every[0]), float(every[-1]), max(count, 1))
    # The constant part is the light itself: one knot stays at 0.
    return {
        f"lamp at {n}": np.where(
            unknown,
            np.interp(x["exposure"], knots, np.eye(count)[n]) * x["level"],
            0.0,
        )
        for n in range(1, count)
    }


def _pulse_columns(channel: Channel) -> dict[str, FloatArray]:
    """Covariance of the pulses of each amplifier's noise, where biases show any."""
    x, shape = channel.axes, channel.axes.get("pulse")
    if shape is None:
        return {}
    own = {int(a): np.where(x["amp"] == a, shape, 0.0) for a in np.unique(x["amp"])}
    return {f"pulses {amp}": column for amp, column in own.items() if column.any()}


def _row_columns(channel: Channel) -> dict[str, FloatArray]:
    """Variance of the levels of each amplifier's rows, which values of usual sensors hold near 0."""
    x, shape = channel.axes, channel.axes.get("same_row")
    if shape is None:
        return {}
    own = {int(a): np.where(x["amp"] == a, shape, 0.0) for a in np.unique(x["amp"])}
    return {f"row noise {amp}": column for amp, column in own.items() if column.any()}


def _level_columns(channel: Channel) -> dict[str, FloatArray]:
    """Level of each amplifier's fixed bias structure above its overscan."""
    x = channel.axes
    level = x["what"] == "level"
    return {
        f"bias level {int(amp)}": np.where(level & (x["amp"] == amp), 1.0, 0.0)
        for amp in np.unique(x["amp"][level])
    }


def _dark_columns(channel: Channel) -> dict[str, FloatArray]:
    """Dark current and its offset, which values of usual sensors hold near 0; level of columns."""
    x = channel.axes
    out, what = {}, x["what"]
    for amp in np.unique(x["amp"][what == "level"]):
        here = x["amp"] == amp
        for name, each, usual in (
            ("dark", x["time"] * warmth(x["temperature"]), "usual"), ("dark level", 1.0, "usual offset")
        ):  # fmt: skip
            column = np.where(what == "level", each, np.where(what == usual, 1.0, 0.0))
            out[f"{name} {int(amp)}"] = np.where(here, column, 0.0)
        out[f"dark column {int(amp)}"] = np.where(here & (what == "column"), 1.0, 0.0)
    return out


def _map_columns(channel: Channel, measured: MeasuredChannels) -> dict[str, FloatArray]:
    x, size = channel.axes, len(channel)
    ny, nx = measured.shape
    out: dict[str, FloatArray] = {}
    places = Places.of(x, measured.shape)
    u, v = (2 * (np.arange(n) + 0.5) / n - 1 for n in (nx, ny))
    orders = [(p, q) for p in range(LIGHT_ORDER + 1) for q in range(LIGHT_ORDER + 1 - p)]
    high = {f"light {p}{q}" for p, q in orders if p + q > MAP_ORDER}
    # Cosines, as polynomials of high order resolve the rims, where the field rolls off.
    waves = [
        np.cos(0.5 * np.pi * np.outer(np.arange(LIGHT_ORDER + 1), w + 1)) for w in (u, v)
    ]
    smooth = {
        f"light {p}{q}": places.product(waves[0][p], waves[1][q], size)
        if p + q > MAP_ORDER
        else places.product(u**p, v**q, size)
        for p, q in orders
    }
    # Each amplifier was divided by its mean, so that steps between amplifiers are free.
    for amp, s in enumerate(measured.segments[1:], 1):
        inside = np.zeros(nx), np.zeros(ny)
        inside[0][s.x : s.x + s.columns] = 1.0
        inside[1][s.y : s.y + s.rows] = 1.0
        smooth[f"amp {amp}"] = places.product(*inside, size)
    for name in dict.fromkeys(x["map"]):
        here = x["map"] == name
        for what, column in smooth.items():
            if what in high and name != "all":
                continue
            out[f"map {name} {what}"] = np.where(here, column, 0.0)
        ring = here & (x["what"] == "ring")
        if ring.any():
            # Pixel sizes have power at high frequency, and brighter-fatter feedback relaxes the
            # pixels' response by amounts that differ between levels and conditions.
            for power in (2, 4):
                out[f"map {name} rings k{power}"] = np.where(ring, x["k"] ** power, 0.0)
        for n, one in enumerate(_lines(measured)):
            # Charge that a bad column lacks leaves its neighbours more area, at each level and
            # condition another.
            reach = int(np.ceil(BRIDGED * reach_of(one.size)))
            beside = _beside(nx, *one.x, reach), _inside(ny, *one.y)
            out[f"map {name} beside {n}"] = np.where(
                here, places.product(*beside, size), 0.0
            )
        if name == "all":
            for n, spot in enumerate(c for c in measured.cosmetics if c.kind == "dust"):
                # The light beneath a dust spot is known less well than that beside it.
                across, down = _bump(nx, *spot.x), _bump(ny, *spot.y)
                # Its level and its slopes.
                for slope, pair in enumerate(
                    ((across, down), (across * u, down), (across, down * v))
                ):
                    column = np.where(here, places.product(*pair, size), 0.0)
                    out[f"map dust {n} {slope}"] = column
        if name == "all" and ring.any():
            out["map rings white"] = np.where(ring, 1.0, 0.0)
    return out


def _lines(measured: MeasuredChannels) -> list[Cosmetic]:
    """Bad columns of many rows that lack enough charge to shift the edges beside them."""
    return [
        c for c in measured.cosmetics
        if c.kind == "bad_column" and c.y[1] - c.y[0] > 1 and reach_of(c.size) > 1
    ]  # fmt: skip


def _beside(size: int, start: int, stop: int, reach: int) -> FloatArray:
    """Inverse square of the distance from columns ``start`` to ``stop``, 0 up to ``reach`` columns."""
    place = np.arange(size)
    away = np.maximum(np.maximum(start - place, place - stop + 1), 0)
    return np.asarray(np.where(away > reach, np.maximum(away, 1.0) ** -2.0, 0.0))


def _inside(size: int, start: int, stop: int) -> FloatArray:
    """1 from ``start`` to ``stop``, 0 elsewhere; shape (size,)."""
    place = np.arange(size)
    return np.asarray(((place >= start) & (place < stop)).astype(float))


def _bump(size: int, start: int, stop: int) -> FloatArray:
    """One arch of a sine from ``start`` to ``stop``, 0 elsewhere; shape (size,)."""
    out, place = np.zeros(size), np.arange(max(start, 0), min(stop, size))
    out[place] = np.sin(np.pi * (place - start + 0.5) / (stop - start))
    return out


def _spot_columns(channel: Channel, rows_of: Rows) -> dict[str, FloatArray]:
    x = channel.axes
    out = {}
    for condition, rows in rows_of.items():
        for what in ("flux", "skew_x", "skew_y"):
            here = rows[x["what"][rows] == what]
            column = np.zeros(len(channel))
            column[here] = x["light"][here] if what == "flux" else 1.0
            out[f"spot {what} {label_of(condition)}"] = column
    return out
