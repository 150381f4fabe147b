"""Projected SNR of a law in a campaign, by common random numbers, from raw pixels.

Two benches with the same random numbers, one with the law and one without, take a part of the
campaign's exposures; the differences of plain statistics of the raw frames are divided by the noise
that the whole campaign's averages of them have.  Nothing of the diagnosis is used.

The statistics, each with its noise for all exposures of its group:

    means       mean of each amplifier in each flat; noise of Poisson, reading and monitor (2e-4)
    covariance  of differenced pairs, lags 0 to 4 in both axes, by level; Gaussian noise
    blocks      variance of the means of 16 x 16 pixels of differenced pairs
    maps        flats at one level, darks, biases: pixel by pixel against Poisson, reading and, for
                flats, a pixel response of 0.3 %; only the best level counts, as response is the same
    overscans   columns 1 to 10 after the data, rows 1 to 6 above them
    spots       the mean spot of each exposure against Poisson and response; and the pixels between
    spectra     power of bias frames in the order of reading; levels of frames; pairs of amplifiers
    outliers    pixels beyond six sigma in biases, darks and differenced flats
    codes       comb in the histogram of flats' codes

Projected out: a gain and a lamp level for each amplifier (means and variances in proportion to the
signal, a constant variance), the card's device parameters with their priors in covariances, each
spot exposure's flux and place, and a change of the spots' widths at each wavelength, as optics make:
the bench is compared with one whose optics have the widths that fit best, so that a change of any size
that optics could make counts for nothing.

A sum of squares of differences would be biased by what common random numbers do not cancel; so each
square is the product of two halves of the data.  Accuracy: 15 % against a case worked out by hand;
README.md has the scatter between seeds.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import correlate1d

from validation.foreign.bench import (
    MONITOR_ERROR,
    NOMINAL_NOISE,
    PIXEL_RESPONSE,
    Bench,
    _profile,
)
from validation.foreign.collection import Edges, Light, Term, collect
from validation.foreign.device import (
    REACH,
    REFERENCE,
    SPREAD,
    Device,
    area_changes,
    edge_shifts,
)
from validation.foreign.law import Law
from validation.foreign.plan import SPOT_FLUX
from validation.foreign.raw_statistics import (
    Products,
    choose,
    comb,
    expose,
    fitted_product,
    fitted_sizes,
    gain,
    smooth,
    variance_gain,
    welch,
    white,
    without_tracks,
)

LAGS = 5
"""Lags of covariances in each axis, from 0."""

STAMP = 8
"""Half of the side of a spot's cut-out [pixel]."""

SMALL = 2e-4
"""Change of a spot's variance [pixel^2] that templates describe; what they leave of it is at most three
standard deviations of the spots of a campaign of size S.  Measured."""

SECOND = (1.0, -2.0, 1.0)
"""Second difference."""

FAR = 3.0
"""Standard deviations of the card at which the curvature of templates is taken; few devices lie
beyond.  Chosen."""


def changed(device: Device, name: str, sigmas: float) -> Device:
    """The device with one quantity of its card off by so many standard deviations."""
    return replace(device, **{name: getattr(device, name) * (1 + sigmas * SPREAD[name])})


def _straight_and_curved(
    nominal: NDArray, near: Sequence[NDArray], far: Sequence[NDArray]
) -> NDArray:
    """Templates in columns: changes for one sigma of each quantity, then their curvatures."""
    straight = [n - nominal for n in near]
    curved = [f - nominal - FAR * s for f, s in zip(far, straight, strict=True)]
    return np.column_stack([*straight, *curved])


class Optics(Law):
    """Optics of other widths: variances by wavelength added to the spots [pixel^2]."""

    def spot_shape(self, sx, sy, exposure):
        """Widths of the spots [pixel]."""
        x, y = self.values[exposure.wavelength]
        return np.sqrt(sx**2 + x), np.sqrt(sy**2 + y)


class Estimator:
    """Projected SNR of laws in one campaign; the bench without laws is exposed once.

    Parameters
    ----------
    bench : Bench
        Without the laws, with the nuisances.
    """

    def __init__(self, bench: Bench) -> None:
        self.bench = bench
        self.chosen = choose(bench.plan)
        self.base = expose(bench, self.chosen)
        self.lay = bench.layout
        self.monitor_error = MONITOR_ERROR
        for n in bench.laws:
            if not n.values.get("monitor", True):
                self.monitor_error = float(n.values["rms"])
        self.templates = self._device_templates()
        self.spot_templates = self._device_spots()

    def _device_templates(self) -> NDArray:
        """Changes of a_ij for one sigma of each parameter of the card, and curvatures; lags in rows."""
        nominal = self.bench.nominal

        def areas(device: Device) -> NDArray:
            lags = area_changes(*edge_shifts(device, REFERENCE[0]))
            return lags[REACH : REACH + LAGS, REACH : REACH + LAGS].ravel()

        return _straight_and_curved(
            areas(nominal),
            *([areas(changed(nominal, n, z)) for n in SPREAD] for z in (1, FAR)),
        )

    def snr(self, law: Law) -> tuple[float, dict[str, float]]:
        """Projected SNR of a law, and the squares by statistic."""
        twin = Bench(
            self.lay, self.bench.plan, self.bench.nominal, self.bench.seed,
            laws=[*self.bench.laws, law],
        )  # fmt: skip
        # nuisances keep the state of their own bench
        other = expose(twin, self.chosen)
        for n in self.bench.laws:
            n.begin(self.bench.setting)
        parts = {
            "means": self._means(other),
            "covariance": self._covariances(other),
            "blocks": self._blocks(other),
            "maps": self._maps(other),
            "overscans": self._overscans(other),
            "spots": self._spots(other),
            "spectra": self._spectra(other),
            "outliers": self._outliers(other),
            "codes": self._combs(other),
        }
        parts = {k: max(v, 0.0) for k, v in parts.items()}
        return float(np.sqrt(sum(parts.values()))), parts

    # ------------------------------------------------------------ helpers
    def _light(self, frames: list[NDArray]) -> list[NDArray]:
        d = self.lay.data
        return [f[d] for f in frames]

    def _image(self, products: Products, k: int) -> NDArray:
        return self.lay.join(self._light(products.frames[k]))

    def _of(self, *kinds: str) -> list[int]:
        return [k for k, c in enumerate(self.chosen) if c.exposure.kind in kinds]

    def _pairs(self) -> list[tuple[int, int, float]]:
        """Pairs of flats and how many pairs each stands for."""
        by: dict[tuple, list[int]] = defaultdict(list)
        for k in self._of("FLAT"):
            by[self.chosen[k].group].append(k)
        out = []
        for ks in by.values():
            pairs = list(zip(ks[::2], ks[1::2], strict=False))
            out += [(a, b, self.chosen[a].stands_for / 2 / len(pairs)) for a, b in pairs]
        return out

    # ------------------------------------------------------------ statistics
    def _means(self, other: Products) -> float:
        flats, total, count = self._of("FLAT"), 0.0, self.lay.amplifiers
        half = self.lay.height // 2
        for amp in range(count):
            a, b, mu, sigma = [], [], [], []
            for k in flats:
                f0 = self._light(self.base.frames[k])[amp]
                f1 = self._light(other.frames[k])[amp]
                # the median of columns is no place for tracks and rims
                a.append(np.median((f1[:half] - f0[:half]).mean(0, dtype=float)))
                b.append(np.median((f1[half:] - f0[half:]).mean(0, dtype=float)))
                m = f0.mean(dtype=float)
                of_group = sum(c.group == self.chosen[k].group for c in self.chosen)
                n = self.chosen[k].stands_for / of_group
                shot = (abs(m) + NOMINAL_NOISE**2) / f0.size
                mu.append(m)
                sigma.append(np.sqrt((shot + count * (self.monitor_error * m) ** 2) / n))
            if a:
                total += fitted_product(
                    np.array(a), np.array(b), np.array(sigma), np.array(mu)[:, None]
                )
            total += self._dark_levels(other, amp)
        return total

    def _dark_levels(self, other: Products, amp: int) -> float:
        """Level of darks and biases above the overscan, to 0.02 e- (row noise, structure)."""
        if not self.lay.serial_overscan:
            return 0.0
        total, half = 0.0, self.lay.height // 2
        for k in self._of("DARK", "BIAS"):
            of_group = sum(c.group == self.chosen[k].group for c in self.chosen)
            n = self.chosen[k].stands_for / of_group
            d = other.frames[k][amp] - self.base.frames[k][amp]
            light = d[self.lay.data]
            a, b = (
                np.median(part.mean(0, dtype=float)) - over.mean(dtype=float) for part, over in (
                    (light[:half], d[:half, -self.lay.serial_overscan :]),
                    (light[half:], d[half : self.lay.height, -self.lay.serial_overscan :]),
                )
            )  # fmt: skip
            error = (
                NOMINAL_NOISE**2 / (self.lay.height * self.lay.serial_overscan) + 0.02**2
            )
            total += a * b / error * n
        return max(total, 0.0)

    def _covariances(self, other: Products) -> float:
        a, b, sigma, gain, white, device = [], [], [], [], [], []
        lags = LAGS * LAGS
        for i, j, n in self._pairs():
            c0, c1 = self._lags(self.base, i, j), self._lags(other, i, j)
            a.append(c1[0] - c0[0])
            b.append(c1[1] - c0[1])
            mean, spread = c0.mean(0), np.full(lags, c0[:, 0].mean())
            spread[0] *= np.sqrt(2)
            size = self.lay.pixels**2 * n
            sigma.append(spread / np.sqrt(size))
            mu = float(np.mean([f.mean() for f in self._light(self.base.frames[i])]))
            gain.append(mean)
            first = np.zeros(lags)
            first[0] = 1.0
            white.append(first)
            device.append(self.templates * mu * mu)
        if not a:
            return 0.0
        t = np.column_stack(
            [np.concatenate(gain), np.concatenate(white), np.vstack(device)]
        )
        prior = np.r_[0.0, 0.0, np.ones(self.templates.shape[1])]
        return fitted_product(
            np.concatenate(a), np.concatenate(b), np.concatenate(sigma), t, prior
        )

    def _lags(self, p: Products, i: int, j: int) -> NDArray:
        """Covariances of a differenced pair in the halves of all amplifiers, [half, lag]."""
        out = np.zeros((2, LAGS * LAGS))
        for f, g in zip(self._light(p.frames[i]), self._light(p.frames[j]), strict=True):
            d = without_tracks((f - g).astype(np.float32))
            h = len(d) // 2
            for half, part in enumerate((d[:h], d[h:])):
                for y in range(LAGS):
                    for x in range(LAGS):
                        u = part[: h - y, : part.shape[1] - x]
                        v = part[y:h, x:]
                        out[half, y * LAGS + x] += float(np.vdot(u, v)) / (2 * u.size)
        return out / self.lay.amplifiers

    def _blocks(self, other: Products) -> float:
        total, side = 0.0, 16
        for i, j, n in self._pairs():
            rho = []
            for p in (self.base, other):
                d = without_tracks(self._image(p, i) - self._image(p, j))
                m = self.lay.pixels // side
                blocks = d.reshape(m, side, m, side).mean((1, 3))
                blocks = blocks - blocks.mean()
                rho.append(
                    np.array(
                        [np.mean(blocks[: m // 2] ** 2), np.mean(blocks[m // 2 :] ** 2)]
                    )
                )
            ratio = rho[1] / rho[0]
            # a tenth of the change is fitted as gain, noise or scale of the covariances
            total += variance_gain(ratio, blocks.size * n)
        return total

    def _maps(self, other: Products) -> float:
        by: dict[tuple, list[int]] = defaultdict(list)
        for k in self._of("FLAT", "DARK", "BIAS"):
            by[self.chosen[k].group].append(k)
        best, rest = 0.0, 0.0
        for group, ks in by.items():
            if len(ks) < 3:
                continue
            change = []
            for k in ks:
                d = [
                    f1 - f0 for f0, f1 in zip(
                        self._light(self.base.frames[k]), self._light(other.frames[k]), strict=True
                    )
                ]  # fmt: skip
                change.append(np.concatenate([(x - x.mean()).ravel() for x in d]))
            mu = np.concatenate([f.ravel() for f in self._light(self.base.frames[ks[0]])])
            flat = group[0] == "FLAT"
            smooth = abs(float(np.median(mu)))
            var = (smooth + NOMINAL_NOISE**2) / self.chosen[ks[0]].stands_for
            if flat:
                var += (PIXEL_RESPONSE * smooth) ** 2
            products = [
                float(np.vdot(change[a], change[b])) / var
                for a in range(len(ks))
                for b in range(a)
            ]
            # a pattern that changes between exposures is no map
            value = float(np.mean(products)) if min(products) > 0.3 * max(products) else 0.0
            if flat:
                best = max(best, value)
            else:
                rest += max(value, 0.0)
        return max(best, 0.0) + rest

    def _overscans(self, other: Products) -> float:
        lay, total = self.lay, 0.0
        first, top = lay.prescan + lay.width, lay.height
        for k in self._of("FLAT", "SPOT", "DARK"):
            of_group = sum(c.group == self.chosen[k].group for c in self.chosen)
            n = self.chosen[k].stands_for / of_group
            for f0, f1 in zip(self.base.frames[k], other.frames[k], strict=True):
                d = f1 - f0
                if lay.serial_overscan:
                    c = d[:top, first : first + 10]
                    far = d[:top, -4:].mean(dtype=float)
                    a, b = c[: top // 2].mean(0) - far, c[top // 2 :].mean(0) - far
                    total += float(a @ b) * n * top / NOMINAL_NOISE**2
                if lay.parallel_overscan:
                    r = d[top : top + 6, lay.prescan : first]
                    far = d[-4:, lay.prescan : first].mean(dtype=float)
                    a, b = r[:, ::2].mean(1) - far, r[:, 1::2].mean(1) - far
                    total += float(a @ b) * n * lay.width / NOMINAL_NOISE**2
        return total

    def _stamps(self, k: int, image: NDArray) -> NDArray:
        """Cut-outs around the spots of an exposure, [spot, y, x]."""
        n, out = self.lay.pixels, []
        for u, v in zip(*self.bench.spot_places(self.chosen[k].exposure), strict=True):
            u, v = round(u), round(v)
            if STAMP <= u < n - STAMP and STAMP <= v < n - STAMP:
                out.append(image[v - STAMP : v + STAMP + 1, u - STAMP : u + STAMP + 1])
        return np.array(out)

    def _spots(self, other: Products) -> float:
        """The middle spot of each exposure, and what amplifiers and a turned image repeat of it."""
        exposures = self._of("SPOT")
        if not exposures or not self.lay.spots:
            return 0.0
        base, optics = self.base, Optics({})
        for _ in range(8):
            form, change = self._mean_spots(base, other)
            if max(np.abs(list(change.values())).ravel()) < SMALL:
                break
            for colour, (x, y) in change.items():
                had = optics.values.get(colour, (0.0, 0.0))
                # no spot becomes narrower than half of what it was
                optics.values[colour] = tuple(
                    max(h + c, -0.75 * s**2)
                    for h, c, s in zip(had, (x, y), self.bench.spot_sigma, strict=True)
                )
            base = self._seen_through(optics)
        return max(form, 0.0) + sum(
            max(self._echoes(base, other, k), 0.0) for k in exposures
        )

    def _seen_through(self, optics: Law) -> Products:
        """The bench without the law, its spots seen through other optics."""
        exposures = self._of("SPOT")
        laws = [*self.bench.laws, optics]
        twin = Bench(
            self.lay, self.bench.plan, self.bench.nominal, self.bench.seed, laws=laws
        )
        spots = expose(twin, [self.chosen[k] for k in exposures])
        # nuisances keep the state of their own bench
        for n in self.bench.laws:
            n.begin(self.bench.setting)
        frames, codes = list(self.base.frames), list(self.base.codes)
        for q, k in enumerate(exposures):
            frames[k], codes[k] = spots.frames[q], spots.codes[q]
        return Products(frames, codes)

    def _mean_spots(
        self, base: Products, other: Products
    ) -> tuple[float, dict[float, tuple[float, float]]]:
        """Square of the SNR of mean spots; changes of their variances that fit best [pixel^2]."""
        exposures = self._of("SPOT")
        a, b, sigma, wide, own = [], [], [], [], []
        side = 2 * STAMP + 1
        for k in exposures:
            n = self.chosen[k].stands_for
            s0 = self._stamps(k, self._image(base, k))
            d, mean = (
                self._stamps(k, self._image(other, k)) - s0,
                np.maximum(np.median(s0, 0), 0),
            )
            a.append(np.median(d[::2], 0).ravel())
            b.append(np.median(d[1::2], 0).ravel())
            var = (mean + NOMINAL_NOISE**2) / n + (PIXEL_RESPONSE * mean) ** 2
            sigma.append(np.sqrt(var / len(s0)).ravel())
            gy, gx = np.gradient(mean)
            own.append(
                np.column_stack([g.ravel() for g in (mean, gx, gy, np.ones_like(mean))])
            )
            wide.append(
                np.column_stack([correlate1d(mean, SECOND, x).ravel() for x in (1, 0)])
            )
        rows, count = side * side, 4 * len(own)
        devices = self.spot_templates.shape[2]
        colours = [self.chosen[k].exposure.wavelength for k in exposures]
        each = {w: count + 2 * n for n, w in enumerate(dict.fromkeys(colours))}
        first = count + 2 * len(each)
        t = np.zeros((rows * len(own), first + devices))
        for q, block in enumerate(own):
            t[q * rows : (q + 1) * rows, 4 * q : 4 * q + 4] = block
            at = each[colours[q]]
            t[q * rows : (q + 1) * rows, at : at + 2] = wide[q]
            t[q * rows : (q + 1) * rows, first:] = self.spot_templates[q]
        prior = np.r_[np.zeros(first), np.ones(devices)]
        first_half, second_half = np.concatenate(a), np.concatenate(b)
        form = fitted_product(first_half, second_half, np.concatenate(sigma), t, prior)
        sizes = fitted_sizes(
            (first_half + second_half) / 2, np.concatenate(sigma), t, prior
        )
        # a Gaussian's variance grows by twice the size of its second derivative
        return form, {w: tuple(2 * sizes[at : at + 2]) for w, at in each.items()}

    def _echoes(self, base: Products, other: Products, k: int) -> float:
        """Squares of regressions on other amplifiers' and the turned image's signal."""
        n, total = self.chosen[k].stands_for, 0.0
        f0, f1 = base.frames[k], other.frames[k]

        def regressed(change: NDArray, dark: NDArray, signal: NDArray) -> float:
            # even and odd rows are the halves; what is the same everywhere is no echo
            weight = np.where(signal > 50, signal, 0)
            weight = np.where(dark, weight - weight[dark].mean(), 0)
            parts = [float(np.vdot(change[s::2], weight[s::2])) for s in (0, 1)]
            norm = float(np.vdot(weight, weight))
            return 4 * parts[0] * parts[1] / max(norm, 1.0) / NOMINAL_NOISE**2 * n

        lit = np.zeros(self.lay.frame_shape, bool)
        lit[self.lay.data] = True
        change = [np.clip(b - a, -2e3, 2e3) for a, b in zip(f0, f1, strict=True)]
        dark = [lit & (a < 50) for a in f0]
        for v in range(len(f0)):
            for u in range(len(f0)):
                if u == v:
                    continue
                for late in (0, 1, 2):
                    signal = np.zeros_like(f0[u])
                    signal[:, late:] = f0[u][:, : f0[u].shape[1] - late]
                    total += max(regressed(change[v], dark[v], signal), 0.0)
        image = self._image(base, k)
        moved = np.clip(self._image(other, k) - image, -2e3, 2e3)
        return total + max(regressed(moved, image < 50, image[::-1, ::-1]), 0.0)

    def _device_spots(self) -> NDArray:
        """Changes of the mean spot as those of a_ij, [exposure, pixel, p]."""
        if not self.lay.spots:
            return np.zeros((0, 0, 0))
        side, out, shifts = 48, [], {}
        for k in self._of("SPOT"):
            e = self.chosen[k].exposure
            # all spots of a grid of whole pixels lie alike in their pixels
            u, v = (p[:1] - np.round(p[:1]) + side // 2 for p in self.bench.spot_places(e))
            ix, px, gx = _profile(u, self.bench.spot_sigma[:1], side)
            iy, py, gy = _profile(v, self.bench.spot_sigma[1:], side)
            one = [
                SPOT_FLUX * u.T @ v
                for u, v in ((iy, ix), (iy, px), (py, ix), (iy, gx), (gy, ix))
            ]
            light = Light(*(i.astype(np.float32) for i in one), seconds=e.seconds)
            stamps = []
            for name, z in [(None, 0.0), *((n, z) for z in (1.0, FAR) for n in SPREAD)]:
                key = (name, z, e.wavelength, e.back_bias)
                if key not in shifts:
                    d = replace(self.bench.nominal, vbb=e.back_bias)
                    shifts[key] = edge_shifts(
                        changed(d, name, z) if name else d, e.wavelength
                    )
                edges = Edges((side, side), [Term(*shifts[key])])
                q = collect(light, edges, np.random.default_rng(1), noise=False)
                low, high = side // 2 - STAMP, side // 2 + STAMP + 1
                stamps.append(q[low:high, low:high].ravel().astype(float))
            count = len(SPREAD)
            out.append(
                _straight_and_curved(stamps[0], stamps[1 : count + 1], stamps[count + 1 :])
            )
        return np.array(out)

    def _spectra(self, other: Products) -> float:
        """Power of biases in readout order, frame levels, rows, and products of amplifiers."""
        biases, total = self._of("BIAS"), 0.0
        n = self.chosen[biases[0]].stands_for
        if all(
            np.array_equal(self.base.codes[k][a], other.codes[k][a])
            for k in biases
            for a in range(self.lay.amplifiers)
        ):
            return 0.0
        for amp in range(self.lay.amplifiers):
            power = [[welch(p.frames[k][amp]) for k in biases] for p in (self.base, other)]
            r = np.array(power[1]) / np.array(power[0])
            halves = np.array([r[::2].mean(0), r[1::2].mean(0)])
            segments = self.base.frames[0][amp].size / 512 * n
            total += sum(variance_gain(h, 2 * segments) for h in halves.T)
            level = [
                [p.frames[k][amp].mean(dtype=float) for k in biases]
                for p in (self.base, other)
            ]
            error = (NOMINAL_NOISE**2 / self.base.frames[0][amp].size) + 0.02**2
            total += (n - 1) * gain(1 + (np.var(level[1]) - np.var(level[0])) / error)
        for one in range(self.lay.amplifiers):
            for two in range(one):
                c = []
                for p in (self.base, other):
                    c.append(
                        [
                            np.mean(white(p.frames[k][one]) * white(p.frames[k][two]))
                            for k in biases
                        ]
                    )
                d = np.array(c[1]) - np.array(c[0])
                size = self.base.frames[0][one].size * n
                total += float(d[::2].mean() * d[1::2].mean()) * size / NOMINAL_NOISE**4
        return total

    def _outliers(self, other: Products) -> float:
        total = 0.0
        for k in self._of("BIAS", "DARK"):
            of_group = sum(c.group == self.chosen[k].group for c in self.chosen)
            total += self._beyond(other, k, None) * self.chosen[k].stands_for / of_group
        for i, j, n in self._pairs():
            total += self._beyond(other, i, j) * n
        return total

    def _beyond(self, other: Products, i: int, j: int | None) -> float:
        """2 ln of the ratio of Poisson probabilities of the number of clusters of outliers."""
        counts = []
        for p in (self.base, other):
            total = 0.0
            for amp in range(self.lay.amplifiers):
                f = self._light(p.frames[i])[amp]
                f = f - self._light(p.frames[j])[amp] if j is not None else f
                f = f - np.median(f, axis=0)
                sigma = 1.4826 * np.median(np.abs(f[::3]))
                total += float(np.count_nonzero(np.abs(f) > 6 * sigma))
            # neighbours belong to one track
            counts.append(total / 4)
        before, after = max(counts[0], 0.1), counts[1]
        if after <= before:
            return 0.0
        return 2 * (after * np.log(after / before) - (after - before))

    def _combs(self, other: Products) -> float:
        """Comb in the codes of flats whose histograms are wide; nothing that scatters about zero."""
        values, count = [], 0.0
        for k in self._of("FLAT"):
            of_group = sum(c.group == self.chosen[k].group for c in self.chosen)
            n = self.chosen[k].stands_for / of_group
            light = self.lay.data
            for f0, f1 in zip(self.base.codes[k], other.codes[k], strict=True):
                f0, f1 = f0[light], f1[light]
                if np.std(f0) < 40:
                    continue
                low = int(min(f0.min(), f1.min()))
                size = int(max(f0.max(), f1.max())) - low + 1
                half = len(f0) // 2
                h = [
                    [
                        np.bincount((part - low).ravel(), minlength=size)
                        for part in (f[:half], f[half:])
                    ]
                    for f in (f0, f1)
                ]
                d = [comb(h[1][s] - h[0][s]) for s in (0, 1)]
                expected = smooth(h[0][0] + h[0][1])
                good = expected > 5
                values.append(4 * float(np.sum(d[0][good] * d[1][good] / expected[good])))
                count += n
        if len(values) < 2:
            return 0.0
        mean, error = np.mean(values), np.std(values) / np.sqrt(len(values) - 1)
        # a comb is in all flats; what common random numbers leave scatters about zero
        return float(count * mean) if mean > 3 * error else 0.0


def find_amplitude(
    estimator: Estimator,
    law: Law,
    wanted: float,
    *,
    start: float | None = None,
    rounds: int = 4,
) -> dict[str, Any]:
    """Scale a law's amplitude to a wanted projected SNR, within its limits.

    Returns
    -------
    dict
        ``snr`` (as estimated for the final amplitude), ``parts``, ``wanted``, ``limited``.
    """
    low, high = type(law).limits
    law.setting = estimator.bench.setting
    size = float(np.clip(start or type(law).start, low, high))
    value, parts = 0.0, {}
    for turn in range(rounds):
        law.set_amplitude(size)
        size = law.size
        value, parts = estimator.snr(law)
        if not type(law).scaled or turn == rounds - 1 or 0.75 < value / wanted < 1.35:
            break
        # a signal below 3 sigma is measured too badly to scale from
        factor = (wanted / max(value, 2.0)) ** (1 / type(law).power)
        new = float(np.clip(size * np.clip(factor, 0.01, 100.0), low, high))
        if abs(new / size - 1) < 0.02:
            break
        size = new
    return {
        "snr": value,
        "parts": parts,
        "wanted": wanted,
        "limited": not 0.5 < value / wanted < 2,
    }
