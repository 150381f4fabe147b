"""Columns of the linear parameters of a baseline: light, darks, shape of the light, fluxes."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from bfsensor.diagnose.channels import Channel
from bfsensor.diagnose.extract import Measured
from bfsensor.diagnose.map_channels import block_side

MAP_ORDER = 4
"""Order of the polynomial in x and y that the light on the sensor may have."""

Rows = Mapping[tuple[str, ...], NDArray[np.int64]]
"""Values of a channel by condition."""


def linear_columns(
    channel: Channel, rows: Rows, measured: Measured
) -> dict[str, NDArray[np.float64]]:
    """What the values of a channel change with each linear parameter, by name.

    Light by amplifier and condition, dark current, shape of the light, flux of the spots; the
    same name is the same parameter in all channels.

    Parameters
    ----------
    channel : Channel
        Whose values.
    rows : mapping
        Which of them belong to each condition.
    measured : Measured
        The campaign, for its amplifiers.
    """
    if channel.word == "flat_mean":
        return _mean_columns(channel, rows)
    if channel.word == "flat_map":
        return _map_columns(channel, measured)
    if channel.word == "dark_map":
        return _dark_columns(channel)
    if channel.word == "spot":
        return _spot_columns(channel, rows)
    return {}


def _mean_columns(channel: Channel, rows_of: Rows) -> dict[str, NDArray[np.float64]]:
    x = channel.axes
    out = {}
    light = x["time"] * x["lamp"]
    for key, rows in rows_of.items():
        for amp in np.unique(x["amp"][rows]):
            here = rows[x["amp"][rows] == amp]
            column = np.zeros(len(channel))
            column[here] = light[here]
            out[f"light {int(amp)} {'/'.join(key)}"] = column
    for amp in np.unique(x["amp"]):
        out[f"dark {int(amp)}"] = np.where(x["amp"] == amp, x["time"], 0.0)
    return out


def _dark_columns(channel: Channel) -> dict[str, NDArray[np.float64]]:
    x = channel.axes
    out = {}
    level, column = x["what"] == "level", x["what"] == "column"
    for amp in np.unique(x["amp"]):
        here = x["amp"] == amp
        out[f"dark {int(amp)}"] = np.where(here & level, x["time"], 0.0)
        out[f"dark level {int(amp)}"] = np.where(here & level, 1.0, 0.0)
        out[f"dark column {int(amp)}"] = np.where(here & column, 1.0, 0.0)
    return out


def _map_columns(channel: Channel, measured: Measured) -> dict[str, NDArray[np.float64]]:
    x = channel.axes
    ny, nx = measured.shape
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
        for step, column in _amplifier_steps(channel, here, measured).items():
            out[f"map {name} {step}"] = column
    return out


def _amplifier_steps(
    channel: Channel, here: NDArray[np.bool_], measured: Measured
) -> dict[str, NDArray[np.float64]]:
    """Steps between amplifiers, which were divided by their means: free, along x and y."""
    x, out = channel.axes, {}
    for what, axis, n in (("column", "x", 0), ("row", "y", 1)):
        rows = here & (x["what"] == what)
        for start in sorted({o[n] for o in measured.origins} - {0}):
            beyond = rows & (x[axis] >= start)
            if beyond.any() and not beyond[rows].all():
                out[f"{what} from {start}"] = np.where(beyond, 1.0, 0.0)
    rows = here & (x["what"] == "block")
    # Blocks may lie on several amplifiers.
    half = 0.5 * block_side(measured.shape)
    shares = [
        np.where(rows, _overlap(x["x"], half, s.x, s.columns), 0.0)
        * _overlap(x["y"], half, s.y, s.rows)
        for s in measured.segments
    ]
    covered = np.maximum(np.sum(shares, axis=0), 1e-9)
    for amp, share in enumerate(shares[1:], 1):
        if share.any():
            out[f"block amp {amp}"] = share / covered
    return out


def _spot_columns(channel: Channel, rows_of: Rows) -> dict[str, NDArray[np.float64]]:
    x = channel.axes
    out = {}
    for key, rows in rows_of.items():
        for what in ("flux", "skew_x", "skew_y"):
            here = rows[x["what"][rows] == what]
            column = np.zeros(len(channel))
            column[here] = x["light"][here] if what == "flux" else 1.0
            out[f"spot {what} {'/'.join(key)}"] = column
    return out


def _overlap(
    centre: NDArray[np.float64], half: float, start: int, count: int
) -> NDArray[np.float64]:
    """Pixels of intervals about centres that lie in another interval."""
    low, high = centre + 0.5 - half, centre + 0.5 + half
    return np.maximum(np.minimum(high, start + count) - np.maximum(low, start), 0.0)
