"""Kernels compiled ahead of use, and what is said when they are not."""

from __future__ import annotations

import os
import re
import subprocess
import sys

import galsim
import numpy as np
import pytest
from click.testing import CliRunner
from numba.core import event

from bfsensor import BrighterFatterSensor, SiliconSensor, correct_table
from bfsensor._kernels import notice
from bfsensor.cli.main import main

RINGS = galsim.LookupTable([0.0, 300.0], [0.0, 0.02], interpolant="linear")

FIRST_STAR = """
import galsim
from numba.core import event
from bfsensor import BrighterFatterSensor
with event.install_recorder("numba:compile") as recorder:
    sensor = BrighterFatterSensor(rng=galsim.BaseDeviate(5113))
    star = galsim.Gaussian(sigma=0.2, flux=2e4)
    star.drawImage(nx=15, ny=15, scale=0.2, method="phot", sensor=sensor)
print(sum(one.is_start for _, one in recorder.buffer))
print({one.data["dispatcher"].py_func.__module__ for _, one in recorder.buffer})
"""

MOST = 105
"""Largest number of functions that a first star may compile, numba's own among them: 101 today, each of
which takes 0.15 s on average."""

TWO_KERNELS = """
import numpy as np
from bfsensor._kernels.counter_rng import deviates, uniforms
key = np.uint32(11), np.uint32(12)
deviates(0, *key, *np.empty((3, 3), np.float32), np.empty(3, np.uint32))
uniforms(0, 5, *key, np.empty((3, 2)))
"""


def test_what_warm_compiled_is_not_compiled_again():
    first = CliRunner().invoke(main, ["warm", "--areas"])
    assert first.exit_code == 0, first.output
    assert re.search(r"about \d\d s, once", first.stderr)
    again = CliRunner().invoke(main, ["warm", "--areas"])
    assert again.stdout.startswith("all was compiled before")
    star = galsim.Gaussian(sigma=0.2, flux=2e4)
    with event.install_recorder("numba:compile") as recorder:
        for made, kind in (
            (BrighterFatterSensor("e2v_ccd250", rng=galsim.BaseDeviate(5113)), np.float32),
            (BrighterFatterSensor("e2v_ccd250", treering_func=RINGS), np.float64),
            (SiliconSensor(rng=galsim.BaseDeviate(5113)), np.float64),
            (SiliconSensor("lsst_e2v_50_32", strength=2.0), np.float32),
        ):
            sensor = made
            image = star.drawImage(
                nx=15, ny=15, scale=0.2, method="phot", sensor=sensor, dtype=kind,
                rng=galsim.BaseDeviate(5114),
            )  # fmt: skip
            sensor.calculate_pixel_areas(image)
        mask = image.array > image.array.max() / 2
        for kind in (np.float32, np.float64, np.int32):
            correct_table(image.array.astype(kind), "e2v_ccd250", mask=mask)
            correct_table(image.array.astype(kind), "e2v_ccd250", charge_response=False)
    assert recorder.buffer == []


@pytest.mark.slow
@pytest.mark.skipif("NUMBA_DISABLE_JIT" in os.environ, reason="nothing is compiled")
def test_a_first_star_compiles_few_functions_and_no_solver(tmp_path):
    bare = {k: v for k, v in os.environ.items() if k != "NUMBA_CACHE_LOCATOR_CLASSES"}
    done = subprocess.run(
        [sys.executable, "-c", FIRST_STAR], capture_output=True, text=True, check=True,
        env={**bare, "NUMBA_CACHE_DIR": str(tmp_path)},
    )  # fmt: skip
    count, modules = done.stdout.splitlines()
    assert 0 < int(count) <= MOST
    assert "bfsensor._kernels.shoot" in modules
    assert "relaxation" not in modules


@pytest.mark.skipif("NUMBA_DISABLE_JIT" in os.environ, reason="nothing is compiled")
def test_the_first_kernel_that_is_compiled_says_so_once(tmp_path):
    # Without the place where tests keep compiled kernels.
    bare = {k: v for k, v in os.environ.items() if k != "NUMBA_CACHE_LOCATOR_CLASSES"}

    def run(**given):
        return subprocess.run(
            [sys.executable, "-c", TWO_KERNELS], capture_output=True, text=True, check=True,
            env={**bare, "NUMBA_CACHE_DIR": str(tmp_path), **given},
        ).stderr  # fmt: skip

    assert run() == f"{notice.TEXT}\n"
    assert run() == ""
    # Compiled again where the code on disk is for another processor.
    assert run(NUMBA_CPU_NAME="generic", NUMBA_CPU_FEATURES="") == f"{notice.TEXT}\n"
