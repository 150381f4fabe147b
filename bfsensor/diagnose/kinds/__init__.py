"""Kinds of channels: one file for each, in :data:`KINDS`.

A kind holds all that follows the measurement: linear parameters, prediction, scans, words and
figure.  Measurements are in :mod:`bfsensor.diagnose.data`, as one pass over the exposures makes all.
"""

from __future__ import annotations

from collections.abc import Mapping

from bfsensor.diagnose.kinds.amp_cross import AmplifierPairs
from bfsensor.diagnose.kinds.bias_cov import BiasCovariances
from bfsensor.diagnose.kinds.bias_level import BiasLevels
from bfsensor.diagnose.kinds.channel_kind import ChannelKind
from bfsensor.diagnose.kinds.code_hist import CodeHistogram
from bfsensor.diagnose.kinds.dark_map import DarkMaps
from bfsensor.diagnose.kinds.flat_cov import FlatCovariances
from bfsensor.diagnose.kinds.flat_map import FlatMaps
from bfsensor.diagnose.kinds.flat_mean import FlatMeans
from bfsensor.diagnose.kinds.overscan import Overscan
from bfsensor.diagnose.kinds.spot import Spots

__all__ = ["KINDS"]

KINDS: Mapping[str, ChannelKind] = {
    kind.name: kind
    for kind in (
        FlatCovariances(), FlatMeans(),
        Overscan("serial_overscan", "serial overscan"),
        Overscan("parallel_overscan", "parallel overscan"),
        FlatMaps(), Spots(), BiasCovariances(), BiasLevels(), DarkMaps(), AmplifierPairs(),
        CodeHistogram(),
    )
}  # fmt: skip
"""All kinds, by the name of the channel, in the order of the figures of a report."""
