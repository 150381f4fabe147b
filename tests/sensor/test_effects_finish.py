"""Reports, the end of an exposure, and GalSim's configuration of effects."""

from __future__ import annotations

import copy
import json
import pickle

import galsim
import numpy as np
import pytest

import bfsensor
from bfsensor.effects.effect import Shot
from bfsensor.effects.library import make_effect
from bfsensor.errors import SensorError
from tests.sensor.contract_cases import RINGS, blank, photons
from tests.sensor.effect_cases import (
    Coloured,
    Ghost,
    Ratio,
    Rough,
    Shade,
    Tail,
    Warm,
    entry,
    sensor_with,
    write_report,
)

COUPLING = make_effect("interpixel_coupling", {"ax": 0.02, "ay": 0.01})


# -- reports -------------------------------------------------------------------------------


def test_a_report_its_content_its_block_and_effects_are_the_same(tmp_path):
    entries = [entry("charge_loss"), entry("interpixel_coupling")]
    path = write_report(tmp_path / "report.json", entries)
    effects = [make_effect("charge_loss", {"q": 1e-7}), COUPLING]
    report = json.loads((tmp_path / "report.json").read_text())
    sensors = [
        bfsensor.BrighterFatterSensor(effects=e, rng=galsim.BaseDeviate(6007))
        for e in (
            path,
            tmp_path / "report.json",
            report,
            {"effects": entries},
            entries,
            effects,
        )
    ]
    for sensor in sensors:
        assert sensor.effects == tuple(effects)
        assert sensor == sensors[0] != sensor_with()
    assert sensor_with(*entries) != sensor_with(entries[0])


def test_a_report_may_bring_its_layout(tmp_path):
    path = write_report(
        tmp_path / "report.json", [entry("tearing")],
        layout={"shape": [24, 64], "reference": [620, -60, -100]},
    )  # fmt: skip
    sensor = bfsensor.BrighterFatterSensor(effects=path)
    assert sensor.layout.shape == (24, 64)
    assert sensor.layout.reference == (620.0, -60.0, 173.15)
    assert sensor.layout.segments[0][:4] == (0, 0, 64, 24)
    own = bfsensor.BrighterFatterSensor(effects=path, layout={"shape": (8, 9)})
    assert own.layout.shape == (8, 9)
    assert own.layout.reference[1] == -50.0  # the device's


def test_temperatures_of_options_are_in_celsius():
    sensor = sensor_with(
        Warm({"rate": 20.0}), conditions={"seconds": 5.0, "temperature": -80.0},
        layout={"shape": (64, 64), "reference": (620, -50, -100)},
    )  # fmt: skip
    assert sensor._applied.shot.temperature == 193.15
    assert sensor.layout.reference == (620.0, -50.0, 173.15)
    assert "'temperature': -80.0" in repr(sensor)
    assert "'reference': (620.0, -50.0, -100.0)" in repr(sensor)
    given = Shot("flat", 0, 5.0, temperature=193.15)
    assert (
        sensor_with(Warm({"rate": 20.0}), conditions=given)._applied.shot.temperature
        == 193.15
    )


def test_variants_are_known_by_their_parameters(monkeypatch):
    class Hot(Warm):
        variant = "hot"

    monkeypatch.setattr("bfsensor.effects.library.LIBRARY", (Hot,))
    block = {"class": "dark_hot", "parameters": {"rate": 3.0}}
    sensor = sensor_with(block, conditions={"seconds": 1.0})
    assert sensor.effects[0].name == "dark_hot:hot"


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ("nothing.json", "nothing.json: cannot be read: No such file"),
        ("broken", "not a report.json"),
        ("array", "it holds no object"),
        (
            {"schema": "bfsensor-diagnosis-9", "effects": []},
            "schema = 'bfsensor-diagnosis-9'",
        ),
        ({"effects": 3}, "effects must be a list"),
        ({}, "effects must be a list"),
        (["charge_loss"], r"effects\[0\] must be an effect"),
        (
            [entry("charge_loss"), {"class": "gremlins"}],
            r"effects\[1\]: effect gremlins ",
        ),
        ([{"class": "charge_loss", "parameters": {}}], r"charge_loss: parameters .*\bq\b"),
        (
            [{"class": "charge_loss", "parameters": {"q": {"lo68": 1}}}],
            "q = .* has no number",
        ),
        ([entry("charge_loss", q=float("nan"))], "q = nan is not finite"),
        ([entry("charge_loss", q=-1e-7)], r"q = -1e-07 must be from 0 to"),
        ([entry("tearing")], "tearing.*layout="),
        (
            [Shade({"dt": 1.0}), Rough({"amp": 0.1})],
            "shutter_timing, mask_stitch.*layout=",
        ),
        ([Warm({"rate": 1.0})], "dark_hot cannot act.*'seconds'"),
    ],
)
def test_what_is_no_report_gives_one_clear_error(tmp_path, given, message):
    if given == "broken":
        (tmp_path / given).write_text('{"schema": ')
    elif given == "array":
        (tmp_path / given).write_text("[]")
    if isinstance(given, str):
        given = tmp_path / given
    with pytest.raises(SensorError, match=message):
        bfsensor.BrighterFatterSensor(effects=given)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"conditions": {"colour": 3.0}}, "conditions: colour = 3.0 must be one of"),
        ({"conditions": {"wavelength": "red"}}, "wavelength = 'red'"),
        ({"conditions": {"kind": "star"}}, "kind with one of"),
        ({"layout": {"shape": 4}}, "shape = 4 must be rows and columns"),
        ({"layout": {"rows": 4}}, "'rows' must be one of shape"),
        (
            {"layout": {"shape": (4, 4), "segments": [(0, 0, 5, 4)]}},
            "does not lie in 4 rows",
        ),
    ],
)
def test_wrong_conditions_and_layouts_are_refused(options, message):
    with pytest.raises(SensorError, match=message):
        sensor_with(COUPLING, **options)


def test_effects_of_the_electronics_are_named_and_left_out():
    bent = make_effect("gain_nonlinearity", {"c2": 0.01, "c3": 0.0})
    with pytest.warns(galsim.GalSimWarning, match="gain_nonlinearity") as caught:
        sensor = sensor_with(bent, COUPLING)
    assert len(caught) == 1
    assert sensor.acts_at_end
    with pytest.warns(galsim.GalSimWarning, match="gain_nonlinearity"):
        assert not sensor_with(bent).acts_at_end


def test_rings_do_not_act_twice():
    class Rings(Rough):
        word = "tree_rings"

    with pytest.raises(SensorError, match=r"tree_rings.*treering_func"):
        sensor_with(Rings({"amp": 0.01}), treering_func=RINGS, layout={"shape": (9, 9)})


def test_pickle_copy_and_repr_with_effects():
    sensor = sensor_with(
        *(entry(w) for w in ("charge_loss", "tearing", "trap_serial")),
        layout={"shape": (21, 21), "segments": [(0, 0, 10, 21), (10, 0, 11, 21, True)]},
        conditions={"wavelength": 750.0, "kind": "flat"},
    )
    image = blank()
    sensor.accumulate(photons(2000), image, galsim.PositionI(11, 11))
    again = pickle.loads(pickle.dumps(sensor))
    assert again == sensor == copy.deepcopy(sensor)
    space = {"galsim": galsim, "bfsensor": bfsensor, "inf": np.inf, "array": np.array}
    assert eval(repr(sensor), space)._key() == sensor._key()
    images = [blank(), blank()]
    for one, other in zip((sensor, again), images, strict=True):
        one.accumulate(photons(2000), other, galsim.PositionI(11, 11))
    np.testing.assert_array_equal(*(i.array for i in images))


# -- the end of an exposure ----------------------------------------------------------------


def test_coupling_in_covariances():
    """White noise through the kernel, its own autocorrelation written out."""
    level, side, ax, ay = 1e4, 400, 0.02, 0.01
    sensor = sensor_with(make_effect("interpixel_coupling", {"ax": ax, "ay": ay}))
    charge = np.random.default_rng(818).poisson(level, (side, side))
    image = galsim.ImageD(charge.astype(float))
    sensor.finish(image)
    assert image.array.sum() == pytest.approx(charge.sum(), rel=1e-12)
    d = image.array - image.array.mean()
    own = 1 - 2 * ax - 2 * ay
    expected = {
        (0, 0): own**2 + 2 * ax**2 + 2 * ay**2, (1, 0): 2 * ax * own, (0, 1): 2 * ay * own,
        (1, 1): 2 * ax * ay, (2, 0): ax**2,
    }  # fmt: skip
    for (i, j), part in expected.items():
        c = (d[: side - j, : side - i] * d[j:, i:]).mean() / level
        # 4 sigma of a covariance; a variance has twice the square.
        assert c == pytest.approx(part, abs=4 * np.sqrt(2.0 if i == j == 0 else 1.0) / side)


def test_trap_per_amplifier_in_readout_order():
    """Two amplifiers read outwards; a trap at the second alone."""
    size, tau = 40.0, 1.5
    trap = make_effect("trap_serial", {"size": size, "tau": tau, "amp": 1.0, "reach": 0.0})
    layout = {
        "shape": (3, 40),
        "segments": [
            {"x": 0, "y": 0, "columns": 20, "rows": 3},
            {"x": 20, "y": 0, "columns": 20, "rows": 3, "flip_x": True, "prescan": 2,
             "serial_overscan": 3, "parallel_overscan": 1},
        ],
    }  # fmt: skip
    sensor = sensor_with(trap, layout=layout)
    charge = np.zeros((3, 40))
    charge[1, [10, 30]] = 1000.0
    image = galsim.ImageF(charge)
    sensor.finish(image)
    expected = charge.copy()
    expected[1, 30] -= size
    # Columns are read from 39 down: what is set free comes in those after 30.
    behind = np.arange(1, 11)
    expected[1, 30 - behind] = size * (1 - np.exp(-1 / tau)) * np.exp(-(behind - 1) / tau)
    np.testing.assert_allclose(image.array, expected, atol=1e-4)
    with pytest.raises(SensorError, match=r"whole sensor, \(3, 40\)"):
        sensor.finish(galsim.ImageF(4, 4))
    sensor = sensor_with(trap)  # one amplifier: there is none of number 1
    with pytest.warns(galsim.GalSimWarning, match="trap_serial changed nothing"):
        sensor.finish(galsim.ImageF(charge))


def test_turned_sensors_turn_what_is_stored():
    charge = np.random.default_rng(3).poisson(100.0, (5, 8)).astype(float)
    effects = (
        COUPLING,
        make_effect("trap_serial", {"size": 40.0, "tau": 1.5, "amp": 0.0, "reach": 0.0}),
    )
    images = galsim.ImageD(charge.copy()), galsim.ImageD(charge.T.copy())
    for image, transpose in zip(images, (False, True), strict=True):
        sensor_with(*effects, transpose=transpose, layout={"shape": (5, 8)}).finish(image)
    np.testing.assert_array_equal(images[0].array, images[1].array.T)
    assert not np.array_equal(images[0].array, charge)


def test_what_acts_once_acts_once():
    sensor = sensor_with(COUPLING)
    image, first, rest = blank(), photons(10_000, 4), photons(10_000, 5)
    sensor.accumulate(first, image)
    sensor.accumulate(rest, image, resume=True)
    plain = image.array.copy()
    whole = blank()
    sensor_with().accumulate(galsim.PhotonArray.concatenate([first, rest]), whole)
    np.testing.assert_array_equal(plain, whole.array)  # nothing has acted so far
    sensor.finish(image)
    stored = COUPLING.store(plain.astype(float), None, None, None, {})
    np.testing.assert_array_equal(image.array, stored.astype(np.float32))
    kept = image.array.copy()
    with pytest.raises(SensorError, match="finish was called twice"):
        sensor.finish(image)
    with pytest.raises(galsim.GalSimError, match="resume after finish"):
        sensor.accumulate(rest, image, resume=True)
    np.testing.assert_array_equal(image.array, kept)
    # The image is exposed again, from the charge in it, and that exposure goes on.
    sensor.accumulate(rest, image)
    sensor.accumulate(first, image, resume=True)
    sensor.finish(image)
    # GalSim draws on a view of the image.
    star = galsim.Gaussian(sigma=1.0, flux=1000.0)
    for _ in range(2):
        star.drawImage(image, scale=1.0, method="phot", sensor=sensor)
        sensor.finish(image)


def test_dark_current_and_what_persists():
    sensor = sensor_with(Warm({"rate": 20.0}), conditions={"seconds": 5.0})
    image = galsim.ImageD(100, 100)
    sensor.finish(image)
    assert image.array.mean() == pytest.approx(100.0, abs=4 * 10.0 / 100)
    assert image.array.var() == pytest.approx(100.0, rel=4 * np.sqrt(2) / 100)
    again = galsim.ImageD(100, 100)
    sensor.finish(again)
    assert not np.array_equal(again.array, image.array)
    ghost = sensor_with(Ghost({"frac": 1e-3}))
    star, dark = galsim.ImageD(9, 9), galsim.ImageD(9, 9)
    star[4, 5] = 5e4
    ghost.finish(star)
    ghost.finish(dark)
    assert (star(4, 5), dark(4, 5), dark.array.sum()) == (5e4, 50.0, 50.0)


def test_without_such_effects_finish_changes_no_bit():
    sensor = sensor_with(Ratio({"eps": 0.1}), Tail({"amp": 1e-8}))
    image = blank()
    sensor.accumulate(photons(1000), image)
    kept, state = image.array.copy(), sensor.rng.duplicate()
    sensor.finish(image)
    np.testing.assert_array_equal(image.array, kept)
    assert sensor.rng == state


# -- GalSim's configuration ----------------------------------------------------------------


def build(sensor, **image):
    config = {
        "modules": ["bfsensor"],
        "gal": {"type": "Gaussian", "sigma": 0.4, "flux": 1e4},
        "stamp": {"draw_method": "phot", "size": 25},
        "image": {
            "type": "Scattered", "size": 64, "nobjects": 2, "pixel_scale": 0.2,
            "random_seed": 9161, "sensor": {"type": "BrighterFatter", **sensor}, **image,
        },
    }  # fmt: skip
    galsim.config.ImportModules(config)
    return galsim.config.BuildImage(config)


@pytest.mark.parametrize("form", ["file", "dict", "list", "evaluated"])
def test_configured_effects_finish_the_image_by_themselves(tmp_path, form):
    entries = [entry("interpixel_coupling"), entry("charge_loss", q=1e-6)]
    path = write_report(tmp_path / "report.json", entries)
    given = {"file": path, "dict": {"effects": entries}, "list": entries,
             "evaluated": f"$'{tmp_path}/' + 'report.json'"}[form]  # fmt: skip
    found = build({"effects": given})
    by_hand = build({"effects": [entries[1]]})
    bfsensor.BrighterFatterSensor(effects=[entries[0]]).finish(by_hand)
    np.testing.assert_array_equal(found.array, by_hand.array)
    assert not np.array_equal(found.array, build({"effects": [entries[1]]}).array)


def test_the_light_has_its_noise_before_and_the_readout_after():
    """Noise of the sky is coupled, that of the readout is not."""
    strong = {"effects": [entry("interpixel_coupling", ax=0.1, ay=0.0)]}

    def neighbours(**image):
        d = build(strong, nobjects=0, size=200, **image).array.astype(float)
        d -= d.mean()
        return (d[:, 1:] * d[:, :-1]).mean() / 100.0

    error = 4 / 200
    both = 2 * 0.1 * 0.8
    sky = {"sky_level_pixel": 100.0}
    assert neighbours(noise={"type": "Poisson"}, **sky) == pytest.approx(both, abs=error)
    for read in ({"type": "CCD", "read_noise": 10.0}, {"type": "Gaussian", "sigma": 10.0}):
        assert neighbours(noise=read) == pytest.approx(0.0, abs=error)
    ccd = {"type": "CCD", "read_noise": 10.0}
    assert neighbours(noise=ccd, **sky) == pytest.approx(both, abs=2 * error)


def test_configured_conditions_are_evaluated():
    config = {
        "type": "BrighterFatter", "effects": [entry("trap_serial")],
        "conditions": {"wavelength": "$lam * 2", "seconds": 30, "kind": "flat"},
        "layout": {"shape": [64, 64], "reference": [620, -50, -100]},
    }  # fmt: skip
    base = {"image": {"sensor": config}, "rng": galsim.BaseDeviate(77),
            "eval_variables": {"flam": 375.0}}  # fmt: skip
    sensor = galsim.config.BuildSensor(base["image"], "sensor", base)
    assert sensor.conditions == {"wavelength": 750.0, "seconds": 30.0, "kind": "flat"}
    assert sensor.layout.shape == (64, 64)
    assert sensor.effects[0]["tau"] == 1.5
    direct = bfsensor.BrighterFatterSensor(
        rng=galsim.BaseDeviate(77), effects=[entry("trap_serial")],
        conditions={"wavelength": 750.0, "seconds": 30.0, "kind": "flat"},
        layout={"shape": (64, 64), "reference": (620, -50, -100)},
    )  # fmt: skip
    assert sensor == direct


def test_effects_tell_sensors_apart():
    one = sensor_with(Coloured({"kappa": 0.1}), conditions={"wavelength": 750.0})
    assert one == sensor_with(Coloured({"kappa": 0.1}), conditions={"wavelength": 750.0})
    assert one != sensor_with(Coloured({"kappa": 0.1}), conditions={"wavelength": 870.0})
    assert one != sensor_with(Coloured({"kappa": 0.2}), conditions={"wavelength": 750.0})
