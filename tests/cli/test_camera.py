"""``bfsensor table --from``: a table, a device and a figure from a camera's covariances."""

from __future__ import annotations

import json

import galsim
import numpy as np
import pytest
from click.testing import CliRunner

from bfsensor import BrighterFatterSensor
from bfsensor.cli.main import main
from bfsensor.device.device import Device
from bfsensor.device.shipped import tables_dir
from bfsensor.simulate.charge_field import ImageCharge
from bfsensor.simulate.image_charge import area_changes
from bfsensor.table.build_image_charge import build_fitted_table
from bfsensor.table.table import DistortionTable

TRUE = ImageCharge(0.7, 2.1, 4.2, 2.5, 4.0, 200.0, 15.0, 15.0, 0.5)
SMALL = ("--vertices", "4", "--pixels", "5")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A file of a_ij, and what the command made of it."""
    folder = tmp_path_factory.mktemp("camera")
    a = area_changes(TRUE, depth=200.0, reach=3)[3:, 3:]
    rows = [f"{i},{j},{v},{0.01 * abs(v)}" for (j, i), v in np.ndenumerate(a)]
    source = folder / "camera.csv"
    source.write_text("\n".join(["i,j,a,error", *rows]) + "\n")
    args = ["table", "--from", source, "--thickness", "200um", "--pitch", "15um", *SMALL]
    target = folder / "mine.fits"
    result = CliRunner().invoke(main, [*map(str, args), "-o", str(target), "--json"])
    assert result.exit_code == 0, result.output
    return source, target, json.loads(result.stdout), a


def test_the_table_holds_the_a_ij_of_the_file(made):
    _, target, _, a = made
    table = DistortionTable.read(target)
    changes = table.area_changes(charge=1e4, depth=200.0)[2:, 2:] / (1e4 * 225)
    # 2 vertices a side less than shipped tables and the second order at 1e4 e-: 2 %.
    assert changes[:2, :2] == pytest.approx(a[:2, :2], rel=0.04)
    assert table.provenance["fitted to"] == "camera.csv, a_ij"
    assert "not measured" in table.provenance["limits"]
    assert np.isnan(table.full_well) and table.depths[-1] == 200.0


def test_what_is_printed_and_written(made):
    source, target, summary, _ = made
    fit = summary["fit"]
    rows = fit["parameters"]
    assert rows["row_height [um]"]["determined_by"] == "data"
    assert rows["row_height [um]"]["value"] == pytest.approx(2.1, abs=0.7)
    assert fit["lags"] == 16 and fit["chi2"] < 30 and not fit["misfits"]
    assert any("conversion depth" in line for line in fit["not_determined"])
    for ending in (".fits", ".png", ".toml", "_fit.ecsv", "_fit.png"):
        path = target.with_name("mine" + ending)
        assert path.exists() and str(path) in summary["written"]
    again = CliRunner().invoke(
        main, ["table", "--from", str(source), "--thickness", "200um", "-o", str(target)]
    )
    assert again.exit_code == 1 and "exists; give --overwrite" in again.stderr


def test_the_device_alone_makes_the_same_table(made, tmp_path):
    _, target, _, _ = made
    other = tmp_path / "again.fits"
    args = ["table", target.with_suffix(".toml"), *SMALL, "-o", other, "--no-figure"]
    result = CliRunner().invoke(main, [str(a) for a in args])
    assert result.exit_code == 0, result.output
    first, second = DistortionTable.read(target), DistortionTable.read(other)
    assert np.array_equal(first.corners, second.corners)
    assert first.device_text == second.device_text


def test_a_sensor_draws_with_it(made):
    sizes = []
    for flux in (1e4, 2e6):
        sensor = BrighterFatterSensor(str(made[1]), rng=galsim.BaseDeviate(5))
        star = galsim.Gaussian(sigma=1.2, flux=flux)
        image = star.drawImage(nx=21, ny=21, scale=1, method="phot", sensor=sensor,
                               rng=galsim.BaseDeviate(8))  # fmt: skip
        sizes.append(image.FindAdaptiveMom().moments_sigma)
    # Shot noise of the small one: 1.2 / sqrt(4 x 1e4) = 0.006.
    assert sizes[1] > sizes[0] + 0.02


@pytest.mark.parametrize(
    ("args", "status", "message"),
    [
        (["--from", "a.csv"], 2, "--from needs --thickness"),
        ([], 2, "Missing argument 'DEVICE', or --from FILE"),
        (["itl_sta3800c", "--thickness", "200um"], 2, "--thickness: only for --from"),
        (["--from", "a.csv", "--accuracy", "0.05"], 2, "--accuracy: not for --from"),
        (["--from", "a.csv", "--without", "1"], 2, "'1' is not a lag I,J"),
        (["--from", "a.csv", "--thickness", "200um"], 1, "a.csv: no such file"),
        (["--from", "b.csv", "--thickness", "200"], 1, "thickness: '200' has no unit"),
        (["--from", "b.csv", "--thickness", "200um"], 1, "2 lags can be fitted"),
        (
            ["--from", "b.csv", "--thickness", "200um", "--without", "3,3"],
            1,
            "lag 3,3 is not among the measured ones",
        ),
        (
            ["--from", "b.csv", "--thickness", "200um", "--set", "back_bias=-2V"],
            1,
            "does not deplete",
        ),
    ],
)
def test_misuse_gets_one_line(tmp_path, monkeypatch, args, status, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "b.csv").write_text("i,j,a,error\n1,0,7e-8,1e-9\n0,1,1e-7,1e-9\n")
    result = CliRunner().invoke(main, ["table", *args])
    assert result.exit_code == status, result.output
    assert message in result.stderr
    if status == 1:
        assert len([line for line in result.stderr.splitlines() if line]) <= 2
    assert not list(tmp_path.glob("*.fits"))


def test_hsc_is_the_device_of_its_table():
    device = Device.load("hsc_hamamatsu")
    table = DistortionTable.load("hsc_hamamatsu")
    assert device.origin == "fitted to covariances"
    assert table.device_text == device.to_toml()
    assert (tables_dir() / "hsc_hamamatsu" / "table.fits").stat().st_size < 400_000
    model = ImageCharge.of_device(device)
    changes = table.area_changes(charge=1e4, depth=200.0) / (1e4 * 225)
    expected = area_changes(model, depth=200.0, reach=table.reach)
    assert changes == pytest.approx(expected, rel=0.02, abs=1e-11)
    built = build_fitted_table(device, vertices=4, pixels=5)
    assert built.device_text == table.device_text
