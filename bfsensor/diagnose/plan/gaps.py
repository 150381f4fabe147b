"""Classes of effects that a campaign is not sensitive to, and the recordings that would show them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from bfsensor.diagnose.data.measure_channels import MeasuredChannels


class Need(NamedTuple):
    """Requirements for a class of effects to be detectable.

    Attributes
    ----------
    channels : tuple of str
        Channels, of which one is enough.
    recording : str
        Recording that would show the class, in words.
    vary : str
        Setting of which two values are needed; '' for none.
    lamp : bool
        Whether the light must be measured by a lamp monitor.
    amplifiers : int
        Least number of amplifiers.
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
    "adc_bits": Need(("code_hist",), "flats as raw integer codes"),
    "gain_drift": Need(("flat_mean",), _LADDER, lamp=True),
    "bf_nonlinear": Need(("flat_cov", "spot"), _PAIRS),
    "bf_chromatic": Need(("flat_cov", "spot"), "pairs of flats at a second wavelength",
                         vary="wavelength"),
    "bf_anisotropy": Need(("flat_cov", "spot"), _PAIRS),
    "bf_long_range": Need(("flat_cov",), _PAIRS),
    "device_parameter": Need(("flat_cov", "spot"), _PAIRS),
    "silicon_physics": Need(("flat_cov", "spot"), _PAIRS),
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
    "saturation": Need(("flat_cov", "spot"), "flats and spots above 100,000 e- per pixel"),
    "fringing": Need(("flat_map",), "flats above 900 nm, and at a shorter wavelength",
                     vary="wavelength"),
    "psf_wings": Need(("spot",), _SPOTS),
    "cosmic_rays": Need(("dark_map",), "long darks"),
    "illumination_turbulence": Need(("flat_cov",), _PAIRS),
}  # fmt: skip
"""Requirements by class.  Derived from the channels that each class of the library changes; numbers
in the recordings' words are chosen advice, on which no result depends."""


class Untested(NamedTuple):
    """A class that recordings cannot show: its name, the reason, and a recording that would."""

    word: str
    because: str
    recording: str

    def to_report(self) -> dict[str, str]:
        """Make the entry of 'not_tested' in report.json."""
        return {"class": self.word, "because": self.because, "recording": self.recording}


ALWAYS = (
    Untested(
        "outside_library",
        "noise of the light in excess of Poisson noise and proportional to it (Fano noise, several "
        "electrons per photon) has the same effect as a different gain",
        "exposures of Fe55, whose line measures the gain independently",
    ),
)
"""Questions that flats and spots alone cannot answer."""


def find_untested(measured: MeasuredChannels) -> tuple[Untested, ...]:
    """Find the classes of effects that a campaign's recordings cannot show.

    Parameters
    ----------
    measured : MeasuredChannels
        Channels of the campaign.

    Returns
    -------
    tuple of Untested
        Classes with the reason and a recording that would show them.
    """
    out = []
    for word, need in NEEDS.items():
        because = _missing(measured, need)
        if because:
            out.append(Untested(word, because, need.recording))
    return (*out, *ALWAYS)


def _missing(measured: MeasuredChannels, need: Need) -> str:
    """Requirement that is not met, in words; '' if all are."""
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
            unit = {"wavelength": " nm", "back_bias": " V"}.get(need.vary, "")
            told = f" ({known[0]:g}{unit})" if len(known) else ""
            return f"one {need.vary.replace('_', ' ')}{told}"
    return ""
