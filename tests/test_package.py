"""The package: its tables are found in a checkout and in a wheel, and it loads lightly."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from pathlib import Path

import pytest

import bfsensor
from bfsensor.device.device import builtin_devices
from bfsensor.device.shipped import tables_dir

ROOT = Path(__file__).resolve().parents[1]
DEVICES = [
    "e2v_ccd250", "e2v_ccd250_2019", "e2v_ccd250_70",
    "hsc_hamamatsu", "itl_sta3800c", "itl_sta3800c_2019", "itl_sta3800c_60",
]  # fmt: skip
REPORT = """
import json, bfsensor
from bfsensor.device.device import Device, builtin_devices
from bfsensor.device.shipped import tables_dir
print(json.dumps({
    "package": bfsensor.__file__, "version": bfsensor.__version__,
    "tables": str(tables_dir()), "devices": builtin_devices(),
    "loaded": [Device.load(name).name for name in builtin_devices()],
}))
"""


def python(code, *, cwd, path=None):
    """Standard output of a new interpreter, without the user's own settings."""
    result = subprocess.run(
        [sys.executable, "-W", "error", "-c", code],
        cwd=cwd, capture_output=True, text=True, check=False, timeout=300,
        env={"PYTHONPATH": str(path)} if path else {},
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    return result.stdout


def test_tables_of_a_checkout():
    assert builtin_devices() == tuple(DEVICES)
    for name in DEVICES:
        assert (tables_dir() / name / "device.toml").is_file()


def pip(*args):
    return subprocess.run(
        [sys.executable, "-m", "pip", *args], capture_output=True, text=True, check=False,
        timeout=600,
    )  # fmt: skip


def test_tables_of_a_wheel(tmp_path):
    if not (ROOT / "pyproject.toml").exists():
        pytest.skip("not a checkout: there is nothing to build")
    here = importlib.util.find_spec("hatchling") is not None
    built = pip(
        "wheel", str(ROOT), "--no-deps", "--wheel-dir", str(tmp_path / "wheel"),
        *(["--no-build-isolation"] if here else []),
    )  # fmt: skip
    if not here and built.returncode and "hatchling" in built.stderr:
        pytest.skip("hatchling, the build backend, can neither be imported nor installed")
    assert built.returncode == 0, built.stderr
    (wheel,) = (tmp_path / "wheel").iterdir()
    target = tmp_path / "site"
    installed = pip("install", "--no-deps", "--target", str(target), str(wheel))
    assert installed.returncode == 0, installed.stderr
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    report = json.loads(python(REPORT, cwd=elsewhere, path=target))
    assert report["version"] == bfsensor.__version__
    assert Path(report["package"]).is_relative_to(target)
    assert (
        target / "bfsensor" / "py.typed"
    ).is_file()  # so that type checkers read its types
    assert Path(report["tables"]).is_relative_to(target)
    assert report["devices"] == report["loaded"] == DEVICES


def test_importing_loads_nothing_heavy(tmp_path):
    code = "import sys, bfsensor; dir(bfsensor); print('\\n'.join(sys.modules))"
    loaded = set(python(code, cwd=tmp_path, path=ROOT).split())
    assert "bfsensor" in loaded
    assert not loaded & {"numba", "galsim", "astropy", "matplotlib", "scipy", "numpy"}


@pytest.mark.parametrize("name", [n for n in bfsensor.__all__ if n != "__version__"])
def test_public_names_exist(name):
    assert getattr(bfsensor, name).__name__ == name
    assert name in dir(bfsensor)


def test_unknown_names_are_refused():
    with pytest.raises(
        AttributeError, match=r"^module 'bfsensor' has no attribute 'Devise'$"
    ):
        bfsensor.Devise  # noqa: B018


def test_unfinished_tables_do_not_ship():
    # force-include would pack what .gitignore names; the wheel's own selection must not.
    import tomllib

    settings = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())
    wheel = settings["tool"]["hatch"]["build"]["targets"]["wheel"]
    assert "force-include" not in wheel
    ignored = (Path(__file__).parents[1] / ".gitignore").read_text().splitlines()
    assert "*.levels/" in ignored


def test_tests_of_the_package_do_not_need_the_validation_scripts():
    """Makers of recordings come through two doors; what compares with them is in tests/validation."""
    import ast

    doors = {"virtual.py", "broken_campaigns.py"}
    apart = ("validation", "benchmarks")
    for path in (ROOT / "tests").rglob("*.py"):
        place = path.relative_to(ROOT / "tests")
        if place.parts[0] in apart or str(place) in doors:
            continue
        for node in ast.walk(ast.parse(path.read_text())):
            named = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            named += [a.name for a in node.names] if isinstance(node, ast.Import) else []
            assert not any(n.partition(".")[0] == "validation" for n in named), str(place)
