"""Channel 'spot': widths, flux, skewness and wings of images of spots, by exposure."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter
from scipy.spatial import cKDTree
from scipy.special import ndtr

from bfsensor.device.condition import Condition
from bfsensor.diagnose.data.bias_channels import STANDS_OUT
from bfsensor.diagnose.data.channels import FOLDS, Channel
from bfsensor.diagnose.data.exposure_info import (
    NUMBERS,
    REPEATS,
    Axes,
    ExposureInfo,
    condition_of,
)
from bfsensor.diagnose.data.flat_channels import LAMP_UNKNOWN
from bfsensor.diagnose.data.lamp_settings import smoothed_levels
from bfsensor.diagnose.data.spot_places import PlacedSpots
from bfsensor.errors import MeasurementError
from bfsensor.measure.spot_fit import fit_spots
from bfsensor.measure.spots import SpotList, cut_stamps, find_spots
from bfsensor.typing import FloatArray

STAMP = 11
"""Side of the stamps in which spots are fitted [pixel].  Chosen: it holds a Gaussian of sigma
1.2 pixels to 1e-5; with 21 wings beyond a Gaussian would widen the fitted spots."""

WING = 21
"""Side of the larger stamps whose sum is a spot's flux [pixel].  Chosen: with 41 those of
neighbours 30 pixels apart overlap."""

CLIP = 8.0
"""Median deviations above which a pixel of a stamp's rim has no part in the background.  Chosen:
5.4 sigma of Gaussian noise, exceeded by 7e-8 of pixels; with 16, faint tracks raise the
background."""

QUIET = 2.0
"""Smallest median deviation of a pixel that is used for that [e-].  Derived: 0.6745 of a read
noise of 3 e-, so that noiseless predictions are clipped like recordings; with 4, wings of up to
32 e- per pixel would count in the background."""

SOFT = 0.6
"""Gaussian width of the ends of the square beyond which light is in the wings [pixel].  Chosen: the part
outside of a Gaussian spot of sigma 1.5 pixels then depends on its place within a pixel by 5e-6 of the
flux, with sharp ends by 4e-4; with 0.9, the spot's own tail there is 0.4 instead of 0.16 %."""

BACKGROUND_ERROR = 0.05
"""Systematic error of the background of an exposure of spots, beside which their wings are measured [e-
per pixel].  Chosen: in three campaigns without effects, whose spots have no tail there, wings of bright
spots depart from the prediction by 0.014; twice as large, wings must hold twice the light to be found
in bright spots."""

TAIL_ERROR = 0.1
"""Relative error of the wings that are predicted for Gaussian spots.  Chosen: in three campaigns without
effects, where these hold 0.05 to 0.11 % of the flux, bright spots depart by 4 to 6 % of them, which is
how well the brighter-fatter effect is predicted so far out; twice as large, wings of wide spots must
hold twice the light to be found."""


WINGS_ALIKE = 4e-5
"""Error that wings of spots at the same places have alike in all exposures [fraction of the flux].

Measured: in four practice campaigns without wings they depart from the prediction by means of -1, -1, 2
and 6 e-5, which is 3 and 4 standard deviations in two of them if each exposure's error is taken as
its own; wings were then named beside three of seven other effects.  Twice as large, wings must hold
twice the light to be found in many exposures."""

MOMENTS = "skew_x", "skew_y", "wings"
"""Moments of spots whose mean over an exposure's spots has the error of their scatter."""

PLACES = {name: n for n, name in enumerate(("sigma_x", "sigma_y", *MOMENTS))}
"""Place of each value in the covariance of an exposure's spots."""

EQUAL = 0.01
"""Relative difference of exposure time and lamp up to which exposures are of equal light.  Chosen:
shutters differ by less than 2 ms in a second; series of levels differ by more.  With 0.02, series of
small steps are taken for repeated exposures, and a nonlinear response for scatter."""


class SpotChannels:
    """Measures images of spots on the sensor in electrons, one by one, and gives their channel.

    Parameters
    ----------
    read_noise : float
        Read noise of a pixel [e-].
    lamp_error : float
        Relative error of the lamp monitor.
    start : float
        Time of the first exposure of the campaign [MJD]; nan where not known.

    Attributes
    ----------
    placed : list of PlacedSpots
        Spots of all measured exposures.
    """

    def __init__(
        self, *, read_noise: float, lamp_error: float, start: float = np.nan
    ) -> None:
        self._noise, self._lamp_error, self._start = read_noise, lamp_error, start
        self._rows: list[
            tuple[ExposureInfo, dict[str, tuple[float, float]], NDArray, str]
        ] = []
        self._backgrounds: dict[int, float] = {}
        self._zeros: dict[int, float] = {}
        self._counting: dict[int, float] = {}
        self._scatter: dict[int, tuple[int, FloatArray]] = {}
        self.dropped: dict[str, int] = {}
        self._grids: list[tuple[float, float]] = []
        self.placed: list[PlacedSpots] = []

    def add(
        self,
        exposure: ExposureInfo,
        image: FloatArray,
        *,
        fold: str = "fit",
        filled: NDArray[np.bool_] | None = None,
    ) -> str | None:
        """Measure an exposure.

        Parameters
        ----------
        exposure : ExposureInfo
            Its header.
        image : ndarray, shape (ny, nx)
            Image on the sensor [e-]; nan where nothing is read.
        fold : str
            Fold of its values.
        filled : ndarray of bool, shape (ny, nx), optional
            Pixels whose values are their neighbours'; spots on them are left out, where at least
            half of all are not.

        Returns
        -------
        reason : str or None
            Why it could not be measured; None if it was.
        """
        background = float(np.nanmedian(image))
        peak = float(np.nanpercentile(image, 99.9)) - background
        if peak < 10 * max(self._noise, 1.0):
            return "no spots are ten times brighter than the noise"
        whole = np.where(np.isfinite(image), image, background)
        try:
            spots = find_spots(
                whole, threshold=background + 0.3 * peak, separation=WING // 2, stamp=STAMP
            )
            inside = _inside(spots, whole.shape, WING // 2 + 1)
            if filled is not None and filled.any():
                inside = _off(inside, filled)
            if len(inside) < 4:
                return f"{len(inside)} spots lie inside, 4 are needed"
            stamps = cut_stamps(whole, inside, size=STAMP)
            fit = fit_spots(
                stamps, read_noise=self._noise, weights="equal", largest_offset=1.5
            )
        except MeasurementError as error:
            return str(error)
        used = fit.used
        if used.sum() < 4:
            return f"{int(used.sum())} spots could be fitted, 4 are needed"
        wide = cut_stamps(whole, inside, size=WING).electrons[used]
        values = stamp_moments(wide, fit.centre_x[used], fit.centre_y[used])
        n = used.sum()
        errors = np.sqrt(np.diag(fit.scatter_covariance))
        out = {
            "sigma_x": (fit.sigma_x, float(errors[0])),
            "sigma_y": (fit.sigma_y, float(errors[1])),
        }
        self._backgrounds[exposure.number] = float(np.mean(values.pop("background")))
        self._zeros[exposure.number] = float(np.mean(values.pop("beyond")))
        flux = values.pop("flux")
        total = float(flux.mean())
        out["flux"] = (total, float(flux.std(ddof=1) / np.sqrt(n)))
        self._counting[exposure.number] = _counting_variance(total, wide) / int(n)
        for name, column in values.items():
            out[name] = (float(column.mean()), float(column.std(ddof=1) / np.sqrt(n)))
        spread = np.diag([1e-30, 1e-30, *(n * out[name][1] ** 2 for name in MOMENTS)])
        # Light in a corner of the stamps widens a spot in x and in y.
        spread[:2, :2] += n * fit.scatter_covariance[:2, :2]
        self._scatter[exposure.number] = int(n), spread
        phases = np.stack([fit.centre_x[used], fit.centre_y[used]], axis=1)
        self._rows.append((exposure, out, phases, fold))
        self._grids.append(_grid(inside))
        corners = np.column_stack([stamps.x, stamps.y])[used]
        self.placed.append(
            PlacedSpots(
                exposure.number, total, (fit.sigma_x, fit.sigma_y), corners + phases
            )
        )
        return None

    def channels(self) -> list[Channel]:
        """Channels 'spot' by fold: widths, fluxes, skewness and wings of each exposure."""
        return [self._channel(fold) for fold in self._folds]

    @property
    def _folds(self) -> list[str]:
        """Folds of the measured exposures, 'fit' first."""
        return [f for f in FOLDS if any(row[3] == f for row in self._rows)]

    def _channel(self, fold: str) -> Channel:
        values, variances, axes = [], [], Axes()
        repeat, scatter_of = self._flux_scatter(), self._pooled()
        # Wings come last, in one block: they have an error in common.
        rows = [
            (exposure, found, what)
            for wings in (False, True)
            for exposure, found, _, own in self._rows
            for what in found
            if own == fold and (what == "wings") == wings
        ]
        for exposure, found, what in rows:
            lamp = exposure.lamp
            light = _light_of(exposure)
            mjd = np.nan if exposure.mjd is None else exposure.mjd
            # Noise that is skew, as of random telegraph signals, has another mean than without
            # its largest values, which count in a flux and not in its background.
            zero = self._zeros[exposure.number]
            value, error = found[what]
            own = scatter_of[exposure.number]
            variance = own[PLACES[what], PLACES[what]] if what in PLACES else error**2
            if what == "flux":
                # Pinholes differ in brightness, and the same ones are seen in all exposures:
                # the scatter between exposures of equal light beyond what counting makes is the
                # error.  Without enough of these it is that of the mean over pinholes, which is
                # larger and holds the counting.
                known = repeat is not None
                scatter = repeat if repeat is not None else error / value
                light_error = (
                    LAMP_UNKNOWN if lamp is None and not known else self._lamp_error
                )
                variance = (value * np.hypot(scatter, light_error)) ** 2
                variance += self._counting[exposure.number] if known else 0.0
                variance += (zero * WING**2) ** 2
            if what == "wings":
                away = np.hypot(zero, BACKGROUND_ERROR)
                variance += (away * (WING**2 - STAMP**2) / found["flux"][0]) ** 2
                variance += (TAIL_ERROR * value) ** 2
            values.append(value)
            variances.append(max(variance, 1e-30))
            axes.add(1, condition_of(exposure), what=what, light=light,
                     flux=found["flux"][0], time=exposure.exposure_time or 0.0,
                     background=self._backgrounds[exposure.number],
                     exposure=exposure.number, hours=24.0 * (mjd - self._start))  # fmt: skip
        columns = axes.columns()
        lit = np.flatnonzero(columns["what"] == "flux")
        place = {int(n): k for k, n in enumerate(columns["exposure"][lit])}
        fluxes = smoothed_levels(
            columns["flux"][lit], columns["light"][lit], [columns[n][lit] for n in NUMBERS],
            within=1 + EQUAL,
        )  # fmt: skip
        columns["flux"] = fluxes[[place[int(n)] for n in columns["exposure"]]]
        singles = columns["what"] != "wings"
        blocks = [
            scatter_of[int(n)][:2, :2] if kind == "sigma_x" else np.array([[v]])
            for kind, n, v in zip(
                columns["what"], columns["exposure"], variances, strict=True
            )
            if kind not in ("sigma_y", "wings")
        ]
        if not singles.all():
            blocks.append(np.diag(np.array(variances)[~singles]) + WINGS_ALIKE**2)
        return Channel("spot", np.array(values), tuple(blocks), columns, "", fold)

    def _alike(self) -> list[list[int]]:
        """Indices of exposures of one condition whose light differs by less than EQUAL."""
        by_condition: dict[Condition, list[tuple[float, int]]] = {}
        for n, (exposure, *_) in enumerate(self._rows):
            rows = by_condition.setdefault(condition_of(exposure), [])
            rows.append((_light_of(exposure), n))
        out = []
        for rows in by_condition.values():
            light, order = (np.array(column) for column in zip(*sorted(rows), strict=True))
            more = np.diff(light) > EQUAL * light[1:]
            out += [p.tolist() for p in np.split(order, np.flatnonzero(more) + 1)]
        return out

    def _flux_scatter(self) -> float | None:
        """Relative scatter of fluxes of equal light beyond that of counting; None with too few."""
        square, number = 0.0, 0
        for group in self._alike():
            rate, counting = [], []
            for exposure, found, *_ in (self._rows[n] for n in group):
                flux = found["flux"][0]
                rate.append(flux / (_light_of(exposure) or 1.0))
                counting.append(self._counting[exposure.number] / flux**2)
            square += float(np.square(np.array(rate) / np.mean(rate) - 1).sum())
            square -= (len(group) - 1) * float(np.mean(counting))
            number += len(group) - 1
        return float(np.sqrt(max(square, 0.0) / number)) if number >= REPEATS else None

    def _pooled(self) -> dict[int, FloatArray]:
        """Covariance of the means of widths and moments over the spots of each exposure.

        Spots of equal light scatter alike, so that their exposures are taken together; one whose
        spots scatter significantly more, as where particles struck them, has its own.
        """
        out = {}
        for group in self._alike():
            numbers = [self._rows[n][0].number for n in group]
            count = np.array([self._scatter[n][0] for n in numbers])
            spreads = np.array([self._scatter[n][1] for n in numbers])
            sizes = np.diagonal(spreads, axis1=1, axis2=2)
            more = 1 + STANDS_OUT * np.sqrt(2.0 / (count - 1))
            apart = (sizes > more[:, None] * np.median(sizes, axis=0)).any(1)
            free = np.where(apart, 0.0, count - 1.0)
            alike = np.tensordot(free, spreads, 1) / max(free.sum(), 1.0)
            for number, n, own, alone in zip(numbers, count, spreads, apart, strict=True):
                out[number] = (own if alone else alike) / n
        return out

    @property
    def phases(self) -> list[FloatArray]:
        """Centres of each exposure's spots within their pixels, shape (n, 2) [pixel].

        In the order of the channels' exposures.
        """
        return [row[2] for fold in self._folds for row in self._rows if row[3] == fold]

    @property
    def neighbours(self) -> tuple[float, float]:
        """Distance of the next spots [pixel], and part of the four places that hold one, 0 to 1."""
        if not self._grids:
            return np.inf, 0.0
        pitch, share = np.median(self._grids, axis=0)
        return float(pitch), float(share)


def _light_of(exposure: ExposureInfo) -> float:
    """Exposure time [s] times the lamp's reading, if any; 0 where the time is not known."""
    return (exposure.exposure_time or 0.0) * (
        1.0 if exposure.lamp is None else exposure.lamp
    )


def _counting_variance(flux: float, wide: FloatArray) -> float:
    """Variance of one spot's flux by its electrons and by the noise of its stamp and background [e-^2].

    The noise of a pixel is that of the stamps' rims, of which the background is the mean: the flux is
    the sum over N pixels less N times the mean of n of them, of variance N (N / n - 1) by their noise.
    """
    rim = _rim(wide)
    away = np.abs(rim - np.median(rim, axis=-1, keepdims=True))
    noise = (1.4826 * float(np.median(away))) ** 2
    pixels = wide[0].size
    return max(flux, 0.0) + noise * pixels * (pixels / rim.shape[-1] - 1.0)


def _rim(wide: FloatArray) -> FloatArray:
    """Outermost pixels of stamps, shape (n, pixels)."""
    return np.concatenate(
        [
            wide[:, [0, -1]].reshape(len(wide), -1),
            wide[:, 1:-1, [0, -1]].reshape(len(wide), -1),
        ],
        axis=1,
    )


def _grid(spots: SpotList) -> tuple[float, float]:
    """Pitch of a square grid of spots [pixel], and part of a spot's four neighbours that exist."""
    places = np.column_stack([spots.x, spots.y])
    tree = cKDTree(places)
    # Itself, and in a square grid its four neighbours and the four on diagonals.
    away, which = tree.query(places, k=min(9, len(places)))
    pitch = float(np.median(away[:, 1]))
    step = np.abs(places[which[:, 1:]] - places[:, None])
    beside = (np.abs(away[:, 1:] - pitch) < 0.1 * pitch) & (step.min(-1) < 0.1 * pitch)
    return pitch, float(beside.sum(1).mean() / 4)


def _inside(spots: SpotList, shape: tuple[int, int], border: int) -> SpotList:
    """Spots whose wide stamps lie inside the image."""
    keep = (
        (spots.x >= border) & (spots.x < shape[1] - border)
        & (spots.y >= border) & (spots.y < shape[0] - border)
    )  # fmt: skip
    return SpotList(spots.x[keep], spots.y[keep], dict(spots.rejected))


def _off(spots: SpotList, filled: NDArray[np.bool_]) -> SpotList:
    """Spots whose stamps hold no filled pixel; all where fewer than half are left."""
    near = maximum_filter(filled, STAMP)[
        np.rint(spots.y).astype(int), np.rint(spots.x).astype(int)
    ]
    if 2 * int((~near).sum()) < max(len(near), 8):
        return spots
    return SpotList(spots.x[~near], spots.y[~near], dict(spots.rejected))


def _clipped_mean(values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean along the last axis without struck pixels and neighbours' light, and what they add.

    The median would be biased by a tenth of a code where codes of the converter have unequal
    widths.  What the left out values add to the mean counts each of them as if it lay at the
    border of those that are used, so that one track does not decide it.
    """
    middle = np.median(values, axis=-1, keepdims=True)
    away = np.abs(values - middle)
    # Predictions have no noise: they are clipped as recordings are.
    usual = np.maximum(np.median(away, axis=-1, keepdims=True), QUIET)
    near = away <= CLIP * usual
    mean = np.asarray((values * near).sum(-1) / near.sum(-1))
    bordered = np.clip(values, middle - CLIP * usual, middle + CLIP * usual)
    return mean, np.asarray(bordered.mean(-1) - mean)


def stamp_moments(
    wide: FloatArray,
    x: FloatArray,
    y: FloatArray,
) -> dict[str, FloatArray]:
    """Flux, skewness along x and y, share of the flux in the wings, and background of each spot.

    Parameters
    ----------
    wide : ndarray, shape (n, 21, 21)
        Images of the spots, larger than those in which they were fitted [e-].
    x, y : ndarray, shape (n,)
        Fitted centres from the middle of the stamps [pixel].

    Returns
    -------
    moments : dict of str to ndarray, shape (n,)
        'skew_x', 'skew_y': mean third power of the distance from the centre, with a Gaussian
        weight of sigma 2 pixels [pixel^3]; 'flux': sum over the wide stamp [e-]; 'background':
        clipped mean of its rim [e- per pixel]; 'beyond': what the clipped pixels
        would add to it [e- per pixel]; 'wings': part of the flux outside a square about the centre
        as large as the small stamp, with soft ends.
    """
    level, beyond = _clipped_mean(_rim(wide))
    signal = wide - level[:, None, None]
    size = wide.shape[-1]
    step = np.arange(size) - size // 2
    dx, dy = step[None] - x[:, None], step[None] - y[:, None]
    # In the larger images, whose ends lie where the weight is 0: the ends of the smaller ones are at
    # other distances from each centre, and wide spots would be skew by their places.
    weight = np.exp(-(dx[:, None] ** 2 + dy[..., None] ** 2) / 8.0)
    flux = (signal * weight).sum((1, 2))
    total = signal.sum((1, 2))
    # Sharp ends would cut spots at distances that depend on their places within pixels.
    inside_x, inside_y = (ndtr((STAMP / 2 - np.abs(d)) / SOFT) for d in (dx, dy))
    small = np.einsum("nij,ni,nj->n", signal, inside_y, inside_x)
    return {
        "skew_x": (signal * weight * dx[:, None] ** 3).sum((1, 2)) / flux,
        "skew_y": (signal * weight * dy[..., None] ** 3).sum((1, 2)) / flux,
        "flux": total,
        "background": level,
        "beyond": beyond,
        "wings": 1.0 - small / total,
    }
