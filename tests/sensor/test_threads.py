"""Threads: the same bits, shared work, and forks."""

import copy
import multiprocessing
import os
import threading
import time
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from unittest import mock

import galsim
import numpy as np
import pytest

from bfsensor import BrighterFatterSensor, SensorError
from bfsensor.sensor import image_exposure
from bfsensor.sensor import threads as threads_module
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

    busy = image_exposure.ImageExposure._busy_threads

    def noted(exposure, count):
        wanted.append(busy(exposure, count))
        return wanted[-1]

    before = galsim.get_omp_threads()
    everything = photons(40_000, full=True)
    images = []
    try:
        if galsim.set_omp_threads(2) != 2:
            pytest.skip("GalSim was built without OpenMP")
        many = mock.patch.object(threads_module, "MANY", 1000)
        use = mock.patch.object(image_exposure.ImageExposure, "_busy_threads", noted)
        with many, use:
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
        with use:
            draw(make(kind), everything)
    finally:
        galsim.set_omp_threads(before)
    # 1000 photons are not worth two threads, nor, by default, are 40,000; blocks may be small.
    assert wanted == [2, 1, 3, 2, 1, 2, 1, 2, 1, 1]
    for n in (1, 2, 4):
        np.testing.assert_array_equal(images[0], images[n])


@BOTH
def test_python_threads_may_draw_at_once(kind):
    alone = draw(make(kind, threads=1))
    with ThreadPoolExecutor(4) as executor:
        futures = [executor.submit(draw, make(kind, threads=2)) for _ in range(16)]
        for future in futures:
            np.testing.assert_array_equal(future.result(), alone)


@BOTH
def test_nobody_is_waited_for(kind):
    """Threads that never come leave the work, and the numbers, to the one that draws."""

    class Nobody(ThreadPoolExecutor):
        def submit(self, *args, **kwargs):
            return None

    everything = photons(100_000, full=True)
    alone = draw(make(kind, threads=1), everything)
    with mock.patch.object(image_exposure, "ThreadPoolExecutor", Nobody):
        np.testing.assert_array_equal(draw(make(kind, threads=3), everything), alone)


@BOTH
def test_threads_go_when_the_kernel_fails(kind):
    """An error of the kernel leaves no thread behind that waits for work."""
    kernel = image_exposure._shoot.shoot

    def fail(*arguments):
        if arguments[-1]:
            return kernel(*arguments)
        raise MemoryError

    sensor = make(kind, threads=2)
    draw(sensor)
    before = threading.active_count()
    with (
        mock.patch.object(image_exposure._shoot, "shoot", fail),
        pytest.raises(MemoryError),
    ):
        draw(sensor, photons(100_000))
    assert threading.active_count() == before


@BOTH
def test_fluxes_are_summed_alike(kind):
    """Fluxes of which sums depend on their order give the same sum on several threads."""
    light = photons(100_000)
    light.flux = np.random.default_rng(5701).uniform(0.1, 2.0, 100_000)
    sums = []
    for threads in (1, 2, 3):
        sensor = make(kind, threads=threads)
        sums.append((sensor.accumulate(light, blank()), *sensor.diagnostics.values()))
    assert sums[0] == sums[1] == sums[2]


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
    sensor = make(kind)
    sensor.threads = 2
    here = draw(copy.deepcopy(sensor))
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("fork")) as executor:
        away = executor.submit(draw, sensor).result()
    np.testing.assert_array_equal(away, here)


@BOTH
def test_threads_share_the_work(kind):
    """The loops run on two threads: both have used processor time."""
    if os.cpu_count() < 2:
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
