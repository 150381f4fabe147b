"""A folder for compiled kernels where package, home and NUMBA_CACHE_DIR cannot be written to.

Numba refuses to keep code that it cannot write, even where all of it is there to be read.
"""

import atexit
import logging
import os
import shutil
import tempfile

import numba


def _probe():
    """Do nothing; numba looks for a place for its code."""


def find_code_folder():
    """Let numba use a temporary folder, with what NUMBA_CACHE_DIR holds, if it finds no other place.

    Processes that this one starts share the folder; it is removed when this process ends.
    """
    try:
        numba.njit(cache=True)(_probe)
    except RuntimeError:
        folder = tempfile.mkdtemp(prefix="bfsensor-")
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
        given = numba.config.CACHE_DIR
        if given and os.path.isdir(given):
            shutil.copytree(given, folder, dirs_exist_ok=True)
            # The copy of a folder that nobody may write to is one as well.
            for path, _, _ in os.walk(folder):
                os.chmod(path, 0o700)
        else:
            logging.getLogger("bfsensor").warning(
                "kernels are compiled by each process: no folder for them can be written to "
                "(set NUMBA_CACHE_DIR)"
            )
        os.environ["NUMBA_CACHE_DIR"] = numba.config.CACHE_DIR = folder
