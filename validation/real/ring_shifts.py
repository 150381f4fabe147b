r"""Tree rings of two sensors, in flats and in the places of spots: whether one displacement makes both.

``python -m validation.real.ring_shifts SHARED`` reads radial profiles that were measured on one e2v
and one ITL sensor of LSSTCam (``SHARED/recordings/lsst_treering``, estevesjh/lsst-treeRing @ 66e70bc;
Esteves et al. 2023, arXiv 2308.00919): modulation of flats g and radial shift of spots d.  It prints a
table and writes ``validation/results/real_ring_shifts.ecsv``, a row for each sensor and band of periods.

Charge that is displaced and kept makes :math:`g = -\operatorname{div} d`: at the wave number k the
transfer from g to d is :math:`i / k`.  A sensitivity that varies moves spots of the width s by
:math:`s^2 g'`, a transfer of :math:`i k s^2`.  Columns: ``ratio``, the transfer's size times k;
``phase`` [degree]; ``coherence``, the part of the shifts' power that flats describe; ``power`` of k that
the transfer's size follows; errors are of sections left out in turn.  Noise of the flats makes ratios
too small, by at most 1 - coherence.

Files state no units.  Flats are taken as percent, shifts as hundredths of a pixel; of shifts in pixels
or micrometres the same charge would make ratios of 0.01 and 0.1.  Radii of the ITL sensor's two files
differ by a constant, which is fitted as a slope of the phase.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from astropy.table import Table
from numpy.typing import NDArray
from scipy.signal import stft

from validation.common.write_results import write_results

RESULTS = Path(__file__).parents[1] / "results" / "real_ring_shifts.ecsv"
COMMAND = "python -m validation.real.ring_shifts SHARED"
SENSORS = "e2v", "ITL"
BANDS = (30.0, 45.0), (45.0, 70.0), (70.0, 110.0), (110.0, 200.0)
"""Periods [pixel].  Chosen: shifts below 30 pixels are noise (coherence 0.1), periods above 200 are
mixed with the light's shape."""
LENGTH, MARGIN = 400, 60
"""Length of the sections of spectra, and what is left off at the profiles' ends [pixel].  Chosen: twice
the longest period; with twice the length errors of the spectra grow by a third."""
SECTIONS = 6
"""Number of groups of sections that are left out in turn.  Chosen: a group holds two of the overlapping
sections; of twice as many neighbours would share half of their pixels."""

Values = NDArray[np.float64]


def profiles(folder: Path, sensor: str) -> tuple[Values, Values]:
    """Modulation of flats [percent] and shifts of spots [pixel / 100] at the same radii, by pixel."""
    flats, shifts = (np.load(folder / f"polar_{sensor}_{w}.npy") for w in ("flat", "dr"))
    low, high = (f(flats[0][e], shifts[0][e]) for f, e in ((max, 0), (min, -1)))
    radius = np.arange(low + MARGIN, high - MARGIN)
    return np.interp(radius, *flats[:2]), np.interp(radius, *shifts[:2])


def spectra(profile: Values) -> tuple[Values, NDArray[np.complex128]]:
    """Frequencies [1/pixel], and transforms of half overlapping sections, shape (nf, sections)."""
    frequencies, _, parts = stft(profile, nperseg=LENGTH, boundary=None, padded=False)
    return frequencies, parts


def numbers(
    f: Values, of_g: NDArray[np.complex128], of_d: NDArray[np.complex128]
) -> Values:
    """Ratio, phase and coherence by band, the power of k, and the offset of the radii [pixel]."""
    h, coherence, wave = [], [], []
    for short, long in BANDS:
        k = (f > 1 / long) & (f <= 1 / short)
        one, two = (np.sum(np.abs(x[k]) ** 2) for x in (of_g, of_d))
        both = np.vdot(of_g[k], of_d[k])
        h.append(both / one)
        coherence.append(abs(both) ** 2 / (one * two))
        wave.append(
            2 * np.pi * np.average(f[k], weights=np.sum(np.abs(of_g[k]) ** 2, axis=1))
        )
    size, k = np.abs(h), np.array(wave)
    # A constant difference of radii turns the phase by k times it; the transfer is i/k.
    turned = np.unwrap(np.angle(np.array(h) / 1j))
    offset = float(turned @ k / (k @ k))
    phase = 90.0 + np.degrees(turned - offset * k)
    power = np.polyfit(np.log(k), np.log(size), 1)[0]
    return np.array([*(size * k), *phase, *coherence, power, offset])


def measure(g: Values, d: Values) -> tuple[Values, Values]:
    """:func:`numbers` of two profiles, and their jackknife errors."""
    (f, of_g), (_, of_d) = spectra(g), spectra(d)
    groups = np.array_split(np.arange(of_g.shape[1]), SECTIONS)
    without = np.array([
        numbers(f, *(np.delete(x, group, axis=1) for x in (of_g, of_d))) for group in groups
    ])  # fmt: skip
    return numbers(f, of_g, of_d), np.sqrt((SECTIONS - 1) * without.var(axis=0))


def main() -> None:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("shared", type=Path)
    folder = parser.parse_args().shared / "recordings" / "lsst_treering"
    rows = []
    for sensor in SENSORS:
        g, d = profiles(folder, sensor)
        found, spread = measure(g, d)
        n = len(BANDS)
        for b, (short, long) in enumerate(BANDS):
            rows.append({
                "sensor": sensor, "shortest": short, "longest": long,
                "ratio": found[b], "ratio_error": spread[b],
                "phase": found[n + b], "phase_error": spread[n + b],
                "coherence": found[2 * n + b],
                "power": found[-2], "power_error": spread[-2],
                "offset": found[-1], "offset_error": spread[-1],
            })  # fmt: skip
    table = Table(rows)
    for name in table.colnames[3:]:
        table[name].info.format = ".3f"
    table.pprint_all()
    write_results(table, RESULTS, COMMAND)


if __name__ == "__main__":
    main()
