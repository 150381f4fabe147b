"""What is left beside what is found: when it counts, and when it says that more is outside.

The rule.  Predictions in closed form are good to about a per cent of an effect.  Of an effect that
is seen at hundreds of standard deviations some are therefore left over, in the channels in which
it is seen: they are held against what has been explained there, channel by channel, and count
only beyond :data:`ACCURACY` of it.  What counts, and noise does not give more than once in a
thousand times (:data:`OUTSIDE_ALARM`, against the once in a hundred of a detection), and no
candidate explains, is outside the library.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from bfsensor.diagnose.detect.locate import FAMILY, Finding, Mismatch
from bfsensor.diagnose.detect.scans import DEVICE, DEVICE_SEEN
from bfsensor.diagnose.fit.baseline_fit import BaselineFit

ACCURACY = 0.02
"""Of the predictions: part of an effect's own deviate that may be left over (closed forms are
held to 0.3 to 1 % against pixels; twice the worst)."""

OUTSIDE_ALARM = 1e-3
"""Family-wise probability of what is left below which something is said to be outside."""


def explained_by_word(before: BaselineFit, after: BaselineFit) -> dict[str, float]:
    """Decrease of each channel's chi-square from one fit to another of the same channels."""
    old, new = before.chi2(), after.chi2()
    return {word: max(old[word][0] - new[word][0], 0.0) for word in old if word in new}


def counts(
    finding: Finding, mismatch: Mismatch, explained: Mapping[str, float], fits: int = 1
) -> bool:
    """Whether a statistic is more than what is found leaves over by its own inaccuracy.

    Parameters
    ----------
    finding : Finding
        Of what is left.
    mismatch : Mismatch
        It is of.
    explained : mapping of str to float
        Chi-square that what is found took of each channel.
    fits : int
        How many effects are found; their inaccuracies add up.
    """
    own = DEVICE_SEEN if finding.word == DEVICE else (finding.word,)
    if finding.word == "bias_cov" and finding.where.get("k") == (0, 0):
        # The read noise is that of flats as well: what is amiss there may show here.
        own = ("bias_cov", "flat_cov")
    reach = ACCURACY**2 * sum(explained.get(w, 0.0) for w in own) * max(fits, 1)
    if finding.family != "chi-square":
        return finding.z**2 > reach
    square, dof = mismatch.chi2[finding.word]
    return square - dof > reach


def stands_out(
    mismatch: Mismatch,
    explained: Mapping[str, float],
    *,
    fits: int = 1,
    alarm: float | None = None,
) -> bool:
    """Whether anything is left that counts.

    Parameters
    ----------
    mismatch, explained, fits
        As for :func:`counts`.
    alarm : float, optional
        Family-wise probability below which it does; by default that of a detection.
    """
    if not mismatch.detected:
        return False
    limit = np.inf if alarm is None else alarm
    # What an effect of the library would explain is not outside it.
    found = [f for f in mismatch.findings if alarm is None or f.family != FAMILY]
    return any(f.p_value < limit and counts(f, mismatch, explained, fits) for f in found)
