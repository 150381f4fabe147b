"""Virtual sensors: their cards, and edge shifts per electron from image charges between two planes.

The law, written for this package alone.  A packet of electrons is stored at height ``h`` above the
gates, spread evenly over a box of ``wx`` by ``wy``.  The gates (z = 0) and the back (z = t) are
conducting planes, so that the transverse field of one electron is the sum over image charges

    E_x(x, y, z) = e / (4 pi eps) sum_n [ x / (r^2 + (z - h - 2nt)^2)^(3/2)
                                        - x / (r^2 + (z + h + 2nt)^2)^(3/2) ].

Another electron drifts from its depth of conversion towards the gates; its velocity is parallel to
the field, so the sideways way is the integral of E_x / E_z along z, down to the height (``zx`` for
the sides across x, ``zy`` across y) where the barrier has decided its fate.  With light absorbed
over a length L, a depth z is crossed by the fraction of electrons that were converted above it,
which turns the mean over conversion depths into a weight inside one integral.  The boundary moves
by minus that way, averaged along the pixel's side.

Sources: Jackson, Classical Electrodynamics, section 2 (images); Rasmussen et al. 2014 and 2016
(JINST 9 C04027, arXiv 1608.01964: sums of multipoles that obey boundary conditions, integrated
drift); Astier and Regnault 2023 (A&A 670, A118: electrostatic fit of the a_ij of HSC).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

REACH = 10
"""Pixels to each side within which edges move; farther edges stand still."""

COULOMB = 1.4399645e-3 / 11.7
"""e / (4 pi eps) in silicon [V um]: 1.43996 eV nm (CODATA 2018) over the permittivity 11.7."""

SPACE_CHARGE = 1.602177e-19 / (11.7 * 8.854188e-14) * 1e-8
"""e / eps in silicon for a doping in cm^-3, as a field gradient [V um^-2 cm^3]."""

ABSORPTION = {
    400: 0.12, 480: 0.75, 550: 1.6, 620: 2.9, 700: 5.8, 750: 8.6, 870: 24.0, 950: 66.0,
    1000: 160.0,
}  # fmt: skip
"""Absorption length of light in silicon at 173 K by wavelength in nm [um], as practice cards state."""

REFERENCE = (620, -60.0)
"""Wavelength [nm] and back bias [V] of the first condition and of the derivatives."""


@dataclass(frozen=True)
class Device:
    """One sensor: lengths in um, voltages in V, doping in cm^-3.

    Attributes
    ----------
    pixel, thickness, h, wx, wy, zx, zy, vbb, vfront, doping : float
        The entries of a device card; see the module.
    """

    pixel: float = 10.0
    thickness: float = 100.0
    h: float = 1.2
    wx: float = 3.5
    wy: float = 6.0
    zx: float = 2.8
    zy: float = 1.9
    vbb: float = -60.0
    vfront: float = 8.0
    doping: float = 1e12


DEVICES = {
    "thick_10um": Device(),
    "thick_15um": Device(
        pixel=15.0, thickness=200.0, h=1.5, wx=5.0, wy=8.0, zx=3.4, zy=2.6, doping=4e11
    ),
    "thin_9um": Device(
        pixel=9.0,
        thickness=60.0,
        h=0.8,
        wx=3.0,
        wy=5.0,
        zx=2.4,
        zy=1.8,
        vfront=6.0,
        doping=2e12,
    ),
}
"""Nominal devices; the first is that of the practice campaigns."""

SPREAD = {
    "thickness": 0.01, "h": 0.05, "wx": 0.05, "wy": 0.035, "zx": 0.02, "zy": 0.03, "doping": 0.1,
}  # fmt: skip
"""Scatter of real devices, one sigma over the nominal value, as the practice cards state."""


def absorption_length(wavelength: float) -> float:
    """Absorption length [um], log-linear between the card's wavelengths [nm].

    Examples
    --------
    >>> absorption_length(620)
    2.9
    """
    if wavelength in ABSORPTION:
        return ABSORPTION[int(wavelength)]
    nm = np.array(sorted(ABSORPTION), float)
    um = np.array([ABSORPTION[int(w)] for w in nm])
    return float(np.exp(np.interp(wavelength, nm, np.log(um))))


def _gauss(count: int, low: float, high: float) -> tuple[NDArray, NDArray]:
    """Nodes and weights of Gauss and Legendre between two ends."""
    x, w = np.polynomial.legendre.leggauss(count)
    return 0.5 * (high - low) * x + 0.5 * (high + low), 0.5 * (high - low) * w


def edge_shifts(
    device: Device, wavelength: float, *, absorption: float | None = None, nodes: int = 20
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Shift of the edges around one pixel per electron stored in it.

    Parameters
    ----------
    device : Device
        With its back bias.
    wavelength : float
        Of the light [nm].
    absorption : float, optional
        Absorption length [um]; that of the wavelength by default.
    nodes : int
        Gauss nodes along z; doubling them changes no shift by more than 1e-4 of the largest.

    Returns
    -------
    kx, ky : ndarray, shape (21, 21)
        Shift of each pixel's right and upper edge [pixel per electron], [row, column], the charge
        in the middle; negative at the middle, where the pixel shrinks.

    Examples
    --------
    >>> kx, ky = edge_shifts(Device(), 620)
    >>> bool(kx[10, 10] < 0 < kx[10, 9]), bool(abs(ky[10, 10]) > abs(kx[10, 10]))
    (True, True)
    """
    d = device
    length = absorption_length(wavelength) if absorption is None else absorption
    kx = _one_axis(d, length, d.zx, d.wx, d.wy, nodes)
    ky = _one_axis(d, length, d.zy, d.wy, d.wx, nodes).T
    return kx, np.ascontiguousarray(ky)


def _one_axis(
    d: Device, length: float, seal: float, along: float, across: float, nodes: int
):
    """Shifts of right edges, [row, column]; the packet is ``along`` wide in x, ``across`` in y."""
    t, p = d.thickness, d.pixel
    u, w = _gauss(nodes, 0.0, 1.0)
    # nodes gather near the gates, where the field of a charge beside its image is confined
    z, wz = seal + (t - seal) * u**3, 3 * (t - seal) * u**2 * w
    drift = (d.vfront - d.vbb) / t + SPACE_CHARGE * d.doping * (t / 2 - z)
    above = -np.expm1(-(t - z) / length) / -np.expm1(-t / length)
    weight = wz * above / drift
    sx, vx = _gauss(3, -along / 2, along / 2)
    sy, vy = _gauss(3, -across / 2, across / 2)
    side, vs = _gauss(5, -p / 2, p / 2)
    columns = (np.arange(REACH) + 0.5) * p
    rows = np.arange(REACH) * p
    x = columns[:, None] - sx
    y = rows[:, None, None] + side[:, None] - sy
    vxn, vyn = vx / along, (vs[:, None] / p) * (vy / across)
    # [column, packet x, row, side, packet y]
    r2 = x[:, :, None, None, None] ** 2 + y[None, None] ** 2
    way = np.zeros(r2.shape)
    for zk, wk in zip(z, weight, strict=True):
        field = np.zeros(r2.shape)
        for n in range(-3, 4):
            for sign, height in ((1.0, d.h + 2 * n * t), (-1.0, -d.h - 2 * n * t)):
                s = r2 + (zk - height) ** 2
                field += sign / (s * np.sqrt(s))
        way += wk * field
    way *= x[:, :, None, None, None]
    mean = np.einsum("apbsq,p,sq->ba", way, vxn, vyn)
    shift = -COULOMB * mean / p
    out = np.zeros((2 * REACH + 1, 2 * REACH + 1))
    m = REACH
    for j in range(REACH):
        for row in {m + j, m - j}:
            out[row, m : m + REACH] = shift[j]
            out[row, m - REACH : m] = -shift[j, ::-1]
    return out


def area_changes(kx: NDArray, ky: NDArray) -> NDArray:
    """Change of each pixel's area per electron in the middle one [1/e-].

    Examples
    --------
    >>> a = area_changes(*edge_shifts(Device(), 620))
    >>> bool(abs(a.sum()) < 1e-18), bool(-4.2e-6 < a[10, 10] < -3.0e-6)
    (True, True)
    """
    a = kx + ky
    a[:, 1:] -= kx[:, :-1]
    a[1:] -= ky[:-1]
    return a


def scattered(nominal: Device, rng: np.random.Generator) -> Device:
    """A real device: the nominal one scattered by the card's spread."""
    values = {
        k: getattr(nominal, k) * (1 + s * rng.standard_normal()) for k, s in SPREAD.items()
    }
    return replace(nominal, **values)


def device_card(
    name: str,
    nominal: Device,
    rows: int,
    columns: int,
    overscans: Mapping[str, int],
    grid: int,
) -> dict[str, Any]:
    """Contents of device_card.json."""
    values = {k: getattr(nominal, k) for k in nominal.__dataclass_fields__}
    return {
        "id": name,
        "nominal": values,
        "spread_1sigma": {k: round(s * values[k], 12) for k, s in SPREAD.items()},
        "absorption_um": {str(k): v for k, v in ABSORPTION.items()},
        "npix": columns if rows == columns else [columns, rows],
        **overscans,
        **({"spot_grid_px": grid} if grid else {}),
        "note": "x = serial, y = parallel; heights in um above the gate plane; the real device "
        "scatters about nominal by spread_1sigma",
    }


@lru_cache(maxsize=16)
def _derivatives(nominal: Device) -> dict[str, Any]:
    out = {}
    for name, part in SPREAD.items():
        value = getattr(nominal, name)
        step = part * value
        high = edge_shifts(replace(nominal, **{name: value + step}), REFERENCE[0])
        low = edge_shifts(replace(nominal, **{name: value - step}), REFERENCE[0])
        out[name] = {
            key: ((a - b) / (2 * step)).tolist()
            for key, a, b in zip(("dkx", "dky"), high, low, strict=True)
        }
    return out


@lru_cache(maxsize=64)
def nominal_shifts(nominal: Device, wavelength: float, back_bias: float):
    """Edge shifts of the nominal device at a condition, computed once in a process."""
    return edge_shifts(replace(nominal, vbb=back_bias), wavelength)


def baseline_edges(
    nominal: Device, conditions: list[tuple[float, float]]
) -> dict[str, Any]:
    """Contents of baseline_edges.json for conditions (wavelength [nm], back bias [V])."""
    shifts = {}
    for wavelength, bias in conditions:
        kx, ky = nominal_shifts(nominal, wavelength, bias)
        shifts[f"{wavelength:.0f}_{bias:.0f}"] = {"kx": kx.tolist(), "ky": ky.tolist()}
    return {
        "note": "edge displacement, pixels per electron at the origin pixel; [row dy, col dx], "
        "origin in the middle; right / upper edge of each pixel",
        "conditions": shifts,
        "derivatives_620_m60": _derivatives(nominal),
    }
