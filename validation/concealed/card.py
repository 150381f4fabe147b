"""The virtual sensor's card: its nominal device, the scatter of real ones, its baseline file."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import numpy as np

from validation.concealed.electrostatics import EdgeShifts, edge_shifts

NOMINAL = {
    "pixel": 10.0,
    "thickness": 100.0,
    "h": 1.2,
    "wx": 3.5,
    "wy": 6.0,
    "zx": 2.8,
    "zy": 1.9,
    "vbb": -60.0,
    "vfront": 8.0,
    "doping": 1e12,
}
"""Lengths in um, heights above the gate plane, voltages in V, doping in cm^-3."""

SPREAD = {
    "thickness": 1.0,
    "h": 0.06,
    "wx": 0.2,
    "wy": 0.2,
    "zx": 0.06,
    "zy": 0.06,
    "doping": 1e11,
}
"""One sigma of real devices about the nominal one."""

ABSORPTION = {
    400: 0.12,
    480: 0.75,
    550: 1.6,
    620: 2.9,
    700: 5.8,
    750: 8.6,
    870: 24.0,
    950: 66.0,
    1000: 160.0,
}
"""Absorption length [um] by wavelength [nm], silicon at 173 K, rounded."""

CONDITIONS = ((620, -60), (480, -60), (950, -60), (620, -40))
"""Wavelength [nm] and back bias [V] of the baseline file."""


def absorption_length(wavelength: float) -> float:
    """Absorption length [um], log-linear between the entries of ABSORPTION.

    Examples
    --------
    >>> absorption_length(620.0)
    2.9
    """
    known = sorted(ABSORPTION)
    if not known[0] <= wavelength <= known[-1]:
        raise ValueError(
            f"wavelength = {wavelength:g} nm: {known[0]} to {known[-1]} nm are known"
        )
    if wavelength in ABSORPTION:
        return ABSORPTION[int(wavelength)]
    return float(
        np.exp(np.interp(wavelength, known, np.log([ABSORPTION[k] for k in known])))
    )


def shifts_at(
    device: Mapping[str, float], wavelength: float, back_bias: float
) -> EdgeShifts:
    """Edge displacements per electron of a device at a wavelength [nm] and back bias [V]."""
    return edge_shifts(device, absorption_length(wavelength), back_bias)


def draw_device(rng: np.random.Generator) -> dict[str, float]:
    """Return a real device: the nominal one scattered by SPREAD, cut at three sigma."""
    device = dict(NOMINAL)
    for name, spread in SPREAD.items():
        device[name] += spread * float(np.clip(rng.standard_normal(), -3, 3))
    return device


def device_card(campaign: str, geometry: Any, spot_grid: float) -> dict[str, Any]:
    """Return what device_card.json holds; ``geometry`` gives sizes and overscans."""
    return {
        "id": campaign,
        "nominal": NOMINAL,
        "spread_1sigma": SPREAD,
        "absorption_um": {str(k): v for k, v in ABSORPTION.items()},
        "npix": geometry.pixels,
        "prescan": geometry.prescan,
        "serial_overscan": geometry.serial_overscan,
        "parallel_overscan": geometry.parallel_overscan,
        "spot_grid_px": spot_grid,
        "note": (
            "x = serial, y = parallel; raw pixels are in readout order; heights in um above "
            "the gate plane; the real device scatters about nominal by spread_1sigma"
        ),
    }


def _rounded(values: np.ndarray) -> list[list[float]]:
    return [[float(f"{v:.5g}") for v in row] for row in values]


@lru_cache(maxsize=1)
def baseline_edges() -> dict[str, Any]:
    """Return what baseline_edges.json holds: the nominal device's shifts and derivatives.

    Derivatives are central differences over half a spread to each side, at the first of
    CONDITIONS.

    Examples
    --------
    >>> edges = baseline_edges()
    >>> sorted(edges["conditions"]), sorted(edges["derivatives_620_m60"])[:2]
    (['480_-60', '620_-40', '620_-60', '950_-60'], ['doping', 'h'])
    """
    conditions = {}
    for wavelength, bias in CONDITIONS:
        kx, ky = shifts_at(NOMINAL, wavelength, bias)
        conditions[f"{wavelength}_{bias}"] = {"kx": _rounded(kx), "ky": _rounded(ky)}
    derivatives = {}
    wavelength, bias = CONDITIONS[0]
    for name, spread in SPREAD.items():
        high, low = (
            shifts_at({**NOMINAL, name: NOMINAL[name] + s * spread / 2}, wavelength, bias)
            for s in (1, -1)
        )
        derivatives[name] = {
            "dkx": _rounded((high.kx - low.kx) / spread),
            "dky": _rounded((high.ky - low.ky) / spread),
        }
    return {
        "note": (
            "edge displacement, pixels per electron at the origin pixel; [row dy, col dx], "
            "origin in the middle; right / upper edge of each pixel"
        ),
        "conditions": conditions,
        "derivatives_620_m60": derivatives,
    }
