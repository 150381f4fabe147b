"""Measure all channels of a campaign from its exposures, one exposure or pair in memory at a time."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bfsensor.device.condition import Condition
from bfsensor.diagnose.data.bench_nuisances import assumed_errors, bench_nuisances
from bfsensor.diagnose.data.bias_channels import (
    BiasChannels,
)
from bfsensor.diagnose.data.channels import Channel
from bfsensor.diagnose.data.code_channels import CodeChannels, CrosstalkChannels
from bfsensor.diagnose.data.cosmetics import (
    Cosmetic,
    RepairedFrame,
    bridged,
    find_cosmetics,
    interpolated,
    repaired_of,
)
from bfsensor.diagnose.data.dark_channels import (
    DarkChannels,
    count_groups,
    count_tails,
    without_hot_columns,
)
from bfsensor.diagnose.data.exposure_info import (
    LAMP_ERROR,
    ExposureInfo,
    Frame,
    Source,
    assign_folds,
    condition_of,
    is_held_out,
    numbers_of,
    zero_folds,
    zero_pixels,
)
from bfsensor.diagnose.data.flat_channels import (
    FlatChannels,
    OverscanZero,
    leave_out_struck,
)
from bfsensor.diagnose.data.flat_pairing import (
    Flat,
    PairFinder,
    UnlikePair,
    by_level,
    describe_unlike,
    find_steps,
    group_flats,
    scan_unlike,
)
from bfsensor.diagnose.data.map_channels import MapChannels, MapShare
from bfsensor.diagnose.data.spot_channels import SpotChannels
from bfsensor.diagnose.data.spot_ghosts import describe_ghosts, find_ghosts
from bfsensor.diagnose.data.spot_places import PlacedSpots
from bfsensor.effects.effect import Segment, Shot
from bfsensor.errors import MeasurementError
from bfsensor.typing import FloatArray


@dataclass(frozen=True, eq=False)
class MeasuredChannels:
    """Measured channels of a campaign, and the properties of the campaign that predictions need.

    Attributes
    ----------
    channels : tuple of Channel
        Channels of all folds.
    amplifiers : tuple of str
        Names of the amplifiers, in the order of the axis 'amp'.
    gains : tuple of float
        Rough gains from mean over variance at low levels [e-/ADU].
    read_noise : tuple of float
        Read noise of each amplifier [ADU]; nan where not known.
    phases : tuple of ndarray, shape (n, 2)
        Centres of the spots within their pixels, by exposure [pixel].
    columns : tuple of int
        Number of columns of each amplifier, prescan included, that charge is shifted through.
    flips : tuple of (bool, bool)
        Whether each amplifier reads backwards in x and y.
    origins : tuple of (int, int)
        Lower left corner (x, y) of each amplifier on the sensor [pixel].
    shape : (int, int)
        Rows and columns of the sensor; (0, 0) where nothing is known of pixels.
    notes : tuple of str
        Sentences on what could not be measured, and why.
    lamp_known : bool
        Whether every flat has a reading of the lamp monitor.
    lamp_error : float
        Relative error of such a reading.
    counts : mapping of str to int
        Number of exposures of each kind.
    unlike : tuple of UnlikePair
        Differences of flats of unlike exposure, which are in no channel.
    segments : tuple of Segment
        Position of each amplifier, with the depths of its prescan and overscans.
    shots : tuple of Shot
        All exposures in order of time, with levels [e-] by the mean of the rough gains.
    maps : mapping of (fold, map) to tuple of MapShare
        Contributions of flats to each map.
    neighbours : (float, float)
        Pitch of the grid of spots [pixel], and part of a spot's four neighbours that exist, 0 to 1.
    offsets : tuple of float
        Mean overscan of each amplifier in one exposure [ADU]; nan without overscan.
    biases : tuple of int
        Numbers of the exposures in the mean bias.
    placed : tuple of PlacedSpots
        Spots of all folds, in order of time.
    """

    channels: tuple[Channel, ...]
    amplifiers: tuple[str, ...]
    gains: tuple[float, ...]
    read_noise: tuple[float, ...]
    phases: tuple[FloatArray, ...]
    columns: tuple[int, ...]
    flips: tuple[tuple[bool, bool], ...]
    origins: tuple[tuple[int, int], ...]
    shape: tuple[int, int]
    notes: tuple[str, ...] = ()
    lamp_known: bool = True
    lamp_error: float = LAMP_ERROR
    counts: Mapping[str, int] = field(default_factory=dict)
    unlike: tuple[UnlikePair, ...] = ()
    segments: tuple[Segment, ...] = ()
    shots: tuple[Shot, ...] = ()
    maps: Mapping[tuple[str, str], tuple[MapShare, ...]] = field(default_factory=dict)
    neighbours: tuple[float, float] = (np.inf, 0.0)
    offsets: tuple[float, ...] = ()
    biases: tuple[int, ...] = ()
    sightings: tuple[Mapping[str, Any], ...] = ()
    """Waves and rings detected in maps, as starting points of fits: see
    :func:`bfsensor.diagnose.data.map_waves.find_patterns`."""
    placed: tuple[PlacedSpots, ...] = ()
    cosmetics: tuple[Cosmetic, ...] = ()
    """Defects of the sensor that were repaired before anything was measured."""


def measure_channels(
    source: Source,
    *,
    lags: int = 4,
    progress: Callable[[int, int], None] | None = None,
    ghosts: bool | Mapping[int, list[NDArray[np.bool_]]] = True,
) -> MeasuredChannels:
    """Measure all channels that a campaign's exposures allow.

    Parameters
    ----------
    source : Source
        Campaign, with exposures in order of time.
    lags : int
        Largest lag of the flats' covariances [pixel], at least 1.
    progress : callable, optional
        Called after each exposure with the number read and the number of all.
    ghosts : bool, or mapping of int to list of ndarray of bool
        Whether biases and darks with persistence of earlier spots are detected: such biases are
        then used for their levels alone, such darks not at all.  With False all are used, so
        that campaigns with and without an effect have the same values.  A mapping, as by
        :func:`~bfsensor.diagnose.data.spot_ghosts.find_ghosts`, names these exposures.

    Returns
    -------
    measured : MeasuredChannels
        Pairs of flats are spread over the folds; of ten or more other exposures of a kind one in
        five is held out, all others are in the fold 'fit'.

    Raises
    ------
    MeasurementError
        No exposure is a bias, dark, flat or image of spots, or nothing can be measured.

    Examples
    --------
    >>> class Nothing:
    ...     exposures, lamp_error, shape, read = (), 2e-4, (512, 512), None
    >>> measure_channels(Nothing())
    Traceback (most recent call last):
    bfsensor.errors.MeasurementError: no bias, flat, dark or spots among no exposures

    A campaign on disk is measured by ``measure_channels(CampaignSource(read_campaign(folder)))``,
    with :class:`bfsensor.diagnose.model.open_baseline.CampaignSource` and
    :func:`bfsensor.recording.campaign.campaign.read_campaign`.
    """
    exposures = list(source.exposures)
    kinds: dict[str, list[ExposureInfo]] = {}
    for exposure in exposures:
        kinds.setdefault(exposure.kind, []).append(exposure)
    notes: list[str] = []
    done = 0

    def read(exposure: ExposureInfo) -> Sequence[Frame]:
        nonlocal done
        frames = source.read(exposure)
        done += 1
        if progress is not None:
            progress(done, len(exposures))
        return frames

    if isinstance(ghosts, bool):
        haunted = find_ghosts(exposures, source.read) if ghosts else {}
    else:
        haunted = dict(ghosts)
    if haunted:
        notes.append(describe_ghosts(haunted, exposures))
    source, cosmetics = find_cosmetics(
        source, [e for e in exposures if e.number not in haunted]
    )
    biases, late_biases = BiasChannels(), BiasChannels("held-out")
    in_mean: list[int] = []
    zeros: dict[str, list[OverscanZero]] = {}
    for exposure in kinds.get("bias", []):
        if exposure.number in haunted:
            biases.add_level(exposure, read(exposure), haunted[exposure.number])
    quiet = [e for e in kinds.get("bias", []) if e.number not in haunted]
    for n, exposure in enumerate(quiet):
        # Noise is measured in differences of two frames, which share a fold.
        held = is_held_out(n // 2, len(quiet) // 2)
        bias_frames = read(exposure)
        (late_biases if held else biases).add(exposure, bias_frames)
        for fold in zero_folds(n, len(quiet)):
            own = zeros.setdefault(fold, [OverscanZero() for _ in bias_frames])
            for zero, frame in zip(own, bias_frames, strict=True):
                zero.add(frame)
        if not held:
            in_mean.append(exposure.number)
    bias_images: dict[str, FloatArray] = {}
    layout: Sequence[Frame] | None = None
    groups = group_flats(kinds.get("flat", []))
    if not any(kinds.get(kind) for kind in ("flat", "spot", "bias", "dark")):
        raise MeasurementError(
            "no bias, flat, dark or spots among "
            f"{', '.join(f'{len(v)} {k}' for k, v in kinds.items()) or 'no exposures'}"
        )
    first = next(
        kinds[kind] for kind in ("flat", "spot", "bias", "dark") if kinds.get(kind)
    )[0]
    layout = source.read(first)
    for frame in layout:
        if (whole := biases.mean(frame.name)) is not None:
            bias_images[frame.name] = _data_section(frame, whole)
    for each in (biases, late_biases):
        each.forget_mean()
    noise = biases.read_noise
    tails, pulses = [], []
    for exposure in quiet:
        if exposure.number in in_mean:
            bias_frames = source.read(exposure)
            known_noise = bias_images, noise, biases.frames
            tails.append(count_tails(bias_frames, *known_noise))
            pulses.append(count_groups(bias_frames, *known_noise))
            biases.add_third(bias_frames, bias_images)
    steps = find_steps(kinds.get("flat", []))
    cosmetics += tuple(bench_nuisances(
        biases, bias_images, tails, kinds.get("flat", []), steps, source.shape
    ))  # fmt: skip
    start = min((e.mjd for e in exposures if e.mjd is not None), default=np.nan)
    flats = FlatChannels(
        bias_images,
        noise,
        lamp_error=source.lamp_error,
        lags=lags,
        start=start,
        steps=steps,
        zeros=zeros,
        pulses=biases.pulses()[0],
    )
    longest: dict[Condition, float] = {}
    for flat in kinds.get("flat", []):
        condition = condition_of(flat)
        longest[condition] = max(longest.get(condition, 0.0), flat.exposure_time or 0.0)
    amplifiers = [
        np.s_[s.y : s.y + s.rows, s.x : s.x + s.columns] for s in map(_segment, layout)
    ]
    maps, late_maps = (
        MapChannels(source.shape, longest, fold, amplifiers) for fold in ("fit", "held-out")
    )
    codes, late_codes = CodeChannels(), CodeChannels("held-out")
    gains: list[list[float]] = [[] for _ in layout]
    finder = PairFinder(read, lambda frames: _mean_level(flats, frames))
    by_fold = {
        "fit": (maps, codes),
        "select": (maps, codes),
        "held-out": (late_maps, late_codes),
    }
    by_step = by_level(groups, steps)
    levels = _take_pairs(finder, by_step, flats, by_fold, biases, source.shape, notes)
    single = sorted(
        [*finder.single, *(g[0] for g in groups if len(g) == 1)], key=lambda f: f.number
    )
    for n, exposure in enumerate(single):
        fold = "held-out" if is_held_out(n, len(single)) else "fit"
        flats.add_single(exposure, frames := read(exposure), fold=fold)
        levels[exposure.number] = _mean_level(flats, frames)
    unlike = scan_unlike(
        single, lambda flat: [_good(flats, f) for f in read(flat)], lags=lags,
    )  # fmt: skip
    notes += [*finder.notes, *describe_unlike(unlike), *codes.notes, *late_codes.notes]
    # Sums of maps take most memory: they are released before images of spots are read.
    found_maps, late_found_maps = maps.channels(), late_maps.channels()
    notes += [*maps.notes, *(f"held out: {n}" for n in late_maps.notes)]
    shares = {(e.fold, k): v for e in (maps, late_maps) for k, v in e.shares().items()}
    sightings = maps.sightings
    del maps, late_maps, by_fold
    for channel in flats.channels():
        if channel.word == "flat_cov":
            _rough_gains(channel, gains)
    rough = tuple(float(np.median(g)) if g else 1.0 for g in gains)
    known = rough if all(gains) else ()
    darks, late_darks = (
        DarkChannels(
            bias_images, noise, fold, biases=biases.frames, tails=tails, groups=pulses
        )
        for fold in ("fit", "held-out")
    )
    before: dict[int, float] = {}
    last = 0.0
    for exposure in exposures:
        before[exposure.number] = last
        last = levels.get(exposure.number, 0.0)
    seen: dict[float | None, int] = {}
    dark = [e for e in kinds.get("dark", []) if e.number not in haunted]
    times = [e.exposure_time for e in dark]
    for exposure in dark:
        turn = seen.get(exposure.exposure_time, 0)
        seen[exposure.exposure_time] = turn + 1
        # The third of at least four of an exposure time.
        held = turn == 2 and times.count(exposure.exposure_time) >= 4
        (late_darks if held else darks).add(
            exposure, read(exposure), after=before[exposure.number]
        )
    mean_noise = float(
        np.mean([noise.get(f.name, 0.0) * g for f, g in zip(layout, rough, strict=True)])
    )
    spots = SpotChannels(read_noise=mean_noise, lamp_error=source.lamp_error, start=start)
    crosstalk, late_crosstalk = (
        CrosstalkChannels(fold, biases=biases.frames) for fold in ("fit", "held-out")
    )
    for n, exposure in enumerate(kinds.get("spot", [])):
        held = is_held_out(n, len(kinds["spot"]))
        spot_frames = read(exposure)
        images = [
            without_hot_columns(flats.clean(f), noise.get(f.name, 0.0)) for f in spot_frames
        ]
        (late_crosstalk if held else crosstalk).add(
            images, [noise.get(f.name, 1.0) for f in spot_frames]
        )
        image, filled = np.full(source.shape, np.nan), np.zeros(source.shape, bool)
        for frame, cleaned, gain in zip(spot_frames, images, rough, strict=True):
            place(image, frame, cleaned * gain)
            if isinstance(frame, RepairedFrame):
                place(filled, frame, frame.filled)
        levels[exposure.number] = float(np.mean([np.nanmean(i) for i in images]))
        reason = spots.add(
            exposure, image, fold="held-out" if held else "fit", filled=filled
        )
        if reason:
            notes.append(f"spots {exposure.number}: {reason}")
    flats.zero_drift = darks.zero_drift
    channels = [
        *flats.channels(), *found_maps, *codes.channels(), *biases.channels(),
        *darks.channels(known), *spots.channels(), *crosstalk.channels(),
        *late_found_maps, *late_codes.channels(), *late_biases.channels(),
        *late_darks.channels(known), *late_crosstalk.channels(),
    ]  # fmt: skip
    if not channels:
        raise MeasurementError(
            f"nothing can be measured: {len(kinds.get('flat', []))} flats make no pair of equal "
            f"light and level, biases {len(kinds.get('bias', []))} (2 are needed), no dark, no "
            f"spots that could be fitted{'; ' + '; '.join(notes) if notes else ''}"
        )
    notes += [*darks.notes, *assumed_errors(channels)]
    if "bias" not in kinds and any(zero_pixels(f).size == 0 for f in layout):
        notes.append(
            "no bias and no overscan: the zero level is not known and stays in the levels, "
            "read noise is not known"
        )
    return MeasuredChannels(
        channels=tuple(channels),
        amplifiers=tuple(f.name for f in layout),
        gains=rough,
        read_noise=tuple(noise.get(f.name, np.nan) for f in layout),
        phases=tuple(spots.phases),
        columns=tuple(f.image.shape[1] + f.prescan.shape[1] for f in layout),
        flips=tuple((f.flip_x, f.flip_y) for f in layout),
        origins=tuple(f.origin or (0, 0) for f in layout),
        shape=source.shape,
        notes=tuple(notes),
        lamp_known=all(e.lamp is not None for e in kinds.get("flat", [])),
        lamp_error=source.lamp_error,
        counts={k: len(v) for k, v in kinds.items()},
        unlike=tuple(unlike),
        segments=tuple(_segment(f) for f in layout),
        shots=_shots(exposures, levels, float(np.mean(rough))),
        maps=shares,
        neighbours=spots.neighbours,
        placed=tuple(spots.placed),
        offsets=tuple(
            float(f.serial_overscan.mean()) if f.serial_overscan.size else np.nan
            for f in layout
        ),
        biases=tuple(in_mean),
        sightings=sightings,
        cosmetics=cosmetics,
    )


def _take_pairs(
    finder: PairFinder,
    by_step: Sequence[Sequence[Sequence[ExposureInfo]]],
    flats: FlatChannels,
    by_fold: Mapping[str, tuple[MapChannels, CodeChannels]],
    biases: BiasChannels,
    shape: tuple[int, int],
    notes: list[str],
) -> dict[int, float]:
    """Read all pairs of flats, level by level; returns the mean level of each flat [ADU]."""
    levels: dict[int, float] = {}
    for members in sorted(by_step, key=lambda m: m[0][0].exposure_time or 0.0):
        folds = iter(
            assign_folds(range(sum(len(g) // 2 for g in members)), shift=len(levels))
        )
        for pair in finder.pairs(members):
            fold = next(folds)
            try:
                flats.add_pair(*pair, fold=fold)
            except MeasurementError as error:
                notes.append(f"flats {pair[0][0].number}, {pair[1][0].number}: {error}")
                continue
            levels |= _add_to_maps(pair, flats, *by_fold[fold], biases, shape)
    return levels


def _add_to_maps(
    pair: Sequence[Flat],
    flats: FlatChannels,
    maps: MapChannels,
    codes: CodeChannels,
    biases: BiasChannels,
    shape: tuple[int, int],
) -> dict[int, float]:
    """Add a pair of flats to maps and codes; returns the mean level of either [ADU]."""
    filled = np.zeros(shape, bool)
    departures = [np.full(shape, np.nan, np.float32) for _ in pair]
    means: list[list[float]] = [[] for _ in pair]
    for both in zip(*(frames for _, frames in pair), strict=True):
        values = [_good(flats, frame) for frame in both]
        leave_out_struck(*values)
        for frame, own, image, mean in zip(both, values, departures, means, strict=True):
            mean.append(float(np.nanmean(own)))
            place(image, frame, own / mean[-1] - 1.0)
            place(filled, frame, repaired_of(frame))
    for _, frames in pair:
        codes.add(frames)
    levels = {e.number: float(np.mean(m)) for (e, _), m in zip(pair, means, strict=True)}
    first, (_, frames) = pair[0][0], pair[1]
    noise = [
        biases.read_noise.get(f.name, 0.0) / np.sqrt(max(biases.frames, 1)) / m
        for f, m in zip(frames, means[1], strict=True)
    ]
    maps.add_pair(
        condition_of(first), first.exposure_time or 0.0, departures[0], departures[1],
        level=levels[first.number], shared=float(np.sqrt(np.mean(np.square(noise)))),
        filled=filled,
    )  # fmt: skip
    return levels


def _segment(frame: Frame) -> Segment:
    rows, columns = frame.image.shape
    x, y = frame.origin or (0, 0)
    depth = [strip.shape[axis] if strip.size else 0 for strip, axis in (
        (frame.prescan, 1), (frame.serial_overscan, 1), (frame.parallel_overscan, 0))]  # fmt: skip
    return Segment(x, y, columns, rows, frame.flip_x, frame.flip_y, *depth)


def _shots(
    exposures: Sequence[ExposureInfo], levels: Mapping[int, float], gain: float
) -> tuple[Shot, ...]:
    """All exposures as effects need them; their level is 0 unless they are flats or spots."""
    times = [e.mjd for e in exposures if e.mjd is not None]
    out = []
    for e in exposures:
        hours = 0.0 if e.mjd is None else 24.0 * (e.mjd - min(times))
        level = gain * levels.get(e.number, 0.0)
        out.append(
            Shot(
                e.kind,
                e.number,
                e.exposure_time or 0.0,
                *numbers_of(condition_of(e)),
                hours,
                level,
            )
        )
    return tuple(out)


def place(image: NDArray, frame: Frame, values: NDArray) -> None:
    """Copy an amplifier's values, in readout order, to their place in an image of the sensor.

    Parameters
    ----------
    image : ndarray, shape (ny, nx)
        Image of the sensor, changed in place.
    frame : Frame
        Gives the origin and the readout directions.
    values : ndarray, shape of ``frame.image``
        Values in readout order.
    """
    values = values[:, ::-1] if frame.flip_x else values
    values = values[::-1] if frame.flip_y else values
    x, y = frame.origin or (0, 0)
    image[y : y + values.shape[0], x : x + values.shape[1]] = values


def _data_section(frame: Frame, whole: FloatArray) -> FloatArray:
    """Cut the image, without prescan and overscans, out of a whole frame."""
    start = frame.prescan.shape[1] if frame.prescan.ndim == 2 else 0
    ny, nx = frame.image.shape
    return whole[:ny, start : start + nx]


def _mean_level(flats: FlatChannels, frames: Sequence[Frame]) -> float:
    return float(np.mean([np.nanmean(_good(flats, f)) for f in frames]))


def _good(flats: FlatChannels, frame: Frame) -> FloatArray:
    """Clean image, nan where a pixel is masked; defects have their neighbours' values."""
    repaired = repaired_of(frame)
    image = bridged(interpolated(flats.clean(frame), repaired | frame.mask), frame)
    return np.where(frame.mask & ~repaired, np.nan, image)


def _rough_gains(channel: Channel, gains: list[list[float]]) -> None:
    """Gain from mean over variance at low levels [e-/ADU]."""
    a = channel.axes
    variance = (a["i"] == 0) & (a["j"] == 0)
    for amp, found in enumerate(gains):
        rows = variance & (a["amp"] == amp)
        if not rows.any():
            continue
        level, value = a["level"][rows], channel.values[rows]
        # Full pixels have hardly any variance, and would make the gain too high.
        rising = value >= 0.5 * np.median(value / level) * level
        level, value = level[rising], value[rising]
        # The slope of variance against level at level 0: read noise is an offset, and the
        # brighter-fatter effect makes the curve quadratic, by a sixth of the slope at half of a
        # full well.
        degree = min(2, len(set(level)) - 1)
        slope = np.polyfit(level, value, degree, w=1 / value)[-2] if degree > 0 else 0.0
        found.append(1.0 / slope if slope > 0 else float(level[0] / value[0]))
