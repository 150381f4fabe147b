"""Objects like those of lsst.afw, which is not installed here."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from bfsensor import DistortionTable
from bfsensor.errors import SensorError, SensorTypeError
from bfsensor.sensor.exposures import correct_exposure
from bfsensor.sensor.table_correction import correct_table

ITL = DistortionTable.load("itl_sta3800c")
STAR = 9e4 * np.exp(-0.5 * np.hypot(*np.indices((40, 40)) - 20) ** 2 / 1.5**2) + 100


class Box:
    """Geometry as lsst.geom.Box2I gives it."""

    def __init__(self, x, y, nx, ny):
        self.ends = x, y, x + nx - 1, y + ny - 1

    def getMinX(self):
        return self.ends[0]

    def getMinY(self):
        return self.ends[1]

    def getMaxX(self):
        return self.ends[2]

    def getMaxY(self):
        return self.ends[3]


class Exposure:
    def __init__(self, array, bits=None, gains=(1.5, 2.0), at=(0, 0)):
        self.image = SimpleNamespace(array=array)
        self.mask = SimpleNamespace(
            array=np.zeros(array.shape, np.int32) if bits is None else bits,
            getMaskPlaneDict=lambda: {"BAD": 0, "SAT": 1, "CR": 3, "DETECTED": 5},
        )
        self.at, self.gains = at, gains

    def getXY0(self):
        return self.at

    def getDetector(self):
        return [
            SimpleNamespace(
                getName=lambda n=n: f"C0{n}", getGain=lambda g=g: g,
                getBBox=lambda n=n: Box(100 + 20 * n, 0, 20, 60),
            )
            for n, g in enumerate(self.gains)
        ]  # fmt: skip


def test_gains_of_the_detector_and_planes_of_the_mask():
    bits = np.zeros((40, 40), np.int32)
    bits[20, 24], bits[5, 5] = 1 << 1, 1 << 5
    gain = np.repeat([1.5, 2.0], 20)
    expected = correct_table(STAR, ITL, mask=bits == 2)
    for gains in ("detector", {"C00": 1.5, "C01": 2.0}):
        exposure = Exposure((STAR / gain).astype(np.float32), bits, at=(100, 10))
        array = exposure.image.array
        correct_exposure(exposure, ITL, gains=gains)
        assert exposure.image.array is array
        np.testing.assert_allclose(array * gain, expected, rtol=1e-6)
    # Planes count: without them the masked pixel is light.
    exposure = Exposure(STAR.copy(), bits)
    correct_exposure(exposure, ITL, planes=["DETECTED", "UNKNOWN"], surroundings=50.0)
    plain = correct_table(STAR, ITL, mask=bits == 32, surroundings=50.0)
    np.testing.assert_array_equal(exposure.image.array, plain)
    assert np.abs(plain - expected).max() > 0.1


def test_wrong_exposures_are_refused():
    with pytest.raises(SensorTypeError, match=r"needs image.array, which ndarray lacks"):
        correct_exposure(STAR, ITL)
    for given, message in (
        ({"gains": 0.0}, "gains = 0.0 e-/ADU must be finite and above 0"),
        ({"gains": "header"}, "gains = 'header' must be a number, 'detector'"),
        ({"gains": {"C00": 1.0}}, "gains lack amplifier C01: they have C00"),
        ({"gains": "detector"}, "1600 pixels of the exposure belong to no amplifier"),
    ):
        with pytest.raises(SensorError, match=message):
            correct_exposure(Exposure(STAR.copy()), ITL, **given)
    bare = SimpleNamespace(image=SimpleNamespace(array=STAR.copy()))
    with pytest.raises(SensorError, match="need an exposure with a detector"):
        correct_exposure(bare, ITL, gains="detector")
