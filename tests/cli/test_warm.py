"""Kernels compiled ahead of use, and what is said when they are not."""

from __future__ import annotations

import os
import subprocess
import sys

import galsim
import numpy as np
import pytest
from click.testing import CliRunner
from numba.core import event

from bfsensor import BrighterFatterSensor
from bfsensor._kernels import notice
from bfsensor.cli.main import main

TWO_KERNELS = """
import numpy as np
from bfsensor._kernels.counter_rng import uniforms, words
key = np.uint32(11), np.uint32(12)
words(0, *key, np.empty(3, np.uint32))
uniforms(0, 5, *key, np.empty((3, 2)))
"""


def test_what_warm_compiled_is_not_compiled_again():
    first = CliRunner().invoke(main, ["warm"])
    assert first.exit_code == 0, first.output
    assert "about 50 s, once" in first.stderr
    again = CliRunner().invoke(main, ["warm"])
    assert again.stdout.startswith("all was compiled before")
    star = galsim.Gaussian(sigma=0.2, flux=2e4)
    with event.install_recorder("numba:compile") as recorder:
        for kind in (np.float32, np.float64):
            sensor = BrighterFatterSensor("e2v_ccd250", rng=galsim.BaseDeviate(5113))
            image = star.drawImage(
                nx=15, ny=15, scale=0.2, method="phot", sensor=sensor, dtype=kind,
                rng=galsim.BaseDeviate(5114),
            )  # fmt: skip
            sensor.calculate_pixel_areas(image)
    assert recorder.buffer == []


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
