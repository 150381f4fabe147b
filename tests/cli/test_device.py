"""Device files on the command line: new, show, check."""

from __future__ import annotations

import json

import pytest
from click.testing import CliRunner

from bfsensor.cli.main import main
from bfsensor.device.depletion import find_depletion
from bfsensor.device.device import Device
from bfsensor.device.shipped import tables_dir


@pytest.fixture
def run(tmp_path, monkeypatch):
    """Run a command in an empty folder."""
    monkeypatch.chdir(tmp_path)
    return lambda *args: CliRunner().invoke(main, [str(a) for a in args])


def test_new_is_the_other_device_under_its_own_name(run, tmp_path):
    result = run("device", "new", "my_ccd.toml", "--from", "e2v_ccd250")
    assert result.exit_code == 0, result.output
    made, shipped = Device.load(tmp_path / "my_ccd.toml"), Device.load("e2v_ccd250")
    assert (made.name, made.physics) == ("my_ccd", shipped.physics)
    # Comments, which say where values are from, are copied.
    text = (tables_dir() / "e2v_ccd250" / "device.toml").read_text()
    changed = text.replace('name = "e2v_ccd250"', 'name = "my_ccd"')
    assert (tmp_path / "my_ccd.toml").read_text() == changed
    # From a file, and not over one.
    assert run("device", "new", "b.toml", "--from", "my_ccd.toml").exit_code == 0
    assert Device.load(tmp_path / "b.toml").name == "b"
    result = run("device", "new", "b.toml", "--from", "my_ccd.toml")
    assert result.exit_code == 1
    assert "b.toml" in result.stderr and "--overwrite" in result.stderr


def test_new_refuses_what_is_no_device_file(run, tmp_path):
    result = run("device", "new", "my_ccd", "--from", "e2v_ccd250")
    assert result.exit_code == 1
    assert result.stderr.startswith("bfsensor: my_ccd: ") and ".toml" in result.stderr
    result = run("device", "new", "my_ccd.toml", "--from", "e2v_ccd25")
    assert result.exit_code == 1
    assert "'e2v_ccd25'" in result.stderr and "e2v_ccd250" in result.stderr
    assert list(tmp_path.iterdir()) == []
    assert run("device", "new", "my_ccd.toml").exit_code == 2


def test_show_prints_every_value_with_its_unit(run):
    result = run("device", "show", "e2v_ccd250", "--set", "back_bias=-60V")
    assert result.exit_code == 0, result.output
    lines = [" ".join(line.split()) for line in result.stdout.splitlines()]
    assert "thickness 100 um +- 5 um (published)" in lines
    assert "back_bias -60 V" in lines
    device = Device.load("e2v_ccd250")
    names = {key.split(".")[-1] for key in device.quantities}
    assert names <= {line.split(" ")[0] for line in lines if line}
    # Sections within sections.
    assert "sigma 0.32 um +- 0.03 um (fitted)" in lines


def test_check_warns_and_refuses(run, tmp_path):
    file = tmp_path / "my_ccd.toml"
    run("device", "new", file, "--from", "e2v_ccd250")
    result = run("device", "check", file)
    assert result.exit_code == 0
    warnings = [x for x in result.stdout.splitlines() if x.startswith("warning: ")]
    assert len(warnings) == 1
    assert "operating_point.hole_quasi_fermi_level" in warnings[0]
    found = json.loads(run("device", "check", file, "--json").stdout)["depletion"]
    estimate = find_depletion(Device.load(file))
    assert found["full_depletion_voltage"] == f"{estimate.full_depletion_voltage:.1f} V"
    assert found["full_depletion_voltage"] in result.stdout
    assert f"depleted_thickness {estimate.depth:.1f} um" in " ".join(result.stdout.split())
    changed = file.read_text().replace('name = "my_ccd"', 'name = "itl_sta3800c"')
    file.write_text(changed.replace('origin = "guessed"', 'source = "a hunch"'))
    found = json.loads(run("device", "check", file, "--json").stdout)
    assert found["device"]["silicon"]["thickness"]["value"] == "100 um"
    assert [one.split(":")[0] for one in found["warnings"]] == [
        "no origin", "name = 'itl_sta3800c' is that of a built-in device with other values",
    ]  # fmt: skip
    file.write_text(changed.replace("thickness", "thikness"))
    result = run("device", "check", file)
    assert result.exit_code == 1
    (line,) = result.stderr.splitlines()
    assert line.startswith("bfsensor: my_ccd.toml: silicon: ")
    assert "'thikness'" in line and "'thickness'" in line


def test_check_warns_of_silicon_that_is_not_depleted(run):
    weak = run("device", "check", "e2v_ccd250", "--set", "back_bias=-5V", "--json")
    assert weak.exit_code == 0
    found = json.loads(weak.stdout)
    assert float(found["depletion"]["depleted_thickness"].removesuffix(" um")) < 80
    assert found["warnings"][0].startswith("back_bias = '-5 V'")
    whole = json.loads(run("device", "check", "e2v_ccd250", "--json").stdout)
    assert not any(one.startswith("back_bias") for one in whole["warnings"])
