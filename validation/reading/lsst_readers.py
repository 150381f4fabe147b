"""LSST's own code reads the files that ``bfsensor export`` writes, and corrects a star with them.

``python -m validation.reading.lsst_readers IP_ISR [-o FILE]``, with IP_ISR a clone of lsst/ip_isr and
the packages astro_metadata_translator, lsst-utils and pyfftw installed.  Its modules ``calibType``,
``brighterFatterKernel``, ``ptcDataset`` and ``electrostaticBrighterFatter`` run unchanged.  What they
import of LSST's compiled stack (containers for headers and images) is replaced by the few lines of
:func:`install_stand_ins`, none of which computes anything.

A row for each quantity: the largest difference between what LSST's code has and what ours has, over
the largest value.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import logging
import subprocess
import sys
import tempfile
from collections import OrderedDict
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import galsim
import numpy as np
from astropy.table import Table

from bfsensor import BrighterFatterSensor
from bfsensor.cli.main import main as command_line
from bfsensor.measure.correct import correct_edges
from bfsensor.recording.tables.lsst_datasets import BrighterFatterKernel, DistortionMatrix
from bfsensor.table.quadrant_shifts import QuadrantShifts
from validation.common.write_results import RESULTS, write_results

DEVICE = "itl_sta3800c"
"""An anisotropic table: exchanged axes change a_01 / a_10 by a factor of 5."""
FILTER = "y_10"
LIMIT = 1e-12
"""Round-off of sums of about 1000 doubles is 1e-14."""
LAST_LAG = 1e-3
"""Allowed of corrections with all lags.  An edge 7 pixels before the charge moves against the one 6
pixels behind it, by symmetry; LSST's code takes 7 there so that shifts sum to zero, and ends.  These
shifts are about 1 % of the largest; with the last two lags at zero both must agree to round-off."""


class Header(OrderedDict):  # type: ignore[type-arg]
    """Stands for lsst.daf.base.PropertyList: an ordered mapping."""

    def toDict(self) -> dict[str, Any]:  # noqa: N802 -- LSST's name
        """Give a plain mapping."""
        return dict(self)


def install_stand_ins(source: Path) -> ModuleType:
    """Make ``lsst.ip.isr`` importable from a clone of ip_isr, and give it with its readers."""

    def module(name: str, **content: Any) -> ModuleType:
        made = ModuleType(name)
        made.__dict__.update(content)
        made.__path__ = []
        sys.modules[name] = made
        return made

    @contextlib.contextmanager
    def untouched(*given: Any) -> Iterator[None]:
        yield

    module("lsst.daf")
    module("lsst.daf.base", PropertyList=Header)
    afw = module("lsst.afw")
    afw.math, afw.image = module("lsst.afw.math"), module("lsst.afw.image")
    module("lsst.ip")
    found = module("lsst.ip.isr")
    found.__path__ = [str(source / "python" / "lsst" / "ip" / "isr")]
    module("lsst.ip.isr.isrFunctions", gainContext=untouched)
    for name in (
        "calibType", "brighterFatterKernel", "ptcDataset", "electrostaticBrighterFatter"
    ):  # fmt: skip
        loaded = importlib.import_module(f"lsst.ip.isr.{name}")
        for public in vars(loaded):
            if not public.startswith("_"):
                setattr(found, public, getattr(loaded, public))
    return found


def draw_star(band: bool) -> np.ndarray:
    """Star of the sensor, 60,000 e- in its peak, off the middle of a pixel."""
    sensor = BrighterFatterSensor(DEVICE, rng=galsim.BaseDeviate(8120))
    star = galsim.Gaussian(sigma=1.6, flux=1e6).shift(0.21, -0.33)
    ops = [galsim.WavelengthSampler(galsim.SED("1", "nm", "fphotons"),
           galsim.Bandpass("1", "nm", blue_limit=940, red_limit=1040))] if band else []  # fmt: skip
    image = star.drawImage(
        nx=47, ny=43, scale=1.0, method="phot", sensor=sensor,
        rng=galsim.BaseDeviate(417), photon_ops=ops,
    )  # fmt: skip
    return np.asarray(image.array, float)


def lsst_correction(
    isr: ModuleType, matrix: Any, image: np.ndarray, band: bool
) -> np.ndarray:
    """Correct an image in electrons with ip_isr's electrostaticBrighterFatterCorrection."""
    array = image.copy()
    plane = SimpleNamespace(array=array, getArray=lambda: array)
    exposure = SimpleNamespace(
        metadata={"FILTER": FILTER}, image=plane,
        getMaskedImage=lambda: SimpleNamespace(getImage=lambda: plane),
    )  # fmt: skip
    isr.electrostaticBrighterFatterCorrection(
        logging.getLogger(__name__), exposure, matrix, False, applyFilterCorrection=band
    )
    return array


def difference(theirs: Any, ours: Any) -> float:
    """Largest difference over the largest value."""
    theirs, ours = np.asarray(theirs, float), np.asarray(ours, float)
    if theirs.shape != ours.shape:
        raise SystemExit(f"shapes {theirs.shape} and {ours.shape}")
    return float(np.max(np.abs(theirs - ours)) / np.max(np.abs(ours)))


def compare(isr: ModuleType, folder: Path) -> dict[str, float]:
    """Write both files by the command line, read and use them with LSST's code."""
    kernel_file, matrix_file = folder / "bfk.fits", folder / "edm.fits"
    for words in (
        ["bfk", DEVICE, "--detector", "94", "--gain", "1.65", "-o", kernel_file],
        ["edm", DEVICE, "--detector", "94", "--gain", "1.65", "-o", matrix_file,
         "--filter", f"{FILTER}=950,1000,1030"],
    ):  # fmt: skip
        command_line(["export", *map(str, words)], standalone_mode=False)
    out: dict[str, float] = {}
    kernel, ours = (
        isr.BrighterFatterKernel.readFits(str(kernel_file)),
        BrighterFatterKernel.read(kernel_file),
    )
    for at, name in enumerate(ours.columns["AMPLIFIER"]):
        for quantity, values, column in (
            ("kernel", kernel.ampKernels, "KERNEL"),
            ("mean correlations", kernel.meanXcorrs, "MEAN_XCORRS"),
        ):
            # LSST's arrays are [i, j] with i in x.
            apart = difference(values[name], ours.columns[column][at].T)
            out[quantity] = max(out.get(quantity, 0.0), apart)
        out["gain"] = max(
            out.get("gain", 0.0), difference(kernel.gain[name], ours.columns["GAIN"][at])
        )
    matrix, edges = (
        isr.ElectrostaticBrighterFatterDistortionMatrix.readFits(str(matrix_file)),
        DistortionMatrix.read(matrix_file).columns,
    )
    for side in "NSEW":
        out[f"shifts {side}"] = difference(
            getattr(matrix, f"a{side}"), edges[f"A_{side}"][0].T
        )
        out[f"shifts {side}, {FILTER}"] = difference(
            getattr(matrix, f"a{side}ByFilter")[FILTER],
            edges[f"A_{side}_BY_FILTER"][0, 0].T,
        )
    for band, whole in product((False, True), (True, False)):
        image = draw_star(band)
        suffix = "_BY_FILTER" if band else ""
        north, east = (edges[f"A_{side}{suffix}"][0] for side in "NE")
        north, east = (north[0], east[0]) if band else (north, east)
        if not whole:
            end_early(matrix, band, north, east)
        name = f"{f', {FILTER}' if band else ''}{'' if whole else ', last lags 0'}"
        mine = correct_edges(image, north, east) - image
        theirs = lsst_correction(isr, matrix, image, band) - image
        out[f"correction of a star{name}"] = difference(theirs, mine)
        turned = correct_edges(image, east.T, north.T) - image
        out[f"axes exchanged{name}"] = difference(theirs, turned)
    return out


def end_early(matrix: Any, band: bool, north: np.ndarray, east: np.ndarray) -> None:
    """Set the last two lags to zero, in our arrays and in LSST's object, whose axes are [i, j]."""
    for shifts in (north, east):
        shifts[-2:], shifts[:, -2:] = 0.0, 0.0
    edges = QuadrantShifts(north, east)
    for side in ("north", "south", "east", "west"):
        held = getattr(matrix, f"a{side[0].upper()}{'ByFilter' if band else ''}")
        (held[FILTER] if band else held)[...] = getattr(edges, side).T


def limit(quantity: str) -> float:
    """Largest difference that a quantity may have; axes exchanged must differ by more."""
    if quantity.startswith("axes") or quantity.endswith("last lags 0"):
        return LIMIT if quantity.startswith("correction") else 10 * LAST_LAG
    return LAST_LAG if quantity.startswith("correction") else LIMIT


def main() -> None:
    """Compare, print and write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("source", metavar="IP_ISR", type=Path)
    parser.add_argument("-o", "--output", default=RESULTS / "lsst_readers.ecsv")
    given = parser.parse_args()
    commit = subprocess.run(
        ["git", "-C", given.source, "rev-parse", "--short", "HEAD"],
        capture_output=True, text=True, check=False,
    ).stdout.strip()  # fmt: skip
    isr = install_stand_ins(given.source)
    with tempfile.TemporaryDirectory() as folder:
        found = compare(isr, Path(folder))
    table = Table({"quantity": list(found), "difference": list(found.values())})
    table["difference"].format = ".2e"
    table.pprint(max_lines=-1)
    write_results(
        table,
        given.output,
        "python -m validation.reading.lsst_readers IP_ISR",
        ip_isr=commit,
    )
    wrong = [
        name for name, apart in found.items()
        if (apart > limit(name)) != name.startswith("axes")
    ]  # fmt: skip
    if wrong:
        raise SystemExit(f"LSST's code has something else: {', '.join(wrong)}")


if __name__ == "__main__":
    main()
