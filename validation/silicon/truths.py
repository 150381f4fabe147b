"""Measured a_ij of a device with concealed physics, by engines other than the predictor's.

- 'poisson': the Poisson solver on 64 cells a pixel; the predictor's shifts are those of 48 cells, its
  derivatives those of 16.  It shares the solver's code.
- 'image charge': the change of the a_ij between two devices by the analytic engine of
  :mod:`validation.concealed.electrostatics`, numpy of its own, applied to the a_ij of the Poisson
  solver's device.  It shares nothing with the predictor but the device without the change.
- 'poisson_ccd': likewise the change by Poisson_CCD, a solver of devices by other authors
  (:mod:`validation.silicon.other_engine`).  It has light at one height; what a change does otherwise
  to longer wavelengths, at most a few percent of it, is the Poisson solver's.

Noise has the covariance matrix of the covariances of flats (Bartlett's formula, here by numpy).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bfsensor.device.device import Device
from bfsensor.device.parameters import change_parameter
from bfsensor.device.parts import ChannelStopDots, Implant
from bfsensor.response.edge_response import solve_response
from bfsensor.response.light import mixed
from validation.concealed.card import NOMINAL, absorption_length
from validation.concealed.electrostatics import edge_shifts
from validation.silicon.other_engine import change_ratio

Array = NDArray[np.float64]

LAGS = 5
"""Lags from 0 in either direction of a table."""
LEVEL = 40_000.0
"""Level of the flats [e-]."""
PAIRS, PIXELS = 300, 2048**2
"""Pairs of flats of a table, and pixels of each.  Chosen: what a laboratory takes in a day."""
CELLS = 64
"""Cells of the truths' mesh a pixel."""
GATES = "gates.collecting_phases"
"""Number of gates, a change that is no quantity of a device file's uncertainties."""
BLUR, MEMORY = "coupling", "memory"
"""Signal that moves after collection: to the four neighbours; to the pixel that is read next."""
DOTS, ECHO, GAIN = "dots", "echo", "gain"
"""Changes that no effect or piece of the diagnosis describes: dots of implants in the channel stops; a
reflected signal that arrives :data:`LATE` pixels late; a gain that is wrong, and with it a_00."""
LATE = 3
"""Delay of a reflected signal [pixel].  Chosen: two are within the reach of a settling amplifier."""
MOVED = {
    BLUR: ((0, 1), (0, -1), (1, 0), (-1, 0)), MEMORY: ((0, 1),), ECHO: ((0, LATE),),
}  # fmt: skip
"""Places (y, x) to which each moves a share of a pixel's signal."""
IMAGE_CHARGE = {
    "silicon.thickness": "thickness",
    "silicon.background_doping": "doping",
    "operating_point.back_bias": "vbb",
}
"""Quantities that the analytic engine has, by its own names."""
POISSON_CCD = (
    "silicon.thickness", "silicon.background_doping", "operating_point.back_bias",
)  # fmt: skip
"""Quantities that truths by Poisson_CCD change: those of the bulk.

Chosen after ``python -m validation.silicon.engines_compared``, and so not independent of our solver:
changes of a_00 by doping, back bias and thickness are 5, 5 and 14 % of themselves above ours, those by
the depth of the channel 25 % and by the holes' level 80 % below.  Which of the two is wrong at the
front is not known, as the program was not run on a finer mesh; a value found there could not be scored.
Doses, surface charge and gates were not compared.  Oxides, tapers and widths of the channel stop are
rounded to whole planes (0.13 um) and columns (0.6 um) of its mesh by its code."""


def changed(device: Device, change: Mapping[str, float]) -> Device:
    """Device with quantities changed [internal units]; raises DeviceError where there is none."""
    for name, by in change.items():
        if name == GATES:
            gates = dataclasses.replace(
                device.gates, collecting_phases=device.gates.collecting_phases + round(by)
            )
            device = dataclasses.replace(device, gates=gates)
        elif name == DOTS:
            dots = ChannelStopDots(
                centre=0.5 * device.pixel.pitch_y, height=3.0,
                implants=(Implant("gaussian", by, peak=0.5, sigma=0.4),),
            )  # fmt: skip
            stop = dataclasses.replace(device.channel_stop, dots=dots)
            device = dataclasses.replace(device, channel_stop=stop)
        elif name not in (*MOVED, GAIN):
            device = change_parameter(device, name, by)
    return device


def areas(device: Device, wavelengths: tuple[float | None, ...]) -> list[Array]:
    """a_ij [1/e-] by the Poisson solver for light of wavelengths [nm], (LAGS, LAGS) each, [j, i].

    None: light that converts at the back surface.
    """
    found = solve_response(device, level=LEVEL, cells=CELLS)
    kelvin = device.operating_point.temperature
    out = []
    for w in wavelengths:
        kx, ky = mixed(found.kx, found.ky, found.depths, w, kelvin)
        whole = kx - np.roll(kx, 1, 1) + ky - np.roll(ky, 1, 0)
        n = len(whole) // 2
        out.append(whole[n : n + LAGS, n : n + LAGS])
    return out


def by_image_charges(
    device: Device, change: Mapping[str, float], wavelength: float
) -> Array:
    """Ratio of the a_ij with and without a change, by the analytic engine."""
    point = device.operating_point
    own = dict(NOMINAL) | {
        "pixel": device.pixel.pitch_x, "thickness": device.silicon.thickness,
        "vfront": 8.0, "doping": -1e12 * device.silicon.background_doping,
    }  # fmt: skip
    other = dict(own)
    bias, moved = point.back_bias, point.back_bias
    for name, by in change.items():
        if name == "operating_point.back_bias":
            moved += by
        elif name == "silicon.background_doping":
            other["doping"] -= 1e12 * by
        else:
            other[IMAGE_CHARGE[name]] += by
    both = []
    for card, volts in ((own, bias), (other, moved)):
        found = edge_shifts(card, absorption_length(wavelength), volts)
        kx, ky = np.asarray(found.kx), np.asarray(found.ky)
        whole = kx - np.roll(kx, 1, 1) + ky - np.roll(ky, 1, 0)
        n = len(whole) // 2
        both.append(whole[n : n + LAGS, n : n + LAGS])
    return both[1] / both[0]


def by_poisson_ccd(
    binary: str | Path,
    device: Device,
    change: Mapping[str, float],
    wavelengths: tuple[float, ...],
    known: dict[str, Array],
) -> tuple[list[Array], list[Array]]:
    """a_ij [1/e-] for light of wavelengths [nm] without a change, and with it by Poisson_CCD.

    Those without are the Poisson solver's.  ``known`` keeps what the program has solved.
    """
    other = changed(device, change)
    # The device that the Poisson solver does not have is drawn again before the program is run.
    back, *before = areas(device, (None, *wavelengths))
    back_after, *after = areas(other, (None, *wavelengths))
    ratio = change_ratio(binary, device, other, lags=LAGS, known=known)
    return before, [a * ratio * back / back_after for a in after]


def read_out(a: Array, name: str, share: float) -> Array:
    """a_ij as measured when a share of each signal moves, or the gain is too large by a share.

    The white part of the variance, 1 / level, is in the covariances C / level^2, and moves too.
    What remains of it at lag (0, 0) grows with the level as the photon noise does: a gain measured on
    photon transfer curves takes it as that noise, and a_00 does not hold it.
    """
    if name == GAIN:
        out = a.copy()
        out[0, 0] += 1 / LEVEL - 1 / (LEVEL * (1 + share))
        return out
    side = 4 * LAGS
    wide = np.zeros((side, side))
    at = np.arange(-LAGS + 1, LAGS)
    wide[np.ix_(at, at)] = a[np.ix_(abs(at), abs(at))]
    wide[0, 0] += 1 / LEVEL
    kernel = np.zeros((side, side))
    kernel[0, 0] = 1 - len(MOVED[name]) * share
    for place in MOVED[name]:
        kernel[place] = share
    power = np.fft.fft2(wide) * abs(np.fft.fft2(kernel)) ** 2
    out = np.fft.ifft2(power).real
    out[0, 0] -= (kernel**2).sum() / LEVEL
    return out[:LAGS, :LAGS]


def noise_matrix(a: Array) -> Array:
    """Covariance matrix of measured a_ij [1/e-^2], lags as in a.ravel(), by Bartlett's formula."""
    side = 8 * LAGS
    c = np.zeros((side, side))
    at = np.arange(-LAGS + 1, LAGS)
    c[np.ix_(at, at)] = LEVEL**2 * a[np.ix_(abs(at), abs(at))]
    c[0, 0] += LEVEL
    square = np.fft.ifft2(np.fft.fft2(c) ** 2).real
    j, i = (index.ravel() for index in np.indices(a.shape))
    less, more = (
        square[(j[:, None] + s * j) % side, (i[:, None] + s * i) % side] for s in (-1, 1)
    )
    # A quadrant's lags (i, j) and (-i, j) are averaged: half of the variance off the axes.
    twice = np.where((i > 0) & (j > 0), 2.0, 1.0)
    scale = np.sqrt(np.outer(twice, twice))
    return (less + more) / (PAIRS * PIXELS * LEVEL**4) / scale
