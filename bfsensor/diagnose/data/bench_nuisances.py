"""Nuisances of a bench in every campaign, for report.json: bias structure, drift, pulses, lamp.

All of it is subtracted or fitted by the channels; the list says that it is there and how large.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence

import numpy as np

from bfsensor.diagnose.data.bias_channels import FRAME_ERROR, JUMP, ROW_ERROR, BiasChannels
from bfsensor.diagnose.data.channels import Channel
from bfsensor.diagnose.data.code_channels import HALO_ERROR
from bfsensor.diagnose.data.cosmetics import Cosmetic
from bfsensor.diagnose.data.exposure_info import ExposureInfo, condition_of
from bfsensor.diagnose.data.flat_channels import LAMP_UNKNOWN
from bfsensor.diagnose.data.spot_channels import (
    BACKGROUND_ERROR,
    STAMP,
    TAIL_ERROR,
    WING,
    WINGS_ALIKE,
)
from bfsensor.effects.dark_hot import warmth
from bfsensor.typing import FloatArray

CLEAR = 5.0
"""Significance [standard deviations] from which a nuisance is listed.  Chosen: noise reaches it in 3e-7
of campaigns; with 10, nuisances of twice the size are fitted without being listed."""


def bench_nuisances(
    biases: BiasChannels,
    bias_images: Mapping[str, FloatArray],
    tails: Sequence[Sequence[int]],
    flats: Sequence[ExposureInfo],
    steps: Mapping[int, float],
    shape: tuple[int, int],
) -> list[Cosmetic]:
    """List what biases and the headers of flats show of the bench.

    Parameters
    ----------
    biases : BiasChannels
        All biases of the mean bias.
    bias_images : mapping of str to ndarray
        Mean bias of each amplifier's image above its overscan [ADU].
    tails : sequence of sequence of int
        Pixels of each bias and amplifier in the tails of the noise.
    flats : sequence of ExposureInfo
        All flats.
    steps : mapping of int to float
        Level of each flat by its number.
    shape : (int, int)
        Rows and columns of the sensor.

    Returns
    -------
    found : list of Cosmetic
        Entries of one amplifier, or of the whole sensor with the amplifier -1.
    """
    place = (0, shape[1]), (0, shape[0])
    found = []
    noise = list(biases.read_noise.values())
    for amp, image in enumerate(bias_images.values() if noise else ()):
        size, z = _structure(image, noise[amp] / np.sqrt(max(biases.frames, 1)))
        if z > CLEAR:
            found.append(Cosmetic("bias_structure", amp, *place, size, "adu", z))
    size, z = biases.drift()
    if z > CLEAR:
        found.append(Cosmetic("bias_drift", -1, *place, size, "adu", z))
    pulses, z = biases.pulses()
    if pulses.any():
        length = float(pulses.sum())
        found.append(Cosmetic("popcorn_noise", -1, *place, length, "pixel", z))
    elif len(tails):
        number = np.array(tails, float).sum(1)
        z = float(number.sum() / np.sqrt(number.sum() + 1.0))
        if z > CLEAR:
            unit = "pixels of a frame"
            found.append(
                Cosmetic("heavy_tailed_noise", -1, *place, float(number.mean()), unit, z)
            )
    lamps, times = _scatter(flats, steps)
    for kind, (size, z) in (("lamp_flicker", lamps), ("exposure_time", times)):
        if z > CLEAR:
            found.append(Cosmetic(kind, -1, *place, size, "of the value", z))
    return found


def assumed_errors(channels: Sequence[Channel]) -> list[str]:
    """One sentence on errors that are assumed, with what they cost; none where they cost less than 1 %.

    Examples
    --------
    >>> x = {"what": np.array(["wings"]), "flux": np.array([3.2e5])}
    >>> wide = Channel("spot", np.zeros(1), (np.array([[5e-9]]),), x, "")
    >>> assumed_errors([wide])[0][52:].split("; ")[0]
    'background beside spots 0.05 e- per pixel (effects on wings look 29 % weaker)'
    >>> assumed_errors([wide])[0][52:].split("; ")[1]
    'wings of all spots alike 4e-05 of the flux (effects on wings look 18 % weaker)'
    """
    kinds = (
        ("spot", "wings", BACKGROUND_ERROR, "background beside spots", "e- per pixel", "on wings"),
        ("spot", "wings", TAIL_ERROR, "tails of spots", "of themselves", "on wings"),
        ("spot", "wings", WINGS_ALIKE, "wings of all spots alike", "of the flux", "on wings"),
        ("amp_cross", "crosstalk", HALO_ERROR, "crosstalk", "of the signal", "there"),
        ("flat_mean", None, LAMP_UNKNOWN, "light without a monitor", "of it", "there"),
        ("bias_level", "frames", FRAME_ERROR, "levels of bias frames", "ADU", "there"),
        ("bias_level", "frames", JUMP, "levels of bias frames", "ADU", "there"),
        ("bias_level", "rows", ROW_ERROR, "levels of rows", "ADU", "on rows"),
    )  # fmt: skip
    told = []
    for word, what, floor, name, unit, where in kinds:
        shares = []
        for c in (c for c in channels if c.word == word):
            rows = slice(None) if what is None else c.axes["what"] == what
            variance = np.square(c.errors[rows])
            if what == "frames":
                variance = c.axes["white"][rows]
            elif what == "rows":
                usual = np.square(floor**2 * c.axes["same_row"][rows])
                variance = floor**2 * (1.0 + variance / usual)
            elif floor == WINGS_ALIKE:
                own = np.maximum(variance - floor**2, 1e-300)
                variance = np.array([floor**2 + 1 / np.sum(1 / own)] if own.size else [])
            elif floor == TAIL_ERROR:
                variance = variance / np.maximum(np.square(c.values[rows]), 1e-300)
            elif what == "wings":
                variance = variance * (c.axes["flux"][rows] / (WING**2 - STAMP**2)) ** 2
            elif what is None:
                variance = variance / np.square(c.values)
            shares += (floor**2 / variance).tolist()
        told += _told(shares, f"{name} {floor:g} {unit}", where)
    for c in (c for c in channels if c.word == "dark_map"):
        level, usual = (c.axes["what"] == w for w in ("level", "usual"))
        size = float(np.median(c.errors[usual])) if usual.any() else 0.0
        parts = (size * (c.axes["time"] * warmth(c.axes["temperature"]))[level]) ** 2
        shares = (parts / (parts + np.square(c.errors[level]))).tolist()
        told += _told(
            shares, f"dark current {size:.2g} ADU/s at -100 C", "on levels of darks"
        )
    text = "; ".join(dict.fromkeys(told)).replace("%", " %")
    return [f"assumed errors, which these recordings do not give: {text}"] if told else []


def _told(shares: Sequence[float], what: str, where: str) -> list[str]:
    """Sentence on what an assumed error costs, by its shares of variances; empty below 1 %."""
    share = float(np.median(shares)) if len(shares) else 0.0
    # A floor above the whole error is not the one that was added.
    if not 0.02 < share <= 1.0 + 1e-9:
        return []
    weaker = 1 - float(np.sqrt(max(1 - share, 0.0)))
    return [f"{what} (effects {where} look {weaker:.0%} weaker)"]


def _structure(image: FloatArray, noise: float) -> tuple[float, float]:
    """Standard deviation of rows' and columns' means of a mean bias [ADU], less noise; its deviate."""
    excess, square, count = 0.0, 0.0, 0
    for axis in (0, 1):
        means = np.nanmedian(image, axis=axis)
        # The median of n Gaussian pixels has pi / 2 times the variance of their mean.
        usual = 0.5 * np.pi * noise**2 / image.shape[axis]
        excess += float(means.var()) - usual
        square += float(np.square(means - means.mean()).sum()) / max(usual, 1e-12)
        count += len(means)
    return float(np.sqrt(max(excess, 0.0))), (square - count) / float(np.sqrt(2 * count))


def _scatter(
    flats: Sequence[ExposureInfo], steps: Mapping[int, float]
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Relative scatter of lamp readings and of exposure times within levels, with deviates.

    Headers have no noise: any scatter beyond the digits of a time is certain.
    """
    groups: dict[object, list[ExposureInfo]] = {}
    for flat in flats:
        groups.setdefault((condition_of(flat), steps.get(flat.number)), []).append(flat)
    # Flats of one level by two lamps have two exposure times, which is no scatter.
    alike = [part for members in groups.values() for part in _of_one_time(members)]
    out = []
    for name in ("lamp", "exposure_time"):
        ratios: list[float] = []
        for members in alike:
            values = np.array([getattr(m, name) or np.nan for m in members], float)
            if len(values) > 1 and np.isfinite(values).all():
                ratios += (values / values.mean() - 1.0).tolist()
        size = float(np.std(ratios)) if ratios else 0.0
        out.append((size, size / LEAST))
    return out[0], out[1]


def _of_one_time(flats: Sequence[ExposureInfo]) -> list[list[ExposureInfo]]:
    """Flats in groups whose exposure times follow one another without a gap of :data:`APART`."""
    ordered = sorted(flats, key=lambda f: f.exposure_time or 0.0)
    out = [ordered[:1]]
    for before, flat in itertools.pairwise(ordered):
        if (flat.exposure_time or 0.0) > (1 + APART) * (before.exposure_time or 0.0):
            out.append([])
        out[-1].append(flat)
    return out


APART = 0.02
"""Relative gap between exposure times of one level above which they belong to two lamps.  Chosen:
shutters scatter by 0.2 % at one second; with 0.04, lamps that differ by 3 % are listed as flicker of
1.5 %."""

LEAST = 1e-5
"""Relative scatter of headers' values that their digits may have.  Derived: times of a second are given
to 1e-5 s or better; with 1e-4, flicker below 5e-4 is fitted without being listed."""
