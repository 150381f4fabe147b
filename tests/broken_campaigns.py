"""Small campaigns on disk, whole and broken, for the package's tests: the only door to their maker."""

from validation.reading.broken_campaigns import (
    BREAKAGES,
    GAIN,
    LADDER,
    RATE,
    copy_campaign,
    lose_biases,
    make_campaign,
    measure,
    read_broken,
    truncate,
)

__all__ = [
    "BREAKAGES", "GAIN", "LADDER", "RATE", "copy_campaign", "lose_biases", "make_campaign",
    "measure", "read_broken", "truncate",
]  # fmt: skip
