"""Compiled kernels by the content of the kernels, not by the place of the checkout.

numba keeps compiled code by the path of the file; a fresh clone would compile everything again
(minutes of CPU time), and a kernel is not compiled again when one that it calls changed.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from numba.core.caching import UserProvidedCacheLocator

from tests.caching import ROOT, cache_folder, kernels_digest


class KernelLocator(UserProvidedCacheLocator):
    """Finds the folder of the checkout's kernels; leaves other files to numba's own locators."""

    def __init__(self, py_func: Any, py_file: str) -> None:
        super().__init__(py_func, py_file)
        folder = cache_folder()
        assert folder is not None
        self._cache_path = os.fspath(folder / "numba" / kernels_digest())

    @classmethod
    def from_function(cls, py_func: Any, py_file: str) -> KernelLocator | None:
        """Give a locator for a kernel of this checkout, None for anything else."""
        kernels = ROOT / "bfsensor" / "_kernels"
        if cache_folder() is None or Path(py_file).resolve().parent != kernels:
            return None
        found = cls(py_func, py_file)
        try:
            found.ensure_cache_path()
        except OSError:  # a cache that cannot be written is no cache
            return None
        return found
