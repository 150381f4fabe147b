"""``bfsensor fit`` as a user runs it; a toy stands for the emulator, whose tests are its own."""

from __future__ import annotations

import json

import numpy as np
import pytest
from click.testing import CliRunner

from bfsensor import Device
from bfsensor.cli import fit as cli_fit
from bfsensor.cli.main import main
from bfsensor.fit.finer_mesh import Finer
from bfsensor.fit.result import FitResult
from tests.fit.test_least_squares import TRUTH
from tests.fit.toys import toy_data, toy_emulator

FREE = ("--free", "thickness", "--free", "background_doping", "--free", "back_bias:2V")


def fit(*arguments):
    return CliRunner().invoke(main, ["fit", *map(str, arguments)])


@pytest.fixture
def recording(tmp_path):
    data = toy_data(toy_emulator(), TRUTH, 12)
    path = tmp_path / "areas.csv"
    rows = [
        f"{i},{j},{v:.8e},{e:.8e}"
        for (i, j), v, e in zip(data.places, data.values, data.errors, strict=True)
    ]
    path.write_text("\n".join(["i_serial,j_parallel,cov_per_e,err_per_e", *rows]) + "\n")
    return path


@pytest.fixture
def asked(monkeypatch):
    """The toy in place of the emulator, and what the command asked of it."""
    out = {}

    def linearise(device, moving, priors, sets, cells):
        names = [prior.name for prior in moving]
        out.update(device=device, parameters=names, sets=sets, cells=cells)
        return lambda values: toy_emulator()

    def build(device, parameters, sets, cells, folder):
        out["curved"] = True
        return toy_emulator()

    def finer(linearise, device, priors, sets, finer, cells, folder):
        Finer(linearise, device, priors, (), finer, cells)  # checks
        out["finer"] = finer, cells, folder

        class Carried:
            at_draw = staticmethod(lambda values: toy_emulator())

            def __call__(self, values):
                return linearise(values)

        return Carried()

    monkeypatch.setattr(cli_fit, "make_linearise", linearise)

    def solved(device, priors, sets, cells, folder):
        return lambda values: toy_emulator()

    monkeypatch.setattr(cli_fit, "make_solved", solved)
    monkeypatch.setattr(cli_fit, "make_finer", finer)
    monkeypatch.setattr(cli_fit, "build_emulator", build)
    return out


def test_fit_prints_a_table_and_writes_result_device_and_figure(tmp_path, recording, asked):
    out = tmp_path / "fit"
    result = fit(
        "itl_sta3800c", recording, *FREE, "--profile", "thickness", "--cells", 8, "-o", out
    )
    assert result.exit_code == 0, result.output
    lines = result.stdout.splitlines()
    assert lines[0].startswith("parameter") and lines[-1].startswith("chi2/n = ")
    assert lines[-2] == f"{out}: fit.json, device.toml, fit.png"
    written = FitResult.read(out / "fit.json")
    device = Device.load(out / "device.toml")
    assert device.silicon.thickness == pytest.approx(written.value[0])
    assert "silicon.thickness" in written.profiles
    assert (out / "fit.png").stat().st_size > 10_000
    assert asked["cells"] == 8 and asked["parameters"] == list(written.parameters)
    # The prior of the command is the emulator's.
    assert asked["device"].provenance["operating_point.back_bias"].uncertainty == 2.0
    # All but (0, 0) would be 24; this table's a_00 is measured.
    assert written.n == 25


@pytest.mark.parametrize(
    ("given", "wanted"),
    [((), (48, 16)), (("--finer", 0), None), (("--cells", 48), None),
     (("--finer", 32, "--curved"), (32, 16))],
)  # fmt: skip
def test_values_are_carried_to_a_finer_mesh_by_default(
    tmp_path, recording, asked, given, wanted
):
    result = fit("itl_sta3800c", recording, *FREE, *given, "-o", tmp_path / "o")
    assert result.exit_code == 0, result.output
    assert asked.get("finer") == (wanted and (*wanted, tmp_path / "o"))
    assert asked.get("curved", False) == ("--curved" in given)


def test_json_conditions_and_what_is_held_out(tmp_path, recording, asked):
    other = tmp_path / "other.csv"
    other.write_text(recording.read_text())
    result = fit(
        "itl_sta3800c", recording, *FREE, "--hold", other, "--lags", 2, "--errors", "stated",
        "--at", "other.csv:back_bias=-50V,wavelength=620nm", "--json", "-o", tmp_path / "o",
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    assert found["n"] == 9 and [one["fitted"] for one in found["sets"]] == [True, False]
    assert found["sets"][0]["scale"] == 1.0
    first, second = asked["sets"]
    assert first.conditions[0].back_bias is None
    assert second.conditions[0].back_bias == -50.0
    assert second.conditions[0].wavelength == 620.0


def test_saturation_alone_needs_no_emulator(tmp_path):
    path = tmp_path / "sat.csv"
    path.write_text("gate_high,saturation,saturation_error\n1,1.49e5,3e3\n2,1.82e5,3e3\n")
    result = fit("itl_sta3800c", path, "--free", "spill_barrier", "-o", tmp_path / "o")
    assert result.exit_code == 0, result.output
    found = FitResult.read(tmp_path / "o" / "fit.json")
    assert found.parameters == ("well.spill_barrier",)
    before, after = (
        abs(s - found.sets[0].values) for s in (found.sets[0].before, found.sets[0].after)
    )
    assert after.sum() < 0.5 * before.sum()
    assert 1.5 < found.value[0] < 2.6


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("nosuch", "F"), "'nosuch' is neither a built-in device"),
        (("itl_sta3800c", "missing.csv"), "missing.csv: no such file"),
        (("itl_sta3800c", "F", "--free", "thicknes"), "no quantity 'thicknes'"),
        (("itl_sta3800c", "F", "--profile", "thickness"), "--profile thickness"),
        (("itl_sta3800c", "F", "--at", "g.csv:back_bias=-50V"), "--at g.csv"),
        (("itl_sta3800c", "F", "--finer", "17"), "finer = 17 must be an even number from 8 to 128"),
        (("itl_sta3800c", "F", "--at", "back_bias=50nm"), "'50nm' is not a potential"),
    ],
)  # fmt: skip
def test_bad_input_gives_one_clear_line(tmp_path, recording, asked, arguments, message):
    result = fit(*(recording if a == "F" else a for a in arguments), "-o", tmp_path / "o")
    assert result.exit_code == 1
    assert result.stderr.startswith("bfsensor: ") and message in result.stderr
    assert len(result.stderr.splitlines()) == 1
    assert not (tmp_path / "o").exists()


def test_wrong_usage(recording):
    result = fit("itl_sta3800c", recording, "--at", "back_bias")
    assert result.exit_code == 2 and "is not of the form [FILE:]KEY=VALUE" in result.stderr
    shown = fit("--help")
    assert "bfsensor fit itl_sta3800c_60 itl.csv --free all" in shown.stdout
    assert np.array_equal(np.unique([result.exit_code, shown.exit_code]), [0, 2])
