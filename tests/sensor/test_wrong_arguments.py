"""Arguments of a wrong type or size: taken on purpose, or refused with an error that names them."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable
from typing import Any

import galsim
import numpy as np
import pytest

from bfsensor import BrighterFatterSensor, SensorError, ShiftMap, SiliconSensor, draw_flat
from bfsensor.sensor import iterate_flat
from tests.sensor.contract_cases import BOTH, RINGS, blank, make, photons

WRONG = {
    "none": None, "text": "x", "list": [1.0], "dict": {"a": 1}, "nan": math.nan,
    "inf": math.inf, "negative": -1.0, "complex": 1j, "huge": 10**400, "large": 1e300,
    "array": np.zeros(3), "object": object(), "bool": True,
}  # fmt: skip
"""Values of which an argument takes few or none."""

LIGHT = photons(50)
CORNERS = np.zeros((3, 3))

# What is taken of them.  Numbers that GalSim knows too: True is 1, as there; of others it is refused.
SEED = "none text negative bool"  # as galsim.BaseDeviate takes them
FLAG = "bool"
NUMBER = "bool"
SIGNED = "bool negative"
TAKEN = {
    # A strength below 0 attracts, for comparisons; GalSim takes it, and nan, as well.
    "strength": SIGNED, "rng": SEED, "diffusion_factor": NUMBER, "nrecalc": "bool large",
    "transpose": FLAG, "threads": "none large", "charge_response": FLAG,
    "background": FLAG, "depth": FLAG, "predict": FLAG, "full_well": "none inf large",
    "treering_func": "none",
    **dict.fromkeys(["shift_map", "temperature", "table", "effects", "conditions", "layout"],
                    "none"),
}  # fmt: skip
"""Values that the constructors take by argument, none where it is not named."""
ONE = {
    # Never renewed, as for GalSim; the other sensor foresees the charge of a finite block.
    (SiliconSensor, "nrecalc"): "bool large inf",
    (SiliconSensor, "qdist"): "bool", (BrighterFatterSensor, "qdist"): "bool none",
}  # fmt: skip
"""The same where the constructors differ."""

Target = tuple[Callable[[Any], Any], str]
"""A call with one argument left open, and the values that it takes."""


def of_constructors() -> dict[tuple[str, str], Target]:
    """Every argument of both constructors; new ones are found by themselves."""
    return {
        (kind.__name__, name): (
            lambda v, kind=kind, name=name: kind(**{name: v}),
            ONE.get((kind, name), TAKEN.get(name, "")),
        )
        for kind in (SiliconSensor, BrighterFatterSensor)
        for name in inspect.signature(kind).parameters
    }


def of_methods() -> dict[tuple[str, str], Target]:
    """Every argument of the methods of both sensors, and the attribute that is one."""
    out: dict[tuple[str, str], Target] = {}
    for kind, options in (
        (SiliconSensor, {}), (BrighterFatterSensor, {}), (BrighterFatterSensor, {"beyond": "error"}),
    ):  # fmt: skip
        sensor = make(kind, **options)
        label = kind.__name__ + ("(beyond='error')" if options else "")

        def accumulate(value, name, sensor=sensor):
            given = {"photons": LIGHT, "image": blank()}
            # Otherwise a value that is taken as True would have nothing to resume.
            sensor.accumulate(**given)
            sensor.accumulate(**{**given, "resume": name == "recalc", name: value})

        def areas(value, name, sensor=sensor):
            sensor.calculate_pixel_areas(**{"image": blank(), name: value})

        def set_threads(value, sensor=sensor):
            sensor.threads = value
            sensor.accumulate(LIGHT, blank())
            sensor.threads = 1

        taken = {"resume": FLAG, "recalc": FLAG, "use_flux": FLAG}
        for method, call in (("accumulate", accumulate), ("calculate_pixel_areas", areas)):
            for name in inspect.signature(getattr(sensor, method)).parameters:
                out[f"{label}.{method}", name] = (
                    lambda v, call=call, name=name: call(v, name), taken.get(name, ""),
                )  # fmt: skip
        out[f"{label}.updateRNG", "rng"] = (sensor.updateRNG, SEED)
        out[f"{label}", "threads"] = (set_threads, TAKEN["threads"])
    out["finish", "image"] = (make(BrighterFatterSensor).finish, "")
    return out


def of_functions(folder: str) -> dict[tuple[str, str], Target]:
    """Every argument of the functions for flats and of shift maps."""
    flat = {"sensor": make(SiliconSensor), "shape": (4, 4), "level": 10.0, "step": 5.0,
            "rng": 1, "illumination": None, "border": 2, "dtype": np.float32}  # fmt: skip
    taken = {"step": "large", "rng": SEED, "illumination": "none",
             "border": "none"}  # fmt: skip
    out: dict[tuple[str, str], Target] = {}
    for name in inspect.signature(draw_flat).parameters:
        out["draw_flat", name] = (
            lambda v, name=name: draw_flat(**{**flat, name: v}), taken.get(name, ""),
        )  # fmt: skip
        out["iterate_flat", name] = (
            lambda v, name=name: list(iterate_flat(**{**flat, name: v})), taken.get(name, ""),
        )  # fmt: skip
    corners = {"dx": CORNERS, "dy": CORNERS}
    for name in inspect.signature(ShiftMap).parameters:
        out["ShiftMap", name] = (
            lambda v, name=name: ShiftMap(**{**corners, name: v}),
            "negative large" if name in ("x0", "y0") else "",
        )  # fmt: skip
    for name in inspect.signature(ShiftMap.from_edges).parameters:
        out["ShiftMap.from_edges", name] = (
            lambda v, name=name: ShiftMap.from_edges(**{"shape": (5, 5), name: v}),
            "" if name == "shape" else "none array",
        )  # fmt: skip
    out["ShiftMap.read", "path"] = (lambda v: ShiftMap.read(v), "")
    out["ShiftMap.write", "path"] = (
        lambda v: ShiftMap(**corners).write(f"{folder}/{v}" if isinstance(v, str) else v), "text",
    )  # fmt: skip
    return out


KEPT = {"name": OSError}
"""Errors that are no SensorError, by argument: GalSim's own tests ask for them."""


FREE = ("dx", "dy", "rng", "dtype", "shape", "illumination", "photons", "image", "orig_center",
        "treering_func", "treering_center", "table", "effects", "conditions", "layout", "sensor",
        "shift_map", "name", "path", "red", "absorption", "diffusion", "surroundings", "beyond",
        "x_low", "x_high", "y_low", "y_high")  # fmt: skip
"""Arguments that are no numbers or flags: any other value, a number too, is of a wrong type."""


def outcome(name: str, call: Callable[[Any], Any], value: Any) -> str:
    """What a call answers: 'taken', 'refused', or the fault of its error."""
    try:
        call(value)
    except (SensorError, galsim.GalSimError) as error:
        kind, text = type(error), str(error)
    except Exception as error:
        kind, text = type(error), str(error)
        if kind is not KEPT.get(name):
            return f"{kind.__name__}: {text}"
    else:
        return "taken"
    if "\n" in text or len(text) > 400:
        return f"{kind.__name__} is long: {text}"
    types = not isinstance(value, str | int | float)
    if (
        issubclass(kind, SensorError)
        and name not in FREE
        and types != issubclass(kind, TypeError)
    ):
        return f"{kind.__name__} for {type(value).__name__}: {text}"
    named = name in text or (isinstance(value, str) and f"{value}" in text)
    return "refused" if named else f"{kind.__name__} without {name!r}: {text}"


@pytest.mark.parametrize("group", [of_constructors, of_methods, of_functions])
@pytest.mark.filterwarnings(
    "error::RuntimeWarning", "error::numpy.exceptions.ComplexWarning"
)
def test_wrong_values_are_refused_by_name(group, tmp_path):
    targets = group(str(tmp_path)) if group is of_functions else group()
    faults = []
    for (where, name), (call, taken) in targets.items():
        for word, value in WRONG.items():
            found = outcome(name, call, value)
            if found != ("taken" if word in taken.split() else "refused"):
                faults.append(f"{where}, {name} = {word}: {found}")
    assert not faults, "\n".join(faults)


@BOTH
@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"strength": "strong"}, "strength = 'strong' must be a finite number from -1e+06 to 1e+06"),
        ({"nrecalc": -5}, r"nrecalc = -5 must be a (finite )?number from 0$"),
        ({"diffusion_factor": -1}, "diffusion_factor = -1 must be a finite number from 0 to 1e+06"),
        ({"qdist": 2.5}, "qdist = 2.5 must be"),
        ({"transpose": "no"}, "transpose = 'no' must be True or False"),
        ({"threads": 0}, "threads = 0 must be at least 1, a whole number, or None"),
        ({"rng": np.random.default_rng(1)},
         r"rng = Generator\(PCG64\).* must be a galsim.BaseDeviate, a whole number as its seed"),
        ({"threads": "two"}, "threads = 'two' must be at least 1, a whole number, or None"),
        ({"threads": True}, "threads = True must be at least 1, a whole number, or None"),
        ({"name": 3.5}, r"name = 3.5 must be (the stem|a built-in device)"),
        ({"treering_func": RINGS, "treering_center": galsim.PositionD(0, np.nan)},
         "treering_center = .* must be a finite galsim.Position"),
        ({"treering_func": galsim.LookupTable([0, 1, 2], [0, np.nan, 0], interpolant="linear")},
         "treering_func holds shifts that are not finite"),
    ],
)  # fmt: skip
def test_messages_say_what_is_allowed(kind, options, message):
    with pytest.raises(SensorError, match=message.replace("+", r"\+")):
        kind(**options)


@BOTH
@pytest.mark.parametrize(
    "name", ["x" * 5000, "x" * 5000 + ".fits", "a\0b", "a\0b.fits", ""]
)
def test_names_that_no_file_can_have_are_refused(kind, name):
    error = SensorError if kind is BrighterFatterSensor else OSError
    with pytest.raises(error, match=r"^name = |no such file$|is a table of bfsensor"):
        kind(name)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"shape": (0, 4)}, r"shape = \(0, 4\) must be rows and columns, at least \(1, 1\)"),
        ({"shape": (1e300, 4)}, "and at most a million each"),
        ({"level": 1e10}, r"level = 1e\+10 e- in steps .* must be at most 1e\+09 e-"),
        ({"step": 1e-9}, r"step = 1e-09 e- must be at most .* in 1e\+06 steps"),
        ({"illumination": np.full((4, 4), np.inf)}, "illumination must be finite, and not neg"),
        ({"dtype": np.int32}, "dtype = <class 'numpy.int32'> must be float32 or float64"),
        ({"sensor": galsim.SiliconSensor()}, "sensor = .* must be a BrighterFatterSensor or"),
    ],
)  # fmt: skip
def test_flats_say_what_is_allowed(given, message):
    with pytest.raises(SensorError, match=message):
        draw_flat(
            **{"sensor": make(SiliconSensor), "shape": (4, 4), "level": 10.0, **given}
        )


@BOTH
def test_numbers_may_be_of_any_kind(kind):
    """As for GalSim: whole, of numpy, or as text."""
    sensor = kind(strength="2", nrecalc=np.int32(500), qdist=np.float32(2), transpose=np.True_,
                  diffusion_factor=np.array(0.5), rng=815)  # fmt: skip
    same = kind(strength=2.0, nrecalc=500.0, qdist=2, transpose=True, diffusion_factor=0.5,
                rng=galsim.BaseDeviate(815))  # fmt: skip
    assert sensor == same
    assert repr(sensor) == repr(same)


def test_strength_below_zero_attracts():
    """Also with renewals: blocks are as long as for the opposite strength."""
    widths = []
    for strength in (0.0, -1.0, 1.0):
        star = galsim.Gaussian(sigma=0.5, flux=3e5)
        image = star.drawImage(
            nx=21, ny=21, scale=0.3, method="phot", rng=galsim.BaseDeviate(5),
            sensor=make(SiliconSensor, strength=strength),
        )  # fmt: skip
        widths.append(galsim.utilities.unweighted_moments(image)["Myy"])
    still, smaller, larger = widths
    # The photons are the same: the growth of 0.1 % and more is good to some per cent of it.
    assert smaller - still == pytest.approx(still - larger, rel=0.3)
    assert larger > still


@BOTH
def test_factors_of_other_strengths_are_let_go(kind):
    """A scan over strengths, as in a fit, takes no more memory than a few sensors."""
    import gc
    import weakref

    kept = []
    for n in range(40):
        # Strengths that no other sensor of the process has, such as another test's of 1.
        sensor = make(kind, strength=1.0037 + 0.01 * n)
        kept.append(weakref.ref(sensor._physics.edges.weights))
    del sensor
    gc.collect()
    alive = [n for n, weights in enumerate(kept) if weights() is not None]
    assert 1 <= len(alive) <= 16
    # The one used last is kept: the next sensor of that strength does not pack it again.
    assert alive[-1] == 39
    if kind is BrighterFatterSensor:
        assert len(alive) <= 4
