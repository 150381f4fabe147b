"""Exposure of one image: its charge, the effective charges, and the calls of the kernels."""

from __future__ import annotations

import copy
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bfsensor._kernels import charge as _charge
from bfsensor._kernels import shoot as _shoot
from bfsensor._kernels.charge import TILE, Ledger, Pixels, Response
from bfsensor._kernels.hot import FENCES, Hot
from bfsensor._kernels.photons import Light, Medium, Pattern
from bfsensor._kernels.shifts import MODES, NEAR_MODES, Charges, Edges
from bfsensor.typing import FloatArray

_HOT_PAGES, _HOT_EDGES = 256, 4096
# Room for edges that are evaluated once a block, in tiles and in edges.  Chosen: enough for a few
# stars; further edges are evaluated electron by electron, which is slower with the same result.

_SHARE = _shoot.PIECE
"""Number of photons that is worth a thread, by definition the kernel's smallest share."""

_EMPTY = np.zeros(0, np.float32)
"""Array in place of one that a sensor does not need (by definition empty)."""

_EMPTY_2 = np.zeros((0, 0), np.float32)
"""The same with two dimensions (by definition empty)."""

_NO_DOUBLE = np.zeros((0, 0))
"""The same in double precision (by definition empty)."""

_NO_STRIKES = np.zeros((0, 0), np.int32)
"""The same of whole numbers (by definition empty)."""


SMALL = 2**16
"""Number of pixels up to which the next image of the same size uses the same arrays again.

Chosen: to clear those of a stamp takes a tenth of the time to make them; for twice as many pixels the
system hands out zeros in less time than they are written."""

_SCRATCH = threading.local()
"""Buffers of each Python thread for the photons under way, which hold nothing between two calls."""


@dataclass(frozen=True)
class Physics:
    """The parts of a sensor as the kernels take them.

    Attributes
    ----------
    edges : Edges
        Shifts of edges by effective charge.
    response : Response
        Effective charge by charge and background.
    medium : Medium
        Silicon: thickness, absorption lengths, diffusion.
    full_well : float
        Charge at which a pixel spills along its column [e-]; inf where it does not.
    spill_along_y : bool
        Whether columns run along y.
    block : float
        Electrons between two renewals of the boundaries; 0: only by ``renew`` of
        :meth:`ImageExposure.add`.
    predict : bool
        Whether the charge expected in the middle of a block acts, or that at its start.
    loss : float
        q [1/e-]: an electron is lost with probability 1 - exp(-q Q) where it meets charge Q.
    surroundings : float
        Charge of every pixel beyond the image [e-], at all times; nan: that of the image, mirrored at
        its sides.
    """

    edges: Edges
    response: Response
    medium: Medium
    full_well: float
    spill_along_y: bool
    block: float
    predict: bool
    loss: float = 0.0
    surroundings: float = 0.0


class ImageExposure:
    """Exposure that collects photons in one image.

    Parameters
    ----------
    image : ndarray, shape (ny, nx)
        Charge [e-], float32 or float64, any strides.  Charge that is in it already moves
        the boundaries from the start.
    physics : Physics
        The sensor.
    pattern : Pattern
        Fixed shifts, in pixels from the lower left corner of the image.
    origin : tuple of float
        Position (x, y) of that corner in the coordinates of the photons.
    key : tuple of int
        Key of the random numbers, two words of 32 bits.
    threads : int
        Largest number of threads to use; the result does not depend on it.
    taken : bool
        Whether the charge in the image acts at once; otherwise from the first call of :meth:`add`
        on, which takes less time.
    """

    def __init__(
        self,
        image: NDArray[np.floating],
        physics: Physics,
        pattern: Pattern,
        origin: tuple[float, float],
        key: tuple[int, int],
        threads: int = 1,
        taken: bool = True,
    ) -> None:
        self.physics = physics
        self.charges, self.ledger = _allocate(image, physics)
        self.hot = _no_hot_edges(physics.edges, self.ledger.flags.size)
        self._begin(image, pattern, origin, key, threads)
        if taken:
            _charge.hold_image(
                as_pixels(np.ascontiguousarray(image)), self.charges, self.ledger,
                physics.response, physics.edges,
            )  # fmt: skip

    def _begin(
        self,
        image: NDArray[np.floating],
        pattern: Pattern,
        origin: tuple[float, float],
        key: tuple[int, int],
        threads: int,
    ) -> None:
        """Set what belongs to one image."""
        physics = self.physics
        self.pattern = pattern
        # Factor on the light by pixel of the sensor, and the offset of positions to its frame.
        self.light_factor: FloatArray | None = None
        self.to_sensor = (0.0, 0.0)
        # The image's own pixels and its place, by which a resumed call knows it again.
        self.pixels: NDArray[np.floating] = image
        self.bounds: Any = None
        self.threads = threads
        # Photons without flux whose numbers are not finite, which fall nowhere.
        self.dropped = 0
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

    def begin_again(
        self,
        image: NDArray[np.floating],
        physics: Physics,
        pattern: Pattern,
        origin: tuple[float, float],
        key: tuple[int, int],
    ) -> bool:
        """Become the exposure of another small image of the same kind; returns whether it can.

        Parameters are those of the class; charge in the image acts from the first :meth:`add` on.
        """
        last = self.pixels
        if (
            physics is not self.physics
            or image.shape != last.shape
            or image.dtype != last.dtype
            or image.size > SMALL
        ):
            return False
        _clear(self.charges, self.ledger, self.hot)
        self._begin(image, pattern, origin, key, 1)
        return True

    def add(
        self, image: NDArray[np.floating], light: Light, *, renew: bool = False
    ) -> float:
        """Collect photons in the image, in place; returns the flux that was collected [e-].

        With ``renew`` the boundaries are renewed first, from the image's charge now.
        """
        p = self.physics
        # Kernels are compiled once for each memory layout, which takes longer than any copy.
        pixels = np.ascontiguousarray(image)
        baton = np.zeros(_shoot.N_BATON, np.int64)
        call = partial(
            _shoot.shoot, as_pixels(pixels), light, p.medium, self.pattern, self.plan, p.edges,
            self.charges, self.hot, self.ledger, p.response, renew,
            int(self.ledger.counters[_charge.PHOTONS]), *_buffers(), baton,
        )  # fmt: skip
        added = _call_on_threads(call, self._busy_threads(light.x.size), baton)
        if pixels is not image:
            image[...] = pixels
        return added

    def _busy_threads(self, photons: int) -> int:
        """Return how many of the threads have a share of the photons that is worth their start."""
        return max(1, min(self.threads, photons // _SHARE))

    def copy(self) -> ImageExposure:
        """Return an independent copy."""
        other = copy.copy(self)
        other.charges = Charges(*(_copied(part) for part in self.charges))
        other.hot = Hot(*(part.copy() for part in self.hot))
        other.ledger = Ledger(*(_copied(part) for part in self.ledger))
        return other

    @property
    def beyond_table(self) -> int:
        """Number of renewals of a pixel with more charge than response and full well know."""
        return int(self.ledger.counters[_charge.BEYOND])

    @property
    def diagnostics(self) -> dict[str, float]:
        """Counts of the exposure, as in :attr:`bfsensor.sensor.base.EngineSensor.diagnostics`."""
        sums, counters = self.ledger.sums, self.ledger.counters
        return {
            "photons": int(counters[_charge.PHOTONS]),
            "spilled": float(sums[_charge.SPILLED]),
            "spilled_off_image": float(sums[_charge.SPILLED_OFF]),
            "off_image": float(sums[_charge.OFF_IMAGE]),
            "crossed": float(sums[_charge.CROSSED]),
            "lost": float(sums[_charge.LOST]),
            "beyond_table": self.beyond_table,
            "dropped": self.dropped,
        }


def _buffers() -> tuple[NDArray[Any], ...]:
    """Return this thread's buffers for photons under way, which are made once."""
    found: tuple[NDArray[Any], ...] | None = getattr(_SCRATCH, "buffers", None)
    if found is None:
        batch = _shoot.BATCH
        found = (
            *(np.empty((2, batch), kind) for kind in (float, float, np.float32, np.uint32)),
            *(np.empty(batch, np.int32) for _ in range(4)),
        )
        _SCRATCH.buffers = found
    return found


def _call_on_threads(
    call: Callable[[int, bool], float], threads: int, baton: NDArray[np.int64]
) -> float:
    """Call the kernel, with other threads that serve it where there are more than one."""
    if threads == 1:
        return float(call(1, False))
    with ThreadPoolExecutor(threads - 1) as executor:
        for _ in range(threads - 1):
            executor.submit(call, threads, True)
        try:
            return float(call(threads, False))
        finally:
            # Those that serve end, also where an error ended this call before its kernel ran.
            baton[_shoot.TICKET] = -1


def as_pixels(image: NDArray[np.floating]) -> Pixels:
    """Hand a C-contiguous image of float32 or float64 to the kernels, as one type for both."""
    if image.dtype == np.float32:
        return Pixels(image, _NO_DOUBLE)
    return Pixels(_EMPTY_2, image)


def _no_hot_edges(edges: Edges, tiles: int) -> Hot:
    """Allocate the arrays of edges that are evaluated once a block."""
    pages = min(tiles, _HOT_PAGES)
    most = min(2 * TILE * TILE * pages, _HOT_EDGES)
    return Hot(
        page_of=np.full(tiles, -1, np.int32),
        pages=np.empty((pages, 2, TILE * TILE), np.int32),
        lines=np.empty((most, 32 * ((edges.points.size + 15) // 16)), np.float32),
        fences=np.empty((most, FENCES, 4), np.float32),
        edge=np.empty((most, 3), np.int32),
        used=np.zeros(2 + pages, np.int64),
    )


def _clear(charges: Charges, ledger: Ledger, hot: Hot) -> None:
    """Set the arrays of an exposure to what they were when they were made.

    Others are written before they are read, or stay what they are: the charge beyond the image, which
    only images with mirrored sides change.
    """
    for zeros in (
        charges.lows, charges.margins, charges.ranges, ledger.carry, ledger.marks, ledger.highs,
        ledger.changes, ledger.flags,
        ledger.strikes, ledger.counters, ledger.sums, hot.used,
    ):  # fmt: skip
        zeros.fill(0)
    for none in (ledger.spill_from, ledger.spill_to, hot.page_of):
        none.fill(-1)
    ny, nx, pad = charges.ny, charges.nx, charges.pad
    for effective, each in ((charges.first, 1), (charges.near, NEAR_MODES)):
        if ledger.mirrored:
            effective.fill(0)
        elif effective.size:
            stride = each * charges.stride
            rows = effective[: (ny + 2 * pad) * stride].reshape(-1, stride)
            rows[pad : pad + ny, each * pad : each * (pad + nx)] = 0


def _copied(part: Any) -> Any:
    """Copy of an array; anything else itself."""
    return part.copy() if isinstance(part, np.ndarray) else part


def _outside(physics: Physics) -> tuple[float, ...]:
    """Effective charges, and charge, of a pixel whose neighbours hold that of the surroundings."""
    level = physics.surroundings
    if level == 0.0 or np.isnan(level):
        return (0.0,) * (MODES + 1)
    # One pixel among its own mirror images.
    alone = replace(physics, surroundings=np.nan)
    image = np.array([[level]])
    charges, ledger = _allocate(image, alone)
    _charge.hold_image(as_pixels(image), charges, ledger, physics.response, physics.edges)
    near = charges.near[:NEAR_MODES] if charges.near.size else np.zeros(NEAR_MODES)
    return float(charges.first[0]), *map(float, near), level


def _surround(array: NDArray[np.float32], value: NDArray[np.float32], shape: tuple[int, int],
              pad: int, stride: int) -> None:  # fmt: skip
    """Fill the padding of an array with the values of a pixel; that of zeros stays as it is."""
    if not value.any() or not array.size:
        return
    ny, nx = shape
    size = (ny + 2 * pad) * stride * len(value)
    rows = array[:size].reshape(-1, stride, len(value))
    rows[:pad] = rows[pad + ny :] = value
    rows[:, :pad] = rows[:, pad + nx :] = value


def _allocate(image: NDArray[np.floating], physics: Physics) -> tuple[Charges, Ledger]:
    """Make the arrays of an exposure, zero but for the charge beyond the image."""
    ny, nx = image.shape
    edges = physics.edges
    pad = edges.reach + 3
    stride = nx + 2 * pad + 16
    size = (ny + 2 * pad) * stride + 16
    modes = physics.response.first.size > 0
    tiles = ((nx + TILE - 1) // TILE) * ((ny + TILE - 1) // TILE)

    # Small arrays are made together: for a stamp, making them one by one takes as long as its light.
    lows, highs = np.zeros((2, MODES * tiles), np.float32)
    spill_from, spill_to = np.full((2, 2, max(nx, ny)), -1, np.int64)
    charges = Charges(
        first=np.zeros(size, np.float32),
        near=np.zeros(NEAR_MODES * size, np.float32) if modes else _EMPTY,
        stride=stride,
        pad=pad,
        nx=nx,
        ny=ny,
        lows=lows,
        margins=np.zeros(tiles, np.float32),
        ranges=np.zeros(tiles, np.int64),
    )
    # Pixels that one block may list; if it touches more, all pixels of the image are updated.
    longest = min(nx * ny // 8 + 65536, nx * ny)
    ledger = Ledger(
        carry=np.zeros((ny, nx), np.float32) if image.dtype == np.float32 else _EMPTY_2,
        marks=np.zeros((nx * ny + 7) // 8, np.uint8),
        listed=np.empty(longest, np.int32),
        gained=np.empty(longest, np.float32),
        # Memory is taken only where it is written: by blocks that touch more pixels than are listed.
        before=np.empty(nx * ny if physics.predict else 0, np.float32),
        rows=np.zeros((3, nx + 2), np.float32),
        starts=np.zeros(ny + 1, np.int32),
        queue=np.zeros(_charge.QUEUE, np.int32),
        ahead=np.zeros((2, _charge.QUEUE), np.float32),
        found=np.zeros(NEAR_MODES * _charge.QUEUE, np.float32),
        listed_before=np.empty(longest if physics.predict else 0, np.int32),
        highs=highs,
        changes=np.zeros(tiles, np.int32),
        flags=np.zeros(tiles, bool),
        flagged=np.zeros(tiles, np.int64),
        spill_from=spill_from,
        spill_to=spill_to,
        # The system commits the memory of zeros only where they are written.
        strikes=np.zeros((ny, nx), np.int32) if physics.full_well < np.inf else _NO_STRIKES,
        struck=np.empty(_HOT_EDGES, np.int32),
        counters=np.zeros(_charge.N_COUNTERS, np.int64),
        sums=np.zeros(_charge.N_SUMS),
        outside=np.array(_outside(physics), np.float32),
        mirrored=bool(np.isnan(physics.surroundings)),
    )
    if not ledger.mirrored:
        _surround(charges.first, ledger.outside[:1], (ny, nx), pad, stride)
        _surround(charges.near, ledger.outside[1:MODES], (ny, nx), pad, stride)
    return charges, ledger
