"""Whether a prediction agrees with pixels, channel by channel; of any effects of the library."""

from validation.concealed.plan import Size
from validation.effects.effect_parity import (
    ENGINES,
    PLACES,
    compare_at,
    effect_at,
    known_to_the_sensor,
)

SMALL = Size(
    128, 2, 0, dithers=2, flat_seconds=(5.0, 20.0, 40.0, 60.0), spot_seconds=(7.5, 30.0)
)
"""A campaign of a second: two amplifiers of 64 columns."""

RANDOM = (
    "correlated_noise", "bias_instability", "illumination_turbulence", "cosmic_rays",
    "outside_library",
)  # fmt: skip
"""Effects that are told by their scatter: predicted is what is expected of many."""

SCATTER = {
    ("correlated_noise:pickup", ""): 3 / 14**0.5,
    ("tearing", "flat_cov"): 3 * 0.71 / 12**0.5,
}
"""Relative scatter of a prediction, three of its standard deviations: a wave's power in the
differences of 2 x 7 biases, whose phases are free, is between 0 and 2 of its mean in each; how far
the edge of a tear moves between two flats scatters by .71 of its mean, and a dozen pairs are bright
(assumed).  Of one channel, or of all."""

FEW = 0.05
"""Relative error of a prediction: closed forms are of first order in amplitudes of per cents."""

UNSEEN = 1.5
"""Error of a prediction [standard deviations of all that a campaign tells] that hides nothing."""


def disagreements(effect, engine, size="S", few=FEW):
    """Channels whose prediction fails, in words; empty where all agree.

    Two campaigns share their noise, but where codes are rounded anew, or the effect is a noise,
    they do not: of two of unit variance the difference has the rms of 2^(1/2), known to
    (2 n)^(-1/2) of itself.
    """
    out = []
    for r in compare_at(effect, engine, size):
        limit = 2**0.5 * (1 + 4 / (2 * r.count) ** 0.5)
        if r.left > limit:
            out.append(f"{r.channel}: rms of {r.left:.2f} left, {limit:.2f} allowed")
        if not r.factor:
            continue
        gap = abs(r.factor - 1) * r.said
        # Of random effects the sums over two campaigns differ by as many of their errors.
        allowed = max(few * r.said, 4 * 2**0.5 if effect.word in RANDOM else UNSEEN)
        scatter = max(SCATTER.get((effect.name, word), 0.0) for word in ("", r.channel))
        allowed = max(allowed, scatter * r.said)
        if gap > max(allowed, 3 * r.error * r.said):
            out.append(
                f"{r.channel}: factor {r.factor:.3f} +- {r.error:.3f} on {r.said:.1f} sigma"
            )
    return out


__all__ = [
    "ENGINES",
    "PLACES",
    "SMALL",
    "disagreements",
    "effect_at",
    "known_to_the_sensor",
]
