"""Opening of FITS files: every fault of a file is raised as one RecordingError."""

from __future__ import annotations

import os
import re
import warnings
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from typing import BinaryIO

from astropy.io import fits
from astropy.utils.exceptions import AstropyUserWarning

from bfsensor.errors import RecordingError

BROKEN = (
    OSError, EOFError, ValueError, TypeError, LookupError, OverflowError, AssertionError, zlib.error,
    fits.VerifyError,
)  # fmt: skip
"""Exceptions that astropy raises on damaged headers and damaged data."""

MOST_AXES = 999
"""Largest number of axes of a FITS file, published in the standard (version 4.0, section 4.4.1)."""


@contextmanager
def open_fits(
    path: str | os.PathLike[str], *, as_stored: bool = False
) -> Iterator[fits.HDUList]:
    """Open a file; old cameras' faulty keywords are mended, files cut short are refused.

    Parameters
    ----------
    path : path-like
        The file, plain or compressed with gzip.
    as_stored : bool
        Leave tile-compressed images as the tables that they are stored as: faster where only
        headers are read.

    Yields
    ------
    hdus : astropy.io.fits.HDUList
        The open file.

    Raises
    ------
    RecordingError
        The file cannot be read, when it is opened or in the ``with`` block.  The message names
        the file.
    """
    with warnings.catch_warnings():
        # astropy warns of lower-case exponents and null padding, and reads them correctly.
        warnings.simplefilter("ignore", AstropyUserWarning)
        # Of a file cut short astropy returns the remaining pixels and only warns.
        warnings.filterwarnings(
            "error",
            "(?s).*(truncated|corrupted|Error validating header)",
            AstropyUserWarning,
        )
        try:
            # fits.open(path) would leave the file open where reading its headers fails.
            with (
                open(path, "rb") as stream,
                fits.open(
                    limited_axes(stream), memmap=False, disable_image_compression=as_stored
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
            # astropy raises this class on damaged tiles, and has it in no public module.
            if not isinstance(error, BROKEN) and type(error).__name__ != "CfitsioException":
                raise
            raise RecordingError(f"{path}: cannot be read: {one_line(error)}") from None


def limited_axes(stream: BinaryIO) -> BinaryIO:
    """Return the stream of a file; refuse a first header with more axes than FITS allows.

    astropy counts to NAXIS before it compares it with what is there.

    Raises
    ------
    ValueError
        NAXIS is above :data:`MOST_AXES`.
    """
    header = stream.read(2880)
    stream.seek(0)
    found = re.search(rb"NAXIS   = *(\d+)", header)
    if found and len(found[1]) > 3:
        raise ValueError(f"NAXIS = {found[1][:20].decode()} must be at most {MOST_AXES}")
    return stream


def one_line(error: object) -> str:
    """Give the text of an error without line breaks, cut at 200 characters."""
    return " ".join(str(error).split())[:200]
