"""Conversion of images to arrays of floats in which masked pixels are nan."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from bfsensor.errors import MeasurementError
from bfsensor.typing import FloatArray


def to_floats(values: ArrayLike, name: str) -> FloatArray:
    """Copy numbers to a new array of floats, nan where a masked array hides a value.

    Parameters
    ----------
    values : array_like
        Real numbers of any type and byte order.
    name : str
        Name of the argument, for errors.

    Returns
    -------
    array : ndarray of float64
        The copy, of the same shape.

    Raises
    ------
    MeasurementError
        The values are complex numbers or text, or rows have different lengths.

    Examples
    --------
    >>> to_floats(np.ma.array([5, 7], mask=[False, True]), "image")
    array([ 5., nan])
    """
    hidden = np.ma.getmaskarray(values) if isinstance(values, np.ma.MaskedArray) else None
    try:
        array = np.asarray(values)
        if array.dtype.kind not in "biufO":
            raise TypeError(f"values of type {array.dtype} are not real numbers")
        out = np.array(array, float)
    except (TypeError, ValueError) as error:
        raise MeasurementError(f"{name}: not an array of real numbers: {error}") from None
    if hidden is not None:
        out[hidden] = np.nan
    return out
