"""Laws that the virtual bench and the fitter share, with conversions of their parameters.

The bench (:mod:`validation.foreign`) defines laws of its own.  Where the library
(:mod:`bfsensor.effects`) has a law with the same formula, a truth's parameters can be
compared with those of report.json, but often only after a conversion: equal names may stand
for unlike quantities, other units, signs, origins or reference signals.  :data:`SAME_LAWS`
holds these pairs of laws; a parameter without an exact conversion is left out, with the
reason beside it.

Not in the table, as the library has no such formula, although it may come near:

    class                   law                 difference
    amp_crosstalk           delayed, nonlinear  the library's crosstalk is linear and prompt
    bf_chromatic            absorption          changes at 620 nm too, where the library's
                                                is 0
    bf_chromatic            window              1 - exp(-1/l) is no power of the length l
    bf_long_range           all                 the bench samples a 1/r field at the middle
                                                of edges: areas of pixels beside the charge
                                                are 3 to 12 times amp a(r)
    bf_nonlinear            own_edges           the library's limit near = infinity
    bf_nonlinear            saturating          1 / (1 - b Q/2), not 1 + b Q/2
    cosmic_rays             all                 2 s of readout, not 5 s; angles as cos^2,
                                                not cos^3; no diffusion: other pixels are
                                                struck
    dark_hot                hot_columns         columns begin at a row, rates differ
    device_parameter        all                 the library is linear in the parameter;
                                                values have the same names and units on both
                                                sides
    gain_nonlinearity       spline_table        another spline
    illumination_turbulence kolmogorov          no Gaussian covariance
    interpixel_coupling     extended            5 x 5 pixels, not all within 3 pixels
    lateral_diffusion       all                 other dependences on wavelength and voltage
    persistence             power_law           ends after 30 exposures, not exponentially
    psf_wings               king                the library's aureole ends elsewhere
    saturation              spill_back          a soft limit
    silicon_physics         all                 no such effects
    tearing                 ragged              a bent tear that lasts until one exposure
    trap_serial             logistic_capture    a logistic function of the signal
    voltage_dependence      drop                changes the form of the shifts too
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from validation.foreign.device import DEVICES, absorption_length

Values = Mapping[str, Any]
Conversion = Callable[[Values], float]

SETTING = ("plan", "layout", "device", "pixels")
"""Entries of a truth, beside those of the effect, that conversions may need."""

CYCLES = frozenset({
    ("fringing", "phase"), ("gain_drift", "phase"), ("mask_stitch", "phase"),
    ("tree_rings", "phase"),
})  # fmt: skip
"""(class, parameter) in cycles: values that differ by a whole number are the same.  The
phase of mask_stitch is in cycles for the law 'wave' only."""

PIVOT = 5e4
"""Signal [e-] at which the library defines ``cti`` of traps (its module ``transfer``)."""

FULL = 1e5
"""Signal [e-] at which the bench defines ``cti`` of traps."""

INDEX = 3.65
"""Refractive index of silicon in the bench's fringes."""

RED = 900.0
"""Shortest wavelength [nm] at which the library has fringes."""

REST_DARK = 0.01
"""Dark current [e-/s] that each sensor of the bench has."""

SMALL_LOSS = 0.01
"""Largest loss x at 1e5 e- for which 1 - x counts as exp(-x).

Chosen: the error x / 2 is at most 0.5 % of the loss; twice as large, 1 %."""


@dataclass(frozen=True)
class SameLaw:
    """A law of the library, and how its parameters follow from those of the bench's law.

    Attributes
    ----------
    law : str
        Its word in report.json's 'law'; '' where the report states none.
    convert : mapping of str to callable
        By parameter of the library: takes the values of the bench's law (parameters, shape,
        and the entries :data:`SETTING` of the truth) and gives the value as report.json
        states it. It raises KeyError where an entry is missing, and gives nan where there
        is no value.
    also : tuple of str
        Other words that the same law of the library has in reports, by its fitted values.
    """

    law: str
    convert: Mapping[str, Conversion] = field(default_factory=dict)
    also: tuple[str, ...] = ()


def _as(name: str) -> Conversion:
    """Give a bench's parameter as it is."""
    return lambda v: float(v[name])


def _is(value: float) -> Conversion:
    """Give a value that the bench's law has always."""
    return lambda v: value


def _cycle(turns: float) -> float:
    """Phase in cycles, from -0.5 to 0.5."""
    return float((turns + 0.5) % 1.0 - 0.5)


# ---- transfer
def _released(tau: float) -> float:
    """Fraction of a trap's charge that it releases into the next packet."""
    return float(-np.expm1(-1 / tau))


def _one_kind(v: Values) -> float:
    """Library's ``cti`` of traps of one kind.

    Bench: behind n transfers traps hold n cti 1e5 (S/1e5)^beta, of which the first packet
    after the light receives 1 - exp(-1/tau).  Library: that packet receives n cti 5e4
    (S/5e4)^power.  Both agree behind flats; of spots, whose light meets empty traps, the
    bench captures all that traps hold and the library only what the first packet receives.
    """
    return _at_pivot(v) * _released(v["tau"])


def _at_pivot(v: Values) -> float:
    """Bench's ``cti`` as a fraction of a packet of :data:`PIVOT` electrons."""
    return float(v["cti"] * (FULL / PIVOT) ** (1 - v["beta"]))


def _slow_part(v: Values) -> float:
    """Part of the slow kind.

    Bench (share2): of the charge held.  Library (slow): of what the next packet receives.
    """
    slow = v["share2"] * _released(v["tau2"])
    return float(slow / (slow + (1 - v["share2"]) * _released(v["tau"])))


def _two_kinds(v: Values) -> float:
    """Library's ``cti`` of traps of two kinds: :func:`_one_kind` with both releases."""
    parts = (1 - v["share2"]) * _released(v["tau"]) + v["share2"] * _released(v["tau2"])
    return float(_at_pivot(v) * parts)


def _behind_prescan(v: Values) -> float:
    """Register pixel of a trap, the prescan counted; the library counts columns of the image."""
    return float(v["column"] - v["layout"]["prescan"])


_TRAPS = SameLaw("traps", {"cti": _one_kind, "power": _as("beta"), "tau": _as("tau")})
_TWO_TRAPS = SameLaw(
    "two_traps",
    {
        "cti": _two_kinds, "power": _as("beta"), "tau": _as("tau"), "slow": _slow_part,
        "slow_tau": _as("tau2"),
    },
)  # fmt: skip
_PROPORTIONAL = SameLaw("proportional", {"cti": _as("cti")})

_TRANSFER = {
    **{
        (word, law): same
        for word in ("cti_serial", "cti_parallel")
        for law, same in (
            ("proportional", _PROPORTIONAL), ("volume_filling", _TRAPS),
            ("two_time_constants", _TWO_TRAPS),
        )
    },
    # Bench: size min(S / full, 1); library: the limit corner = infinity of its rounded
    # corner. Fits have a finite corner, on which size, middle and power depend: they are
    # left out.
    ("trap_serial", "linear_capture"): SameLaw(
        "gradual", {"tau": _as("tau"), "amp": _as("amp"), "column": _behind_prescan}
    ),
    # Bench: size (S/1e5)^beta without an end; library: the limit middle = infinity.  Size
    # and middle are then one number, and the power depends on the middle of a fit: left
    # out.  Parts are those of the charge held, on both sides.
    ("trap_serial", "volume_two_times"): SameLaw(
        "two_times",
        {
            "tau": _as("tau"), "slow": _as("share2"), "slow_tau": _as("tau2"),
            "amp": _as("amp"), "column": _behind_prescan,
        },
    ),
}  # fmt: skip


# ---- stored charge and collection
def _filling_knee(v: Values) -> float:
    """Charge at which traps are half full, in an exponent.

    Bench: a fraction 1 - x is collected, x = q Q / (1 + Q/K).  Library: exp(-x), with K'.
    -ln(1 - x) is x / (1 - x/2) up to x^3 / 12, which is the library's form with
    1/K' = 1/K - q/2.
    """
    return float(1 / (1 / v["saturation_charge"] - v["q"] / 2))


def _if_small_loss(value: Conversion) -> Conversion:
    # Bench: 1 - x is collected, library exp(-x), x = q 1e5 (Q/1e5)^(1/2): no power of the
    # charge makes them equal, unless x is small.
    return lambda v: value(v) if v["q"] * FULL < SMALL_LOSS else np.nan


def _voltage_delta(v: Values) -> float:
    """Change of the shifts at -40 V.

    Bench: (V/V0)^p; library: linear.  They are the same if no other voltage is recorded.
    """
    return float(v["delta"]) if set(v["plan"]["back_biases"]) <= {-40.0} else np.nan


def _glow_rate(v: Values) -> float:
    """Rate at the corner.

    Bench: distances from the middle of the corner's pixel; library: from its outer corner,
    which is farther by (cos + sin) / 2, 2 / pi on average over a quadrant; pixels
    differ from that by at most 0.14 pixel, 0.7 % of the rate for the shortest length of 20
    pixels.
    """
    return float(v["rate"] * np.exp(2 / np.pi / v["length"]))


def _persistent_parts(v: Values) -> tuple[float, float]:
    # Bench: exp(-(k-1)/tau) in the k-th exposure after; library: exp(-k/tau).
    slow = v["share2"] * np.exp(1 / v["tau2"])
    return float((1 - v["share2"]) * np.exp(1 / v["tau"])), float(slow)


_CHARGE = {
    ("amp_crosstalk", "linear"): SameLaw("", {"c": _as("c")}),
    ("interpixel_coupling", "four_neighbours"): SameLaw(
        "four_neighbours",
        {"ax": _as("ax"), "ay": _as("ay"), "decay": _is(0.0)},
        ("extended",),
    ),
    ("saturation", "hard_clip"): SameLaw(
        "drained", {"full_well": _as("full_well"), "drain": _is(1.0)}
    ),
    ("saturation", "blooming"): SameLaw("blooming", {"full_well": _as("full_well")}),
    ("psf_wings", "exponential"): SameLaw(
        "exponential", {"frac": _as("frac"), "length": _as("length")}
    ),
    ("charge_loss", "exponential"): SameLaw("exponential", {"q": _as("q")}),
    ("charge_loss", "langmuir"): SameLaw("filling", {"q": _as("q"), "knee": _filling_knee}),
    ("charge_loss", "root"): SameLaw(
        "power", {"q": _if_small_loss(_as("q")), "power": _if_small_loss(_is(0.5))}
    ),
    # Darks are taken at -100 C, where both rates are defined.  The library's is constrained
    # by struck pixels of darks, which all dark charge makes: that of every sensor is added.
    ("dark_hot", "uniform"): SameLaw("uniform", {"rate": lambda v: v["rate"] + REST_DARK}),
    ("dark_hot", "glow"): SameLaw(
        "glow",
        {
            "rate": _glow_rate, "length": _as("length"),
            # Bench: (right, top), each 0 or 1; library: right + 2 top.
            "corner": lambda v: float(v["corner"][0] + 2 * v["corner"][1]),
        },
    ),
    # The bench also takes what is released later from the exposure itself: in proportion,
    # as a fainter lamp would; above a threshold it bends the response, by up to 0.5 %.
    ("persistence", "one_exponential"): SameLaw(
        "one_exponential",
        {"frac": lambda v: v["frac"] * np.exp(1 / v["tau"]), "tau": _as("tau")},
    ),
    ("persistence", "two_exponentials"): SameLaw(
        "two_exponentials",
        {
            "frac": lambda v: v["frac"] * sum(_persistent_parts(v)), "tau": _as("tau"),
            "slow": lambda v: _persistent_parts(v)[1] / sum(_persistent_parts(v)),
            "slow_tau": _as("tau2"), "threshold": _as("threshold"),
        },
    ),
}  # fmt: skip


# ---- shifts by charge
_SHIFTS = {
    ("bf_nonlinear", "packet_height"): SameLaw("packet_height", {"b": _as("b")}),
    # Bench: b (1 -+ split) for edges between columns and rows; library: one number for
    # each.
    ("bf_nonlinear", "two_axes"): SameLaw(
        "two_axes",
        {
            "b": lambda v: v["b"] * (1 - v["split"]),
            "b_y": lambda v: v["b"] * (1 + v["split"]), "near": _is(0.0),
        },
        ("own_edges",),
    ),
    ("bf_chromatic", "linear"): SameLaw("wavelength", {"kappa": _as("kappa")}),
    ("bf_anisotropy", "uniform"): SameLaw(
        "uniform", {"eps": _as("eps"), "near": _is(0.0)}, ("near",)
    ),
    # A report calls this law 'uniform' where the length is above 1 / ln 2 = 1.44 pixels.
    ("bf_anisotropy", "near"): SameLaw(
        "near", {"eps": _as("eps"), "near": lambda v: 1 / v["length"]}, ("uniform",)
    ),
    ("voltage_dependence", "linear"): SameLaw("", {"delta": _as("delta")}),
    ("voltage_dependence", "power"): SameLaw("", {"delta": _voltage_delta}),
}  # fmt: skip


# ---- fixed shifts
def _rim_amp(v: Values) -> float:
    """Amplitude outwards.

    Bench: amp above 0 moves edges inwards, those of both axes or of one.  Library:
    outwards, (1 + sides) A between columns and (1 - sides) A between rows.
    """
    return float(-v["amp"] if v["axes"] == "xy" else -v["amp"] / 2)


def _rim_sides(v: Values) -> float:
    return {"xy": 0.0, "x": 1.0, "y": -1.0}[v["axes"]]


_RIM: dict[str, Conversion] = {"amp": _rim_amp, "sides": _rim_sides, "rim": _is(0.0)}
"""The bench holds the outermost edges: the library's ``rim`` is 0."""


def _if_columns(value: Conversion) -> Conversion:
    # The library displaces single boundaries between columns only.
    return lambda v: value(v) if v["axis"] == "x" else np.nan


def _step_phase(v: Values) -> float:
    """First displaced boundary, e being that before column e.

    Bench: (e - 1 + phase) mod period = 0.  Library: e mod period = phase.
    """
    return float((1 - v["phase"]) % v["period"])


def _wave_phase(v: Values) -> float:
    """Phase at boundary 0, in cycles.

    Bench: amp sin 2 pi (x + phase) / period at x = e - 1/2, phase in pixels, amp of either
    sign. Library: A sin 2 pi (e / period + phase), A above 0.
    """
    return _cycle((v["phase"] - 0.5) / v["period"] + 0.5 * (v["amp"] < 0))


def _ring_phase(v: Values) -> float:
    """Phase of a sine in cycles.

    Bench: cos(2 pi r / period + phase); library: sin 2 pi (r / period + phase).
    """
    return _cycle(v["phase"] / (2 * np.pi) + 0.25)


_FIXED = {
    ("edge_rolloff", "exponential"): SameLaw(
        "exponential", {**_RIM, "length": _as("length"), "tail": _is(0.0)}, ("power",)
    ),
    # Bench: (1 + d / length)^-exponent; library: (1 + tail d / length)^(-1 / tail).
    ("edge_rolloff", "power"): SameLaw(
        "power",
        {
            **_RIM, "length": lambda v: v["length"] / v["exponent"],
            "tail": lambda v: 1 / v["exponent"],
        },
        ("exponential",),
    ),
    ("mask_stitch", "step"): SameLaw(
        "step",
        {
            "amp": _if_columns(_as("amp")), "period": _if_columns(_as("period")),
            "phase": _if_columns(_step_phase),
        },
    ),
    ("mask_stitch", "wave"): SameLaw(
        "wave",
        {
            "amp": lambda v: abs(v["amp"]), "period": _as("period"), "phase": _wave_phase,
            "along": lambda v: float(v["axis"] == "y"),
        },
    ),
    # Bench: amp above 0 leans towards the tear, in all rows of all exposures; library: away
    # from it, up to a row (``open`` of the height at least).  ``top`` has no meaning for
    # open = 1.
    ("tearing", "divisadero"): SameLaw(
        "divisadero",
        {
            "amp": lambda v: -v["amp"], "length": _as("length"), "column": _as("column"),
            "open": _is(1.0),
        },
    ),
    ("tree_rings", "one_period"): SameLaw(
        "one_period",
        {
            "amp": _as("amp"), "period": _as("period"), "xc": _as("xc"), "yc": _as("yc"),
            "chirp": _is(0.0), "phase": _ring_phase,
        },
    ),
    # The library takes the profile from the map.  Bench: amp times (r / pixels)^growth,
    # falling with 1 - depth / thickness and 1 / bias; library: amp times a profile of the
    # mean square of a sine, falling with powers of the drift path and of the whole voltage;
    # its period is that of the strongest wave.  Only the centre is the same quantity.
    ("tree_rings", "growing_sum"): SameLaw("radial", {"xc": _as("xc"), "yc": _as("yc")}),
}  # fmt: skip


# ---- light
def _red(v: Values) -> float:
    """Wavelength at which the library has fringes; nan without one."""
    return max((w for w in v["plan"]["wavelengths"] if w >= RED), default=np.nan)


def _fringe_amp(v: Values) -> float:
    """Amplitude in the red flats that there are.

    Bench: amp at 950 nm, elsewhere by the light that crosses the silicon twice.
    """
    t, red = DEVICES[v["device"]["nominal"]].thickness, _red(v)
    if not red > 0:
        return np.nan
    return float(
        v["amp"] * np.exp(2 * t / absorption_length(950) - 2 * t / absorption_length(red))
    )


def _fringe_period(v: Values) -> float:
    """Period along a row in the middle [pixel].

    Bench: cos(4 pi n d / lambda), d = (a X + b Y) / N + bowl (X^2 + Y^2) / N^2 [um] at X, Y
    from the middle of N pixels.  Library: sin 2 pi ((X + tilt Y + ...) / period + phase).
    """
    turns = 2 * INDEX * 1e3 / _red(v) * abs(v["wedge"][0])
    return float(v["pixels"] / turns)


def _fringe_curve(v: Values) -> float:
    # Both sides are even in the phase: a change of the sign of a changes that of all
    # others.
    return float(v["bowl"] / v["wedge"][0])


def _iris_mean(v: Values) -> float:
    """Mean over the sensor of 1 - shading 2 (x^2 + y^2), x = i/N - 1/2: 1 - shading / 3."""
    return float(1 - v["shading"] / 3 * (1 + 2 / v["pixels"] ** 2))


def _iris_middle(v: Values) -> float:
    """1 - shading 2 (x^2 + y^2) in the middle of the sensor, half a pixel beside x = 0."""
    return float(1 - v["shading"] / v["pixels"] ** 2)


def _iris_slope(v: Values) -> float:
    """Slope that the half pixel makes: library's places -1 to 1 are 2 x + 1/N."""
    return float(v["shading"] / v["pixels"] / _iris_middle(v))


_OTHER_SHUTTERS = ("offset", "iris", "blade")

_LIGHT = {
    ("fringing", "wedge"): SameLaw(
        "",
        {
            "amp": _fringe_amp, "period": _fringe_period,
            "tilt": lambda v: v["wedge"][1] / v["wedge"][0], "xx": _fringe_curve,
            "xy": _is(0.0), "yy": _fringe_curve, "phase": _is(0.25),
        },
    ),
    # Power exp(-(2 pi k length)^2 / 2) is the covariance exp(-r^2 / 2 length^2) on both
    # sides. rms is left out: the bench's fields have no mean over the sensor, and a part
    # ``memory`` of them is the same in both flats of a pair, while the library's are
    # independent.
    ("illumination_turbulence", "drifting_cells"): SameLaw("", {"corr": _as("length")}),
    ("shutter_timing", "offset"): SameLaw(
        "offset",
        {"dt": _as("dt"), "shade": _is(0.0), "rise": _is(0.0), "iris": _is(0.0)},
        _OTHER_SHUTTERS,
    ),
    # Bench: dt on average over the sensor; library: dt in its middle, less iris (x^2 + y^2)
    # / 2.
    ("shutter_timing", "iris"): SameLaw(
        "iris",
        {
            "dt": lambda v: v["dt"] * _iris_middle(v) / _iris_mean(v),
            "shade": _iris_slope, "rise": _iris_slope,
            "iris": lambda v: v["shading"] / _iris_middle(v),
        },
        _OTHER_SHUTTERS,
    ),
    # Bench: dt (1 + shading y), y = j/N - 1/2; library: y = 2 (j + 1/2)/N - 1.
    ("shutter_timing", "blade"): SameLaw(
        "blade",
        {
            "dt": lambda v: v["dt"] * (1 - v["shading"] / (2 * v["pixels"])),
            "shade": _is(0.0), "iris": _is(0.0),
            "rise": lambda v: v["shading"] / (2 - v["shading"] / v["pixels"]),
        },
        _OTHER_SHUTTERS,
    ),
}  # fmt: skip


# ---- amplifier, converter, noise
def _cycle_amp(v: Values) -> float:
    """Amplitude of a sine, above 0, from its largest slope [1/h], of either sign."""
    return float(abs(v["slope"]) * v["period_hours"] / (2 * np.pi))


def _first_column(v: Values) -> float:
    """Bench: rms over the columns of a frame; library: rms at the first column."""
    lay = v["layout"]
    width = lay["pixels"] // (lay["amplifiers"] // lay["rows"])
    columns = np.arange(lay["prescan"] + width + lay["serial_overscan"])
    return float(v["rms"] / np.sqrt(np.mean(np.exp(-2 * columns / v["length"]))))


_READOUT = {
    ("electronic_memory", "previous_pixel"): SameLaw(
        "previous_pixel", {"alpha": _as("alpha")}
    ),
    ("electronic_memory", "settling"): SameLaw(
        "settling", {"alpha": _as("alpha"), "tau": _as("tau")}
    ),
    ("electronic_memory", "threshold_and_decay"): SameLaw(
        "offset_drift",
        {"scale": _as("alpha"), "threshold": _as("threshold"), "tau": _as("tau")},
    ),
    ("gain_nonlinearity", "polynomial"): SameLaw(
        "polynomial", {"c2": _as("c2"), "c3": _as("c3")}
    ),
    ("gain_nonlinearity", "kink"): SameLaw(
        "kink", {"slope": _as("c"), "level": _as("level")}
    ),
    ("gain_nonlinearity", "low_signal"): SameLaw(
        "low_signal", {"deficit": _as("c"), "length": _as("length")}
    ),
    ("gain_drift", "linear"): SameLaw("linear", {"slope": _as("slope")}),
    # Bench: slope at the begin; library: change in the end.
    ("gain_drift", "warming_up"): SameLaw(
        "warming",
        {"amp": lambda v: v["slope"] * v["tau_hours"], "tau": _as("tau_hours")},
    ),
    ("gain_drift", "thermal_cycle"): SameLaw(
        "cycle",
        {
            "amp": _cycle_amp, "period": _as("period_hours"),
            "phase": lambda v: 0.5 * (v["slope"] < 0),
        },
    ),
    # Codes with the bit set are written delta higher, on both sides; the library's other
    # law, of the word 'bit_weight', has a converter that decides by a wrong weight.
    ("adc_bits", "bit_weight"): SameLaw(
        "shifted_codes", {"delta": _as("delta"), "bit": _as("bit")}
    ),
    # The bench's wide codes are the multiples of 2^bit themselves: place 0.
    ("adc_bits", "wide_codes"): SameLaw(
        "wide_codes", {"delta": _as("delta"), "bit": _as("bit"), "place": _is(0.0)}
    ),
    ("correlated_noise", "autoregressive"): SameLaw(
        "autoregressive", {"rms": _as("rms"), "corr": _as("corr")}
    ),
    ("correlated_noise", "pickup_line"): SameLaw(
        "pickup", {"rms": _as("rms"), "period": _as("period")}
    ),
    # Bench: white below 1 / 20000 cycles per pixel, with a sharp knee; library: a soft knee
    # at 1 / (2 pi memory).  Above it both fall as f^-exponent; rms and memory depend on the
    # knee.
    ("correlated_noise", "pink"): SameLaw("flicker", {"exponent": _as("exponent")}),
    ("correlated_noise", "common_mode"): SameLaw("common_mode", {"rms": _as("rms")}),
    ("bias_instability", "frames"): SameLaw("frames", {"rms": _as("rms")}),
    ("bias_instability", "rows"): SameLaw(
        "rows_with_memory", {"rms": _as("rms"), "corr": _as("memory")}
    ),
    ("bias_instability", "along_rows"): SameLaw(
        "settling", {"rms": _first_column, "length": _as("length")}
    ),
}  # fmt: skip

SAME_LAWS: dict[tuple[str, str], SameLaw] = {
    **_TRANSFER, **_CHARGE, **_SHIFTS, **_FIXED, **_LIGHT, **_READOUT,
}  # fmt: skip
"""The library's law by (class, law of the bench)."""

EQUAL_LAWS: dict[tuple[str, str], tuple[SameLaw, ...]] = {
    # Codes with the bit set are |delta| too low, |delta| up to 1: the same codes are then
    # wide as of a bit that weighs |delta| too much.  Above 1 and for delta above 0 they are
    # others.
    ("adc_bits", "bit_weight"): (
        SameLaw(
            "bit_weight",
            {
                "delta": lambda v: -v["delta"] if -1 <= v["delta"] < 0 else np.nan,
                "bit": lambda v: float(v["bit"]) if -1 <= v["delta"] < 0 else np.nan,
            },
        ),
    ),
    ("charge_loss", "exponential"): (
        SameLaw("power", {"q": _as("q"), "power": _is(1.0)}),
    ),
    # One wave in radius, the same for all light and voltages.  The phase is in the profile.
    ("tree_rings", "one_period"): (
        SameLaw(
            "radial",
            {
                "amp": _as("amp"), "period": _as("period"), "xc": _as("xc"),
                "yc": _as("yc"), "drift": _is(0.0), "field": _is(0.0),
            },
        ),
    ),
}  # fmt: skip
"""Further laws of the library with the same formula: more general ones, and equal ones."""


def expected_parameters(
    effect: Mapping[str, Any],
    truth: Mapping[str, Any] | None = None,
    *,
    law: str | None = None,
) -> dict[str, float]:
    """Return a truth's effect in the library's parameters, as report.json states them.

    Parameters
    ----------
    effect : mapping
        Entry of a truth's ``effects``: 'class', 'law', 'parameters', 'shape'.
    truth : mapping, optional
        The whole truth.  Without it parameters that depend on :data:`SETTING` are left out.
    law : str, optional
        Word of the law in the report ('' where it states none): the parameters are those of
        this law.  By default they are those of :data:`SAME_LAWS`.

    Returns
    -------
    dict of str to float
        Empty where the library has no law of the same formula, or ``law`` has another one.

    Examples
    --------
    >>> stitch = {"period": 8.0, "phase": 2.5, "amp": -0.002}
    >>> effect = {"class": "mask_stitch", "law": "wave", "parameters": stitch}
    >>> expected_parameters({**effect, "shape": {"axis": "y"}})
    {'amp': 0.002, 'period': 8.0, 'phase': -0.25, 'along': 1.0}
    """
    key = effect["class"], effect.get("law", "")
    same = SAME_LAWS.get(key)
    if same is not None and law is not None and law not in (same.law, *same.also):
        same = next((s for s in EQUAL_LAWS.get(key, ()) if s.law == law), None)
    if same is None:
        return {}
    setting = {k: truth[k] for k in SETTING if k in truth} if truth else {}
    values = {**setting, **(effect.get("shape") or {}), **effect["parameters"]}
    out = {}
    for name, convert in same.convert.items():
        try:
            value = float(convert(values))
        except KeyError:
            continue
        if np.isfinite(value):
            out[name] = value
    return out
