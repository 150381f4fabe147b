"""Questions that a campaign cannot answer: what is missing, and which recording would bring it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from bfsensor.diagnose.data.measure_channels import MeasuredChannels


class Need(NamedTuple):
    """What a class needs to be seen: any of some channels, and variety or a lamp beside.

    Attributes
    ----------
    channels : tuple of str
        Any of them will do.
    recording : str
        What would bring it, in words.
    vary : str
        Condition of which two values are needed; '' for none.
    lamp : bool
        Whether light must be measured.
    amplifiers : int
        How many are needed.
    """

    channels: tuple[str, ...]
    recording: str
    vary: str = ""
    lamp: bool = False
    amplifiers: int = 1


_PAIRS = "pairs of flats at several levels"
_SPOTS = "spots at several fluxes"
_MAPS = "flats of the whole sensor, several of them"
_LADDER = "flats at several levels with a lamp monitor or photodiode"

NEEDS: Mapping[str, Need] = {
    "cti_serial": Need(("serial_overscan",), "flats with at least 16 serial overscan pixels"),
    "cti_parallel": Need(("parallel_overscan",), "flats with at least 16 parallel overscan rows"),
    "trap_serial": Need(("serial_overscan",), "flats with at least 16 serial overscan pixels"),
    "electronic_memory": Need(("serial_overscan",), "flats with at least 16 serial overscan pixels"),
    "interpixel_coupling": Need(("flat_cov",), _PAIRS),
    "amp_crosstalk": Need(("amp_cross",), "spots, read by two amplifiers or more", amplifiers=2),
    "correlated_noise": Need(("bias_cov", "amp_cross"), "at least two biases"),
    "bias_instability": Need(("bias_level",), "at least four biases"),
    "gain_nonlinearity": Need(("flat_mean",), _LADDER, lamp=True),
    "adc_bits": Need(("code_hist",), "raw codes of flats"),
    "gain_drift": Need(("flat_mean",), _LADDER, lamp=True),
    "bf_nonlinear": Need(("flat_cov", "spot"), _PAIRS),
    "bf_chromatic": Need(("flat_cov", "spot"), "pairs of flats at a second wavelength",
                         vary="wavelength"),
    "bf_anisotropy": Need(("flat_cov", "spot"), _PAIRS),
    "bf_long_range": Need(("flat_cov",), _PAIRS),
    "device_parameter": Need(("flat_cov", "spot"), _PAIRS),
    "voltage_dependence": Need(("flat_cov", "spot"), "pairs of flats at a second back bias",
                               vary="back_bias"),
    "lateral_diffusion": Need(("spot",), "spots at a second back bias, wavelength or temperature"),
    "tree_rings": Need(("flat_map",), _MAPS),
    "edge_rolloff": Need(("flat_map",), _MAPS),
    "mask_stitch": Need(("flat_map",), _MAPS),
    "tearing": Need(("flat_map",), _MAPS),
    "charge_loss": Need(("flat_mean",), _LADDER, lamp=True),
    "persistence": Need(("dark_map",), "short darks after bright flats"),
    "shutter_timing": Need(("flat_mean",), _LADDER, lamp=True),
    "dark_hot": Need(("dark_map",), "long darks"),
    "saturation": Need(("flat_cov", "spot"), "flats and spots beyond 100,000 electrons"),
    "fringing": Need(("flat_map",), "flats beyond 900 nm beside others", vary="wavelength"),
    "psf_wings": Need(("spot",), _SPOTS),
    "cosmic_rays": Need(("dark_map",), "long darks"),
    "illumination_turbulence": Need(("flat_cov",), _PAIRS),
}  # fmt: skip
"""By class: channels it shows in at all, one of which must be there."""


class Untested(NamedTuple):
    """A class that recordings cannot show, why, and what would."""

    word: str
    because: str
    recording: str

    def to_report(self) -> dict[str, str]:
        """Give the entry of 'not_tested' in report.json."""
        return {"class": self.word, "because": self.because, "recording": self.recording}


ALWAYS = (
    Untested(
        "outside_library",
        "noise of the light beyond Poisson's in proportion to it (Fano noise, several electrons a "
        "photon) is the same as another gain",
        "exposures of Fe55, which tell the gain by themselves",
    ),
)
"""What flats and spots alone never tell."""


def find_untested(measured: MeasuredChannels) -> tuple[Untested, ...]:
    """Classes of effects that a campaign's recordings cannot show.

    Parameters
    ----------
    measured : MeasuredChannels
        Its channels.
    """
    out = []
    for word, need in NEEDS.items():
        because = _missing(measured, need)
        if because:
            out.append(Untested(word, because, need.recording))
    return (*out, *ALWAYS)


def _missing(measured: MeasuredChannels, need: Need) -> str:
    """What a class lacks; '' for nothing."""
    channels = [c for c in measured.channels if c.word in need.channels and len(c)]
    if not channels:
        return "no " + " or ".join(need.channels)
    if need.amplifiers > max(len(measured.amplifiers), 1):
        return "one amplifier"
    if need.lamp and not measured.lamp_known:
        return "no lamp monitor"
    if need.vary:
        values = np.concatenate([np.asarray(c.axes[need.vary], float) for c in channels])
        known = np.unique(values[np.isfinite(values)])
        if len(known) < 2:
            told = f" ({known[0]:g})" if len(known) else ""
            return f"one {need.vary.replace('_', ' ')}{told}"
    return ""
