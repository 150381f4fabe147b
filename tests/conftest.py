"""What every test needs: children find this checkout; kernels are compiled once."""

from __future__ import annotations

import os
from importlib.metadata import version

import numba

from tests.caching import ROOT, cache_folder, kernels_digest, remove_old

LOCATORS = ",".join([
    "tests.numba_cache.KernelLocator", "UserProvidedCacheLocator", "InTreeCacheLocator",
    "UserWideCacheLocator",
])  # fmt: skip
"""Places where numba looks for compiled code, in this order."""

NUMBA = (0, 68)
"""First version of numba on which the locator was tried."""


def pytest_configure(config) -> None:
    """Let child processes find this checkout, and all processes the kernels compiled before.

    pytest puts the root of the checkout on its own path (``pythonpath`` in pyproject.toml);
    children inherit the environment only.  Without it ``python -m validation.concealed`` and
    Parsl's workers would need an editable install.
    """
    before = os.environ.get("PYTHONPATH", "").split(os.pathsep)
    if str(ROOT) not in before:
        os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [str(ROOT), *before]))
    # As many workers as cores: BLAS threads of each would wait for one another.
    for library in ("OMP", "OPENBLAS", "MKL"):
        os.environ.setdefault(f"{library}_NUM_THREADS", "1")
    folder = cache_folder()
    known = tuple(int(part) for part in version("numba").split(".")[:2]) >= NUMBA
    # Who says where compiled code lies, for kernels with bounds checked, means it.
    if folder is None or not known or "NUMBA_CACHE_DIR" in os.environ:
        return
    os.environ["NUMBA_CACHE_LOCATOR_CLASSES"] = LOCATORS
    # pytest imports numba to know its warnings, before any conftest.
    numba.config.CACHE_LOCATOR_CLASSES = LOCATORS
    if not hasattr(config, "workerinput"):  # once, not in every worker
        kernels = folder / "numba" / kernels_digest()
        kernels.mkdir(parents=True, exist_ok=True)
        os.utime(kernels)
        remove_old(folder)
