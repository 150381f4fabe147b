"""Examples of the documentation run, and its command lines are accepted."""

from __future__ import annotations

import re
import shlex
import warnings
from pathlib import Path

import click
import pytest
import yaml

from bfsensor.cli.main import main
from bfsensor.recording.campaign.settings import read_settings
from tests.docs.pages import DOCS, load
from validation.concealed.__main__ import main as concealed

GENERATED = (
    "gallery",
    "validation",
    "reference/generated",
    "concepts/effects.md",
    "reference/api.md",
)
"""Pages of other code's docstrings, which are tested there, and of results."""

REFERENCE = {
    f"reference/{name}": make() for name, make in load("reference_pages").PAGES.items()
}
PAGES = {
    name: path.read_text(encoding="utf-8")
    for path in sorted(DOCS.rglob("*.md"))
    if path.name != "README.in.md"
    and not (name := path.relative_to(DOCS).as_posix()).startswith(GENERATED)
    and name not in REFERENCE
} | REFERENCE
"""Text of the pages, also of those that are written when the site is built."""

LONG = {"howto/own_device.md": "solves the device for two charges and two depths"}
"""Pages whose examples take more than 20 s."""


def blocks(page, *languages):
    """Text of a page's fenced blocks of some languages, with the line that each begins on."""
    text = PAGES[page]
    for found in re.finditer(r"^```(\w+)\n(.*?)^```$", text, re.DOTALL | re.MULTILINE):
        if found[1] in languages:
            yield text.count("\n", 0, found.start(2)), found[2]


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


def commands():
    """Command lines of shell blocks, by page and line, comments and continuations resolved."""
    for page in PAGES:
        for start, text in blocks(page, "sh", "console", "bash"):
            joined = text.replace("\\\n", " ")
            for n, line in enumerate(joined.splitlines()):
                words = shlex.split(line, comments=True)
                yield pytest.param(words, id=f"{page}:{start + n + 1}")


def accept(command, name, words, parent=None):
    """Let click parse a command line down to its last command, without running any."""
    with command.make_context(name, list(words), parent=parent) as context:
        if isinstance(command, click.Group):
            rest = [*context._protected_args, *context.args]
            inner, found, left = command.resolve_command(context, rest)
            return accept(found, inner, left, context)
    return name


@pytest.fixture
def files_are_there(monkeypatch):
    """Names of files in examples are those of a reader: they are not looked for."""
    plain = click.Path.convert

    def convert(self, value, param, context):
        self.exists = False
        return plain(self, value, param, context)

    monkeypatch.setattr(click.Path, "convert", convert)


@pytest.mark.parametrize("words", list(commands()))
def test_command_lines_are_accepted(words, files_are_there):
    program = Path(words[0]).name if words else ""
    if program == "bfsensor":
        assert accept(main, "bfsensor", words[1:])
    elif words[1:3] == ["-m", "validation.concealed"]:
        assert accept(concealed, "concealed", words[3:])
    else:
        known = ("python", "python3", "pip", "pytest", "sphinx-build", "run", "conda")
        assert not words or program in known, f"nothing checks {words}"


def test_wrong_command_lines_are_refused(files_are_there):
    for line in ("chek folder", "table itl_sta3800c --chrages 0", "diagnose"):
        with pytest.raises(click.UsageError):
            accept(main, "bfsensor", line.split())


def test_commands_named_in_text_exist(files_are_there):
    """Of `bfsensor word` in running text, the word is a command."""
    for page, given in PAGES.items():
        text = re.sub(r"^```.*?^```$", "", given, flags=re.DOTALL | re.MULTILINE)
        for found in re.finditer(r"`bfsensor ([a-z_]+)", text):
            assert found[1] in main.commands, f"{page}: {found[0]}"


def campaigns():
    for page in PAGES:
        for line, text in blocks(page, "yaml"):
            if "sensor: {type" not in text:
                yield pytest.param(text, id=f"{page}:{line}")


@pytest.mark.parametrize("text", list(campaigns()))
def test_campaign_files_are_read(text, tmp_path):
    (tmp_path / "campaign.yaml").write_text(text)
    assert read_settings(tmp_path).remarks == ()


def test_configuration_makes_a_sensor():
    import galsim

    (found,) = blocks("howto/configuration.md", "yaml")
    given = yaml.safe_load(found[1])
    galsim.config.ImportModules(given)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        sensor = galsim.config.BuildSensor(given["image"], "sensor", {}, None)
    assert type(sensor).__name__ == "BrighterFatterSensor" and "e2v_ccd250" in repr(sensor)
