"""Scans of residuals that assume no effect: patterns of each kind of channels, and of the device."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from bfsensor.diagnose.data.channels import Channel
from bfsensor.diagnose.fit.baseline_fit import BaselineFit
from bfsensor.diagnose.kinds import KINDS
from bfsensor.diagnose.kinds.scan_templates import Group, Template

DEVICE, DEVICE_SCAN = "device", "device parameter away from its nominal value"
"""Name that stands for a channel, and family, of the scan of the device's parameters."""

DEVICE_SEEN = "flat_cov", "spot"
"""Channels that the device's parameters change."""


def make_templates(channels: Sequence[Channel]) -> Iterator[Template]:
    """Make all templates that channels allow, whatever is fitted to them, one after another.

    Every template is a pattern in the unit of its channel over all folds: a power of the flux
    at one lag, a step in time, a strip of columns.

    Parameters
    ----------
    channels : sequence of Channel
        Channels of a fit.

    Yields
    ------
    template : Template
        Whitened.
    """
    for group in _groups(channels):
        yield from group.templates(KINDS[group.word].patterns(group))


def make_fitted_templates(fit: BaselineFit) -> Iterator[Template]:
    """Make the templates that depend on a fit: shape of the predicted covariances, device.

    Parameters
    ----------
    fit : BaselineFit
        The fit.

    Yields
    ------
    template : Template
        Whitened.
    """
    for group in _groups(fit.channels):
        yield from group.templates(KINDS[group.word].fitted_patterns(group, fit.residuals))
    yield from _device(fit)


def _groups(channels: Sequence[Channel]) -> list[Group]:
    """Channels of one name each, with the index at which their values begin."""
    by_word: dict[str, list[tuple[Channel, int]]] = {}
    start = 0
    for channel in channels:
        by_word.setdefault(channel.word, []).append((channel, start))
        start += len(channel)
    return [Group(word, members, KINDS[word].level) for word, members in by_word.items()]


def _device(fit: BaselineFit) -> Iterator[Template]:
    """Yield the derivatives of all values by each device parameter, as templates.

    The fit moves these parameters against their priors.  A device far from nominal therefore
    leaves residuals along the derivative, in proportion to the pull, and noise a known amount.
    A parameter that only has a bound has no nominal value to differ from, and an error of the
    calculation is none of the device.
    """
    for n, name in enumerate(fit.names[: fit.slopes.shape[1]]):
        quantity = name.removeprefix("device ")
        if quantity != name and quantity not in fit.unknown:
            rows = np.nonzero(fit.slopes[:, n])[0]
            if len(rows):
                where = {"device": quantity}
                yield Template(DEVICE_SCAN, DEVICE, rows, fit.slopes[rows, n], where)
