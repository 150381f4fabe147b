"""FITS files opened so that whatever is wrong with them is one error."""

from __future__ import annotations

import os
import warnings
import zlib
from collections.abc import Iterator
from contextlib import contextmanager

from astropy.io import fits
from astropy.utils.exceptions import AstropyUserWarning

from bfsensor.errors import RecordingError


@contextmanager
def open_fits(path: str | os.PathLike[str]) -> Iterator[fits.HDUList]:
    """Open a file, letting the harmless faults of old cameras' cards pass, but not a file cut short.

    Raises
    ------
    RecordingError
        The file cannot be read, here or in the block; names it.
    """
    with warnings.catch_warnings():
        # Lower-case exponents, null padding: read correctly, warned about.
        warnings.simplefilter("ignore", AstropyUserWarning)
        # What is left of a file cut short would be read without a word.
        warnings.filterwarnings(
            "error", "(?s).*(truncated|Error validating header)", AstropyUserWarning
        )
        try:
            # Opened here: astropy leaves a file open in whose headers it fails.
            with open(path, "rb") as stream, fits.open(stream, memmap=False) as hdus:
                len(hdus)  # finds all extensions, and the end
                hdus.verify("silentfix")
                yield hdus
        except RecordingError:
            raise
        # Damaged headers and data end in several kinds of exception inside astropy.
        except (
            OSError, ValueError, TypeError, KeyError, EOFError, zlib.error, AstropyUserWarning
        ) as error:  # fmt: skip
            line = " ".join(str(error).split())[:200]
            raise RecordingError(f"{path}: cannot be read: {line}") from None
