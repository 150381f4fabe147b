"""Frames without light that hold what spots before them left: they tell no noise and no zero."""

from __future__ import annotations

from collections.abc import Callable, Container, Sequence

import numpy as np
from numpy.typing import NDArray

from bfsensor.diagnose.data.exposure_info import ExposureInfo, Frame
from bfsensor.typing import FloatArray

LIT = 20.0
"""Median deviations above the median from which on a pixel of an image of spots is lit."""

CERTAIN = 5.0
"""Standard deviations of the lit pixels' mean above the others from which on ghosts are certain."""

LEAST = 4
"""Frames of a kind that must be left: with fewer all are used."""

Read = Callable[[ExposureInfo], Sequence[Frame]]


def find_ghosts(
    exposures: Sequence[ExposureInfo], read: Read
) -> dict[int, list[NDArray[np.bool_]]]:
    """Biases and darks in which pixels that spots lit before stand above the others.

    They are held against the last frame of their kind and exposure time before any spots, line
    by line: neither a pattern that stands nor the level of a row counts.  Where there is none
    before spots, or nothing would be left, none is given.

    Parameters
    ----------
    exposures : sequence of ExposureInfo
        In the order of time.
    read : callable
        Gives the frames of an exposure, one of each amplifier.

    Returns
    -------
    dict of int to list of ndarray of bool
        By the exposure's number the lit pixels of each amplifier, which together deviate by more
        than :data:`CERTAIN` of their error.
    """
    spots: list[ExposureInfo] = []
    before: dict[tuple[str, float], list[ExposureInfo]] = {}
    after: dict[tuple[str, float], list[tuple[ExposureInfo, ExposureInfo]]] = {}
    for one in exposures:
        key = (one.kind, one.exposure_time or 0.0)
        if one.kind == "spot":
            spots.append(one)
        elif one.kind in ("bias", "dark") and not spots:
            before.setdefault(key, []).append(one)
        elif one.kind in ("bias", "dark"):
            # The brightest shows best where light falls; of equal ones the last left most.
            brightest = max(spots, key=lambda s: (s.exposure_time or 0.0, s.number))
            after.setdefault(key, []).append((one, brightest))
    found: dict[int, list[NDArray[np.bool_]]] = {}
    lit: dict[int, list[NDArray[np.bool_]]] = {}
    for key, late in after.items():
        early = before.get(key, [])
        least = LEAST if key[0] == "bias" else 1
        if len(early) < least:
            continue
        reference = [f.image.astype(np.float64) for f in read(early[-1])]
        for one, brightest in late:
            if brightest.number not in lit:
                lit[brightest.number] = [_lit(f.image) for f in read(brightest)]
            if _excess(read(one), reference, lit[brightest.number]) > CERTAIN:
                found[one.number] = lit[brightest.number]
    return found


def describe_ghosts(ghosts: Container[int], exposures: Sequence[ExposureInfo]) -> str:
    """One line on which exposures are used how."""
    parts = []
    for kind, words in (
        ("bias", "used for their levels alone"),
        ("dark", "not used"),
    ):
        numbers = [
            str(e.number) for e in exposures if e.kind == kind and e.number in ghosts
        ]
        if numbers:
            parts.append(f"{kind} {', '.join(numbers)} ({words})")
    return f"hold what spots before them left: {'; '.join(parts)}"


def _lit(image: NDArray[np.float32]) -> NDArray[np.bool_]:
    away = image - np.median(image)
    return np.asarray(away > LIT * 1.4826 * np.median(np.abs(away)))


def _excess(
    frames: Sequence[Frame],
    reference: Sequence[FloatArray],
    lit: Sequence[NDArray[np.bool_]],
) -> float:
    """Mean of lit pixels above those of their rows that are not [standard deviations]."""
    above, precision = 0.0, 0.0
    for frame, earlier, here in zip(frames, reference, lit, strict=True):
        if not here.any() or here.all(1).any():
            continue
        change = frame.image.astype(np.float64) - earlier
        away = change - np.mean(change, axis=1, where=~here, keepdims=True)
        # Particles and hot pixels do not lie where the spots do.
        sigma = 1.4826 * float(np.median(np.abs(away[~here])))
        values = np.clip(away[here], -LIT * sigma, LIT * sigma)
        error = values.std() / np.sqrt(values.size)
        if error > 0:
            above += float(values.mean()) / error**2
            precision += 1 / error**2
    return above / np.sqrt(precision) if precision else 0.0
