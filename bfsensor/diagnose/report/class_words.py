"""Plain words for channels, classes of effects, their parameters and scans, and printed p-values."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from bfsensor.diagnose.detect.locate import FAMILY, SMALLEST
from bfsensor.diagnose.detect.scans import DEVICE, DEVICE_SCAN
from bfsensor.diagnose.kinds import KINDS
from bfsensor.effects.gain_drift import KNOTS as TIMES
from bfsensor.effects.gain_nonlinearity import KNOTS as SIGNALS

NAMES = {DEVICE: "device's parameters"} | {word: kind.title for word, kind in KINDS.items()}
"""Plain words for each channel."""

CLASS_WORDS = {
    "cti_serial": "some charge stays behind at each serial transfer",
    "cti_parallel": "some charge stays behind at each parallel transfer",
    "trap_serial": "a trap at one place of the serial register",
    "electronic_memory": "the amplifier or its clamp remembers earlier pixels",
    "interpixel_coupling": "neighbours share signal after collection, in proportion to the signal",
    "amp_crosstalk": "a fraction of one amplifier's signal appears in another",
    "correlated_noise": "read noise is correlated in time or between amplifiers",
    "bias_instability": "the bias level moves between frames, between rows or along rows",
    "gain_nonlinearity": "the signal in ADU is not proportional to the charge",
    "adc_bits": "codes of the analogue-to-digital converter have wrong widths or places",
    "gain_drift": "the gain changes with time",
    "bf_nonlinear": "pixel boundaries do not shift in proportion to the stored charge",
    "bf_chromatic": "the brighter-fatter effect changes with wavelength otherwise than simulated",
    "bf_anisotropy": "the ratio of boundary shifts in x and in y differs from the simulated one",
    "bf_long_range": "boundary shifts fall off with distance more slowly than electrostatics predicts",
    "device_parameter": "a quantity of the device differs from its nominal value by far more than "
    "its uncertainty",
    "voltage_dependence": "boundary shifts change with back bias otherwise than simulated",
    "lateral_diffusion": "electrons diffuse sideways more than simulated",
    "tree_rings": "a circular pattern of pixel areas",
    "edge_rolloff": "field lines lean outwards or inwards near the sensor's edge",
    "mask_stitch": "a periodic error of the widths of columns or rows from the mask",
    "tearing": "columns on either side of a boundary have wrong widths, as with holes redistributed "
    "in the channel stops",
    "charge_loss": "the fraction of light that is collected falls with the stored charge",
    "persistence": "charge is released from earlier exposures",
    "shutter_timing": "exposure times are offset, or unequal over the sensor",
    "dark_hot": "dark current, hot columns, or glow",
    "saturation": "the full well is smaller than the baseline's",
    "fringing": "light interferes within the sensor at long wavelengths",
    "psf_wings": "spots have an extended halo",
    "cosmic_rays": "tracks of charged particles",
    "illumination_turbulence": "the illumination changes from frame to frame",
    "silicon_physics": "physics of the silicon that the simulated device lacks",
    "outside_library": "none of the effects in the library",
}
"""Plain words for each class of effects of report.json."""

PIECE_WORDS = {
    "free_holes": "holes in the channel stops and under the barrier gates follow the potential",
    "stop_diffusion": "implants of the channel stops spread sideways",
    "oxide_charge": "charge is fixed at the interface of oxide and silicon",
    "fewer_gates": "charge is stored under fewer gates, always or a part of the time",
    "more_gates": "charge is stored under more gates, always or a part of the time",
    "charge_diffusion": "diffusion widens with the charge stored below the drifting electrons",
    "quantum_yield": "some photons of blue or near-ultraviolet light make two electrons",
}
"""Plain words for each piece of physics of the class silicon_physics."""

LAW_WORDS = {
    "adc_bits": ("bit_weight", "the bit has a wrong weight"),
    "adc_bits:shifted": ("shifted_codes", "codes with the bit set are moved by a constant"),
    "adc_bits:wide": (
        "wide_codes",
        "every 2^bit-th code is wider, at the cost of the next",
    ),
    "bias_instability:frame": ("frames", "the level differs from frame to frame"),
    "bias_instability:row": ("rows", "the level differs from row to row, without memory"),
    "bias_instability:row_memory": (
        "rows_with_memory",
        "rows remember the level of the row before",
    ),
    "bias_instability:settling": (
        "settling",
        "rows settle, by a size that differs between frames",
    ),
    "charge_loss": ("exponential", "the loss is proportional to the charge"),
    "charge_loss:power": ("power", "the loss grows as a power of the charge"),
    "charge_loss:filling": ("filling", "the loss saturates, as of traps that fill up"),
    "correlated_noise:ar1": ("autoregressive", "one relaxation, as of a filter"),
    "correlated_noise:common": ("common_mode", "white in time, shared by all amplifiers"),
    "correlated_noise:pickup": ("pickup", "a wave of one period, shared by all amplifiers"),
    "correlated_noise:flicker": ("flicker", "power that falls with the frequency"),
    "cti_parallel": ("proportional", "in proportion to the signal, one packet late"),
    "cti_parallel:traps": ("traps", "a power of the signal, released over several packets"),
    "cti_parallel:two_traps": (
        "two_traps",
        "a power of the signal, with two release times",
    ),
    "cti_serial": ("proportional", "in proportion to the signal, one packet late"),
    "cti_serial:traps": ("traps", "a power of the signal, released over several packets"),
    "cti_serial:two_traps": ("two_traps", "a power of the signal, with two release times"),
    "dark_hot:dark": ("uniform", "in all pixels alike"),
    "dark_hot:glow": ("glow", "around one corner of the sensor"),
    "dark_hot:hot": ("hot_columns", "in single columns"),
    "electronic_memory": ("previous_pixel", "of the pixel read before alone"),
    "electronic_memory:settling": (
        "settling",
        "of all pixels before, falling exponentially",
    ),
    "electronic_memory:offset_drift": (
        "offset_drift",
        "an offset that bright pixels drive",
    ),
    "gain_drift": ("linear", "in proportion to time"),
    "gain_drift:warming": ("warming", "towards a last value, exponentially"),
    "gain_drift:cycle": ("cycle", "as a sine of time"),
    "gain_drift:curve": ("curve", "as a free curve of time"),
    "gain_nonlinearity": ("polynomial", "by a polynomial of the signal"),
    "gain_nonlinearity:kink": ("kink", "by a change of slope at one level"),
    "gain_nonlinearity:low_signal": (
        "low_signal",
        "the first electrons are lost, or too many",
    ),
    "gain_nonlinearity:curve": ("curve", "by a free curve of the signal"),
    "persistence": ("one_exponential", "released with one time constant"),
    "persistence:power": ("power", "released as a power of the age"),
    "persistence:two_times": ("two_exponentials", "above a level, with two time constants"),
    "psf_wings": ("gaussian", "a Gaussian halo"),
    "psf_wings:exponential": ("exponential", "a halo that falls exponentially"),
    "psf_wings:aureole": ("aureole", "an aureole that falls as the square of the distance"),
    "saturation": ("blooming", "charge above it spills along the columns"),
    "saturation:drained": ("drained", "charge above it is lost, or spills in part"),
    "trap_serial": ("sharp", "full after any packet above its reach"),
    "trap_serial:gradual": ("gradual", "larger packets fill it further"),
    "trap_serial:two_times": (
        "two_times",
        "larger packets fill it further; two release times",
    ),
}
"""Name and plain words of the law, by the name of an effect, for classes that have several."""

PARAMETER_WORDS: Mapping[str, Mapping[str, str]] = {
    "cti_serial": {"cti": "fraction left behind per transfer",
        "power": "power of the signal", "tau": "release time constant",
        "slow": "part that is released slowly", "slow_tau": "time constant of that part",
    },
    "cti_parallel": {"cti": "fraction left behind per transfer",
        "power": "power of the signal", "tau": "release time constant",
        "slow": "part that is released slowly", "slow_tau": "time constant of that part",
    },
    "trap_serial": {
        "size": "charge that the trap holds", "tau": "release time constant",
        "amp": "amplifier (the first is 1)", "reach": "smallest packet that meets the trap",
        "column": "columns that are read before it",
        "middle": "signal that fills it", "power": "power of small signals",
        "corner": "sharpness of the corner below full",
        "slow": "part that is released slowly", "slow_tau": "time constant of that part",
    },
    "electronic_memory": {"alpha": "fraction of the pixel read before",
        "tau": "decay constant", "scale": "offset driven per electron",
        "threshold": "signal above which it is driven",
    },
    "interpixel_coupling": {
        "ax": "fraction given to each neighbour in the row",
        "ay": "fraction given to each neighbour in the column",
        "decay": "factor on that per pixel of further distance",
    },
    "amp_crosstalk": {"c": "fraction of the other amplifiers' signal"},
    "correlated_noise": {
        "rms": "rms of the noise", "corr": "correlation with the pixel read before",
        "period": "period",
        "exponent": "power of the frequency by which the noise falls",
        "memory": "time beyond which the noise is white",
    },
    "bias_instability": {
        "rms": "rms of the level",
        "length": "settling length",
        "corr": "correlation with the row before",
    },
    "gain_nonlinearity": {
        "c2": "relative change of the signal at 1e5 e-, linear in the signal",
        "c3": "relative change of the signal at 1e5 e-, quadratic in the signal",
        "slope": "relative change of the slope", "level": "signal at the kink",
        "deficit": "charge lost at high signal", "length": "signal by which most of it is lost",
        **{f"f{n + 1}": f"relative change at {v:g}e5 e-" for n, v in enumerate(SIGNALS)},
    },
    "adc_bits": {
        "delta": "error of codes, or of the bit's weight", "bit": "bit, the lowest is 0",
        "place": "wide code, from multiples of 2^bit",
    },
    "gain_drift": {
        "slope": "relative growth of the signal", "amp": "relative change of the signal",
        "tau": "time constant", "period": "period", "phase": "phase",
        **{f"g{n}": f"relative change after {n}/{TIMES} of the time" for n in range(1, TIMES + 1)},
    },
    "bf_nonlinear": {
        "b": "b in the shift k Q (1 + b Q / 2) of a charge Q", "b_y": "the same of edges between rows",
        "near": "inverse distance over which it falls",
    },
    "bf_chromatic": {
        "kappa": "relative change of the shifts from 620 to 950 nm",
        "power": "power of the absorption length that it goes with",
    },
    "bf_anisotropy": {
        "eps": "excess of the shifts in y over those in x, relative",
        "near": "inverse distance over which it falls",
    },
    "bf_long_range": {
        "amp": "area change at 1 pixel's distance", "power": "power of the distance",
        "near": "inverse length of its exponential",
    },
    "voltage_dependence": {"delta": "relative growth of the shifts per 20 V less back bias"},
    "lateral_diffusion": {"var": "added variance of a spot"},
    "tree_rings": {
        "amp": "amplitude", "period": "period", "xc": "centre in x", "yc": "centre in y",
        "phase": "phase", "chirp": "relative change of the rings' frequency",
        "sway": "relative modulation of the rings' frequency", "length": "length of the modulation",
        "sway_phase": "phase of the modulation",
        "drift": "power of the drift path that it goes with",
        "field": "power of one over the voltage that it goes with",
    },
    "edge_rolloff": {
        "amp": "displacement at the edge", "length": "decay length",
        "sides": "excess near the sides over bottom and top, relative",
        "tail": "one over the power of the distance, 0 for an exponential",
        "rim": "whether the outermost boundaries move (1) or not (0)",
    },
    "mask_stitch": {
        "amp": "displacement of the boundaries", "period": "period",
        "phase": "first displaced boundary, or phase",
        "along": "0 along rows, 1 along columns",
    },
    "tearing": {
        "amp": "displacement at the boundary", "length": "decay length",
        "column": "place of the boundary, as a fraction of the sensor's width",
        "open": "fraction of rows in which the tear never closes",
        "top": "side from which rows count, 0 the bottom and 1 the top",
    },
    "charge_loss": {
        "q": "relative loss of light per stored electron", "power": "power of the charge",
        "knee": "charge at which the loss saturates",
    },
    "persistence": {
        "frac": "fraction released", "tau": "decay constant",
        "exponent": "power of the age by which it falls",
        "slow": "part that is released slowly", "slow_tau": "time constant of that part",
        "threshold": "charge above which it is trapped",
    },
    "shutter_timing": {
        "dt": "exposure beyond the commanded time",
        "shade": "relative change of that from the centre to the last column",
        "rise": "relative change of that from the centre to the last row",
        "iris": "relative fall of that from the centre to the corners",
    },
    "dark_hot": {"rate": "dark current", "columns": "number of hot columns",
                 "length": "decay length", "corner": "corner"}
    | {f"x{n}": f"hot column {n}" for n in range(1, 7)}
    | {f"part{n}": f"dark current of hot column {n} over that of 1" for n in range(2, 7)},
    "saturation": {
        "full_well": "full well", "drain": "part of the charge above it that is lost",
    },
    "fringing": {
        "amp": "relative amplitude", "period": "period (smooth fringes: along a row at the centre)",
        "tilt": "tilt of the contours", "phase": "phase",
        "xx": "curvature of the contours, x x", "xy": "curvature of the contours, x y",
        "yy": "curvature of the contours, y y",
    },
    "psf_wings": {"frac": "fraction of the light in the halo", "sigma": "added width of the halo",
        "length": "length on which the halo falls",
    },
    "cosmic_rays": {"rate": "tracks on 256 x 256 pixels"},
    "illumination_turbulence": {
        "rms": "relative rms of the light", "corr": "correlation length",
    },
    "silicon_physics": {
        "growth": "growth of the variance of diffusion with the charge of the pixel",
        "extra": "electrons that a photon of 350 nm makes beyond one, on average",
    },
}  # fmt: skip
"""Plain words for the parameters of each class, as defined by the class in :mod:`bfsensor.effects`;
parameters that are not listed are printed by their names."""

SCAN_WORDS = {
    "chi-square": "chi-square of the channel",
    FAMILY: "shape of an effect of the library",
    DEVICE_SCAN: "pull of a device parameter",
    "lags": "single lag", "lags together": "several lags together",
    "lag x power": "single lag, by power of the level",
    "lag x condition": "single lag, one light or voltage alone",
    "lag x amplifier": "single lag, one amplifier alone",
    "lag x level": "single lag, one level alone",
    "own shape x power": "all lags as the baseline has them, by power of the level",
    "own shape x condition": "all lags as the baseline has them, one light or voltage alone",
    "mean x power": "mean, by power of the level", "mean x level": "mean, one level alone",
    "mean, step in time": "mean, step in time", "mean, slope in time": "mean, slope in time",
    "mean, one exposure": "mean of one exposure",
    "columns": "single column", "rows": "single row",
    "column strips": "strip of columns", "row strips": "strip of rows",
    "column edges": "columns near an edge", "row edges": "rows near an edge",
    "column waves": "wave along x", "row waves": "wave along y",
    "column boundaries": "columns beside a boundary", "row boundaries": "rows beside a boundary",
    "boxes": "rectangle", "rims": "all four edges", "combs": "every n-th column boundary",
    "rings": "power at one spatial frequency", "texture waves": "wave in the autocorrelation",
    "chess pattern": "alternating pixels",
    "overscan pixel x power": "one overscan pixel, by power of the level",
    "overscan tail x power": "exponential tail, by power of the level",
    "overscan tail x level": "exponential tail, one level alone",
    "noise lag": "single lag", "noise tail": "exponential tail", "noise wave": "wave",
    "bias": "level of all biases", "bias, one exposure": "level of one bias",
    "dark current": "dark level, by exposure time",
    "dark after light": "dark level after bright exposures",
    "struck pixels": "number of pixels hit by particles", "tracks": "number of tracks in darks",
    "dark columns": "single column",
    "spots x power": "shape or flux, by power of the flux",
    "spots x condition": "shape or flux, one light or voltage alone",
    "spots, one exposure": "shape or flux in one exposure",
    "code bits": "one bit", "codes": "one code", "codes below high bits": "codes below a high bit",
    "amplifiers": "one pair of amplifiers",
}  # fmt: skip
"""Plain words for the scans of report.json ('family')."""


def said_p(value: float, floor: float = SMALLEST) -> str:
    """Print a p-value; at or below the floor of its calculation as '< 1e-30'."""
    return f"< {floor:.0e}" if value <= floor else f"{value:.2g}"


def said_family_p(value: float) -> str:
    """Print a family-wise p-value, which is twice the smaller one of two families."""
    return said_p(value, 2 * SMALLEST)


def said_number(value: float, digits: int = 3) -> str:
    """Print a number with a few digits, from a thousand to a million without exponent."""
    rounded = float(f"{value:.{digits}g}")
    return f"{rounded:,.0f}" if 1e3 <= abs(rounded) < 1e6 else f"{value:.{digits}g}"


def said_interval(told: Mapping[str, Any], level: str) -> str:
    """Print the interval of a parameter of report.json, '68' or '95'; open ends in words."""
    if f"lo{level}" not in told:
        return "chosen, not fitted"
    low, high = said_number(told[f"lo{level}"]), said_number(told[f"hi{level}"])
    open_ = told.get(f"open{level}", ())
    text = f"{low} to {high}"
    if len(open_) == 2:
        text = "not constrained"
    elif open_:
        text = f"above {low}" if "hi" in open_ else f"below {high}"
    if told.get(f"stopped{level}"):
        text += f", calculated between {low} and {high} only"
    return text


def said_value(word: str, name: str, value: float) -> str:
    """Print a parameter's value; amplifiers are counted from 1, in report.json from 0."""
    if (word, name) == ("trap_serial", "amp"):
        return f"{value + 1:g}"
    return said_number(value)
