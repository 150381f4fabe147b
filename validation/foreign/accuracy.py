"""Accuracy of the collection of charge: covariances of flats against the closed form, without noise.

In the linear-noise limit the scheme of :mod:`validation.foreign.collection` is a recursion of second
moments for each Fourier mode of the charge; the closed form is P = (exp(2 a mu) - 1) / (2 a), with a
the mode of the area changes (Astier et al. 2019).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from validation.foreign.collection import ELECTRONS_PER_STEP, FEWEST_STEPS
from validation.foreign.device import DEVICES, REACH, area_changes, edge_shifts

SIDE = 64
"""Side of the periodic sensor [pixel]; three times the reach of the shifts."""

LEVELS = (1e4, 3e4, 6e4, 1.2e5)
"""Levels of the flats [e-]."""

LAGS = {"variance": (0, 0), "c_01": (1, 0), "c_10": (0, 1), "c_11": (1, 1)}
"""Names of the moments, and their lags (y, x)."""


def modes_of(device: str) -> NDArray[np.float64]:
    """Fourier modes of the area changes of a device [1/e-]."""
    a = area_changes(*edge_shifts(DEVICES[device], 620))
    frame = np.zeros((SIDE, SIDE))
    for j, row in enumerate(a):
        for i, value in enumerate(row):
            frame[(j - REACH) % SIDE, (i - REACH) % SIDE] = value
    return np.fft.fft2(frame).real


def closed_form(modes: NDArray, mu: float) -> NDArray:
    """Covariances of a flat of mean ``mu`` [e-^2]."""
    still = np.abs(modes) * mu < 1e-12
    power = np.where(still, mu, np.expm1(2 * modes * mu) / np.where(still, 1, 2 * modes))
    return np.fft.ifft2(power).real


def of_the_scheme(modes: NDArray, mu: float, steps: int) -> NDArray:
    """Covariances that the scheme gives in a number of steps [e-^2].

    Examples
    --------
    >>> modes = modes_of("thick_10um")
    >>> fine = of_the_scheme(modes, 3e4, 200) / closed_form(modes, 3e4)
    >>> bool(np.abs(fine[:2, :2] - 1).max() < 1e-4)
    True
    """
    h = mu / steps
    gain = (h * modes).ravel()
    # second moments of charge, expected arrivals and their Poisson excess
    moments = np.zeros((gain.size, 3, 3))
    arrivals = np.outer([1.0, 0.0, 1.0], [1.0, 0.0, 1.0])
    step = np.zeros((gain.size, 3, 3))
    step[:, 1] = np.stack([gain, gain / 2, gain / 2], axis=1)
    step[:, 0] = step[:, 1]
    step[:, 0, 0] += 1
    for _ in range(steps):
        moments = step @ moments @ step.transpose(0, 2, 1) + h * arrivals
    last = np.zeros((gain.size, 3))
    last[:, 0], last[:, 2] = 1, gain / 2
    power = np.einsum("ni,nij,nj->n", last, moments, last).reshape(modes.shape)
    return np.fft.ifft2(power).real


def accuracy_rows() -> list[dict[str, Any]]:
    """One row for each device, level and number of steps: relative errors of the moments."""
    rows = []
    for device in DEVICES:
        modes = modes_of(device)
        for mu in LEVELS:
            want = closed_form(modes, mu)
            usual = max(FEWEST_STEPS, int(np.ceil(mu / ELECTRONS_PER_STEP)))
            for steps in (usual, 2 * usual):
                got = of_the_scheme(modes, mu, steps)
                errors = {
                    name: float(got[lag] / want[lag] - 1) for name, lag in LAGS.items()
                }
                rows.append({"device": device, "mu": mu, "steps": steps, **errors})
    return rows


def faults_of(rows: list[dict[str, Any]]) -> list[str]:
    """Rows that break the criterion: 0.05 % in variance, 0.4 % in covariances, second order."""
    out = []
    for usual, twice in zip(rows[::2], rows[1::2], strict=True):
        for name in LAGS:
            where = f"{usual['device']} at {usual['mu']:.0f} e-, {name}"
            limit = 0.0005 if name == "variance" else 0.004
            if abs(usual[name]) > limit:
                out.append(f"{where}: off by {usual[name]:.2%}, more than {limit:.1%}")
            if abs(twice[name]) > 0.35 * abs(usual[name]) + 1e-7:
                out.append(f"{where}: twice as many steps leave {twice[name]:.2%}")
    return out
