"""Images as this room works on them: floats of the machine, nan where there is no value."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from bfsensor.errors import MeasurementError
from bfsensor.typing import FloatArray


def to_floats(values: ArrayLike, name: str) -> FloatArray:
    """Give a new array of floats, nan where a masked array hides what it holds.

    Parameters
    ----------
    values : array_like
        Real numbers of any type and byte order.
    name : str
        For the error.

    Raises
    ------
    MeasurementError
        Complex numbers, text, or rows of different lengths.

    Examples
    --------
    >>> to_floats(np.ma.array([5, 7], mask=[False, True]), "image")
    array([ 5., nan])
    """
    hidden = np.ma.getmaskarray(values) if isinstance(values, np.ma.MaskedArray) else None
    try:
        array = np.asarray(values)
        if array.dtype.kind not in "biufO":
            raise TypeError(f"{array.dtype} are no real numbers")
        out = np.array(array, float)
    except (TypeError, ValueError) as error:
        raise MeasurementError(f"{name}: not an array of real numbers: {error}") from None
    if hidden is not None:
        out[hidden] = np.nan
    return out
