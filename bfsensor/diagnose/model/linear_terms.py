"""Columns of a baseline's linear parameters: light, dark current, light's shape, fluxes, odd codes."""

from __future__ import annotations

import numpy as np

from bfsensor.diagnose.data.channel_rows import Rows
from bfsensor.diagnose.data.channels import Channel
from bfsensor.diagnose.data.exposure_info import label_of
from bfsensor.diagnose.data.measure_channels import MeasuredChannels
from bfsensor.diagnose.model.map_shapes import Places
from bfsensor.typing import FloatArray

MAP_ORDER = 4
"""Largest total order of the polynomial in x and y that describes the light on the sensor. Chosen, to
be derived: twice as large takes up more of smooth effects such as rings of long period."""


def linear_columns(
    channel: Channel, rows: Rows, measured: MeasuredChannels
) -> dict[str, FloatArray]:
    """Make the columns of a channel's linear parameters: its change for a unit of each, by name.

    Parameters are the light by amplifier and condition, the dark current, the shape of the light,
    the flux of the spots and the excess of even codes; the same name is the same parameter in all
    channels.

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
        return _mean_columns(channel, rows)
    if channel.word == "flat_map":
        return _map_columns(channel, measured)
    if channel.word == "dark_map":
        return _dark_columns(channel)
    if channel.word == "spot":
        return _spot_columns(channel, rows)
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
    for condition, rows in rows_of.items():
        for amp in np.unique(x["amp"][rows]):
            here = rows[x["amp"][rows] == amp]
            column = np.zeros(len(channel))
            column[here] = light[here]
            out[f"light {int(amp)} {label_of(condition)}"] = column
    for amp in np.unique(x["amp"]):
        out[f"dark {int(amp)}"] = np.where(x["amp"] == amp, x["time"], 0.0)
    return out


def _dark_columns(channel: Channel) -> dict[str, FloatArray]:
    x = channel.axes
    out = {}
    level, column = x["what"] == "level", x["what"] == "column"
    for amp in np.unique(x["amp"]):
        here = x["amp"] == amp
        out[f"dark {int(amp)}"] = np.where(here & level, x["time"], 0.0)
        out[f"dark level {int(amp)}"] = np.where(here & level, 1.0, 0.0)
        out[f"dark column {int(amp)}"] = np.where(here & column, 1.0, 0.0)
    return out


def _map_columns(channel: Channel, measured: MeasuredChannels) -> dict[str, FloatArray]:
    x, size = channel.axes, len(channel)
    ny, nx = measured.shape
    out: dict[str, FloatArray] = {}
    places = Places.of(x, measured.shape)
    u, v = (2 * (np.arange(n) + 0.5) / n - 1 for n in (nx, ny))
    smooth = {
        f"light {p}{q}": places.product(u**p, v**q, size)
        for p in range(MAP_ORDER + 1) for q in range(MAP_ORDER + 1 - p)
    }  # fmt: skip
    # Each amplifier was divided by its mean, so that steps between amplifiers are free.
    for amp, s in enumerate(measured.segments[1:], 1):
        inside = np.zeros(nx), np.zeros(ny)
        inside[0][s.x : s.x + s.columns] = 1.0
        inside[1][s.y : s.y + s.rows] = 1.0
        smooth[f"amp {amp}"] = places.product(*inside, size)
    for name in dict.fromkeys(x["map"]):
        here = x["map"] == name
        for what, column in smooth.items():
            out[f"map {name} {what}"] = np.where(here, column, 0.0)
        ring = here & (x["what"] == "ring")
        if ring.any():
            # Pixel sizes have power at high frequency, and brighter-fatter feedback relaxes the
            # pixels' response by amounts that differ between levels and conditions.
            for power in (2, 4):
                out[f"map {name} rings k{power}"] = np.where(ring, x["k"] ** power, 0.0)
        if name == "all" and ring.any():
            out["map rings white"] = np.where(ring, 1.0, 0.0)
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
