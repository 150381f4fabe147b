"""Bad values at every door: one clear line, before anything is built or solved."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import galsim
import numpy as np
import pytest
from click.testing import CliRunner

from bfsensor import BrighterFatterSensor, Device, SiliconSensor
from bfsensor.cli.main import main
from bfsensor.errors import BFSensorError, DeviceError, SensorError
from bfsensor.text_files import UnreadableTextError, load_yaml, read_ecsv

STEM = Path(galsim.meta_data.share_dir) / "sensors" / "lsst_itl_50_8"

BOMB = "a: &a [x, x]\n" + "".join(
    f"{b}: &{b} [{', '.join([f'*{a}'] * 9)}]\n"
    for a, b in zip("abcdefgh", "bcdefghi", strict=True)
)
"""Names within named parts, 9^8 entries in 300 bytes."""


@pytest.fixture
def said(tmp_path, monkeypatch):
    """Run a command in an empty folder; its last line, or '' if it succeeds."""
    monkeypatch.chdir(tmp_path)

    def run(*args: object) -> str:
        result = CliRunner().invoke(main, [str(a) for a in args])
        assert result.exception is None or isinstance(result.exception, SystemExit)
        lines = result.stderr.strip().splitlines()
        assert all(len(line) < 500 for line in lines)
        return lines[-1] if result.exit_code else ""

    return run


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("[" * 20_000, "line 1: entries are nested deeper than 64"),
        (BOMB, "line 2: a named part holds the name"),
        ("{[1]: 2}", "unhashable"),
        ("a: 2026-13-45", "month must be in"),
        ("a: [", "expected the node content"),
    ],
)
def test_yaml_is_bounded(said, text, why):
    with pytest.raises(UnreadableTextError, match=why):
        load_yaml(text)
    Path("campaign.yaml").write_text(text)
    assert "campaign.yaml: not readable as YAML" in said("check", ".")
    header = "".join(
        f"# {line}\n" for line in f"%ECSV 1.0\n---\nmeta: {{b: 1}}\n{text}".split("\n")
    )
    Path("table.ecsv").write_text(f"{header}i j\n0 0\n")
    with pytest.raises(UnreadableTextError):
        read_ecsv("table.ecsv")


def test_names_are_allowed_where_they_hold_no_others():
    assert load_yaml("a: &a [1, 2]\nb: *a\nc: {d: *a}") == {
        "a": [1, 2], "b": [1, 2], "c": {"d": [1, 2]},
    }  # fmt: skip


def test_device_files_are_bounded():
    with pytest.raises(DeviceError, match="more than 64 parts"):
        Device.from_toml("a." * 50_000 + "b = 1\n")
    with pytest.raises(DeviceError, match="no finite size"):
        Device.load("itl_sta3800c").with_value("thickness", "1 1e400um")


@pytest.mark.parametrize(
    ("args", "why"),
    [
        (("sweep", "itl_sta3800c", "--over", "back_bias=nan V"), "must be a finite value"),
        (
            ("sweep", "itl_sta3800c", "--over", "back_bias=-30V:-inf V:3"),
            "must be a finite value",
        ),
        (("spots", "itl_sta3800c", "--wavelength", "0", "-o", "out"), "wavelength = 0"),
        (("spots", "itl_sta3800c", "--wavelength", "nan", "-o", "out"), "wavelength = nan"),
    ],
)
def test_values_are_refused_before_anything_is_solved(said, args, why):
    assert why in said(*args)
    assert not any(Path().iterdir())


@pytest.mark.parametrize(
    ("row", "why"),
    [
        ("word,1.2,1.2", "row 1: flux = 'word' is not a number"),
        ("nan,1.2,1.2", "row 1: flux = nan must be a finite number (1 of 3 rows)"),
        ("1e4,nan,1.2", "row 1: sigma_x = nan must be a number above 0"),
        ("1e4,1.2,-1", "row 1: sigma_y = -1 must be a number above 0"),
    ],
)
def test_spot_tables_hold_measured_spots_only(said, row, why):
    Path("spots.csv").write_text(f"flux,sigma_x,sigma_y\n{row}\n2e4,1.2,1.2\n3e4,1.2,1.3\n")
    assert why in said("check", "spots.csv")


def test_vertices_lie_near_their_pixel(tmp_path):
    for end in (".cfg", ".dat"):
        shutil.copy(f"{STEM}{end}", tmp_path / f"far{end}")
    lines = (tmp_path / "far.dat").read_text().splitlines()
    *others, x, _ = lines[7].split()
    lines[7] = " ".join([*others, x, "1e30"])
    (tmp_path / "far.dat").write_text("\n".join(lines) + "\n")
    with pytest.raises((BFSensorError, OSError), match=r"line 8: the vertex .* 1e\+30\)"):
        SiliconSensor(str(tmp_path / "far"))


def image(value: float = 0.0) -> galsim.ImageD:
    out = galsim.ImageD(32, 32, init_value=0)
    out[16, 16] = value
    return out


def test_photons_hold_no_charge_beyond_all_meaning():
    photons = galsim.PhotonArray(
        2, x=np.full(2, 16.0), y=np.full(2, 16.0), flux=np.array([1e300, -1e300])
    )
    with pytest.raises(
        SensorError, match=r"photon 0: flux = 1e\+300 e- must be at most 1e\+15"
    ):
        BrighterFatterSensor("itl_sta3800c").accumulate(photons, image())


def test_negative_areas_are_told():
    sensor = BrighterFatterSensor("itl_sta3800c")
    with pytest.warns(galsim.GalSimWarning, match=r"pixel \(16, 1\d\) has the area -"):
        sensor.calculate_pixel_areas(image(-1e8))


@pytest.mark.parametrize(
    ("name", "values", "why"),
    [
        ("cti_serial", {"cti": -1}, "cti = -1 must be from 0 to 0.0005"),
        ("interpixel_coupling", {"ax": 1e18, "ay": 0.0}, "ax = 1e[+]18 must be from"),
        ("no\n\x1bsuch", {}, "not in the library, which has .* others"),
        ("dark_hot", {"columns": 3.0}, "not in the library, which has dark_hot:"),
    ],
)
def test_effects_of_reports_lie_in_the_range_of_fits(tmp_path, name, values, why):
    entry = {"class": name, "parameters": {k: {"value": v} for k, v in values.items()}}
    report = {"schema": "bfsensor-diagnosis-1", "effects": [entry]}
    (tmp_path / "report.json").write_text(json.dumps(report))
    with pytest.raises(SensorError, match=why) as caught:
        BrighterFatterSensor("itl_sta3800c", effects=str(tmp_path / "report.json"))
    assert len(str(caught.value)) < 400 and str(caught.value).isprintable()


def test_reports_are_bounded(tmp_path):
    path = tmp_path / "report.json"
    for text in ("[" * 20_000, f'{{"schema": {"1" * 5000}}}'):
        path.write_text(text)
        with pytest.raises(SensorError, match=r"not a report\.json"):
            BrighterFatterSensor("itl_sta3800c", effects=str(path))
