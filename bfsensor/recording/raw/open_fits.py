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

BROKEN = (
    OSError, EOFError, ValueError, TypeError, LookupError, zlib.error, fits.VerifyError,
)  # fmt: skip
"""What astropy may raise on a damaged file, in its headers and in its data."""


@contextmanager
def open_fits(
    path: str | os.PathLike[str], *, as_stored: bool = False
) -> Iterator[fits.HDUList]:
    """Open a file, letting the harmless faults of old cameras' cards pass, but not a file cut short.

    Parameters
    ----------
    path : path-like
        The file, plain or in gzip.
    as_stored : bool
        Leave tile-compressed images as the tables that they are stored as: faster where only
        headers are read.

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
            "error",
            "(?s).*(truncated|corrupted|Error validating header)",
            AstropyUserWarning,
        )
        try:
            # Opened here: astropy leaves a file open in whose headers it fails.
            with (
                open(path, "rb") as stream,
                fits.open(
                    stream, memmap=False, disable_image_compression=as_stored
                ) as hdus,
            ):
                len(hdus)  # finds all extensions, and the end
                hdus.verify("silentfix")
                yield hdus
        except RecordingError:
            raise
        except AstropyUserWarning as warning:
            raise RecordingError(
                f"{path}: is truncated or damaged: {one_line(warning)}"
            ) from None
        except Exception as error:
            # The class that its decompression of tiles raises is in no public module.
            if not isinstance(error, BROKEN) and type(error).__name__ != "CfitsioException":
                raise
            raise RecordingError(f"{path}: cannot be read: {one_line(error)}") from None


def one_line(error: object) -> str:
    """Give the text of an error without line breaks, cut at 200 characters."""
    return " ".join(str(error).split())[:200]
