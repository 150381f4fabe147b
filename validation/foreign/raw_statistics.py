"""Chosen exposures of a campaign, and the small statistics that the estimator of strength is made of."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

from validation.foreign.bench import Bench
from validation.foreign.plan import Exposure, Plan


@dataclass
class Chosen:
    """An exposure to be simulated, its group, and how many of the campaign it stands for."""

    exposure: Exposure
    group: tuple
    stands_for: float


def choose(plan: Plan) -> list[Chosen]:
    """Choose a part of a campaign's exposures that stands for all of it."""
    groups: dict[tuple, list[Exposure]] = defaultdict(list)
    for e in plan.exposures():
        groups[(e.kind, e.seconds, *e.condition, e.lamp)].append(e)
    main = [
        g
        for g in groups
        if g[0] == "FLAT" and g[2:5] == (620.0, -60.0, -100.0) and g[5] == 1
    ]
    main.sort(key=lambda g: g[1])
    at = sorted({0, len(main) // 3, (2 * len(main)) // 3, len(main) - 1})
    few = [main[i] for i in at]
    out = []
    for group, es in groups.items():
        kind = group[0]
        if kind == "BIAS":
            picked, stands = [*es[:3], es[-1]], len(es)
        elif kind == "DARK":
            picked, stands = es[:3], len(es)
        elif kind == "FLAT" and group in main:
            if group not in few:
                continue
            picked = [*es[:2], *es[-2:]] if group == main[-1] else es[:2]
            stands = len(es) * len(main) / len(few)
        elif kind == "FLAT":
            brighter = [g for g in groups if g[0] == "FLAT" and g[2:] == group[2:]]
            if group[1] < max(g[1] for g in brighter):
                continue
            picked, stands = es[:3], sum(len(groups[g]) for g in brighter)
        else:
            alike = sorted(g[1] for g in groups if g[0] == "SPOT" and g[2:] == group[2:])
            wanted = {alike[-1]} if len(alike) < 4 else {alike[1], alike[4], alike[-1]}
            if group[1] not in wanted:
                continue
            picked, stands = es[:1], len(es) * len(alike) / len(wanted)
        out += [Chosen(e, group, stands) for e in dict.fromkeys(picked)]
    return sorted(out, key=lambda c: c.exposure.sequence)


@dataclass
class Products:
    """Statistics of one bench's exposures."""

    frames: list[list[NDArray]] = field(default_factory=list)
    codes: list[list[NDArray]] = field(default_factory=list)


def expose(bench: Bench, chosen: Sequence[Chosen]) -> Products:
    """Take the exposures; frames in electrons above the amplifiers' offsets."""
    out = Products()
    for c in chosen:
        taken = bench.take(c.exposure)
        out.codes.append([f.astype(np.int32) for f in taken.frames])
        out.frames.append(
            [
                (f.astype(np.float32) - np.float32(o)) * np.float32(g)
                for f, o, g in zip(taken.frames, bench.offsets, bench.gains, strict=True)
            ]
        )
    return out


def fitted_product(
    a: NDArray, b: NDArray, sigma: NDArray, templates: NDArray | None, prior=None
) -> float:
    """a^T W b after the templates (columns) are fitted out of both, with priors on their sizes."""
    w = 1 / sigma
    if templates is None or not templates.size:
        return float((a * w) @ (b * w))
    sizes = fitted_sizes(b, sigma, templates, prior)
    return float((a * w) @ (b * w - (templates * w[:, None]) @ sizes))


def fitted_sizes(b: NDArray, sigma: NDArray, templates: NDArray, prior=None) -> NDArray:
    """Sizes of templates (columns) that fit b best, with priors; 0 for a template without values."""
    t = templates / sigma[:, None]
    keep = (t * t).sum(0) > 0
    part = t[:, keep]
    normal = part.T @ part
    normal += np.diag(1e-12 * np.diag(normal))
    if prior is not None:
        normal += np.diag(np.asarray(prior)[keep])
    sizes = np.zeros(templates.shape[1])
    sizes[keep] = np.linalg.solve(normal, part.T @ (b / sigma))
    return sizes


def smooth(h: NDArray) -> NDArray:
    """Running mean of a histogram over 33 codes."""
    return uniform_filter1d(h.astype(float), 33, mode="constant")


def comb(h: NDArray) -> NDArray:
    """What a histogram has beside its running mean."""
    return h - smooth(h)


def white(frame: NDArray) -> NDArray:
    """A frame about its median."""
    return frame - np.median(frame)


def without_tracks(difference: NDArray) -> NDArray:
    """A difference of frames about its median, zero beyond seven sigma as any reduction clips."""
    d = difference - np.median(difference)
    # every seventh row tells the scatter well enough
    sigma = 1.4826 * np.median(np.abs(d[::7]))
    return np.where(np.abs(d) > 7 * sigma, 0, d)


def welch(frame: NDArray) -> NDArray:
    """Power of a frame in the order of reading, over segments of 512 pixels."""
    x = without_tracks(frame).ravel()
    x = x[: x.size // 512 * 512].reshape(-1, 512)
    return (np.abs(np.fft.rfft(x, axis=1)) ** 2).mean(0)


def gain(ratio: float) -> float:
    """2 ln L of one sample's variance that is ``ratio`` of what was expected."""
    return float(max(ratio - 1 - np.log(ratio), 0.0)) if ratio > 1e-6 else 0.0


def variance_gain(halves: NDArray, count: float) -> float:
    """As before, of ``count`` samples in two halves; nothing where the halves disagree in sign."""
    if (halves[0] - 1) * (halves[1] - 1) <= 0:
        return 0.0
    return count * float(np.sqrt(gain(float(halves[0])) * gain(float(halves[1]))))
