"""Conversion of light: the heights at which a response is taken, and their weights for a colour."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from bfsensor.device import silicon
from bfsensor.simulate.boundaries import SPLIT_HEIGHT
from bfsensor.simulate.mesh import Surfaces
from bfsensor.typing import Edges, FloatArray

if TYPE_CHECKING:
    from bfsensor.device.device import Device

STORAGE_DEPTH = 0.3
"""Depth of the stored charge below the channel's silicon surface [um].

Measured: the mean depth of the electrons is within 0.07 um of this in the built-in devices at
20,000 to 150,000 e- (``tests/table/test_build.py``); a device with deeper implants stores deeper,
and the lowest depth of its table is then too low by the difference."""

LOWEST = 2.0
"""Height of the lowest boundaries above the highest silicon surface [um].

Measured: at 1.3 um a_00 of the ITL device on 8 to 16 cells is 1.4 to 60 times that on 24 cells, as
electrons there drift to no definite well; at 2 um, at back biases of -50 and -30 V, it is within 17 %,
that of E2V on 12 and 16 cells within 10 %, but on 8 cells twice as large.  Below, the response is
taken as linear down to the stored charge."""

BETWEEN = 6
"""Number of heights between that of bisection and the back surface, at a constant ratio.

Measured on both LSST devices against 25 heights, at 650 to 1050 nm: a_00 within 0.2 %, a_10 0.5 %, a_01
0.1 %, a_11 0.3 %, lag 2 0.8 % (``tests/response/test_light.py``); heights of
10, 20 and 40 um alone 2.3 %.  Twice as many leave a third of that."""


def storage_height(device: Device) -> float:
    """Height above the gates [um] at and below which boundaries are taken as fixed.

    It is the height of the stored charge, :data:`STORAGE_DEPTH` into the silicon of the channel.

    Parameters
    ----------
    device : Device
        Device of any kind.

    Returns
    -------
    height : float
        Height [um].

    Examples
    --------
    >>> from bfsensor.device.device import Device
    >>> round(storage_height(Device.load("itl_sta3800c")), 3)
    0.9
    """
    return Surfaces.of(device).silicon_channel + STORAGE_DEPTH


def conversion_depths(device: Device) -> tuple[float, ...]:
    """Conversion depths at which a response is taken, heights above the gates [um].

    At the first, the height of the stored charge, nothing moves; boundaries at the second are
    bisected; from the third on they are traced up.  The response rises over one pixel pitch and is
    nearly flat beyond four.

    Parameters
    ----------
    device : Device
        Device of any kind.

    Returns
    -------
    depths : tuple of float
        Ten heights [um], ascending, the last one the back surface.

    Examples
    --------
    >>> from bfsensor.device.device import Device
    >>> [round(z, 1) for z in conversion_depths(Device.load("itl_sta3800c"))]
    [0.9, 3.0, 5.0, 7.7, 11.8, 18.1, 27.7, 42.5, 65.2, 100.0]
    """
    surfaces = Surfaces.of(device)
    deepest = max(surfaces.silicon_channel, surfaces.silicon_stop)
    split, thickness = deepest + SPLIT_HEIGHT, device.silicon.thickness
    between = split * (thickness / split) ** (np.arange(1, BETWEEN + 1) / (BETWEEN + 1))
    return (
        storage_height(device), deepest + LOWEST, split, *map(float, between), thickness,
    )  # fmt: skip


def conversion_weights(
    depths: FloatArray,
    wavelength: float,
    temperature: float,
    *,
    thickness: float | None = None,
    stretch: float = 1.0,
) -> FloatArray:
    r"""Weights of depths for the mean, over converting light, of a response linear between them.

    .. math:: w_k = \int h_k(z)\, \frac{e^{-(T - z) / \ell}}{\ell}\, dz \Big/
        \int \frac{e^{-(T - z) / \ell}}{\ell}\, dz, \qquad \ell = \ell(\lambda, \text{K}),

    with hat functions h_k, in closed form.  Light that passes through the silicon or converts
    below the first depth is left out, where that is the height of the stored charge 0.3 um of
    silicon; none is reflected at the gates.

    Parameters
    ----------
    depths : ndarray, shape (nd,)
        Conversion depths [um above the gates], ascending.
    wavelength : float
        Vacuum wavelength of the light [nm].
    temperature : float
        Temperature of the silicon [K]; with the wavelength it gives
        :func:`bfsensor.device.silicon.absorption_length`.
    thickness : float, optional
        Height of the back surface [um]; by default the last depth.  Light that converts between the
        last depth and the back surface counts at the last depth.
    stretch : float
        Factor on the absorption length.

    Returns
    -------
    weights : ndarray, shape (nd,)
        Weights of the depths, at least 0; their sum is 1.

    Examples
    --------
    >>> conversion_weights(np.array([0.0, 50.0, 100.0]), 400.0, 173.0).round(3)
    array([0.   , 0.004, 0.996])
    """
    depths = np.asarray(depths, float)
    if len(depths) == 1:
        return np.ones(1)
    # 1 m stands for an infinite length: the little light that converts is then uniform in depth.
    length = min(stretch * float(silicon.absorption_length(wavelength, temperature)), 1e6)
    back = depths[-1] if thickness is None else thickness
    reaching = np.exp(-(back - depths) / length)
    converted = np.diff(reaching)
    upper = reaching[1:] - converted * length / np.diff(depths)
    weights = np.zeros(len(depths))
    weights[1:] += upper
    weights[:-1] += converted - upper
    weights[-1] += 1 - reaching[-1]
    return weights / weights.sum()


def mixed(
    kx: FloatArray,
    ky: FloatArray,
    depths: FloatArray,
    wavelength: float | None,
    temperature: float,
    stretch: float = 1.0,
) -> Edges:
    """Average shifts over the conversion depths of light.

    Parameters
    ----------
    kx, ky : ndarray, shape (..., nd, ny, nx)
        Shifts of right and upper edges by conversion depth.
    depths : ndarray, shape (nd,)
        Heights above the gates [um], ascending, the last one the back surface.
    wavelength : float or None
        Wavelength of the light [nm]; None: all of it converts at the back surface.
    temperature : float
        Temperature of the silicon [K].
    stretch : float
        Factor on the absorption length.

    Returns
    -------
    kx, ky : ndarray, shape (..., ny, nx)
        Mean shifts, in the unit of the given ones.

    Examples
    --------
    >>> shifts = np.array([0.0, 1.0])[:, None, None]
    >>> mixed(shifts, shifts, np.array([0.0, 100.0]), None, 173.0)[0]
    array([[1.]])
    """
    if wavelength is None:
        return kx[..., -1, :, :], ky[..., -1, :, :]
    weights = conversion_weights(depths, wavelength, temperature, stretch=stretch)
    return (
        np.einsum("...dji,d->...ji", kx, weights),
        np.einsum("...dji,d->...ji", ky, weights),
    )
