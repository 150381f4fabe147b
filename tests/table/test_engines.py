"""Tables by either engine: the same kind, by the same call and the same command."""

import dataclasses
import json

import numpy as np
import pytest
from click.testing import CliRunner

from bfsensor import Device, DistortionTable, build_table, plan_table
from bfsensor.cli.main import main
from bfsensor.cli.table import _image_charge
from bfsensor.errors import TableError
from bfsensor.simulate.charge_field import ImageCharge
from bfsensor.table.build_image_charge import build_image_charge_table, default_depths

# Fitted to the table of this device (validation/results/image_charge.ecsv, model 'device').
MODEL = ImageCharge(
    0.320, 1.211, 2.573, 0.203, 3.818, drift_field=((0.0, 0.7361), (100.0, 0.3641))
)
GIVEN = [
    "--image-charge", "charge_height=0.32um", "--image-charge", "row_height=1211 nm",
    "--image-charge", "column_height=2.573um", "--image-charge", "half_width_x=0.203um",
    "--image-charge", "half_width_y=3.818um",
    "--image-charge", "drift_field=0um:0.7361V/um,0.1mm:3641V/cm",
]  # fmt: skip
ANALYTIC = ["table", "itl_sta3800c", "--engine", "image_charge", "--pixels", "5"]


@pytest.fixture(scope="module")
def plan():
    return plan_table(
        Device.load("itl_sta3800c"), charges=[0.0, 50e3], backgrounds=[0.0], depths=[95.0],
        vertices=8, pixels=5, accuracy=0.05,
    )  # fmt: skip


@pytest.fixture(scope="module")
def analytic(plan):
    return build_table(
        plan, engine="image_charge", image_charge=MODEL, provenance={"command": "a test"}
    )


def test_both_engines_fill_the_same_kind_of_table(plan, analytic):
    solved = build_table(plan)
    for name in ("charges", "backgrounds", "depths", "corners", "horizontal", "vertical"):
        assert getattr(analytic, name).shape == getattr(solved, name).shape
    for name in ("pitch", "thickness", "full_well", "device_text", "symmetric"):
        assert getattr(analytic, name) == getattr(solved, name)
    a, s = (t.area_changes(charge=50e3, depth=95.0) for t in (analytic, solved))
    # Fitted to 2.5 % rms of the lags up to 2; 16 cells a pixel are 2 % off. No code is shared.
    near = np.s_[1:4, 1:4]
    np.testing.assert_allclose(a[near], s[near], rtol=0.1)
    assert analytic.provenance["engine"].startswith("image charges")
    assert analytic.provenance["command"] == "a test" and "engine" not in solved.provenance


def test_the_shifts_are_those_of_the_analytic_engine(plan, analytic, tmp_path):
    bare = build_image_charge_table(
        MODEL, charges=plan.charges, depths=plan.depths, vertices=8, pixels=5
    )
    for name in ("corners", "horizontal", "vertical"):
        np.testing.assert_array_equal(getattr(analytic, name), getattr(bare, name))
    analytic.write(tmp_path / "a.fits")
    assert DistortionTable.read(tmp_path / "a.fits") == analytic


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"engine": "magic"}, "engine = 'magic' must be one of poisson, image_charge"),
        ({"image_charge": MODEL}, "image_charge: "),
        ({"engine": "image_charge"}, "engine = 'image_charge' needs its parameters"),
        (
            {
                "engine": "image_charge",
                "image_charge": MODEL,
                "executor": 1,
                "errors": dict,
            },
            "executor, errors: ",
        ),
        (
            {"engine": "image_charge", "image_charge": MODEL, "progress": print},
            "progress: ",
        ),
        (
            {
                "engine": "image_charge",
                "image_charge": dataclasses.replace(MODEL, pitch_y=12.0),
            },
            "image_charge: pitch_y = 12 is not that of itl_sta3800c, 10",
        ),
    ],
)
def test_options_of_the_other_engine_are_refused(plan, options, message):
    with pytest.raises(TableError) as caught:
        build_table(plan, **options)
    assert message in str(caught.value)


# -- the command -------------------------------------------------------------------------


def run(*arguments):
    return CliRunner().invoke(main, [*map(str, arguments)])


def test_command(tmp_path):
    path = tmp_path / "a.fits"
    result = run(*ANALYTIC, *GIVEN, "-o", path, "--json", "--no-figure")
    assert result.exit_code == 0, result.output
    summary = json.loads(result.stdout)
    assert summary["engine"] == "image_charge" and "newton_steps" not in summary
    table = DistortionTable.read(path)
    assert table.depths.tolist() == pytest.approx(list(default_depths(MODEL)))
    expected = build_image_charge_table(MODEL, pixels=5)
    np.testing.assert_allclose(table.vertical, expected.vertical, rtol=1e-6, atol=1e-9)
    assert [p.name for p in tmp_path.iterdir()] == ["a.fits"]


def test_command_for_galsim(tmp_path):
    assert (
        run(*ANALYTIC, *GIVEN, "--galsim", tmp_path / "stem", "--no-figure").exit_code == 0
    )
    assert sorted(p.name for p in tmp_path.iterdir()) == ["stem.cfg", "stem.dat"]


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        ([*GIVEN, "--accuracy", "0.01"], 2, "--accuracy: not for --engine image_charge"),
        (
            [*GIVEN, "--workers", "1", "--no-assess"],
            2,
            "--workers, --assess: not for --engine image_charge",
        ),
        ([*GIVEN, "--engine", "poisson"], 2, "--image-charge: not for --engine poisson"),
        ([*GIVEN, "--engine", "fem"], 2, "'fem' is not one of"),
        (GIVEN[:-2], 1, "image charge: drift_field missing; give each by --image-charge"),
        (
            [],
            1,
            "charge_height, row_height, column_height, half_width_x, half_width_y, drift",
        ),
        (
            [*GIVEN, "--image-charge", "thickness=100um"],
            1,
            "no parameter 'thickness'; there",
        ),
        (
            [*GIVEN, "--image-charge", "row_height=1.2"],
            1,
            "image charge: row_height: '1.2' has no unit",
        ),
        (
            [*GIVEN, "--image-charge", "drift_field=0um:1V/um,50um"],
            1,
            "image charge: drift_field: '' is not a number with a unit",
        ),
        (
            [*GIVEN, "--image-charge", "row_height=0.1um"],
            1,
            "image charge: row_height = 0.1 um must be above charge_height = 0.32 um",
        ),
    ],
)
def test_faults_are_one_clear_line(tmp_path, arguments, code, message):
    result = run(*ANALYTIC, *arguments, "-o", tmp_path / "a.fits")
    assert result.exit_code == code
    assert message in result.output.splitlines()[-1]
    assert not list(tmp_path.iterdir())


def test_the_pitch_is_the_devices_on_either_axis():
    device = Device.load("itl_sta3800c")
    tall = dataclasses.replace(
        device, pixel=dataclasses.replace(device.pixel, pitch_y=12.0)
    )
    given = [text.partition("=")[::2] for text in GIVEN if "=" in text]
    model = _image_charge(tall, given)
    assert (model.pitch_x, model.pitch_y) == (tall.pixel.pitch_x, 12.0)
