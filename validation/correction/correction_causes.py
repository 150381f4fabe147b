"""Why corrections of stars are not complete: the same stars without photons.

Expected charge, edges that move by their mean shifts in proportion to what is there, and sweep
the true light that falls on them or the mean of their two pixels.  Held against what the sensor's
stars keep (``validation.correction.correction_round_trip``), causes come apart:

order
    shifts feed back on themselves; the correction knows the charge at the end only;
boundary
    the light on an edge is not the mean of its two pixels;
within
    shifts vary along an edge and the light across what they sweep: sensor, linear response;
response
    shifts are not in proportion to the charge: sensor, whole response.

``python -m validation.correction.correction_causes`` writes what tables miss because they reach no
farther than 4 pixels from charge (:func:`share_beyond`).
"""

from __future__ import annotations

import argparse
from collections.abc import Callable

import numpy as np
from astropy.table import Table
from numpy.typing import NDArray
from scipy.signal import fftconvolve
from scipy.special import ndtr

from bfsensor.measure.correct import correct_edges
from bfsensor.simulate.charge_field import ImageCharge
from bfsensor.simulate.image_charge import edge_shifts
from bfsensor.table.quadrant_shifts import QuadrantShifts, quadrant_shifts
from validation.common.write_results import RESULTS, write_results
from validation.correction.correction_round_trip import (
    PEAKS,
    SIDE,
    SIGMAS,
    growth,
    residuals,
    slope,
    table_of,
)

Correction = Callable[[NDArray], NDArray]


def model_growth(
    shifts: QuadrantShifts, sigma: float, peak: float, place: tuple[float, float],
    correct: Correction, *, exact: bool, steps: int = 40,
) -> tuple[NDArray, NDArray]:  # fmt: skip
    """Growth [%] before and after a correction, of expected charge.

    Every edge moves by its mean shift times the charge that is there, and sweeps the light that
    falls on it (``exact``) or the mean of its two pixels.
    """
    half = SIDE // 2
    at = np.arange(-half - 0.5, half + 1)
    cumulative = [ndtr((at - p) / sigma) for p in place]
    density = [
        np.exp(-0.5 * ((at - p) / sigma) ** 2) / np.sqrt(2 * np.pi) / sigma for p in place
    ]
    total = peak * 2 * np.pi * sigma**2
    wide, high = (np.diff(c) for c in cumulative)
    light = total * np.outer(high, wide)
    if exact:
        on_rows = total * np.outer(density[1][1:-1], wide)
        on_columns = total * np.outer(high, density[0][1:-1])
    else:
        on_rows = 0.5 * (light[1:] + light[:-1])
        on_columns = 0.5 * (light[:, 1:] + light[:, :-1])
    up, right = _both_sides(shifts.north), _both_sides(shifts.east.T).T
    n = len(shifts.north)
    charge = np.zeros_like(light)
    before = np.zeros_like(light)
    for k in range(steps):
        # The charge expected in the middle of the step.
        middle = charge + 0.5 * (charge - before) if k else 0.5 * light / steps
        rows = fftconvolve(np.pad(middle, ((n, n), (n - 1, n - 1))), up, "valid")[1:-1]
        columns = fftconvolve(np.pad(middle, ((n - 1, n - 1), (n, n))), right, "valid")
        swept = [(on_rows * rows), (on_columns * columns[:, 1:-1])]
        came = light.copy()
        came[:-1] += swept[0]
        came[1:] -= swept[0]
        came[:, :-1] += swept[1]
        came[:, 1:] -= swept[1]
        before, charge = charge, charge + came / steps
    return growth(charge, light), growth(correct(charge), light)


def _both_sides(upper: NDArray) -> NDArray:
    half = np.concatenate([upper[:, :0:-1], upper], axis=1)
    return np.concatenate([-half[::-1], half])


def model_residuals(
    device: str, sigma: float, *, exact: bool, strength: float = 1.0, places: int = 3
) -> tuple[NDArray, NDArray]:
    """Slopes in x and y of the model before and after the edge correction, over many places."""
    shifts = QuadrantShifts(
        *(strength * part for part in quadrant_shifts(table_of(device), tail_slope=None))
    )
    peaks = np.array(PEAKS)
    at = (np.arange(places) + 0.5) / places - 0.5
    out = np.zeros((2, 2))
    for x in at:
        for y in at:
            grown = np.array([
                model_growth(
                    shifts, sigma, peak, (x, y), lambda i: correct_edges(i, *shifts),
                    exact=exact,
                )
                for peak in peaks
            ])  # fmt: skip
            out += [[slope(peaks, grown[:, k, a]) for a in (0, 1)] for k in (0, 1)]
    return out[0] / places**2, out[1] / places**2


def find_causes(rows: Table, device: str, sigma: float) -> dict[str, NDArray]:
    """Parts in x and y of what the edge correction leaves of the slope [%]; they add up to it.

    The model's stars have the width that diffusion gave the sensor's.
    """
    part = rows[(rows["device"] == device) & (rows["sigma"] == sigma)]
    variance = float(np.mean(part["variance_off"][part["sensor"] == "linear"]))
    width = float(np.sqrt(variance - 1 / 12))
    left = []
    for exact in (False, True):
        before, after = model_residuals(device, width, exact=exact)
        left.append(100 * after / before)
    for sensor in ("linear", "whole"):
        left.append(
            np.array([residuals(part, sensor, sigma, "edges", axis)[0] for axis in "xy"])
        )
    steps = np.diff([np.zeros(2), *left], axis=0)
    return dict(zip(("order", "boundary", "within", "response"), steps, strict=True))


def share_beyond(sigma: float, reach: int, *, peak: float = 60e3) -> NDArray[np.float64]:
    """Part [%] of a star's growth, x and y, by shifts of edges beyond so many pixels from charge.

    By image charges between planes 100 um apart, like the ITL device; no table reaches so far.
    """
    model = ImageCharge(0.32, 1.21, 2.57, 0.2, 3.8, drift_field=((0, 0.74), (100, 0.36)))
    far = 9
    shifts = edge_shifts(model, depth=99.9, reach=far)
    whole = QuadrantShifts(shifts.north[far:, far:], shifts.east[far:, far:])
    near = QuadrantShifts(*(part.copy() for part in whole))
    for part in near:
        part[reach + 1 :] = 0.0
        part[:, reach + 1 :] = 0.0
    grown = [
        model_growth(s, sigma, peak, (0.1, 0.2), lambda image: image, exact=True)[0]
        for s in (near, whole)
    ]
    return 100 * (1 - grown[0] / grown[1])


def main() -> None:
    """Write what tables of 4 pixels miss of the growth of stars, by the width of the star."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    rows = []
    for sigma in SIGMAS:
        x, y = share_beyond(sigma, 4)
        rows.append({"sigma_pixel": sigma, "reach": 4, "missed_x": x, "missed_y": y})
    table = Table(rows)
    table.pprint()
    path = RESULTS / "growth_beyond.ecsv"
    write_results(table, path, "python -m validation.correction.correction_causes")


if __name__ == "__main__":
    main()
