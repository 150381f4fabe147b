"""Detection of waves, plane or curved, in maps of flats: starting points of rings and fringes."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bfsensor.diagnose.data.map_rings import find_radial, find_rings
from bfsensor.typing import FloatArray

ORDER = 4
"""Order in x and in y of the polynomial of the light's smooth shape that is removed from maps.
Chosen: with 8, waves of half a side and longer are removed, too."""

SHORTEST = 5.0
"""Period [pixel] of the shortest waves that are searched.  Chosen: with 10, fringes and rings of
5 to 10 pixels have no starting point in the data."""

LARGEST = 1024
"""Side [pixel] of the middle part of a sensor that is searched.  Chosen: it is enough for a
starting point; with 2048 the search takes four times as long, and weaker waves are found."""

GAIN = 35.0
"""Decrease of the chi-square above which a wave is returned.  Derived: a chi-square of seven
parameters exceeds 30 with probability 1e-4, that is in one of 1e4 tries; 35 with 1.1e-5.  With 70,
waves must be 1.4 times as strong to be returned."""

TRIES = 3
"""Number of windows from which waves are followed.  Chosen: with 6, weaker waves beside two strong
ones are found, in twice the time."""

CLEAR = 2.0
"""Minus the logarithm of the probability that the strongest mode of a window of noise is as strong,
above which a window is followed.  Chosen: 14 % of windows of noise pass, and :data:`GAIN` decides;
with 4, 2 % pass and weak waves are lost."""

Part = tuple[slice, slice]
"""Rows and columns of a part of a sensor."""


@lru_cache(maxsize=8)
def smooth_shapes(n: int) -> FloatArray:
    """Orthonormal polynomials along a side of n pixels up to :data:`ORDER`, shape (n, ORDER + 1)."""
    return np.linalg.qr(np.polynomial.legendre.legvander(np.linspace(-1, 1, n), ORDER))[0]


def without_shape(image: NDArray[Any]) -> NDArray[Any]:
    """Subtract the least-squares polynomial of order :data:`ORDER` in x and in y."""
    q_y, q_x = (smooth_shapes(n) for n in image.shape)
    return np.asarray(image - q_y @ (q_y.T @ image @ q_x) @ q_x.T, image.dtype)


def without_steps(image: NDArray[Any], amplifiers: Sequence[Part]) -> NDArray[Any]:
    """A map without smooth shape, less the steps between amplifiers that are its least squares.

    Each amplifier is over its own mean: light that is not even leaves steps.  Those of amplifiers in
    one row are in the means of columns; those of two rows are in the rings and the texture, too.
    """
    if len(amplifiers) < 4:
        return image
    q_y, q_x = (smooth_shapes(n) for n in image.shape)
    # Products of two amplifiers' masks, less their smooth shapes, without making any.
    smooth = np.array(
        [np.outer(q_y[y].sum(0), q_x[x].sum(0)).ravel() for y, x in amplifiers]
    )
    pixels = [(y.stop - y.start) * (x.stop - x.start) for y, x in amplifiers]
    sums = [float(image[part].sum(dtype=np.float64)) for part in amplifiers]
    sizes = np.linalg.pinv(np.diag(pixels) - smooth @ smooth.T, rcond=1e-10) @ sums
    steps = np.zeros_like(image)
    for part, size in zip(amplifiers, sizes, strict=True):
        steps[part] = size
    return np.asarray(image - without_shape(steps))


class Wave(NamedTuple):
    """A wave whose phase is quadratic in position, about (x, y) [pixel].

    ``fx``, ``fy``: frequency there [cycles per pixel]; ``xx``, ``xy``, ``yy``: its derivatives
    [cycles per pixel^2]; ``sine``, ``cosine``: amplitudes of its two parts, in units of the map.
    """

    x: float
    y: float
    fx: float
    fy: float
    xx: float = 0.0
    xy: float = 0.0
    yy: float = 0.0
    sine: float = 0.0
    cosine: float = 0.0

    def about(self, x: float, y: float) -> Wave:
        """The same wave, expanded about another point."""
        dx, dy = x - self.x, y - self.y
        fx = self.fx + self.xx * dx + self.xy * dy
        fy = self.fy + self.xy * dx + self.yy * dy
        turn = 2 * np.pi * 0.5 * (dx * (self.fx + fx) + dy * (self.fy + fy))
        sine = self.sine * np.cos(turn) - self.cosine * np.sin(turn)
        cosine = self.sine * np.sin(turn) + self.cosine * np.cos(turn)
        return Wave(x, y, fx, fy, self.xx, self.xy, self.yy, float(sine), float(cosine))

    @property
    def amp(self) -> float:
        """Amplitude, in units of the map."""
        return float(np.hypot(self.sine, self.cosine))


def find_patterns(
    image: NDArray[Any], name: str, amplifiers: Sequence[Part] = ()
) -> list[dict[str, Any]]:
    """Find waves in a map and, in the map of all flats, rings that they may belong to.

    Plane waves are sought in the spectra of windows; each is fitted in ever larger parts of the
    map with a frequency that changes linearly with position, and returned if it explains enough
    of the whole map.

    Parameters
    ----------
    image : ndarray, shape (ny, nx)
        Map of relative response less one, nan where nothing is read.
    name : str
        Name of the map; rings are sought in 'all' only.
    amplifiers : sequence of (slice, slice)
        Rows and columns of each amplifier, between whose means the map may have steps.

    Returns
    -------
    list of dict
        At most two waves, the most significant first: 'map', 'z', 'shape' ('wave': 'fx', 'fy',
        'xx', 'xy', 'yy' of :class:`Wave` about the middle, pixel n / 2, 'phase' [cycles], 'amp').
        Before them, in the map of all flats, the most significant 'rings' of
        :func:`bfsensor.diagnose.data.map_rings.find_rings`.  Empty for maps of less than 24
        pixels on a side.

    Examples
    --------
    >>> y, x = np.mgrid[:128, :128]
    >>> rng = np.random.default_rng(8231)
    >>> flat = 0.01 * np.sin(0.4 * x + 0.2 * y) + 0.01 * rng.standard_normal(x.shape)
    >>> found = find_patterns(flat, "950")[0]
    >>> round(2 * np.pi * found["fx"], 2), round(found["amp"], 3)
    (0.4, 0.01)
    """
    corner, values = _middle(image, amplifiers)
    side = 2 if min(values.shape) >= 192 else 1
    ny, nx = (n // side for n in values.shape)
    values = values[: ny * side, : nx * side].reshape(ny, side, nx, side).mean((1, 3))
    spread = 1.4826 * float(np.median(np.abs(values - np.median(values))))
    if not spread > 0 or min(ny, nx) < 24:
        return []
    values = np.clip(values, -5 * spread, 5 * spread) / spread
    out: list[tuple[float, Wave]] = []
    for start in _plane_waves(values, 2.0 * side / SHORTEST)[:TRIES]:
        wave = _follow(values, start)
        if wave is None:
            continue
        gain = float(
            (values**2).sum() - ((values - _model(wave, *_grid(values))[0]) ** 2).sum()
        )
        # Chosen, to be derived: windows of one wave lead to gains that agree to 5 %; two waves
        # rarely do.
        like = any(abs(gain - g) < 0.05 * g for g, _ in out)
        if gain > GAIN and not like:
            out.append((gain, wave))
    out.sort(key=lambda found: -found[0])
    told: list[dict[str, Any]] = []
    found: list[tuple[float, list[dict[str, Any]]]] = []
    ny_all, nx_all = image.shape
    for gain, wave in out:
        # Centre of a binned pixel on the sensor.
        first = 0.5 * (side - 1)
        whole = Wave(
            wave.x * side + first + corner[1], wave.y * side + first + corner[0],
            wave.fx / side, wave.fy / side, wave.xx / side**2, wave.xy / side**2,
            wave.yy / side**2, wave.sine * spread, wave.cosine * spread,
        ).about(nx_all / 2, ny_all / 2)  # fmt: skip
        if name == "all":
            y, x = (
                side * g + first + c
                for g, c in zip(np.indices(values.shape), corner, strict=True)
            )
            near = _circles(whole, 20.0 * side * max(values.shape))
            rings = find_rings(values, x, y, near)
            if rings:
                found.append((rings[0][0], [
                    {"map": name, "shape": "rings", "z": float(np.sqrt(own)), **r}
                    | {"amp": spread * r["amp"]}
                    for own, r in rings
                ]))  # fmt: skip
        told.append({
            "map": name, "shape": "wave", "z": float(np.sqrt(gain)), "amp": whole.amp,
            "phase": float(np.arctan2(whole.cosine, whole.sine) / (2 * np.pi)),
            **{k: getattr(whole, k) for k in ("fx", "fy", "xx", "xy", "yy")},
        })  # fmt: skip
    # Waves in different parts of the same rings give different circles: the best is kept.
    clearest = max(found, key=lambda f: f[0], default=(0.0, []))[1]
    if name == "all":
        first = 0.5 * (side - 1)
        y, x = (
            side * g + first + c
            for g, c in zip(np.indices(values.shape), corner, strict=True)
        )
        places = [(float(r["xc"]), float(r["yc"])) for r in clearest]
        radial = find_radial(values, x, y, places, least=GAIN)
        if radial is not None:
            radial["amp"] *= spread
            clearest = [*clearest, {"map": name, "shape": "radial", **radial}]
    return [*clearest, *told[:2]]


def _middle(
    image: NDArray[Any], amplifiers: Sequence[Part]
) -> tuple[tuple[int, int], FloatArray]:
    """Corner of the middle part, and its deviations from a smooth shape with steps."""
    y, x = (max((n - LARGEST) // 2, 0) for n in image.shape)
    part = np.s_[y : y + LARGEST, x : x + LARGEST]
    values = np.asarray(image[part], float)
    good = np.isfinite(values)
    values = np.where(good, values, values[good].mean() if good.any() else 0.0)
    values = without_shape(values - values.mean())
    steps = []
    for amplifier in amplifiers[1:]:
        step = np.zeros(image.shape)
        step[amplifier] = 1.0
        if 0 < step[part].mean() < 1:
            steps.append(without_shape(step[part]).ravel())
    if steps:
        design = np.stack(steps)
        height = np.linalg.lstsq(design @ design.T, design @ values.ravel(), rcond=None)[0]
        values = values - (height @ design).reshape(values.shape)
    return (y, x), values


def _plane_waves(values: FloatArray, highest: float) -> list[Wave]:
    """Peaks in the spectra of windows of three sizes, the least probable under noise first."""
    ny, nx = values.shape
    found = []
    for part in (1, 2, 4):
        size = min(ny, nx) // part
        if size < 16:
            continue
        window = np.hanning(size + 2)[1:-1]
        weight = window[:, None] * window
        f = np.hypot(np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size)[None])
        use = (f > 1.5 / size) & (f < 0.5 * highest)
        for y0 in range(0, ny - size + 1, max(size // 2, 1)):
            for x0 in range(0, nx - size + 1, max(size // 2, 1)):
                cut = values[y0 : y0 + size, x0 : x0 + size] * weight
                power = np.abs(np.fft.rfft2(cut)) ** 2 / (weight**2).sum()
                power = np.where(use, power / np.median(power[use]) * np.log(2), 0.0)
                j, i = np.unravel_index(int(np.argmax(power)), power.shape)
                # Power of noise is exponential: the largest of n modes exceeds p with n exp(-p).
                chance = power[j, i] - np.log(use.sum())
                fy, fx = np.fft.fftfreq(size)[j], np.fft.rfftfreq(size)[i]
                middle = 0.5 * (size - 1)
                found.append(
                    (chance, size, Wave(x0 + middle, y0 + middle, float(fx), float(fy)))
                )
    clear = [f for f in found if f[0] > CLEAR]
    clear.sort(key=lambda f: -f[0])
    return [wave for _, _, wave in clear]


def _grid(values: FloatArray) -> tuple[FloatArray, FloatArray]:
    y, x = np.indices(values.shape, float)
    return x, y


def _model(wave: Wave, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Value of a wave at points, and its derivatives by all parameters but x and y (last axis)."""
    dx, dy = x - wave.x, y - wave.y
    phase = 2 * np.pi * (
        wave.fx * dx + wave.fy * dy
        + 0.5 * (wave.xx * dx * dx + 2 * wave.xy * dx * dy + wave.yy * dy * dy)
    )  # fmt: skip
    s, c = np.sin(phase), np.cos(phase)
    by_phase = 2 * np.pi * (wave.sine * c - wave.cosine * s)
    slopes = [dx, dy, 0.5 * dx * dx, dx * dy, 0.5 * dy * dy]
    return wave.sine * s + wave.cosine * c, np.stack(
        [*(by_phase * v for v in slopes), s, c], axis=-1
    )


def _follow(values: FloatArray, start: Wave) -> Wave | None:
    """Fit a wave in ever larger parts of a map around the window where it was detected."""
    ny, nx = values.shape
    reach = max(min(ny, nx) / 8, 1.0 / np.hypot(start.fx, start.fy))
    wave, bent = start, False
    while True:
        rows = slice(max(int(wave.y - reach), 0), int(wave.y + reach) + 2)
        columns = slice(max(int(wave.x - reach), 0), int(wave.x + reach) + 2)
        part = values[rows, columns]
        y, x = np.indices(part.shape, float)
        fitted = _fit(part, x + columns.start, y + rows.start, wave, bent)
        if fitted is None:
            return None
        wave = fitted
        if reach > max(ny, nx):
            return wave
        # Chosen, to be derived: 1.4 doubles the area; much farther the extrapolated phase may be off
        # by half a turn and the fit lose the wave.
        reach, bent = 1.4 * reach, True


def _fit(
    values: FloatArray, x: FloatArray, y: FloatArray, wave: Wave, bent: bool
) -> Wave | None:
    """Least squares from a wave nearby (Levenberg-Marquardt); None where it is singular."""
    used = np.array([True, True, bent, bent, bent, True, True])
    if not wave.amp:
        _, slopes = _model(wave, x, y)
        both = slopes[..., 5:].reshape(-1, 2)
        parts = np.linalg.lstsq(both, values.ravel(), rcond=None)[0]
        wave = wave._replace(sine=float(parts[0]), cosine=float(parts[1]))
    here, slopes = _model(wave, x, y)
    square, damping = float(((values - here) ** 2).sum()), 1e-3
    # Damping after Marquardt, in units of the normal matrix's diagonal: a fifth of it after a step
    # that gains, eight times after one that does not; 1e3 allows no step worth taking.
    for _ in range(12):
        design = slopes.reshape(-1, 7)[:, used]
        normal = design.T @ design
        scale = np.sqrt(np.diag(normal))
        if not np.all(scale > 0):
            return None
        normal = normal / np.outer(scale, scale) + damping * np.eye(used.sum())
        step = np.linalg.solve(normal, design.T @ (values - here).ravel() / scale) / scale
        point = np.array(wave[2:])
        point[used] += step
        new = Wave(wave.x, wave.y, *(float(v) for v in point))
        there, steeper = _model(new, x, y)
        left = float(((values - there) ** 2).sum())
        if left < square:
            done = square - left < 1e-3
            wave, here, slopes, square, damping = new, there, steeper, left, damping / 5
            if done:
                break
        else:
            damping *= 8
            if damping > 1e3:
                break
    return wave


def _circles(wave: Wave, far: float) -> tuple[float, float, float, float]:
    """Circles that a curved wave is part of; the curvature of its crests gives the centre.

    ``far``: largest distance of the centre [pixel].  Returns the centre [pixel], the period at the
    pixel (0, 0) [pixel] and the relative change of the frequency per 100 pixels.
    """
    frequency = float(np.hypot(wave.fx, wave.fy))
    ux, uy = wave.fx / frequency, wave.fy / frequency
    across = wave.xx * uy * uy - 2 * wave.xy * ux * uy + wave.yy * ux * ux
    along = wave.xx * ux * ux + 2 * wave.xy * ux * uy + wave.yy * uy * uy
    if across < 0:
        ux, uy, across, along = -ux, -uy, -across, -along
    radius = frequency / max(across, frequency / far)
    xc, yc = wave.x - radius * ux, wave.y - radius * uy
    start = np.hypot(xc, yc)
    rate = 100.0 * along
    inverse = frequency - rate * (2 * radius - start) / 200.0
    if not inverse > 0.2 * frequency:
        inverse, rate = frequency, 0.0
    return float(xc), float(yc), float(1.0 / inverse), float(rate / inverse)
