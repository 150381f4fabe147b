"""Configurations of Poisson_CCD become devices, or are refused by name."""

from __future__ import annotations

import dataclasses
import pickle
from pathlib import Path

import galsim
import pytest

from bfsensor.device.device import Device
from bfsensor.device.parts import Implant
from bfsensor.device.poisson_ccd import import_poisson_ccd
from bfsensor.errors import DeviceError
from tests.device.device_cases import refusal

SENSORS = Path(galsim.meta_data.share_dir) / "sensors"


def assert_same_numbers(a, b, where):
    """All values equal to 1e-12 relative: both sides are a few roundings from the text."""
    assert type(a) is type(b), where
    if dataclasses.is_dataclass(a):
        for spec in dataclasses.fields(a):
            assert_same_numbers(
                getattr(a, spec.name), getattr(b, spec.name), f"{where}.{spec.name}"
            )
    elif isinstance(a, tuple):
        assert len(a) == len(b), where
        for i, (x, y) in enumerate(zip(a, b, strict=True)):
            assert_same_numbers(x, y, f"{where}[{i}]")
    elif isinstance(a, float):
        assert a == pytest.approx(b, rel=1e-12, abs=0), where
    else:
        assert a == b, where


@pytest.mark.parametrize(
    ("stem", "name"), [("lsst_itl_50_8", "itl_sta3800c"), ("lsst_e2v_50_8", "e2v_ccd250")]
)
def test_import_gives_the_builtin_devices(stem, name):
    imported = import_poisson_ccd(SENSORS / f"{stem}.cfg")
    builtin = Device.load(name)
    assert imported.name == stem
    for section in (
        "pixel", "material", "silicon", "gates", "channel", "channel_stop",
        "operating_point", "edge",
    ):  # fmt: skip
        assert_same_numbers(getattr(imported, section), getattr(builtin, section), section)
    assert Device.from_toml(imported.to_toml()) == imported
    assert pickle.loads(pickle.dumps(imported)) == imported


def changed_cfg(folder, key, value):
    """GalSim's ITL configuration with one line set to ``value`` (None: taken away)."""
    lines = (SENSORS / "lsst_itl_50_8.cfg").read_text().splitlines()
    kept = [line for line in lines if line.split("=")[0].strip() != key]
    path = folder / "itl.cfg"
    path.write_text(
        "\n".join([*kept, *([f"{key} = {value}"] if value is not None else [])])
    )
    return path


def test_import_evaluates_nothing(tmp_path, monkeypatch):
    witness = tmp_path / "witness"
    monkeypatch.chdir(tmp_path)
    for value in (
        '__import__("os").getcwd()',
        f'open("{witness}", "w").write("1")',
        "10 - 60",
        "-50.0 V",
        "'-50'",
    ):
        assert refusal(import_poisson_ccd, changed_cfg(tmp_path, "Vbb", value)) == (
            f"itl.cfg: Vbb = {value!r} is not a number"
        )
    assert not witness.exists()


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("Vbb", None, "itl.cfg: Vbb is missing"),
        ("Vbb", "", "itl.cfg: Vbb = '' is not a number"),
        (
            "Vbb",
            "nan",
            "itl.cfg: operating_point: back_bias = 'nan' must be finite",
        ),
        ("Vbb", "50", "itl.cfg: operating_point: back_bias = '50 V' must be at most 0 V"),
        *(
            (key, value, f"itl.cfg: {key} = {value!r} is not a whole number")
            for key in ("NumPhases", "ChannelProfile")
            for value in ("2.5", "nan", "inf")
        ),
        ("ChannelProfile", "3", "itl.cfg: ChannelDose_2 is missing"),
        (
            "TreeRingAmplitude",
            "0.1",
            "itl.cfg: TreeRingAmplitude = 0.1: its period lacks a factor 2 pi there; give "
            "the ripple in the device file instead",
        ),
        (
            "GateGap",
            "0.2",
            "itl.cfg: GateGap = 0.2: gaps between gates are not modelled",
        ),
        (
            "NumberofFixedRegions",
            "1",
            "itl.cfg: NumberofFixedRegions = 1: fixed regions are not taken over; describe "
            "a guard ring as [edge] in the device file",
        ),
    ],
)
def test_import_refuses(key, value, message, tmp_path):
    assert refusal(import_poisson_ccd, changed_cfg(tmp_path, key, value)) == message


def test_import_reads_square_profiles(tmp_path):
    path = changed_cfg(tmp_path, "ChannelProfile", "0")
    path.write_text(path.read_text() + "\nChannelDoping = 1.0E12\nChannelDepth = 1.0\n")
    (implant,) = import_poisson_ccd(path).channel.implants
    assert_same_numbers(implant, Implant("box", 1e4, depth=1.0), "implant")


def test_import_of_other_files(tmp_path):
    path = tmp_path / "notes.cfg"
    path.write_text("nothing\n# Vbb = 7\n")
    assert refusal(import_poisson_ccd, path) == (
        f"{path}: not a Poisson_CCD configuration: no line of the form key = value"
    )
    path.write_bytes(b"\xff\xfeVbb = 3")
    assert refusal(import_poisson_ccd, path).startswith(f"{path}: cannot be read: ")
    missing = tmp_path / "missing.cfg"
    assert refusal(import_poisson_ccd, missing).startswith(f"{missing}: cannot be read: ")


@pytest.mark.parametrize(
    "line", ["qfh1 = 1.0", "TopSurfaceDoping = 1e12", "ChannelStopDopng = -1e12"]
)
def test_import_refuses_device_keys_that_it_does_not_know(tmp_path, line):
    source = Path(galsim.meta_data.share_dir) / "sensors" / "lsst_itl_50_8.cfg"
    path = tmp_path / "other.cfg"
    path.write_text(f"{source.read_text()}\n{line}\n")
    key = line.split()[0]
    with pytest.raises(DeviceError, match=rf"other\.cfg: {key} is not a key"):
        import_poisson_ccd(path)
