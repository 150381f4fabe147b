"""
An effect of one's own
======================

A class of effects is one file: what it does to pixels, and what it changes in each channel of a
diagnosis. Here electronics warm up, so that the gain rises with the root of the time.
"""

import matplotlib.pyplot as plt
import numpy as np

from bfsensor.effects import Effect, Layout, Parameter, Segment, Shot


class WarmingGain(Effect):
    """The signal in ADU grows by ``size`` times the root of the hours since the first exposure."""

    word = "gain_drift"
    variant = "root"
    parameters = (Parameter("size", "1/h^0.5", 5e-4, 2e-2, signed=True, amplitude=True),)
    touches = ("flat_mean", "flat_cov", "spot")
    source = "An example; heat that spreads from a chip grows with the root of the time"

    def amplify(self, frames, shot, layout):
        """Pixels: each frame of an exposure [e-]."""
        return [f * (1 + self["size"] * np.sqrt(shot.hours)) for f in frames]

    def signal(self, level, axes, layout):
        """Channels: a mean signal [e-] of exposures at the times ``axes['hours']``."""
        return level * (1 + self["size"] * np.sqrt(axes["hours"]))


effect = WarmingGain({"size": 0.004})
layout = Layout((64, 64), (Segment(0, 0, 64, 64),))
hours = np.linspace(0.0, 6.0, 13)
flats = np.random.default_rng(5).poisson(2e4, (len(hours), 64, 64)).astype(float)
pixels = [
    effect.amplify([flat], Shot("flat", n, 2.0, hours=h), layout)[0].mean()
    for n, (flat, h) in enumerate(zip(flats, hours, strict=True))
]
predicted = effect.signal(flats.mean((1, 2)), {"hours": hours}, layout)
plt.plot(hours, pixels, "o", label="pixels of flats")
plt.plot(hours, predicted, label="prediction")
plt.xlabel("time [h]")
plt.ylabel("mean signal [e-]")
plt.legend()

# %%
# Pixels and prediction agree to rounding; with the neutral value nothing changes.
assert np.allclose(pixels, predicted, rtol=1e-12)
assert WarmingGain({"size": 0.0}).is_neutral
