"""Examples of the documentation run, and its command lines are accepted."""

from __future__ import annotations

import re
import warnings
from pathlib import Path

import click
import pytest
import yaml

from bfsensor.cli.main import main
from bfsensor.recording.campaign.settings import read_settings
from tests.docs.examples import PAGES, accept, blocks, commands, ignore_files

LONG = {"howto/own_device.md": "solves the device for two charges and two depths"}
"""Pages whose examples take more than 20 s."""


def with_python():
    for page in PAGES:
        if any(True for _ in blocks(page, "python")):
            marks = [pytest.mark.slow] if page in LONG else []
            yield pytest.param(page, marks=marks, id=page)


@pytest.mark.parametrize("page", list(with_python()))
def test_python_examples_run(page, tmp_path, monkeypatch):
    """All examples of a page share one namespace, in a folder of their own."""
    monkeypatch.chdir(tmp_path)
    space = {"__name__": "__main__"}
    for line, code in blocks(page, "python"):
        # Tracebacks name the page and the line.
        exec(compile("\n" * line + code, str(page), "exec"), space)


@pytest.fixture
def files_are_there(monkeypatch):
    ignore_files(monkeypatch)


@pytest.mark.parametrize("words", list(commands()))
def test_command_lines_are_accepted(words, files_are_there):
    program = Path(words[0]).name if words else ""
    if program == "bfsensor":
        assert accept(main, "bfsensor", words[1:])
    else:
        known = (
            "python",
            "python3",
            "pip",
            "pytest",
            "sphinx-build",
            "run",
            "conda",
            "export",
        )
        assert not words or program in known, f"nothing checks {words}"


def test_wrong_command_lines_are_refused(files_are_there):
    for line in ("chek folder", "table itl_sta3800c --chrages 0", "diagnose"):
        with pytest.raises(click.UsageError):
            accept(main, "bfsensor", line.split())


def test_commands_named_in_text_exist(files_are_there):
    """Running text names existing commands after `bfsensor`."""
    for page, given in PAGES.items():
        text = re.sub(r"^```.*?^```$", "", given, flags=re.DOTALL | re.MULTILINE)
        for found in re.finditer(r"`bfsensor ([a-z_]+)", text):
            assert found[1] in main.commands, f"{page}: {found[0]}"


def campaigns():
    for page in PAGES:
        for line, text in blocks(page, "yaml"):
            if "sensor: {type" not in text and "image.sensor" not in text:
                yield pytest.param(text, id=f"{page}:{line}")


@pytest.mark.parametrize("text", list(campaigns()))
def test_campaign_files_are_read(text, tmp_path):
    (tmp_path / "campaign.yaml").write_text(text)
    assert read_settings(tmp_path).remarks == ()


def test_configurations_make_sensors():
    import galsim

    made = []
    for _, text in blocks("howto/configuration.md", "yaml"):
        given = yaml.safe_load(text)
        galsim.config.ImportModules(given)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            made.append(galsim.config.BuildSensor(given["image"], "sensor", {}, None))
    names = [(type(sensor).__name__, sensor.name) for sensor in made]
    assert ("BrighterFatterSensor", "e2v_ccd250") in names
    assert ("SiliconSensor", "lsst_e2v_50_8") in names
