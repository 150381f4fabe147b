"""Detection of persistence in biases and darks: charge that earlier spots left in lit pixels."""

from __future__ import annotations

from collections.abc import Callable, Container, Sequence

import numpy as np
from numpy.typing import NDArray

from bfsensor.diagnose.data.exposure_info import ExposureInfo, Frame
from bfsensor.typing import FloatArray

LIT = 20.0
"""Excess over the median above which a pixel of an image of spots is lit [sigma, as 1.4826 median
deviations].  Chosen: noise never reaches 20; with 40 the outer pixels of spots are not lit, and
less persistence is seen."""

CERTAIN = 5.0
"""Significance [sigma] of the lit pixels' mean excess above which a frame holds persistence.
Chosen: noise exceeds 5 in 3e-7 of frames; with 10, frames with up to twice as much persistence
stay in the mean bias and the read noise."""

LEAST = 4
"""Number of biases before any spots below which all biases are used.  Chosen: two differences
for the read noise need four; with 8, campaigns with 4 to 7 early biases use those with
persistence."""

Read = Callable[[ExposureInfo], Sequence[Frame]]
"""Function that returns the frames of an exposure, one for each amplifier."""


def find_ghosts(
    exposures: Sequence[ExposureInfo], read: Read
) -> dict[int, list[NDArray[np.bool_]]]:
    """Find biases and darks with persistence: pixels lit by earlier spots above the others.

    They are compared, row by row, with the last frame of their kind and exposure time before any
    spots, so that neither a fixed pattern nor the level of a row counts.  None is found without
    such a frame, or with fewer than :data:`LEAST` biases before spots.

    Parameters
    ----------
    exposures : sequence of ExposureInfo
        All exposures in order of time.
    read : callable
        Returns the frames of an exposure, one for each amplifier.

    Returns
    -------
    dict of int to list of ndarray of bool
        Lit pixels of each amplifier by the exposure's number, for exposures in which their mean
        excess is above :data:`CERTAIN`.
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
            # The brightest spots define the lit pixels best; of equal ones the last left most.
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
    """Sentence on which exposures hold persistence and how they are used."""
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
    return f"persistence of earlier spots is found in: {'; '.join(parts)}"


def _lit(image: NDArray[np.float32]) -> NDArray[np.bool_]:
    away = image - np.median(image)
    return np.asarray(away > LIT * 1.4826 * np.median(np.abs(away)))


def _excess(
    frames: Sequence[Frame],
    reference: Sequence[FloatArray],
    lit: Sequence[NDArray[np.bool_]],
) -> float:
    """Mean excess of lit pixels over the unlit ones of their rows [standard deviations]."""
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
