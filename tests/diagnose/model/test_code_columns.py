"""Even codes that rounding prefers are a linear parameter of the fit, not a fault of one bit."""

from types import SimpleNamespace

import numpy as np
import pytest

from bfsensor.diagnose.data.code_channels import CodeChannels
from bfsensor.diagnose.kinds import KINDS


def codes_of(rounded, seed=4):
    """Codes of flats whose levels are multiples of a 64th of an ADU, as of short floating numbers."""
    rng = np.random.default_rng(seed)
    channels = CodeChannels()
    for _ in range(12):
        level = np.round(64 * (26e3 + 110 * rng.standard_normal((256, 256)))) / 64
        frame = SimpleNamespace(image=rounded(level).astype(np.float32), repaired=None)
        channels.add([frame])
    return channels.channels()[0]


@pytest.mark.parametrize(
    ("rounded", "prefers"), [(np.rint, True), (lambda v: np.floor(v + 0.5), False)]
)
def test_rounding_to_even_is_one_parameter(rounded, prefers):
    channel = codes_of(rounded)
    (name, column), *more = KINDS[channel.word].columns(channel, {}, None).items()
    assert name == "codes even 0" and not more
    left, shape = channel.whiten(channel.values), channel.whiten(column)
    found = shape @ left / (shape @ shape)
    error = (shape @ shape) ** -0.5
    # One level in 64 is a tie and goes to the even code: even ones are wider by a 64th.
    assert found == pytest.approx(1 / 64 if prefers else 0.0, abs=4 * error)
    assert found > 4 * error or not prefers
    after = left - found * shape
    assert after @ after < len(left) + 4 * (2 * len(left)) ** 0.5
