"""Cosmic rays: straight tracks of muons, at a constant rate in all exposures."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache, partial
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from bfsensor.effects.dark_pixels import OUTLIER
from bfsensor.effects.effect import Axes, Effect, Image, Layout, Parameter, Seen, Shot
from bfsensor.effects.random_covariances import scatter_of_pairs
from bfsensor.typing import FloatArray

AREA = 256 * 256
"""Number of pixels for which the rate is defined: 256 x 256."""

READOUT = 5.0
"""Time besides the exposure during which a frame collects tracks, in readout [s].

Chosen: twice as large, a bias holds twice the tracks, an exposure of 60 s 8 % more."""

IONISATION = 80.0
"""Least charge of a muon's track in silicon [e-/um]; an exponential tail adds a fifth on average.

Chosen: the mean of 96 lies between the most probable 73 (22,000 e- in 300 um) and the mean of
minimum-ionising particles, 388 eV/um / 3.65 eV = 106 (Particle Data Group 2022, Prog. Theor. Exp.
Phys. 2022, 083C01, silicon detectors and properties of materials).  Twice as large, every struck
pixel holds twice the charge, and covariances of flats grow up to fourfold."""

SPREAD = 0.3
"""Gaussian sigma of the charge about the track, by diffusion [pixel].

Chosen: twice as large, tracks are wider: more pixels are struck, each with less charge."""

TRACKS = 3000
"""Number of simulated tracks over which means are taken.

Measured: ``make_tracks(3000, 100.0, 10.0, rng)`` with twelve seeds gives means of the summed squared
charges that scatter by 1.2 %."""

TRACK_PIXELS = 3
"""Touching struck pixels of a dark from which the measurement counts them as one track.

Chosen: Gaussian noise strikes 2e-9 of the pixels, so that three of 256 x 256 touch by chance in one of
1e20 frames; with 6, tracks of steep muons count as struck pixels."""

LEVELS = np.geomspace(30.0, 1e6, 40)
"""Levels of flats [e-] at which the excess is computed; between them it is interpolated.

Chosen: neighbours differ by 31 %; with twice as many levels the error of the linear interpolation is
a quarter as large, at twice the time."""


class CosmicRays(Effect):
    """Muons leave ``rate`` tracks a minute on 256 x 256 pixels, also during 5 s of readout.

    Their flux goes with the square of the cosine of the zenith angle, the sensor being horizontal.
    In darks, tracks are counted, and struck pixels that are in none.  In flats, charge too weak to be
    excluded as an outlier adds to the variance and, along the track, to covariances.

    Parameters
    ----------
    values : mapping of str to float
        Plausible ranges: ``rate`` [1/min]: 0.3 to 30 (0 changes nothing).

    Examples
    --------
    >>> CosmicRays({"rate": 3.0}).name
    'cosmic_rays'
    """

    word = "cosmic_rays"
    stage = "store"
    parameters = (Parameter("rate", "1/min", 0.3, 30.0, amplitude=True),)
    touches = ("dark_map", "flat_cov")
    needs: ClassVar[tuple[str, ...]] = ("pixels",)
    source = (
        "Groom 2002, Exp. Astron. 14, 45 (straight muon tracks in thick CCDs; the muon rate is "
        "irreducible); about one a minute and cm^2 at sea level: Particle Data Group 2022, Prog. "
        "Theor. Exp. Phys. 2022, 083C01, Cosmic rays; charge in lumps of a quarter of a pixel assumed"
    )

    @classmethod
    def starts(cls, layout: Layout, seen: Sequence[Seen] = ()) -> list[dict[str, float]]:
        return [{"rate": 3.0}]

    def store(
        self,
        charge: Image,
        shot: Shot,
        layout: Layout,
        rng: np.random.Generator,
        memory: dict[str, NDArray],
    ) -> Image:
        ny, nx = charge.shape
        number = rng.poisson(self._each(shot.seconds) * nx * ny)
        if not number:
            return charge
        found = make_tracks(number, layout.thickness, layout.pixel, rng)
        y = found.y + rng.integers(0, ny, number)[found.owner]
        x = found.x + rng.integers(0, nx, number)[found.owner]
        inside = (x >= 0) & (x < nx) & (y >= 0) & (y < ny)
        struck = charge.copy()
        np.add.at(struck, (y[inside], x[inside]), found.charge[inside].astype(charge.dtype))
        return struck

    def covariances(self, c: FloatArray, axes: Axes, layout: Layout) -> FloatArray:
        side = c.shape[-1]
        table, _ = _excess(
            layout.thickness, layout.pixel, layout.shape, layout.clip, layout.lags
        )
        place = np.interp(
            np.log(np.maximum(axes["level"], LEVELS[0])),
            np.log(LEVELS),
            np.arange(len(LEVELS)),
        )
        low = np.minimum(place.astype(int), len(LEVELS) - 2)
        part = (place - low)[:, None, None]
        own = (1 - part) * table[low] + part * table[low + 1]
        lags = np.arange(-layout.lags, layout.lags + 1)
        added = np.zeros_like(c)
        each = self._each(np.asarray(axes["time"], float))[:, None, None]
        added[:, (lags % side)[:, None], lags % side] = each * own
        return np.asarray(c + added)

    def dark_map(self, axes: Axes, layout: Layout) -> FloatArray:
        out = self._tracks_seen(axes, layout)
        for rows, mean, _ in self._struck(axes, layout):
            out[rows] = mean
        return out

    def _tracks_seen(self, axes: Axes, layout: Layout) -> FloatArray:
        """Tracks in all darks of a campaign, beyond those in as many biases."""
        found = _tracks(layout.thickness, layout.pixel, layout.shape)
        # The total exposure time of all darks; biases hold those of the readout.
        number = self["rate"] * np.asarray(axes["time"], float) / 60.0 / AREA
        number *= sum(s.rows * s.columns for s in layout.segments)
        seen = found.counted(OUTLIER * float(np.mean(layout.noise))).mean()
        return np.where(axes["what"] == "tracks", number * seen, 0.0)

    def modes(self, word: str, axes: Axes, layout: Layout) -> FloatArray | None:
        if word == "flat_cov":
            return scatter_of_pairs(self, axes, layout, partial(self._few, layout=layout))
        if word != "dark_map":
            return None
        rows = np.nonzero(axes["what"] == "struck")[0]
        out = np.zeros((len(axes["what"]), len(rows)))
        for here, _, spread in self._struck(axes, layout):
            out[here, np.searchsorted(rows, here)] = spread
        return np.column_stack([out, np.sqrt(self._tracks_seen(axes, layout))])

    def _few(self, amp: int, level: float, time: float, layout: Layout) -> float:
        """Relative scatter of the covariance that the tracks of one pair of flats add."""
        _, single = _excess(
            layout.thickness, layout.pixel, layout.shape, layout.clip, layout.lags
        )
        segment = layout.segments[amp]
        tracks = 2 * float(self._each(time)) * segment.rows * segment.columns
        own = float(np.interp(np.log(max(level, LEVELS[0])), np.log(LEVELS), single))
        return own / np.sqrt(tracks) if tracks > 0 else 0.0

    def _each(self, seconds: FloatArray | float) -> FloatArray:
        """Mean number of tracks that begin in one pixel during an exposure."""
        return np.asarray(self["rate"] * (np.asarray(seconds) + READOUT) / 60.0 / AREA)

    def _struck(
        self, axes: Axes, layout: Layout
    ) -> list[tuple[NDArray[np.int64], FloatArray, FloatArray]]:
        """Rows of the channel by amplifier, mean number of struck pixels of each dark, and its scatter.

        Pixels in tracks of three pixels and more are not among them.
        """
        found = _tracks(layout.thickness, layout.pixel, layout.shape)
        out = []
        for amp, (segment, noise) in enumerate(
            zip(layout.segments, layout.noise, strict=True)
        ):
            rows = np.nonzero(
                (axes["what"] == "struck") & (np.asarray(axes["amp"]).astype(int) == amp)
            )[0]
            number = found.above(OUTLIER * noise, fewer=TRACK_PIXELS)
            tracks = self._each(np.asarray(axes["time"], float)[rows])
            tracks = tracks * segment.rows * segment.columns
            rms = float(np.sqrt((number**2).mean()))
            out.append((rows, tracks * number.mean(), np.sqrt(tracks) * rms))
        return out


class Tracks(NamedTuple):
    """Pixels of many simulated tracks, all beginning in the pixel (0, 0).

    ``number`` is that of the tracks.  By struck pixel: ``owner``, the number of its track; ``y`` and
    ``x``, its place; ``charge`` [e-]; ``share``, the probability that it lies on the sensor if the
    track begins anywhere on it.
    """

    number: int
    owner: NDArray[np.int64]
    y: NDArray[np.int64]
    x: NDArray[np.int64]
    charge: FloatArray
    share: FloatArray

    def above(self, limit: float, fewer: float = np.inf) -> FloatArray:
        """Mean number of pixels of each track with more charge than ``limit`` [e-].

        It is 0 for tracks with ``fewer`` such pixels or more.
        """
        over = self.charge > limit
        many = np.bincount(self.owner[over], minlength=self.number) >= fewer
        weight = np.where(over, self.share, 0.0)
        return np.where(many, 0.0, np.bincount(self.owner, weight, self.number))

    def counted(self, limit: float) -> FloatArray:
        """Probability that each track has :data:`TRACK_PIXELS` with more charge than ``limit`` [e-]."""
        over = (self.charge > limit) & (self.share > 0)
        number = np.bincount(self.owner[over], minlength=self.number)
        on_sensor = self.above(limit) / np.maximum(number, 1)
        return np.where(number >= TRACK_PIXELS, on_sensor, 0.0)


def make_tracks(
    count: int,
    thickness: float,
    pixel: float,
    rng: np.random.Generator,
    shape: tuple[int, int] = (10**9, 10**9),
) -> Tracks:
    """Draw tracks of muons with random directions and charges.

    Parameters
    ----------
    count : int
        Number of tracks.
    thickness, pixel : float
        Thickness and pixel pitch of the sensor [um].
    rng : numpy.random.Generator
        Source of all random numbers.
    shape : tuple of int
        Rows and columns of the sensor; by default so large that no track leaves it.

    Returns
    -------
    Tracks
    """
    # A flux that goes with cos^2 crosses a plate with cos^3: cos^4 is uniform.
    strata = (rng.permutation(count) + rng.random(count)) / count
    cosine = np.maximum(strata, 1e-3) ** 0.25
    run = thickness / pixel * np.sqrt(1 / cosine**2 - 1)
    charge = IONISATION * thickness / cosine * (1 + 0.2 * rng.exponential(size=count))
    lumps = np.maximum((4 * run).astype(int), 8)
    owner = np.repeat(np.arange(count), lumps)
    along = np.arange(lumps.sum()) - np.repeat(np.cumsum(lumps) - lumps, lumps)
    along = (along + 0.5) / lumps[owner] * run[owner]
    turn = 2 * np.pi * rng.random(count)
    first = rng.random((2, count))
    x, y = (
        np.floor(first[k][owner] + along * part(turn)[owner] + SPREAD * rng.standard_normal(len(owner)))
        for k, part in enumerate((np.cos, np.sin))
    )  # fmt: skip
    lump = rng.poisson((charge / lumps)[owner]).astype(float)
    wide = int(max(np.abs(x).max(initial=0), np.abs(y).max(initial=0))) + 1
    key = (owner * (2 * wide + 1) + (y + wide).astype(np.int64)) * (2 * wide + 1)
    pixels, which = np.unique(key + (x + wide).astype(np.int64), return_inverse=True)
    rest, x0 = np.divmod(pixels, 2 * wide + 1)
    track, y0 = np.divmod(rest, 2 * wide + 1)
    y0, x0 = y0 - wide, x0 - wide
    # A shape of 0 stands for a reduced recording, of a sensor of unknown size: no track leaves it.
    inside = [
        np.maximum(1 - np.abs(v) / n, 0.0) if n else np.ones(len(v))
        for v, n in zip((y0, x0), shape, strict=True)
    ]
    total = np.asarray(np.bincount(which.ravel(), lump), float)
    return Tracks(count, track, y0, x0, total, inside[0] * inside[1])


@lru_cache(maxsize=4)
def _tracks(thickness: float, pixel: float, shape: tuple[int, int]) -> Tracks:
    """Draw the tracks over which means are taken, with fixed random numbers."""
    return make_tracks(TRACKS, thickness, pixel, np.random.default_rng(80_256), shape)


@lru_cache(maxsize=4)
def _excess(
    thickness: float, pixel: float, shape: tuple[int, int], clip: float, lags: int
) -> tuple[FloatArray, FloatArray]:
    """Excess covariances [e-^2] by level for one track per pixel, lag (0, 0) in the middle.

    The second array is the root mean square of the excess variance by single tracks over its mean.
    The measurement excludes pixels whose difference of two flats exceeds ``clip`` times its noise,
    and their neighbours; in the others the charge of a track adds to squares and products.
    """
    found = _tracks(thickness, pixel, shape)
    near = found.share > 0
    owner, y, x = found.owner[near], found.y[near], found.x[near]
    charge, share = found.charge[near], found.share[near]
    plane = [(j, i) for j in range(-lags, lags + 1) for i in range(-lags, lags + 1)]
    other = dict(zip(plane, _neighbours(owner, y, x, plane), strict=True))
    ring = [(j, i) for j in (-1, 0, 1) for i in (-1, 0, 1)]
    out = np.zeros((len(LEVELS), 2 * lags + 1, 2 * lags + 1))
    single = np.zeros(len(LEVELS))
    for n, level in enumerate(LEVELS):
        noise = np.sqrt(2 * level)
        low, high = -clip - charge / noise, clip - charge / noise
        kept = np.maximum(ndtr(high) - ndtr(low), 1e-300)
        bell_low, bell_high = (
            np.exp(-0.5 * v**2) / np.sqrt(2 * np.pi) for v in (low, high)
        )
        first = charge - noise * (bell_high - bell_low) / kept
        square = (
            charge**2 - 2 * charge * noise * (bell_high - bell_low) / kept
            - noise**2 * (high * bell_high - low * bell_low) / kept
        )  # fmt: skip
        # Logarithm of the probability that a pixel and all of its neighbours are no outliers.
        stays = np.append(np.log(kept), 0.0)
        around = {o: stays[other[o]] for o in ring}
        alone = np.sum(list(around.values()), axis=0)
        each = np.bincount(owner, share * np.exp(alone) * square, found.number)
        single[n] = np.sqrt((each**2).mean()) / max(float(each.mean()), 1e-300)
        for j, i in plane:
            if (j, i) < (0, 0):
                continue
            a = np.nonzero(other[j, i] >= 0)[0]
            b = other[j, i][a]
            both = [o for o in ring if (o[0] - j, o[1] - i) in around]
            union = alone[a] + alone[b] - np.sum([around[o][a] for o in both], axis=0)
            products = square[a] if j == i == 0 else first[a] * first[b]
            total = float((share[a] * np.exp(union) * products).sum())
            out[n, lags + j, lags + i] = out[n, lags - j, lags - i] = total
    # Directions and starting points are isotropic: averaging over the symmetries of the square
    # lowers the scatter of the finite sample.
    out = (out + out[:, ::-1] + out[:, :, ::-1] + out[:, ::-1, ::-1]) / 4
    return np.asarray((out + out.transpose(0, 2, 1)) / 2 / found.number), single


def _neighbours(
    owner: NDArray[np.int64],
    y: NDArray[np.int64],
    x: NDArray[np.int64],
    offsets: Sequence[tuple[int, int]],
) -> list[NDArray[np.int64]]:
    """Number of the pixel of the same track at each offset (y, x); -1 where there is none."""
    reach = max(max(map(abs, o)) for o in offsets)
    side = 2 * (int(max(np.abs(x).max(), np.abs(y).max())) + reach) + 1
    key = (owner * side + y + side // 2) * side + x + side // 2
    order = np.argsort(key)
    out = []
    for j, i in offsets:
        wanted = key + j * side + i
        at = order[np.minimum(np.searchsorted(key, wanted, sorter=order), len(key) - 1)]
        out.append(np.where(key[at] == wanted, at, -1))
    return out
