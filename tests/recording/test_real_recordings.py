"""Recordings of real sensors, where they lie beside the checkout: what they give.

They have no licence that lets them be shipped; see the README there for their sources.
"""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from bfsensor.measure.bartlett import image_weights
from bfsensor.measure.flat_pairs import flat_covariances
from bfsensor.recording.raw.headers import scan_file
from bfsensor.recording.raw.images import read_images
from bfsensor.recording.raw.keywords import translate
from bfsensor.recording.tables.lsst_datasets import BrighterFatterKernel

SHARED = Path(__file__).parents[2].parent / "shared" / "recordings"
if not SHARED.is_dir():
    pytest.skip(f"no recordings in {SHARED}", allow_module_level=True)
LANGFORD = SHARED / "sbig_flats" / "langford"
BERGESON = SHARED / "sbig_flats" / "bergeson"
# The frame's rim is dark or masked in places: 16 pixels are left out.
INSIDE = np.s_[16:-16, 16:-16]


def read_adu(path):
    (frame,) = read_images(scan_file(path), overscan=None, gain=1.0)
    return frame.image


def measure_pair(first, second, bias, **options):
    images = [(read_adu(p) - bias)[INSIDE] for p in (first, second)]
    return flat_covariances(*images, lags=4, box=64, unit="adu", **options)


def test_sbig_headers():
    scan = scan_file(LANGFORD / "slitview.00000357.FLAT.FIT")
    (frame,) = read_images(scan, overscan=None)
    assert frame.image.shape == (495, 657)
    assert (frame.gain, translate(scan.cards)[0]["exposure_time"]) == (0.46, 6.0)
    assert scan.cards["TEMPERAT"] == pytest.approx(-5.232156846)
    assert not frame.mask.any()


@pytest.mark.parametrize(
    ("folder", "names", "sign"),
    [
        (BERGESON, ("flat29.5.FIT", "flat29.5(2).FIT", "flat29.5(3).FIT"), 1),
        (LANGFORD, tuple(f"slitview.0000035{k}.FLAT.FIT" for k in (7, 8, 9)), -1),
    ],
)  # fmt: skip
def test_sbig_equal_exposures_correlate_along_the_readout(folder, names, sign):
    """Near 7 kADU the serial neighbour is correlated by +0.03, near 19.4 kADU below zero.

    Pairs of a triple are not independent: their mean has more than a third of the
    variance; the error of one pair, 1 / sqrt(N), is used.
    """
    biases = sorted(folder.glob("*bias*")) or sorted(folder.glob("*BIAS*"))
    bias = np.mean([read_adu(path) for path in biases], axis=0)
    found = [
        measure_pair(folder / names[a], folder / names[b], bias)
        for a, b in ((0, 1), (0, 2), (1, 2))
    ]
    serial = np.mean([one.correlations[0, 1] for one in found])
    parallel = np.mean([one.correlations[1, 0] for one in found])
    error = found[0].errors[0, 1] / found[0].covariances[0, 0]
    assert error == pytest.approx(found[0].pixels ** -0.5, rel=0.05)
    assert sign * serial > 5 * error
    # The readout chain, not the field of the charge: that would favour y at any level.
    assert abs(parallel) < 0.5 * abs(serial) + 3 * error
    # Mean over variance: the reduction in the README has 0.42 to 0.44 e-/ADU.
    level = np.mean([one.level for one in found])
    variance = np.mean([one.covariances[0, 0] for one in found])
    assert 0.41 < level / (variance - 1360.0) < 0.45


def test_sbig_biases():
    """Two independent reductions of the same frames: the README's table and this code."""
    frames = [read_adu(p)[INSIDE] for p in sorted(LANGFORD.glob("*BIAS*"))]
    found = [flat_covariances(a, b, lags=2, unit="adu") for a, b in pairwise(frames)]
    serial = np.mean([one.correlations[0, 1] for one in found])
    variance = np.mean([one.covariances[0, 0] for one in found])
    # measured_pairs.csv: -0.032 +- 0.002 and 1363 +- 8 ADU^2.
    assert serial == pytest.approx(-0.032, abs=0.004)
    assert variance == pytest.approx(1363.0, abs=25.0)


def test_hsc_kernel_through_lsst_format(tmp_path):
    """The measured kernel survives LSST's format; its neighbours differ by 2.2 in the axes."""
    kernel = np.loadtxt(SHARED / "hsc_bfk" / "hsc_bf_kernel.txt")
    columns = {
        "AMPLIFIER": np.array(["HSC"]), "RAW_MEANS": np.ones((1, 2)),
        "RAW_XCORRS": np.ones((1, 2, 8, 8)), "GAIN": np.ones(1), "NOISE": np.ones(1),
        "MEAN_XCORRS": kernel[None], "KERNEL": kernel[None], "VALID": np.ones(1, int),
    }  # fmt: skip
    dataset = BrighterFatterKernel(columns, {"LEVEL": "AMP"}, {"HSC": kernel})
    dataset.write(tmp_path / "hsc.fits")
    again = BrighterFatterKernel.read(tmp_path / "hsc.fits")
    assert again == dataset
    a = again.area_changes(again.detectors["HSC"])
    assert a[0, 0] < 0
    # The ratio of 2.2 between the axes is the README's.  By the sensor's physics rows are y, which
    # would show an exchange of axes: in the kernel itself axis 1 is the deeper, by 1.15.
    assert a[1, 0] / a[0, 1] == pytest.approx(2.2, abs=0.05)
    assert again.larger_axis(again.detectors["HSC"]) == "y"
    assert again.larger_axis(again.detectors["HSC"].T) == "x"


def read_ucd(name):
    """Correlations at 80,000 e- [j, i] and errors; the file's ii is y, jj is x."""
    rows = np.loadtxt(SHARED / "ucd_bf_kernel" / name, skiprows=1, max_rows=36)
    side = int(rows[:, 0].max()) + 1
    table, error = np.full((2, side, side), np.nan)
    table[rows[:, 0].astype(int), rows[:, 1].astype(int)] = rows[:, 2]
    error[rows[:, 0].astype(int), rows[:, 1].astype(int)] = rows[:, 3]
    return table, error


def test_ucd_tables_obey_the_sum_rule_because_it_made_their_centre():
    table, error = read_ucd("corr_meas_ITL002_VBB60_08Aug17.txt")
    weights = image_weights(table.shape[0] - 1)
    known = np.isfinite(table)
    total = (weights * table)[known].sum()
    scatter = np.sqrt(((weights * error)[known] ** 2).sum())
    # The centre's own error is 1.7e-3: a sum this small is no measurement of it.
    assert abs(total) < 0.02 * scatter
    assert table[1, 0] > 2 * table[0, 1]
