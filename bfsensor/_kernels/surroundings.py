"""Charge beyond the image that mirrors the charge within it, in the padding of an exposure's arrays."""

import numba
import numpy as np

from bfsensor._kernels.compile_options import INLINED, INNER


@numba.njit(**INLINED)
def within(place, size):
    """Pixel of the image, 0 to ``size`` - 1, that a place beyond it mirrors, at any distance."""
    place %= 2 * size
    return place if place < size else 2 * size - 1 - place


@numba.njit(**INNER)
def mirror_all(charges, array, each):
    """Fill the padding of an array of ``each`` values a pixel with the mirror image of the image."""
    pad, stride = charges.pad, charges.stride
    nx, ny = charges.nx, charges.ny
    for j in range(-pad, ny + pad):
        start = (j + pad) * stride + pad
        source = (within(j, ny) + pad) * stride + pad
        for i in range(-pad, nx + pad):
            if source == start and 0 <= i < nx:
                continue
            to = np.uint64(each * (start + i))
            place = np.uint64(each * (source + within(i, nx)))
            for m in range(np.uint64(each)):
                array[to + m] = array[place + m]


@numba.njit(**INNER)
def mirror_pixel(charges, array, each, j, i):
    """Copy the ``each`` values of a pixel of the image to its mirror images in the padding."""
    pad, stride = charges.pad, charges.stride
    nx, ny = charges.nx, charges.ny
    if pad <= j < ny - pad and pad <= i < nx - pad:
        return
    place = np.uint64(each * ((j + pad) * stride + i + pad))
    # Its images lie at j and -1 - j, and at every second width of the image from there.
    for row in (j, -1 - j):
        for tj in range((row + pad) % (2 * ny), ny + 2 * pad, 2 * ny):
            for column in (i, -1 - i):
                for ti in range((column + pad) % (2 * nx), nx + 2 * pad, 2 * nx):
                    to = np.uint64(each * (tj * stride + ti))
                    for m in range(np.uint64(each)):
                        array[to + m] = array[place + m]
