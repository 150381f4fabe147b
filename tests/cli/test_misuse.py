"""Inputs given to the wrong function or command: each error names the right one."""

from __future__ import annotations

from pathlib import Path

import galsim
import numpy as np
import pytest
from astropy.io import fits
from click.testing import CliRunner

from bfsensor import BrighterFatterSensor, Device, SiliconSensor
from bfsensor.cli.main import main
from bfsensor.device.shipped import tables_dir
from bfsensor.errors import DeviceError, SensorError

STEM = str(Path(galsim.meta_data.share_dir) / "sensors" / "lsst_itl_50_8")
SHIPPED = str(tables_dir() / "itl_sta3800c" / "table.fits")


@pytest.fixture
def run(tmp_path, monkeypatch):
    """Run a command in an empty folder."""
    monkeypatch.chdir(tmp_path)
    return lambda *args: CliRunner().invoke(main, [str(a) for a in args])


@pytest.mark.parametrize("there", [True, False])
def test_a_device_file_is_no_table(tmp_path, there):
    file = tmp_path / "my.toml"
    if there:
        Device.load("e2v_ccd250").write(file)
    with pytest.raises(SensorError, match=f"`bfsensor table {file}`"):
        BrighterFatterSensor(str(file))


@pytest.mark.parametrize("name", ["lsst_itl_50_8", STEM, f"{STEM}.cfg", f"{STEM}.dat"])
def test_a_table_of_galsim_is_for_the_other_sensor(name):
    with pytest.raises(SensorError, match=r"bfsensor\.SiliconSensor"):
        BrighterFatterSensor(name)


def test_a_configuration_beside_does_not_hide_a_built_in_table(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("e2v_ccd250.cfg").touch()
    assert BrighterFatterSensor("e2v_ccd250").name == "e2v_ccd250"


@pytest.mark.parametrize("name", ["itl_sta3800c", SHIPPED])
def test_our_table_is_for_our_sensor(name):
    with pytest.raises(OSError, match="BrighterFatterSensor"):
        SiliconSensor(name)


def test_names_that_are_nearly_right_are_asked_about():
    with pytest.raises(
        SensorError, match=r"; did you mean e2v_ccd250 or .*e2v_ccd250_70\?$"
    ):
        BrighterFatterSensor("e2v")
    with pytest.raises(OSError, match=r"; did you mean lsst_e2v_50_32.*\?$"):
        SiliconSensor("lsst_e2v_50_33")
    with pytest.raises(DeviceError, match=r"; did you mean itl_sta3800c"):
        Device.load("itl_sta380c")
    with pytest.raises(SensorError, match=r"nor a .fits file$"):
        BrighterFatterSensor("nothing like it")


# -- folders of recordings ---------------------------------------------------------------


def flat(kind="FLAT", level=900, **cards):
    header = fits.Header({"IMAGETYP": kind, "EXPTIME": 2.0, **cards})
    return fits.PrimaryHDU(np.full((8, 9), level, np.uint16), header)


@pytest.mark.parametrize("command", ["check", "diagnose"])
def test_one_file_is_no_campaign(run, command):
    flat().writeto("flat.fits")
    more = ("--baseline", "none") if command == "diagnose" else ()
    result = run(command, "flat.fits", *more)
    assert result.exit_code == 1
    (line,) = result.stderr.splitlines()
    assert line.startswith("bfsensor: flat.fits: ") and "folder" in line


@pytest.mark.parametrize("command", ["check", "diagnose"])
def test_a_cube_and_several_exposures_are_to_be_split(run, tmp_path, command):
    fits.PrimaryHDU(np.zeros((5, 8, 9), np.uint16)).writeto("flats.fits")
    more = ("--baseline", "none") if command == "diagnose" else ()
    result = run(command, tmp_path, *more)
    assert result.exit_code == 1
    assert "flats.fits" in result.stderr and "5 images of 9 x 8 pixels" in result.stderr
    frames = [fits.ImageHDU(flat().data, flat(kind).header) for kind in ("FLAT", "BIAS")]
    hdus = fits.HDUList([fits.PrimaryHDU(), *frames])
    hdus.writeto("flats.fits", overwrite=True)
    result = run(command, tmp_path, *more)
    assert result.exit_code == 1
    assert "IMAGETYP" in result.stderr and "(BIAS, FLAT)" in result.stderr
    # Amplifiers of one exposure are none.
    frames = [fits.ImageHDU(flat().data, flat().header, name=n) for n in ("A", "B")]
    fits.HDUList([fits.PrimaryHDU(), *frames]).writeto("flats.fits", overwrite=True)
    assert "1 exposures (1 flat)" in run("check", tmp_path).stdout


def test_words_for_kinds_are_named_and_mapped(run, tmp_path):
    for kind, level in (("offset", 200), ("flatfield", 900)):
        flat("", level=level, TYP=kind).writeto(f"{kind[:3]}.fits")
    settings = tmp_path / "campaign.yaml"
    settings.write_text("keywords: {kind: {keyword: TYP}}")
    result = run("check", tmp_path)
    assert result.exit_code == 1
    assert "TYP = 'flatfield'" in result.stderr
    assert "bias, zero, dark, flat" in result.stderr
    assert "keywords: {kind: {keyword: TYP, values: {flatfield: flat}}}" in result.stderr
    settings.write_text(
        "keywords: {kind: {keyword: TYP, values: {Offset: bias, flatfield: flat}}}"
    )
    result = run("check", tmp_path)
    assert result.exit_code == 0, result.output
    assert "2 exposures (1 flat, 1 bias)" in result.stdout
    for values, message in (
        ("{offset: bais}", "values: 'bais'"),
        ("[offset]", "values = ['offset']"),
    ):
        settings.write_text(f"keywords: {{kind: {{keyword: TYP, values: {values}}}}}")
        result = run("check", tmp_path)
        assert result.exit_code == 1
        assert message in result.stderr


@pytest.mark.parametrize("words", [["flats"], ["spots", "--threshold", "500"]])
def test_a_folder_is_to_be_given_as_its_files(run, tmp_path, words):
    (tmp_path / "run_12").mkdir()
    found = run("measure", *words, "run_12")
    assert found.exit_code == 2
    assert "run_12 is a folder" in found.output and "run_12/flat_*.fits" in found.output


def test_a_figure_of_another_format_is_refused_before_anything_is_solved(run):
    result = run("show", "itl_sta3800c", "-o", "boundaries.zzz")
    assert result.exit_code == 2
    assert "'boundaries.zzz': a figure's name ends in .png, .pdf or .svg" in result.output


@pytest.mark.parametrize(
    ("over", "said"),
    [
        (("back_bias=-30V:-70V:1000000000",), "1000000000 values"),
        ((f"back_bias=-30V:-70V:{'9' * 5000}",), "(5000 digits) values"),
        (
            ("back_bias=-30V:-70V:1000", "wavelength=400nm:900nm:1000"),
            "1000 x 1000 = 1,000,000 points",
        ),
    ],
)
def test_a_sweep_of_more_points_than_anyone_can_wait_for_is_refused(run, over, said):
    options = [word for axis in over for word in ("--over", axis)]
    result = run("sweep", "itl_sta3800c", *options)
    assert result.exit_code == 1, result.output
    assert said in result.output and "a sweep has at most 100,000" in result.output
    assert len(result.output) < 300


def test_a_device_file_of_endless_brackets_is_refused(tmp_path):
    file = tmp_path / "deep.toml"
    file.write_text("a = " + "[" * 100_000 + "]" * 100_000)
    with pytest.raises(
        DeviceError, match=r"deep\.toml: not a device file: values are nested"
    ):
        Device.load(str(file))
