"""Exposures as arrays, without files: many small campaigns for statistics."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from validation.concealed.effect import Effect
from validation.concealed.plan import SIZES, Geometry, Size, exposures_of
from validation.concealed.sensor import Taken, VirtualSensor

SMALL = Size(64, 2, 1, dithers=1)
"""A campaign of 64 x 64 pixels with all conditions."""


def iterate_exposures(
    size: Size | str = SMALL,
    *,
    seed: int,
    effects: Sequence[Effect] = (),
    amplifiers: int = 2,
    withheld: bool = False,
) -> Iterator[Taken]:
    """Take a campaign's exposures one by one, in memory.

    The same seed and effects give the same bits as in the files of a campaign of that size.

    Parameters
    ----------
    size : Size or str
        A Size of your own (any number of pixels from 32, levels, pairs), or "S", "M", "L".
    seed : int
        Fixes chip, lamp and noise.
    effects : sequence of Effect
        From :func:`validation.concealed.library.make_effect`.
    amplifiers : int
        Read strips of columns.
    withheld : bool
        Give those exposures too that a campaign keeps back.

    Yields
    ------
    Taken
        ``exposure`` (kind, seconds, wavelength, back bias, temperature, mjd), raw ``frames`` per
        amplifier [ADU], lamp ``monitor`` [nA].

    Examples
    --------
    >>> size = Size(64, 1, 0, dithers=0, flat_seconds=(5.0, 30.0))
    >>> flats = [t for t in iterate_exposures(size, seed=8231) if t.exposure.kind == "FLAT"]
    >>> [t.exposure.seconds for t in flats], flats[0].frames[1].shape
    ([5.0, 5.0, 30.0, 30.0], (80, 64))
    """
    if isinstance(size, str):
        if size not in SIZES:
            raise ValueError(f"size = {size!r}: one of {', '.join(SIZES)}")
        size = SIZES[size]
    sensor = VirtualSensor(Geometry(size.pixels, amplifiers), seed=seed, effects=effects)
    for exposure in exposures_of(size):
        # taken in any case: the lamp walks on and the next exposure remembers it
        taken = sensor.take(exposure)
        if withheld or not exposure.withheld:
            yield taken
