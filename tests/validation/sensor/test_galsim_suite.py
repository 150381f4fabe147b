"""GalSim's suite on another class: which sites of a test file are pinned to the random stream."""

from validation.sensor.galsim_suite import TestFile

SITES = """
import numpy as np

MOMENT_TOL = 1.e-6
LOOSE_TOL = 1.e-3


def test_moments():
    moments = {'None': 1.0, 'Sensor': 1.0, '8point': 1.3}
    np.testing.assert_allclose(moments['None'], 1.0, rtol=MOMENT_TOL)
    np.testing.assert_allclose(moments['8point'], 1.3, rtol=MOMENT_TOL)
    np.testing.assert_allclose(moments['8point'], 1.3, rtol=1e-6)
    np.testing.assert_allclose(moments['8point'], 1.3, rtol=LOOSE_TOL)
    np.testing.assert_allclose(moments['8point'], 1.3)
"""


def test_tight_sites_on_images_of_the_sensor_are_pinned_however_the_tolerance_is_written(
    tmp_path,
):
    path = tmp_path / "test_sensor_models.py"
    path.write_text(SITES)
    lines = SITES.splitlines()
    found = [lines[n - 1].split("rtol=")[1] for n in sorted(TestFile(path).tight_lines())]
    # The first asks for the same tolerance of an image without the sensor.
    assert found == ["MOMENT_TOL)", "1e-6)"]
