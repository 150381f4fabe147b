"""Door of the command line: one value of a valid command is changed; no solve is ever begun."""

from __future__ import annotations

import contextlib
import itertools
import math
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from astropy.io import fits
from astropy.table import Table
from click.testing import CliRunner

from bfsensor.cli.main import main
from tests.fuzz.door_campaigns import make_frames
from tests.fuzz.door_devices import convert
from tests.fuzz.door_tables import Areas
from tests.fuzz.mutations import NUMBER, pick, short
from tests.fuzz.outcomes import Case, Door

TEXTS = (
    "0", "-1", "1e30", "-1e30", "nan", "inf", "-inf", "1e-300", "1e400", "9" * 400, "0x10", "1_0",
    "", "abc", "x" * 3000, "\x1b[31m", "\u202e", "\n", "true", "None", "[1]", "3", "7", "2.5", "12",
    "10", "100", "-50 V", "100 um", "5 K", "1e400 um", "1 1e400um", "nan V", "-inf V", ",", ":", "=",
    "0,1", "1,0", "0,nan", "0,0", "a=b", "\u0661", "620", "1,2,3", "../a", "5 ly",
)  # fmt: skip
"""Texts in place of a value."""


class _RefusedError(Exception):
    """A command ended with status 1 or 2; the text is its last line on stderr."""


class _SolveError(BaseException):
    """A command would now solve: all its values were accepted."""


class Value(NamedTuple):
    """A value of a command that is changed.

    Attributes
    ----------
    command : str
        The valid command; ``{}`` stands for the value.
    valid : str
        A value that is allowed.
    right : callable
        Whether a text is allowed, by the help or the documentation.
    names : tuple of str
        Names of the value, of which an error has one.
    """

    command: str
    valid: str
    right: Callable[[str], bool]
    names: tuple[str, ...]


def within(
    low: float, high: float = math.inf, *, whole: bool = False, odd: int | None = None
) -> Callable[[str], bool]:
    """Make a test of one finite number within limits, whole, or odd (1) or even (0)."""

    def right(text: str) -> bool:
        try:
            value = int(text) if whole else float(text)
        except ValueError:
            return False
        try:
            fits = math.isfinite(value) and low <= value <= high
        except OverflowError:
            return False
        return fits and (odd is None or value % 2 == odd)

    return right


def ascending(low: float, high: float) -> Callable[[str], bool]:
    """Make a test of a list of numbers that ascend within limits."""

    def right(text: str) -> bool:
        try:
            values = [float(part) for part in text.split(",")]
        except ValueError:
            return False
        ordered = all(a < b for a, b in itertools.pairwise(values))
        return ordered and all(math.isfinite(v) and low <= v <= high for v in values)

    return right


def quantity(
    kind: str, low: float, high: float, factor: float = 1.0
) -> Callable[[str], bool]:
    """Make a test of a number with a unit within limits."""

    def right(text: str) -> bool:
        value = convert(text, kind) * factor
        return bool(np.isfinite(value) and low <= value <= high)

    return right


def swept(kind: str, low: float, high: float) -> Callable[[str], bool]:
    """Make a test of a list of quantities, or of first:last:number."""
    one = quantity(kind, low, high)

    def right(text: str) -> bool:
        ends = text.split(":")
        if len(ends) == 3:
            count = ends[2].strip()
            return (
                one(ends[0]) and one(ends[1]) and count.isdecimal() and 1 < int(count) < 1e5
            )
        return all(one(part) for part in text.split(","))

    return right


VALUES = (
    Value("table itl_sta3800c -o t.fits --charges {}", "0,5e4", ascending(0, 1e7), ("charge",)),
    Value("table itl_sta3800c -o t.fits --backgrounds {}", "0,5e4", ascending(0, 1e7),
          ("background",)),
    Value("table itl_sta3800c -o t.fits --depths {}", "50,100", ascending(1e-9, 100), ("depth",)),
    Value("table itl_sta3800c -o t.fits --vertices {}", "8", within(2, 1e4, whole=True),
          ("vertices",)),
    Value("table itl_sta3800c -o t.fits --pixels {}", "9", within(3, 11, whole=True, odd=1),
          ("pixels",)),
    Value("table itl_sta3800c -o t.fits --accuracy {}", "0.02", within(0.005), ("accuracy",)),
    Value("table itl_sta3800c -o t.fits --workers {}", "1", within(1, 1e4, whole=True),
          ("workers",)),
    Value("table itl_sta3800c --no-figure -o {}", "t.fits", lambda text: True, ("",)),
    Value("table itl_sta3800c -o t.fits --set thickness={}", "90 um",
          quantity("length", 5, 1000), ("thickness", "KEY=VALUE", "deplet")),
    Value("table itl_sta3800c -o t.fits --set back_bias={}", "-60 V",
          quantity("potential", -500, 0), ("back_bias", "KEY=VALUE", "deplet")),
    Value("table {} -o t.fits", "e2v_ccd250", lambda text: False, ("device", "DEVICE")),
    Value("sweep itl_sta3800c -o s.ecsv --over back_bias={}", "-60V,-50V",
          swept("potential", -500, 0), ("back_bias", "KEY=VALUE", "given twice")),
    Value("sweep itl_sta3800c -o s.ecsv --over thickness={}", "90um:110um:3",
          swept("length", 5, 1000), ("thickness", "KEY=VALUE")),
    Value("sweep itl_sta3800c -o s.ecsv --over wavelength={}", "500nm,600nm",
          swept("length", 0.25, 1.45), ("wavelength", "KEY=VALUE")),
    Value("sweep itl_sta3800c -o s.ecsv --over back_bias=-60V,-50V --level {}", "4e4",
          within(0, 1e7), ("level",)),
    Value("sweep itl_sta3800c -o s.ecsv --over back_bias=-60V,-50V --full-pixel {}", "4e4",
          within(0, 1e7), ("full-pixel", "full pixel")),
    Value("sweep itl_sta3800c -o s.ecsv --over back_bias=-60V,-50V --cells {}", "16",
          within(8, 128, whole=True, odd=0), ("cells",)),
    Value("sweep itl_sta3800c -o s.ecsv --over back_bias=-60V,-50V --accuracy {}", "0.02",
          within(0.005), ("accuracy",)),
    Value("spots itl_sta3800c -o out --spots {}", "2", within(1, 1e6, whole=True), ("spots",)),
    Value("spots itl_sta3800c -o out --peak {}", "5e4", within(1, 1e7), ("peak", "full well")),
    Value("spots itl_sta3800c -o out --sigma {}", "8", within(0.1, 20), ("sigma",)),
    Value("spots itl_sta3800c -o out --steps {}", "20", within(1, 100_000, whole=True),
          ("steps",)),
    Value("spots itl_sta3800c -o out --pixels {}", "13", within(7, 63, whole=True, odd=1),
          ("pixels",)),
    Value("spots itl_sta3800c -o out --cells {}", "8", within(8, 64, whole=True, odd=0),
          ("cells",)),
    Value("spots itl_sta3800c -o out --depth {}", "90", within(2, 100), ("depth",)),
    Value("spots itl_sta3800c -o out --wavelength {}", "620", within(250, 1450), ("wavelength",)),
    Value("spots itl_sta3800c -o out --diffusion {}", "1.5", within(0), ("diffusion",)),
    Value("spots itl_sta3800c -o out --seed {}", "7", within(0, 2**63, whole=True), ("seed",)),
    Value("fit itl_sta3800c areas.csv -o out --free background_doping --lags {}", "2",
          within(1, 8, whole=True), ("lags",)),
    Value("fit itl_sta3800c areas.csv -o out --free thickness:{}", "2um",
          lambda text: (quantity("length", 1e-12, 1000)(text.rpartition("+-")[2])
                        and ("+-" not in text or quantity("length", 5, 1000)(text.split("+-")[0]))),
          ("free", "thickness")),
    Value("fit itl_sta3800c areas.csv -o out --free background_doping --cells {}", "16",
          within(8, 128, whole=True, odd=0), ("cells",)),
    Value("fit itl_sta3800c areas.csv -o out --free background_doping --finer {}", "24",
          within(0, 128, whole=True, odd=0), ("finer", "cells")),
    Value("fit itl_sta3800c areas.csv -o out --free background_doping --draws {}", "2",
          within(0, 1e6, whole=True), ("draws",)),
    Value("fit itl_sta3800c areas.csv -o out --free background_doping --readout {}", "1",
          within(0, whole=True), ("readout",)),
    Value("fit itl_sta3800c areas.csv -o out --free background_doping --at level={}", "1e4",
          lambda text: within(0, 1e9)(text.removesuffix("e-").strip()), ("level", "KEY=VALUE")),
    Value("fit itl_sta3800c areas.csv -o out --free background_doping --at back_bias={}", "-60V",
          quantity("potential", -500, 0), ("back_bias", "KEY=VALUE")),
    Value("fit itl_sta3800c areas.csv -o out --free background_doping --profile {}",
          "background_doping", lambda text: False, ("profile",)),
    Value("fit itl_sta3800c {} -o out --free background_doping", "areas.csv", lambda text: False,
          ("no such file", "folder", "cannot be read", "RECORDINGS", "name")),
    Value("diagnose areas.csv --baseline itl_sta3800c -o out --seed {}", "3",
          within(0, 2**63, whole=True), ("seed",)),
    Value("diagnose areas.csv --baseline {} -o out", "itl_sta3800c", lambda text: text == "none",
          ("baseline", "device", "table")),
    Value("diagnose areas.csv --baseline itl_sta3800c -o out --at back_bias={}", "-60V",
          quantity("potential", -500, 0), ("back_bias", "KEY=VALUE")),
    Value("diagnose areas.csv --baseline itl_sta3800c -o out --predict level={}", "4e4",
          within(1e-9, 1e7), ("level", "condition")),
    Value("export bfk itl_sta3800c --detector {} --gain 1.6 -o b.fits", "3",
          within(0, 1e9, whole=True), ("detector",)),
    Value("export bfk itl_sta3800c --detector 3 --gain {} -o b.fits", "1.6",
          lambda text: within(1e-300)(text.rpartition("=")[2]), ("gain",)),
    Value("export bfk itl_sta3800c --detector 3 --gain 1.6 --level {} -o b.fits", "1e4",
          within(0, 1e7), ("level", "background")),
    Value("export bfk itl_sta3800c --detector 3 --gain 1.6 --lags {} -o b.fits", "4",
          within(2, 64, whole=True), ("lags",)),
    Value("export bfk itl_sta3800c --detector 3 --gain 1.6 --wavelength {} -o b.fits", "620",
          within(250, 1450), ("wavelength",)),
    Value("measure flats campaign/flat_2.fits campaign/flat_3.fits --lags 3 --gain {}", "1.6",
          within(1e-4, 1e4), ("gain",)),
    Value("measure flats campaign/flat_2.fits campaign/flat_3.fits --lags {}", "3",
          within(0, 5, whole=True), ("lag",)),
    Value("measure flats campaign/flat_2.fits campaign/flat_3.fits --lags 3 --sections {}",
          "data=[1:16,1:12],bias=[17:24,1:12]", lambda text: False, ("sections", "data")),
    Value("measure spots spots.fits --overscan none --threshold {}", "1e4",
          within(1e-300, 1e30), ("threshold", "spot")),
    Value("measure spots spots.fits --overscan none --threshold 1e3 --stamp {}", "9",
          within(3, 12, whole=True, odd=1), ("stamp", "spot")),
    Value("device show itl_sta3800c --set temperature={}", "170 K",
          quantity("temperature", 77, 350), ("temperature", "KEY=VALUE")),
    Value("device check itl_sta3800c --set thickness={}", "90 um", quantity("length", 5, 1000),
          ("thickness", "KEY=VALUE")),
    Value("device check itl_sta3800c --set {}=3", "phases", lambda text: False,
          ("quantity", "KEY=VALUE")),
    Value("device show {}", "itl_sta3800c", lambda text: False, ("device", "DEVICE")),
    Value("device new {} --from itl_sta3800c", "mine.toml", lambda text: False, (".toml",)),
    Value("show itl_sta3800c -o {}", "a.png", lambda text: False, ("figure", "output")),
    Value("check {}", "campaign", lambda text: False, ("", )),
)  # fmt: skip
"""Values of commands."""


class Commands(Door):
    """The command line, in process; a solve, a fit and a diagnosis stop it as accepted."""

    name = "command"

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        Table(Areas.columns).write(folder / "areas.csv", format="ascii.csv")
        y, x = np.mgrid[:60, :60]
        spots = sum(
            3e4 * np.exp(-((x - i) ** 2 + (y - j) ** 2) / 4.0)
            for i in (15, 45)
            for j in (15, 45)
        )
        noise = np.random.default_rng(3119).normal(100, 5, (60, 60))
        fits.PrimaryHDU(spots + noise, fits.Header({"GAIN": 1.0})).writeto(
            folder / "spots.fits"
        )
        (folder / "campaign").mkdir()
        make_frames(folder / "campaign")
        (folder / "campaign" / "manifest.ecsv").unlink()

    def make(self, rng: np.random.Generator) -> Case:
        """Give one value another text; one in twelve stays, and must be accepted."""
        value = pick(rng, VALUES)
        text = value.valid if rng.random() < 1 / 12 else pick(rng, TEXTS)
        if rng.random() < 0.2 and text != value.valid and value.valid[0].isdigit():
            start = NUMBER.match(value.valid)
            text = (
                f"{float(start[0]) * 10:g}{value.valid[start.end() :]}" if start else text
            )
        args = [part.replace("{}", text) for part in value.command.split()]

        def judge(made: str) -> str:
            if text == value.valid or value.right(text):
                return ""
            return f"{made} although {short(text)} is not allowed"

        return Case(
            f"bfsensor {value.command} with {short(text)}",
            lambda: self._run(args), judge, (*value.names, "No such option"), text == value.valid,
            (_RefusedError,),
        )  # fmt: skip

    def _run(self, args: list[str]) -> str:
        """Run a command in the folder of the door."""
        before = {path.name for path in self.folder.iterdir()}
        here = Path.cwd()
        os.chdir(self.folder)
        try:
            with no_solves():
                result = CliRunner().invoke(main, args)
        except _SolveError:
            return "a solve begins"
        finally:
            os.chdir(here)
            for path in self.folder.iterdir():
                if path.name not in before:
                    _remove(path)
        if result.exception is not None and not isinstance(result.exception, SystemExit):
            raise result.exception
        if result.exit_code == 0:
            return "the command ends with status 0"
        lines = result.stderr.strip().split("\n")
        # Usage errors of click have lines of usage before, and may have several.
        start = next((k for k, line in enumerate(lines) if line.startswith("Error: ")), -1)
        raise _RefusedError("\n".join(lines[start:]))


def _remove(path: Path) -> None:
    if path.is_dir():
        for inner in path.iterdir():
            _remove(inner)
        path.rmdir()
    else:
        path.unlink()


@contextlib.contextmanager
def no_solves() -> Iterator[None]:
    """Stop at the first solve, fit or diagnosis, and start no workers."""
    from unittest import mock

    def stop(*args: Any, **more: Any) -> None:
        raise _SolveError

    def no_pool(*args: Any, **more: Any) -> Any:
        return contextlib.nullcontext(None)

    with (
        mock.patch("bfsensor.simulate.poisson.Electrostatics.__init__", stop),
        mock.patch("bfsensor.sweeps.executors.open_executor", no_pool),
        mock.patch("bfsensor.table.build.build_table", stop),
        mock.patch("bfsensor.diagnose.diagnosis.diagnose", stop),
        mock.patch("bfsensor.diagnose.diagnosis.diagnose_measured", stop),
    ):
        yield
