"""Threads: the same bits, shared work, and forks."""

import copy
import multiprocessing
import time
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from unittest import mock

import galsim
import numba
import numpy as np
import pytest
from click.testing import CliRunner

from bfsensor import BrighterFatterSensor, SensorError
from bfsensor.cli.main import main
from bfsensor.sensor import image_exposure
from bfsensor.sensor import threads as threads_module
from bfsensor.sensor.threads import threads_to_use
from tests.sensor.contract_cases import BOTH, blank, draw, make, part, photons


@BOTH
def test_threads_do_not_matter(kind):
    everything = photons(300_000, full=True)
    images = []
    for threads in (1, 2):
        sensor = make(kind)
        sensor.threads = threads
        images.append(draw(sensor, everything))
    np.testing.assert_array_equal(*images)
    if kind is BrighterFatterSensor:
        np.testing.assert_array_equal(draw(make(kind, threads=2), everything), images[0])


@BOTH
def test_by_default_threads_are_those_of_galsim(kind):
    """A number wins; what is asked for is used as far as there is work, with the same bits."""
    wanted = []

    def noted(threads):
        wanted.append(threads)
        return threads_to_use(threads)

    before = galsim.get_omp_threads()
    everything = photons(40_000, full=True)
    images = []
    try:
        if galsim.set_omp_threads(2) != 2:
            pytest.skip("GalSim was built without OpenMP")
        many = mock.patch.object(threads_module, "MANY", 1000)
        with many, mock.patch.object(image_exposure, "threads_to_use", noted):
            images.append(draw(make(kind), everything))
            images.append(draw(make(kind, threads=1), everything))
            images.append(draw(make(kind, threads=3), everything))
            images.append(draw(make(kind, nrecalc=4000), everything))
            sensor, image = make(kind), blank()
            for n, threads in enumerate((1, 2, 1, 2)):
                # What GalSim says at each call counts, also within an exposure.
                galsim.set_omp_threads(threads)
                some = part(everything, 10_000 * n, 10_000 * (n + 1))
                sensor.accumulate(some, image, resume=n > 0)
            images.append(image.array)
            sensor.accumulate(photons(1000), blank())
        with mock.patch.object(image_exposure, "threads_to_use", noted):
            draw(make(kind), everything)
    finally:
        galsim.set_omp_threads(before)
    # Blocks of 4000 e- and 1000 photons are not worth two threads, nor, by default, are 40,000.
    assert wanted == [2, 1, 3, 1, 1, 2, 1, 2, 1, 1]
    for n in (1, 2, 4):
        np.testing.assert_array_equal(images[0], images[n])


@BOTH
def test_python_threads_may_draw_at_once(kind):
    """Numba's own work queue would end the process; who comes second draws on one thread."""
    alone = draw(make(kind, threads=1))
    with ThreadPoolExecutor(4) as executor:
        futures = [executor.submit(draw, make(kind, threads=2)) for _ in range(16)]
        for future in futures:
            np.testing.assert_array_equal(future.result(), alone)


def test_warm_draws_enough_for_two_threads():
    """Ten photons would be drawn on one, and leave the kernel to be compiled later."""
    if numba.config.NUMBA_NUM_THREADS < 2:
        pytest.skip("this machine has one core")
    kernel = image_exposure._shoot.shoot_on_threads
    with mock.patch.object(image_exposure._shoot, "shoot_on_threads", wraps=kernel) as seen:
        result = CliRunner().invoke(main, ["warm", "--threads"])
    assert result.exit_code == 0, result.output
    # One set of kernels serves images of either precision.
    assert seen.called


def test_a_second_user_of_threads_gets_one():
    if numba.config.NUMBA_NUM_THREADS < 2:
        pytest.skip("this machine has one core")
    with threads_to_use(2) as first, threads_to_use(2) as second:
        assert (first, second) == (2, 1)
    with threads_to_use(2) as third:
        assert third == 2


@BOTH
def test_the_number_of_threads_may_be_changed(kind):
    sensor = make(kind)
    assert sensor.threads is None
    sensor.threads = 2
    assert sensor == make(kind, threads=2)
    for wrong in (0, -1, 1.5, "all", [2], np.inf):
        with pytest.raises(SensorError, match=r"threads = .* must be at least 1"):
            sensor.threads = wrong
    assert sensor.threads == 2
    sensor.threads = None
    assert sensor == make(kind)


@BOTH
def test_threads_survive_a_fork(kind):
    """A process that is forked after threads were used may use threads as well."""
    # GNU OpenMP, which numba prefers, ends such a process; GalSim's configuration forks.
    sensor = make(kind)
    sensor.threads = 2
    here = draw(copy.deepcopy(sensor))
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("fork")) as executor:
        away = executor.submit(draw, sensor).result()
    np.testing.assert_array_equal(away, here)


@BOTH
def test_threads_share_the_work(kind):
    """The loops run on two threads: both have used processor time."""
    if numba.config.NUMBA_NUM_THREADS < 2:
        pytest.skip("this machine has one core")
    sensor = make(kind, nrecalc=0)
    sensor.threads = 2
    rng = np.random.default_rng(60701)
    x, y = rng.normal(0, 1, (2, 600_000))
    light = galsim.PhotonArray(len(x), x, y, np.ones(len(x)))
    image = galsim.ImageF(40, 40)
    image.setCenter(0, 0)
    sensor.accumulate(light, image)  # compiled
    ratios = []
    # Threads take pieces as they are free: where others keep the second core busy, this one
    # may do nearly all, but not every time.  Without threads every ratio is 1.
    while len(ratios) < 20 and not (ratios and ratios[-1] > 1.15):
        process, thread = time.process_time(), time.thread_time()
        for _ in range(4):
            sensor.accumulate(light, image)
        ratios.append((time.process_time() - process) / (time.thread_time() - thread))
    assert ratios[-1] > 1.15, ratios
