"""One image while it collects photons: its charge, and what moves its boundaries."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bfsensor._kernels import charge as _charge
from bfsensor._kernels import shoot as _shoot
from bfsensor._kernels.charge import TILE, Ledger, Response
from bfsensor._kernels.hot import FENCES, Hot
from bfsensor._kernels.photons import Light, Medium, Pattern
from bfsensor._kernels.shifts import Charges, Edges
from bfsensor.sensor.threads import threads_to_use
from bfsensor.typing import FloatArray

_HOT_PAGES, _HOT_EDGES = 256, 4096
_EMPTY = np.zeros(0, np.float32)
_EMPTY_2 = np.zeros((0, 0), np.float32)
_NO_STRIKES = np.zeros((0, 0), np.int32)


@dataclass(frozen=True)
class Physics:
    """What a sensor is made of, as the kernels take it.

    Attributes
    ----------
    edges, response, medium : Edges, Response, Medium
        See there.
    full_well : float
        Electrons at which a pixel spills along its column; inf where it does not.
    spill_along_y : bool
        Columns run along y.
    block : float
        Electrons between two renewals of the boundaries, 0: only by hand.
    predict : bool
        Use the charge expected in the middle of the block.
    loss : float
        q [1/e-]: an electron is lost with probability 1 - exp(-q Q), Q the charge it meets.
    """

    edges: Edges
    response: Response
    medium: Medium
    full_well: float
    spill_along_y: bool
    block: float
    predict: bool
    loss: float = 0.0


class ImageExposure:
    """Collects photons in one image.

    Parameters
    ----------
    image : ndarray, shape (ny, nx)
        Electrons, float32 or float64, any strides; changed in place.  What is in it moves
        the boundaries from the start.
    physics : Physics
        The sensor.
    pattern : Pattern
        Fixed shifts, in pixels from the lower left corner of the image.
    origin : tuple of float
        Position (x, y) of that corner in the coordinates of the photons.
    key : tuple of int
        Two words of 32 bits: the same key, the same random numbers.
    threads : int
        Threads to use; the result does not depend on it.
    """

    def __init__(
        self,
        image: NDArray[np.floating],
        physics: Physics,
        pattern: Pattern,
        origin: tuple[float, float],
        key: tuple[int, int],
        threads: int = 1,
    ) -> None:
        self.physics = physics
        self.pattern = pattern
        # Factor on the light by pixel of the sensor, and what takes positions to its frame.
        self.light_factor: FloatArray | None = None
        self.to_sensor = (0.0, 0.0)
        self.threads = threads
        self.charges, self.ledger = _allocate(image, physics)
        self.hot = _no_hot_edges(physics.edges, self.ledger.flags.size)
        self.plan = _shoot.Plan(
            block=float(physics.block),
            predict=bool(physics.predict),
            full_well=float(physics.full_well),
            spill_along_y=bool(physics.spill_along_y),
            x0=float(origin[0]),
            y0=float(origin[1]),
            key0=np.uint32(key[0]),
            key1=np.uint32(key[1]),
            loss=float(physics.loss),
        )
        batch = _shoot.BATCH
        self._buffers = (
            *(np.empty((2, batch), kind) for kind in (float, float, np.float32, np.uint32)),
            *(np.empty(batch, np.int32) for _ in range(4)),
        )
        _charge.take_image(
            np.ascontiguousarray(image), self.charges, self.ledger, physics.response,
            physics.edges, np.float32(0),
        )  # fmt: skip

    def add(self, image: NDArray[np.floating], light: Light) -> float:
        """Collect photons; returns the flux that stays in the image."""
        p = self.physics
        with _in_rows(image) as pixels:
            arguments: Any = (
                pixels, light, p.medium, self.pattern, self.plan, p.edges, self.charges,
                self.hot, self.ledger, p.response,
            )  # fmt: skip
            if self.threads == 1:
                return float(_shoot.shoot(*arguments, 1, *self._buffers))
            with threads_to_use(self.threads) as threads:
                return float(_shoot.shoot_on_threads(*arguments, threads, *self._buffers))

    def renew(self, image: NDArray[np.floating]) -> None:
        """Renew the boundaries now."""
        p = self.physics
        with _in_rows(image) as pixels:
            _shoot.renew(
                pixels, self.plan, p.edges, self.charges, self.hot, self.ledger, p.response
            )

    def copy(self) -> ImageExposure:
        """Give an independent copy."""
        other = copy.copy(self)
        other.charges = Charges(*(_copied(part) for part in self.charges))
        other.hot = Hot(*(part.copy() for part in self.hot))
        other.ledger = Ledger(*(part.copy() for part in self.ledger))
        if self.charges.first is self.ledger.charge:
            other.charges = other.charges._replace(first=other.ledger.charge)
        return other

    @property
    def diagnostics(self) -> dict[str, float]:
        """Electrons that spilled, left the image, crossed or were lost, and held pixels."""
        sums, counters = self.ledger.sums, self.ledger.counters
        return {
            "photons": int(counters[_charge.PHOTONS]),
            "spilled": float(sums[_charge.SPILLED]),
            "spilled_off_image": float(sums[_charge.SPILLED_OFF]),
            "off_image": float(sums[_charge.OFF_IMAGE]),
            "crossed": float(sums[_charge.CROSSED]),
            "lost": float(sums[_charge.LOST]),
            "beyond_table": int(counters[_charge.BEYOND]),
        }


@contextmanager
def _in_rows(image: NDArray[np.floating]) -> Iterator[NDArray[np.floating]]:
    """Give the image with its pixels one after another, itself or a copy that is written back.

    Kernels are compiled for each layout of memory, which takes longer than any copy.
    """
    if image.flags.c_contiguous:
        yield image
        return
    pixels = np.ascontiguousarray(image)
    yield pixels
    image[...] = pixels


def _no_hot_edges(edges: Edges, tiles: int) -> Hot:
    """Make room for hot edges: a few stars' worth."""
    pages = min(tiles, _HOT_PAGES)
    return Hot(
        page_of=np.full(tiles, -1, np.int32),
        pages=np.empty((pages, 2, TILE * TILE), np.int32),
        lines=np.empty((_HOT_EDGES, edges.points.size, 2), np.float32),
        fences=np.empty((_HOT_EDGES, FENCES, 2), np.float32),
        edge=np.empty((_HOT_EDGES, 3), np.int32),
        used=np.zeros(2 + pages, np.int64),
    )


def _copied(part: Any) -> Any:
    return part.copy() if isinstance(part, np.ndarray) else part


def _allocate(image: NDArray[np.floating], physics: Physics) -> tuple[Charges, Ledger]:
    """Make the arrays of an exposure, all zero."""
    ny, nx = image.shape
    edges = physics.edges
    pad = edges.reach + 3
    stride = nx + 2 * pad + 16
    size = (ny + 2 * pad) * stride + 16
    modes = physics.response.first.size > 0
    charge = np.zeros(size, np.float32)
    tiles = ((nx + TILE - 1) // TILE) * ((ny + TILE - 1) // TILE)

    def by_tile(kind: type = np.float32) -> NDArray:
        return np.zeros(tiles, kind)

    charges = Charges(
        # A linear sensor that looks at no time ahead needs no effective charge.
        first=np.zeros(size, np.float32) if modes or physics.predict else charge,
        second=np.zeros(size, np.float32) if modes else _EMPTY,
        stride=stride,
        pad=pad,
        nx=nx,
        ny=ny,
        low_first=by_tile(),
        low_second=by_tile(),
        margins=by_tile(),
        ranges=by_tile(np.int64),
    )
    # A block that touches more pixels is taken over from the whole image.
    longest = nx * ny // 8 + 65536
    ledger = Ledger(
        charge=charge,
        carry=np.zeros((ny, nx), np.float32) if image.dtype == np.float32 else _EMPTY_2,
        listed=np.empty(longest, np.int32),
        gained=np.empty(longest, np.float32),
        listed_before=np.empty(longest if physics.predict else 0, np.int32),
        high_first=by_tile(),
        high_second=by_tile(),
        changes=by_tile(np.int32),
        flags=by_tile(bool),
        flagged=by_tile(np.int64),
        spill_from=np.full((2, max(nx, ny)), -1, np.int64),
        spill_to=np.full((2, max(nx, ny)), -1, np.int64),
        # Zeros of which nothing is touched cost no memory.
        strikes=np.zeros((ny, nx), np.int32) if physics.full_well < np.inf else _NO_STRIKES,
        struck=np.empty(_HOT_EDGES, np.int32),
        counters=np.zeros(_charge.N_COUNTERS, np.int64),
        sums=np.zeros(_charge.N_SUMS),
    )
    return charges, ledger
