"""GalSim's own tests of its SiliconSensor, run on another class in its place.

``python -m validation.sensor.galsim_suite SOURCE [--sensor bfsensor.SiliconSensor] [--json OUT]`` reads
the tests in ``SOURCE/tests`` at run time.  SOURCE is a checkout of GalSim 2.8.5, or its source
distribution (``pip download --no-deps --no-binary :all: galsim==2.8.5``, ``tar xf``) completed with
``tests/sensor_validation/lsst_itl_8_areas.dat`` and ``tests/fits_files/tnx.fits``.
``--imsim DIR`` adds imSim's two tests: DIR is an imSim checkout, of which
``tests/test_sensor_models.py`` and ``data/sensor_models`` are read.

Counted are functions and assertion sites, that is lines that assert.  A failing site does not end
its function; a site passes if it was reached and every execution passed.  Two classes calibrate
the counts: ``--sensor galsim.SiliconSensor`` and ``--sensor null``, which has no physics.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import importlib
import io
import json
import os
import shutil
import sys
import tempfile
import time
import types
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from unittest import mock

import galsim
import numpy as np

SUITE = (
    ("test_sensor.py", None),
    ("test_config_image.py", "test_sensor"),
    ("test_config_noise.py", "test_poisson"),
    ("test_photon_array.py", "test_lsst_y_focus"),
)
"""Test files of GalSim that use its SiliconSensor, with one function or all (None)."""

IMSIM_FILE = "test_sensor_models.py"

STREAM_PINNED = {("test_sensor.py", line) for line in (556, 557, 558)}
"""Sites of GalSim 2.8.4 and 2.8.5 that hold for its own sequence of random numbers alone."""

MODEL_PINNED = {("test_sensor.py", line) for line in (525, 526, 527)}
"""Sites there that hold for its model at its default lag between boundary updates."""

IMSIM_PINNED_RTOL = 1e-6
"""imSim's sites this tight on images of the sensor are pinned to the stream: one electron elsewhere
fails them.  Those on images without it (``None`` and ``Sensor``) hold for any class and are counted."""

IMSIM_MODELS = ("4point", "8point", "32point")
"""Names that imSim's tests give to images of the sensor."""

NEEDED = ("sensor_validation/lsst_itl_8_areas.dat", "fits_files/tnx.fits")
"""Data of the tests that are in GalSim's repository but not in its source distribution."""

NOT_REACHED = "not reached"
RINGS = "tree_ring_lookup.dat"

SWITCHES = {"run_slow", "test_timing"}
"""Names that turn on slow and timing tests; both are off."""


class NullSensor(galsim.SiliconSensor):
    """SiliconSensor's interface without its physics: fixed square pixels, no diffusion."""

    def accumulate(
        self,
        photons: galsim.PhotonArray,
        image: galsim.Image,
        orig_center: galsim.PositionI | None = None,
        resume: bool = False,
        recalc: bool = False,
    ) -> float:
        """Add each photon to the pixel it falls on, as ``galsim.Sensor`` does."""
        return galsim.Sensor.accumulate(self, photons, image, orig_center, resume)

    def calculate_pixel_areas(
        self,
        image: galsim.Image,
        orig_center: galsim.PositionI | None = None,
        use_flux: bool = True,
    ) -> galsim.Image:
        """Give an image of ones [pixel area]."""
        ones = np.ones(image.array.shape, dtype=image.dtype)
        return galsim.Image(ones, xmin=image.xmin, ymin=image.ymin, scale=1.0)


@dataclass
class Outcome:
    """What became of one test function.

    Attributes
    ----------
    file, function : str
        Name of the test file and of the function in it.
    failures : dict of int to str
        Line of each site that did not pass, with the first line of the first exception there.
    sites : int
        Assertion sites of the function and of the functions of its file that it uses.
    pinned, model_pinned : frozenset of int
        Lines of those sites that are pinned to the random stream, and to GalSim's model.
    error : str
        First line of the exception that ended the function early; empty if none did.
    seconds : float
        Wall-clock time.
    """

    file: str
    function: str
    failures: dict[int, str]
    sites: int
    pinned: frozenset[int]
    model_pinned: frozenset[int]
    error: str
    seconds: float

    @property
    def passed(self) -> bool:
        """Whether every site passed and nothing else was raised."""
        return not self.failures and not self.error

    def pinned_to(self, line: int) -> str:
        """``stream``, ``model`` or nothing: what the site at a line is pinned to."""
        if line in self.pinned:
            return "stream"
        return "model" if line in self.model_pinned else ""

    def count(self, *without: frozenset[int]) -> tuple[int, int]:
        """Sites passed and sites in all, those of the sets `without` left out."""
        left_out = frozenset().union(*without)
        failed = len(self.failures.keys() - left_out)
        total = self.sites - len(left_out)
        return total - failed, total


@dataclass
class Recorder:
    """Outcome of each site of the test function that runs."""

    reached: set[int] = field(default_factory=set)
    failures: dict[int, str] = field(default_factory=dict)

    @contextlib.contextmanager
    def site(self, line: int) -> Iterator[None]:
        """Run one assertion; keep its exception and go on."""
        self.reached.add(line)
        try:
            yield
        except Exception as exc:
            self.failures.setdefault(line, _first_line(exc))


def _first_line(exc: BaseException) -> str:
    lines = [line.strip() for line in str(exc).splitlines() if line.strip()]
    return f"{type(exc).__name__}: {lines[0][:160]}" if lines else type(exc).__name__


class SiteFinder(ast.NodeTransformer):
    """Wraps each assertion of a test file in ``with RECORDER.site(line)``.

    Sites are assert statements, calls of ``assert_*`` and ``check_*`` as statements, and ``with``
    blocks on ``assert_*`` or ``raises``.  What stands under one of the `SWITCHES` is left as it is.

    Attributes
    ----------
    sites : dict of int to ast.stmt
        The assertions by line.
    """

    RECORDER = "_site_recorder"

    def __init__(self) -> None:
        self.sites: dict[int, ast.stmt] = {}

    def visit_Assert(self, node: ast.Assert) -> ast.AST:
        """Wrap an assert statement."""
        return self._wrap(node)

    def visit_Expr(self, node: ast.Expr) -> ast.AST:
        """Wrap the call of an assertion function."""
        is_site = _called_name(node.value).startswith(("assert_", "check_"))
        return self._wrap(node) if is_site else node

    def visit_With(self, node: ast.With) -> ast.AST:
        """Wrap a block that must raise or warn; look into any other."""
        names = [_called_name(item.context_expr) for item in node.items]
        if any(name.startswith("assert_") or name == "raises" for name in names):
            return self._wrap(node)
        return self.generic_visit(node)

    def visit_If(self, node: ast.If) -> ast.AST:
        """Look into the branches that run."""
        if isinstance(node.test, ast.Name) and node.test.id in SWITCHES:
            node.orelse = [self.visit(child) for child in node.orelse]
            return node
        return self.generic_visit(node)

    def _wrap(self, node: ast.stmt) -> ast.AST:
        if node.lineno in self.sites:
            raise ValueError(f"line {node.lineno} holds two assertions")
        self.sites[node.lineno] = node
        call = ast.parse(f"{self.RECORDER}.site({node.lineno})", mode="eval").body
        block = ast.With(items=[ast.withitem(context_expr=call)], body=[node])
        ast.copy_location(block, node)
        for part in ast.walk(call):
            ast.copy_location(part, node)
        return block


def _called_name(node: ast.expr) -> str:
    """Last name of a called function, empty for what is no call."""
    if not isinstance(node, ast.Call):
        return ""
    function = node.func
    if isinstance(function, ast.Attribute):
        return function.attr
    return function.id if isinstance(function, ast.Name) else ""


class TestFile:
    """One test file with its assertions made to record instead of to raise.

    Parameters
    ----------
    path : Path
        The file; it is read, and nothing of it kept.
    """

    __test__ = False

    def __init__(self, path: Path) -> None:
        self.path = path
        self._tree = ast.parse(path.read_text(encoding="utf-8"))
        self._functions = {
            node.name: node for node in self._tree.body if isinstance(node, ast.FunctionDef)
        }
        finder = SiteFinder()
        finder.visit(self._tree)
        self.sites = finder.sites

    @property
    def tests(self) -> list[str]:
        """Names of the test functions in order."""
        return [name for name in self._functions if name.startswith("test_")]

    def lines_of(self, function: str) -> set[int]:
        """Lines of the sites in a function and in those of this file that it uses."""
        used, waiting = set(), [function]
        while waiting:
            name = waiting.pop()
            used.add(name)
            names = {
                n.id for n in ast.walk(self._functions[name]) if isinstance(n, ast.Name)
            }
            waiting += (names & self._functions.keys()) - used
        bodies = [self._functions[name] for name in used]
        return {
            line for line in self.sites for f in bodies if f.lineno <= line <= f.end_lineno
        }

    def tight_lines(self) -> set[int]:
        """Lines of the sites that ask for the relative tolerance of imSim's pinned ones.

        The tolerance is a number, or the name of one that the file sets once.
        """
        numbers = {
            target.id: node.value.value
            for node in self._tree.body
            if isinstance(node, ast.Assign) and isinstance(node.value, ast.Constant)
            for target in node.targets
            if isinstance(target, ast.Name)
        }

        def value(node: ast.expr) -> object:
            if isinstance(node, ast.Name):
                return numbers.get(node.id)
            return node.value if isinstance(node, ast.Constant) else None

        def of_models(site: ast.stmt) -> bool:
            words = {n.value for n in ast.walk(site) if isinstance(n, ast.Constant)}
            return bool(words.intersection(IMSIM_MODELS))

        return {
            line
            for line, site in self.sites.items()
            for part in ast.walk(site)
            if isinstance(part, ast.keyword)
            and part.arg == "rtol"
            and value(part.value) == IMSIM_PINNED_RTOL
            and of_models(site)
        }

    def load(self) -> types.ModuleType:
        """Execute the file as a module with a recorder that is set before each function."""
        module = types.ModuleType(self.path.stem)
        module.__file__ = str(self.path)
        sys.modules[module.__name__] = module
        exec(compile(self._tree, str(self.path), "exec"), module.__dict__)
        return module

    def run(self, module: types.ModuleType, function: str) -> Outcome:
        """Run one function and say what became of it.

        GalSim's threads are set to one before, since one of the tests changes their number.
        """
        galsim.set_omp_threads(1)
        recorder = Recorder()
        setattr(module, SiteFinder.RECORDER, recorder)
        test = getattr(module, function)
        takes_slow = "run_slow" in {arg.arg for arg in self._functions[function].args.args}
        error, start = "", time.perf_counter()
        with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                test(**({"run_slow": False} if takes_slow else {}))
            except Exception as exc:
                error = _first_line(exc)
        seconds = time.perf_counter() - start
        lines = self.lines_of(function)
        failures = dict.fromkeys(lines - recorder.reached, NOT_REACHED)
        tight = self.tight_lines() if self.path.name == IMSIM_FILE else set()
        return Outcome(
            file=self.path.name,
            function=function,
            failures=dict(sorted((failures | recorder.failures).items())),
            sites=len(lines),
            pinned=frozenset(
                line
                for line in lines
                if (self.path.name, line) in STREAM_PINNED or line in tight
            ),
            model_pinned=frozenset(
                line for line in lines if (self.path.name, line) in MODEL_PINNED
            ),
            error=error,
            seconds=seconds,
        )


@contextlib.contextmanager
def replaced(sensor: type) -> Iterator[None]:
    """Put a class in the place of ``galsim.SiliconSensor``, also for the type 'Silicon'."""
    config = galsim.config.sensor
    with contextlib.ExitStack() as stack:
        for module in (galsim, galsim.sensor, config):
            stack.enter_context(mock.patch.object(module, "SiliconSensor", sensor))
        stack.enter_context(mock.patch.dict(config.valid_sensor_types))
        galsim.config.RegisterSensorType("Silicon", config.SimpleSensorBuilder(sensor))
        yield


@contextlib.contextmanager
def working_directory(tests: Path) -> Iterator[None]:
    """Work in a copy, by links, of GalSim's tests, with what its archive leaves out.

    The archive's missing file of tree rings is cos(2 pi r / 250) for radii r up to 2000 pixels, of
    which the tests take half.
    """
    with tempfile.TemporaryDirectory() as name, contextlib.ExitStack() as stack:
        place = Path(name)
        for path in tests.iterdir():
            (place / path.name).symlink_to(path.resolve())
        if not (place / RINGS).exists():
            radii = np.linspace(0, 2000, 2048)
            rings = np.cos(2 * np.pi * radii / 250)
            np.savetxt(place / RINGS, np.column_stack([radii, rings]))
        modules = {}
        if not (place / "galsim_test_helpers.py").exists():
            modules["galsim_test_helpers"] = _test_helpers()
        stack.enter_context(mock.patch.dict(sys.modules, modules))
        stack.enter_context(mock.patch.object(sys, "path", [name, *sys.path]))
        stack.enter_context(contextlib.chdir(place))
        yield


def _test_helpers() -> types.ModuleType:
    """Module with the helpers that the tests run here import, the one that prints left empty."""
    helpers = types.ModuleType("galsim_test_helpers")
    for name in ("check_pickle", "check_all_diff", "timer", "CaptureLog"):
        setattr(helpers, name, getattr(galsim.utilities, name))
    helpers.printval = lambda first, second: None
    helpers.assert_raises = np.testing.assert_raises
    helpers.assert_warns = np.testing.assert_warns
    return helpers


@contextlib.contextmanager
def imsim_package(models: Path) -> Iterator[None]:
    """Stand in for the package ``imsim``, of which the tests ask for the data directory only.

    imSim's models with 8 and 32 vertices are those of GalSim and are taken there if absent.
    """
    with tempfile.TemporaryDirectory() as name:
        place = Path(name) / "sensor_models"
        place.mkdir()
        for folder in (Path(galsim.meta_data.share_dir) / "sensors", models):
            for path in folder.glob("lsst_*_50_*"):
                (place / path.name).unlink(missing_ok=True)
                (place / path.name).symlink_to(path.resolve())
        package = types.ModuleType("imsim")
        package.meta_data = types.ModuleType("imsim.meta_data")
        package.meta_data.data_dir = name
        modules = {"imsim": package, "imsim.meta_data": package.meta_data}
        with mock.patch.dict(sys.modules, modules):
            yield


def missing_imsim(directory: Path | None) -> str:
    """Say why imSim's tests cannot run; empty if they can."""
    if directory is None:
        return "no --imsim"
    wanted = [directory / "tests" / IMSIM_FILE]
    wanted += [
        directory / "data" / "sensor_models" / f"lsst_{vendor}_50_4.{ending}"
        for vendor in ("itl", "e2v")
        for ending in ("cfg", "dat")
    ]
    absent = [path.name for path in wanted if not path.exists()]
    return f"{directory} lacks {', '.join(absent)}" if absent else ""


def run_suite(
    source: Path, sensor: type, *, imsim: Path | None = None, only: str = ""
) -> Iterator[Outcome]:
    """Run the tests on a class in the place of ``galsim.SiliconSensor``.

    Parameters
    ----------
    source : Path
        Unpacked source distribution of GalSim 2.8.4 or 2.8.5.
    sensor : type
        The class.
    imsim : Path, optional
        Checkout of imSim with all that `missing_imsim` asks for.
    only : str
        Run only the functions whose name contains this.

    Yields
    ------
    outcome : Outcome
        One for each function, when it has run.
    """
    with replaced(sensor), working_directory(source / "tests"):
        for name, function in SUITE:
            yield from _run_file(TestFile(source / "tests" / name), function, only)
        if imsim is not None:
            with imsim_package(imsim / "data" / "sensor_models"):
                yield from _run_file(TestFile(imsim / "tests" / IMSIM_FILE), None, only)


def _run_file(file: TestFile, function: str | None, only: str) -> Iterator[Outcome]:
    names = [name for name in file.tests if function in (None, name) and only in name]
    if names:
        module = file.load()
        for name in names:
            yield file.run(module, name)


def load_sensor(name: str) -> type:
    """Class of a dotted name, or `NullSensor` for ``null``."""
    if name == "null":
        return NullSensor
    module, _, attribute = name.rpartition(".")
    return getattr(importlib.import_module(module), attribute)


def summarise(outcomes: list[Outcome]) -> dict[str, tuple[int, int]]:
    """Count what passed and all there is, with and without the pinned sites."""

    def total(counts: list[tuple[int, int]]) -> tuple[int, int]:
        return sum(n for n, _ in counts), sum(n for _, n in counts)

    return {
        "functions": (sum(o.passed for o in outcomes), len(outcomes)),
        "sites": total([o.count() for o in outcomes]),
        "sites not pinned to the stream": total([o.count(o.pinned) for o in outcomes]),
        "sites not pinned to stream or model": total(
            [o.count(o.pinned, o.model_pinned) for o in outcomes]
        ),
    }


def main() -> int:
    """Run, print a table and the failing sites; 1 if one fails that is not pinned."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("source", type=Path, help="unpacked GalSim source distribution")
    parser.add_argument("--sensor", default="bfsensor.SiliconSensor", help="class, or null")
    parser.add_argument("--imsim", type=Path, help="imSim checkout, for its two tests")
    parser.add_argument("--only", default="", help="functions whose name contains this")
    parser.add_argument("--json", type=Path, help="file for the outcome of each function")
    args = parser.parse_args()
    source = args.source.resolve()
    imsim = args.imsim.resolve() if args.imsim else None
    wanted = [source / "tests" / name for name in (*dict(SUITE), *NEEDED)]
    if absent := [str(path) for path in wanted if not path.exists()]:
        parser.error("missing: " + ", ".join(absent))
    if stray := _not_sites(source / "tests"):
        parser.error(f"no assertion at {stray}: SOURCE is not GalSim 2.8.4 or 2.8.5")
    try:
        sensor = load_sensor(args.sensor)
    except (ImportError, AttributeError, ValueError) as exc:
        parser.error(f"--sensor {args.sensor}: {exc}")
    json_path = args.json.resolve() if args.json else None

    without = missing_imsim(imsim)
    print(f"{args.sensor}, GalSim {galsim.__version__}, tests of {source.name}")
    outcomes = []
    for outcome in run_suite(
        source, sensor, imsim=None if without else imsim, only=args.only
    ):
        outcomes.append(outcome)
        passed, total = outcome.count()
        name = f"{outcome.file.removesuffix('.py')}.{outcome.function}"
        print(f"{name:50s} {passed:3d} / {total:3d} {outcome.seconds:8.1f} s", flush=True)
    if without:
        print(f"imSim's 2 functions: not run ({without})")
    summary = summarise(outcomes)
    for name, (passed, total) in summary.items():
        print(f"{name + ' passed':50s} {passed:3d} / {total:3d}")
    for outcome in outcomes:
        _print_failures(outcome)
    if json_path:
        _write_json(json_path, args.sensor, summary, outcomes, without)
    passed, total = summary["sites not pinned to stream or model"]
    return int(passed < total or any(outcome.error for outcome in outcomes))


def _not_sites(tests: Path) -> list[str]:
    """Pinned lines at which the tests assert nothing."""
    sites = {name: TestFile(tests / name).sites for name, _ in SUITE}
    pinned = sorted(STREAM_PINNED | MODEL_PINNED)
    return [f"{name}:{line}" for name, line in pinned if line not in sites[name]]


def _print_failures(outcome: Outcome) -> None:
    if outcome.error:
        print(f"{outcome.file} {outcome.function} ended early: {outcome.error}")
    unreached = [n for n, message in outcome.failures.items() if message == NOT_REACHED]
    if unreached:
        print(f"{outcome.file}:{','.join(map(str, unreached))} {NOT_REACHED}")
    for line, message in outcome.failures.items():
        if message == NOT_REACHED:
            continue
        pinned_to = outcome.pinned_to(line)
        mark = f" [pinned to {pinned_to}]" if pinned_to else ""
        print(f"{outcome.file}:{line}{mark} {message}")


def _write_json(
    path: Path,
    sensor: str,
    summary: dict[str, tuple[int, int]],
    outcomes: list[Outcome],
    without: str,
) -> None:
    """Write summary and outcomes; a half-written file never stands at `path`."""
    content = {
        "sensor": sensor,
        "galsim": galsim.__version__,
        "not_run": f"imSim: {without}" if without else "",
        "passed_and_total": summary,
        "functions": [
            {
                "file": o.file,
                "function": o.function,
                "sites_passed": o.count()[0],
                "sites": o.sites,
                "seconds": round(o.seconds, 2),
                "error": o.error,
                "failures": [
                    {"line": line, "message": message, "pinned_to": o.pinned_to(line)}
                    for line, message in o.failures.items()
                ],
            }
            for o in outcomes
        ],
    }
    partial = path.with_name(path.name + ".partial")
    partial.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    shutil.move(partial, path)


if __name__ == "__main__":
    # For what the class loads; GalSim's own threads are set before each function.
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    sys.exit(main())
