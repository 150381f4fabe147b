"""Flats against position: columns, rows, blocks, rings and texture."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from bfsensor.diagnose.data.channel_rows import Rows
from bfsensor.diagnose.data.channels import Channel
from bfsensor.diagnose.data.cosmetics import BRIDGED, Cosmetic, reach_of
from bfsensor.diagnose.data.measure_channels import MeasuredChannels
from bfsensor.diagnose.kinds.channel_kind import ChannelKind, ChannelModel, Picture
from bfsensor.diagnose.kinds.map_shapes import Places
from bfsensor.diagnose.kinds.scan_shapes import (
    boundaries,
    boxes,
    frames,
)
from bfsensor.diagnose.kinds.scan_templates import Group, Pattern
from bfsensor.plots import residuals as show
from bfsensor.typing import FloatArray

MAP_ORDER, LIGHT_ORDER = 4, 8
"""Largest total order of the polynomial in x and y that describes the ratio of two maps; and the largest
number of half waves on the sensor that describes the light beyond it.  Chosen: with 8 half waves the
light may vary over a quarter of the sensor; twice as many take up rings of an eighth of it."""

OCTAVES = 4
"""Number of widths of strips: 1/4, 1/8, 1/16 and 1/32 of a side, each at steps of half a width.
Chosen: each further width has twice as many strips; with 8, strips of 1/512 of a side are narrower
than the columns of most maps."""


class FlatMaps(ChannelKind):
    """Mean flats against position, of each amplifier divided by its mean, and ratios of these."""

    name = "flat_map"
    title = "flats against position"

    def predict(self, channel: Channel, model: ChannelModel) -> FloatArray:
        return model.map_change(channel)

    def columns(
        self, channel: Channel, rows: Rows, measured: MeasuredChannels
    ) -> dict[str, FloatArray]:
        x, size = channel.axes, len(channel)
        ny, nx = measured.shape
        out: dict[str, FloatArray] = {}
        places = Places.of(x, measured.shape)
        u, v = (2 * (np.arange(n) + 0.5) / n - 1 for n in (nx, ny))
        orders = [
            (p, q) for p in range(LIGHT_ORDER + 1) for q in range(LIGHT_ORDER + 1 - p)
        ]
        high = {f"light {p}{q}" for p, q in orders if p + q > MAP_ORDER}
        # Cosines, as polynomials of high order resolve the rims, where the field rolls off.
        waves = [
            np.cos(0.5 * np.pi * np.outer(np.arange(LIGHT_ORDER + 1), w + 1))
            for w in (u, v)
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
                # pixels' response by amounts that differ between levels and conditions: in long
                # waves in proportion to k, as area changes fall with the third power of distance.
                for power in (1, 2, 4):
                    out[f"map {name} rings k{power}"] = np.where(ring, x["k"] ** power, 0.0)
            for n, one in enumerate(_bad_lines(measured)):
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

    def patterns(self, g: Group) -> Iterator[Pattern]:
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

    def picture(self, channel: Channel, pulls: FloatArray) -> Picture:
        return Picture(
            "Flats against position, the light's smooth shape removed: pulls of blocks, columns and "
            "rows.", (5.2, 7.0),
            (lambda ax: show.draw_map(channel.axes, pulls, ax, name="all"),
             lambda ax: show.draw_profile(channel.axes, pulls, ax, name="all")),
        )  # fmt: skip


def _bad_lines(measured: MeasuredChannels) -> list[Cosmetic]:
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
