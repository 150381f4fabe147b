"""Layouts: amplifiers on the sensor, overscans, and how frames are cut, stored and described.

Frames are in readout order: row 0 is next to the serial register, column 0 next to the output.  A
sensor has one or two rows of amplifiers; the upper row reads towards the upper register.  Which
amplifiers read from the far end of their strip is a word of the layout:

    plain        all read towards smaller x
    alternate    every second one reads towards larger x (two outputs share a corner)
    mirrored     those of the left half towards smaller x, those of the right half towards larger x
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

FLIPS = ("plain", "alternate", "mirrored")
VOCABULARIES = ("practice", "lsst", "noao", "eso")


@dataclass(frozen=True)
class Amplifier:
    """Place of one amplifier: columns and rows of the sensor, and the directions it reads in."""

    number: int
    x: slice
    y: slice
    flip_x: bool
    flip_y: bool

    def detector_section(self) -> str:
        """DETSEC: reversed where the sensor's coordinate runs against the readout."""
        x = (self.x.start + 1, self.x.stop)
        y = (self.y.start + 1, self.y.stop)
        x, y = (x[::-1] if self.flip_x else x), (y[::-1] if self.flip_y else y)
        return f"[{x[0]}:{x[1]},{y[0]}:{y[1]}]"


@dataclass(frozen=True)
class Layout:
    """Amplifiers, overscans, spots and files of a campaign.

    Attributes
    ----------
    pixels : int
        Side of the square sensor.
    amplifiers : int
        1, 2, 4, 8 or 16.
    rows : int
        Rows of amplifiers, 1 or 2.
    flips : str
        One of :data:`FLIPS`.
    prescan, serial_overscan, parallel_overscan : int
        Columns and rows of each frame.
    spots : int
        Pitch of the grid of spots [pixel]; 0 for none.
    vocabulary : str
        Of the headers, one of :data:`VOCABULARIES`.
    storage : str
        'mef' (an extension for each amplifier) or 'single' (one image; in `campaign.yaml` stands
        where the amplifiers are).
    compressed : bool
        Tile compression (Rice).
    manifest : bool
        Whether there is a manifest.ecsv.
    """

    pixels: int = 256
    amplifiers: int = 2
    rows: int = 1
    flips: str = "alternate"
    prescan: int = 8
    serial_overscan: int = 24
    parallel_overscan: int = 16
    spots: int = 30
    vocabulary: str = "practice"
    storage: str = "mef"
    compressed: bool = True
    manifest: bool = True

    def __post_init__(self) -> None:
        if self.amplifiers % self.rows or self.pixels % (self.amplifiers // self.rows):
            raise ValueError(
                f"{self.amplifiers} amplifiers in {self.rows} rows on {self.pixels} pixels: "
                "each row must hold the same number, and they must divide the columns"
            )
        if self.flips not in FLIPS or self.vocabulary not in VOCABULARIES:
            raise ValueError(f"flips = {self.flips!r}, vocabulary = {self.vocabulary!r}")

    @property
    def width(self) -> int:
        """Columns of light of one amplifier."""
        return self.pixels // (self.amplifiers // self.rows)

    @property
    def height(self) -> int:
        """Rows of light of one amplifier."""
        return self.pixels // self.rows

    @property
    def frame_shape(self) -> tuple[int, int]:
        """Rows and columns of one amplifier's frame."""
        return (
            self.height + self.parallel_overscan,
            self.prescan + self.width + self.serial_overscan,
        )

    @property
    def data(self) -> tuple[slice, slice]:
        """Where in a frame the light is."""
        return slice(0, self.height), slice(self.prescan, self.prescan + self.width)

    def places(self) -> tuple[Amplifier, ...]:
        """The amplifiers, lower row first, by growing x."""
        out = []
        across = self.amplifiers // self.rows
        for k in range(self.amplifiers):
            row, column = divmod(k, across)
            flip = {
                "plain": False,
                "alternate": bool(column % 2),
                "mirrored": column >= (across + 1) // 2,
            }[self.flips]
            x = slice(column * self.width, (column + 1) * self.width)
            y = slice(row * self.height, (row + 1) * self.height)
            out.append(Amplifier(k + 1, x, y, flip, row == 1))
        return tuple(out)

    def cut(self, image: NDArray) -> list[NDArray]:
        """The sensor's image as frames of light, in readout order, without overscans.

        Examples
        --------
        >>> lay = Layout(pixels=4, amplifiers=2)
        >>> [f[0].tolist() for f in lay.cut(np.arange(16).reshape(4, 4))]
        [[0, 1], [3, 2]]
        """
        out = []
        for a in self.places():
            frame = image[a.y, a.x]
            frame = frame[:, ::-1] if a.flip_x else frame
            frame = frame[::-1] if a.flip_y else frame
            out.append(np.ascontiguousarray(frame))
        return out

    def join(self, frames: Sequence[NDArray]) -> NDArray:
        """Put frames of light, in readout order, together to the sensor's image."""
        image = np.zeros((self.pixels, self.pixels), np.asarray(frames[0]).dtype)
        for a, frame in zip(self.places(), frames, strict=True):
            frame = frame[::-1] if a.flip_y else frame
            image[a.y, a.x] = frame[:, ::-1] if a.flip_x else frame
        return image

    def data_section(self) -> str:
        """DATASEC of a frame in readout order."""
        p, w, h = self.prescan, self.width, self.height
        return f"[{p + 1}:{p + w},1:{h}]"

    def bias_section(self) -> str | None:
        """BIASSEC of a frame in readout order, None without serial overscan."""
        if not self.serial_overscan:
            return None
        first = self.prescan + self.width + 1
        rows, columns = self.frame_shape
        return f"[{first}:{columns},1:{rows}]"

    def single_image(self, frames: Sequence[NDArray]) -> NDArray:
        """All frames side by side (two rows: one above the other) in one image."""
        across = self.amplifiers // self.rows
        lines = [np.hstack(frames[r * across : (r + 1) * across]) for r in range(self.rows)]
        return np.vstack(lines)

    def yaml_amplifiers(self, gain: float, noise: float) -> list[dict[str, Any]]:
        """Entries of campaign.yaml for :meth:`single_image`."""
        rows, columns = self.frame_shape
        across = self.amplifiers // self.rows
        out = []
        for a in self.places():
            r, c = divmod(a.number - 1, across)
            x0, y0 = c * columns, r * rows
            p, w, h = self.prescan, self.width, self.height
            entry: dict[str, Any] = {
                "name": f"A{a.number:02d}",
                "hdu": 1 if self.compressed else 0,
                "window": f"[{x0 + 1}:{x0 + columns},{y0 + 1}:{y0 + rows}]",
                "data": f"[{x0 + p + 1}:{x0 + p + w},{y0 + 1}:{y0 + h}]",
                "detector": a.detector_section(),
                "gain": gain,
                "noise": noise,
            }
            if self.serial_overscan:
                first = x0 + p + w + 1
                entry["bias"] = f"[{first}:{x0 + columns},{y0 + 1}:{y0 + rows}]"
            out.append(entry)
        return out

    def truth(self) -> dict[str, Any]:
        """All attributes, for the sealed truth."""
        return {k: getattr(self, k) for k in self.__dataclass_fields__}


AMPLIFIER_CHOICES = {
    "S": ((1, 1), (2, 1), (2, 1), (2, 2), (4, 1), (4, 2)),
    "M": ((1, 1), (2, 1), (4, 1), (4, 2), (8, 1), (8, 2)),
    "X": ((8, 2), (16, 1), (16, 2)),
    "T": ((1, 1), (2, 1), (2, 2)),
}
"""(amplifiers, rows) that are drawn for each size; at least 64 columns each, 32 in T."""


def draw_layout(
    rng: np.random.Generator, size: str, pixels: int, needs: frozenset[str] = frozenset()
) -> Layout:
    """Draw a layout that a law can be seen in.

    Parameters
    ----------
    rng : numpy Generator
    size : str
        S, M, X or T.
    pixels : int
    needs : frozenset of str
        Of 'spots', 'serial_overscan', 'parallel_overscan', 'two_amplifiers'.
    """
    choices = [
        c for c in AMPLIFIER_CHOICES[size] if c[0] > 1 or "two_amplifiers" not in needs
    ]
    amplifiers, rows = choices[rng.integers(len(choices))]
    serial = int(rng.choice([0, 16, 24, 32, 48], p=[0.06, 0.2, 0.4, 0.2, 0.14]))
    if "serial_overscan" in needs and not serial:
        serial = 24
    parallel = int(rng.choice([0, 12, 16, 24], p=[0.2, 0.2, 0.4, 0.2]))
    if "parallel_overscan" in needs and not parallel:
        parallel = 16
    grid = int(rng.choice([0, 26, 30, 34, 41], p=[0.2, 0.2, 0.3, 0.2, 0.1]))
    if "spots" in needs and not grid:
        grid = 30
    storage = "single" if rng.random() < 0.25 else "mef"
    return Layout(
        pixels=pixels,
        amplifiers=amplifiers,
        rows=rows,
        flips=str(rng.choice(FLIPS))
        if amplifiers > 1
        else str(rng.choice(["plain", "alternate"])),
        prescan=int(rng.choice([0, 3, 8, 10, 24])),
        serial_overscan=serial,
        parallel_overscan=parallel,
        spots=grid,
        vocabulary=str(rng.choice(VOCABULARIES)),
        storage=storage,
        compressed=bool(rng.random() < 0.7),
        manifest=bool(rng.random() < 0.6),
    )
