"""Requirements of GalSim and imSim on a sensor: objects, generators, drawing, pools."""

from __future__ import annotations

import copy
import inspect
import pickle
from concurrent.futures import ProcessPoolExecutor

import galsim
import numpy as np
import pytest

import bfsensor
from bfsensor import BrighterFatterSensor, SensorError, SiliconSensor
from tests.sensor.contract_cases import BOTH, RINGS, blank, draw, make, part, photons


def test_silicon_sensor_has_the_signature_of_galsim():
    """Both begin with it; BrighterFatterSensor has another table and its whole reach."""
    theirs = inspect.signature(galsim.SiliconSensor).parameters
    ours = inspect.signature(SiliconSensor).parameters
    assert [(k, p.default) for k, p in ours.items()][: len(theirs)] == [
        (k, p.default) for k, p in theirs.items()
    ]
    # What ours has beside it is given by name, and leaves GalSim's calls as they are.
    more = list(ours.values())[len(theirs) :]
    assert [p.kind for p in more] == [inspect.Parameter.KEYWORD_ONLY] * len(more)
    assert all(p.default is not inspect.Parameter.empty for p in more)
    assert ours["threads"].default is None
    assert list(inspect.signature(BrighterFatterSensor).parameters)[: len(theirs)] == list(
        theirs
    )
    for method in ("accumulate", "calculate_pixel_areas"):
        theirs = inspect.signature(getattr(galsim.SiliconSensor, method)).parameters
        for kind in (SiliconSensor, BrighterFatterSensor):
            ours = inspect.signature(getattr(kind, method)).parameters
            assert [(k, p.default) for k, p in ours.items()] == [
                (k, p.default) for k, p in theirs.items()
            ]


@BOTH
def test_pickle_copy_and_repr(kind):
    for options in (
        {},
        {"treering_func": RINGS, "treering_center": galsim.PositionD(3, 4), "threads": 3},
    ):
        sensor = make(kind, **options)
        galsim.utilities.check_pickle(sensor)
        # Drawing with a copy gives the same pixels.
        galsim.utilities.check_pickle(
            sensor, lambda s: draw(copy.deepcopy(s), photons(2000)).tolist()
        )
        assert copy.copy(sensor) == sensor == copy.deepcopy(sensor)
        assert copy.copy(sensor).rng is sensor.rng
        space = {"galsim": galsim, "bfsensor": bfsensor, "inf": np.inf, "array": np.array}
        again = eval(repr(sensor), space)
        assert again._key() == sensor._key()  # generators do not come back from their repr
        assert isinstance(str(sensor), str)
    assert isinstance(sensor, galsim.SiliconSensor)
    with pytest.raises(TypeError, match="unhashable"):
        hash(sensor)


@BOTH
def test_copies_begin_a_new_exposure(kind):
    sensor, image = make(kind), blank()
    sensor.accumulate(photons(), image)
    for other in (
        pickle.loads(pickle.dumps(sensor)),
        copy.copy(sensor),
        copy.deepcopy(sensor),
    ):
        assert other == sensor
        with pytest.raises(galsim.GalSimError, match="not without it before"):
            other.accumulate(photons(), image, resume=True)
    # The exposure of the sensor itself goes on.
    sensor.accumulate(photons(), image, resume=True)


DIFFERENT = {
    "name": "lsst_e2v_50_8", "strength": 2.0, "diffusion_factor": 0.5, "qdist": 2,
    "nrecalc": 7.0, "treering_func": RINGS, "treering_center": galsim.PositionD(1.0, 2.0),
    "transpose": True, "threads": 2,
}  # fmt: skip


@BOTH
@pytest.mark.parametrize("key", DIFFERENT)
def test_sensors_differ_by_every_option(kind, key):
    value = DIFFERENT[key]
    if key == "name" and kind is BrighterFatterSensor:
        value = "e2v_ccd250"
    sensor = make(kind, **{key: value})
    assert getattr(sensor, key) == value
    assert sensor == make(kind, **{key: value})
    assert sensor != make(kind)


@BOTH
def test_sensors_differ_by_kind_and_generator(kind):
    galsim.utilities.check_all_diff(
        [
            make(SiliconSensor), make(BrighterFatterSensor),
            kind(rng=galsim.BaseDeviate(6008)), galsim.SiliconSensor(rng=galsim.BaseDeviate(6007)),
            galsim.Sensor(), "sensor",
        ],
        check_hash=False,
    )  # fmt: skip


@BOTH
def test_rings_must_be_tables_and_positions(kind):
    for wrong in (lambda r: r, 0.3, np.zeros(4), "rings.txt"):
        with pytest.raises(TypeError, match=r"treering_func must be a galsim.LookupTable"):
            kind(treering_func=wrong)
    for wrong in ((3.0, 4.0), None, galsim.PositionI(3, 4), "here"):
        with pytest.raises(TypeError, match=r"treering_center must be a galsim.PositionD"):
            kind(treering_func=RINGS, treering_center=wrong)


# -- random numbers ------------------------------------------------------------------------


@BOTH
def test_generator_is_shared(kind):
    rng = galsim.BaseDeviate(88)
    sensor = kind(rng=rng)
    assert sensor.rng.raw() == galsim.BaseDeviate(88).raw()
    # One generator: what either takes is gone for both.
    rng.discard(5)
    twin = galsim.BaseDeviate(88)
    twin.discard(6)
    assert sensor.rng == galsim.UniformDeviate(twin)
    draw(sensor)
    assert rng != twin
    # Two sensors that share one draw other electrons; two alike draw the same.
    first, second = (draw(kind(rng=rng)) for _ in range(2))
    assert not np.array_equal(first, second)
    np.testing.assert_array_equal(draw(make(kind)), draw(make(kind)))
    # A copy has its own.
    alone = copy.deepcopy(sensor)
    before = sensor.rng.serialize()
    draw(alone)
    assert sensor.rng.serialize() == before != alone.rng.serialize()


@BOTH
def test_update_rng_restarts_and_shares(kind):
    sensor = kind(rng=galsim.BaseDeviate(88))
    images = []
    for _ in range(2):
        rng = galsim.BaseDeviate(1234)
        sensor.updateRNG(rng)
        images.append(draw(sensor))
        assert sensor.rng == galsim.UniformDeviate(rng)  # it has gone on as well
    np.testing.assert_array_equal(*images)
    np.testing.assert_array_equal(images[0], draw(kind(rng=galsim.BaseDeviate(1234))))
    assert not np.array_equal(draw(sensor), images[0])
    before = sensor.rng.serialize()
    for wrong in ([3.5], {}, galsim.Sensor()):
        with pytest.raises(SensorError, match=r"rng = .* must be a galsim.BaseDeviate"):
            sensor.updateRNG(wrong)
    assert sensor.rng.serialize() == before


@BOTH
def test_an_exposure_keeps_its_random_numbers(kind):
    """GalSim updates the generator before every stamp; a resumed exposure goes on as it was."""
    everything, image = photons(), blank()
    sensor = make(kind)
    for n in range(3):
        sensor.accumulate(
            part(everything, 10_000 * n, 10_000 * (n + 1)), image, resume=n > 0
        )
        sensor.updateRNG(galsim.BaseDeviate(500 + n))
    np.testing.assert_array_equal(image.array, draw(make(kind)))


@BOTH
@pytest.mark.parametrize("method", ["phot", "fft"])
@pytest.mark.parametrize("dtype", [np.float32, np.int32])
def test_draw_image(kind, method, dtype):
    """Nothing is lost, the star is larger than with strength 0, batches change nothing."""
    star = galsim.Gaussian(sigma=0.5, flux=8e5)

    def image(strength=1.0, **batch):
        return star.drawImage(
            galsim.Image(33, 33, dtype=dtype), scale=0.3, method=method,
            sensor=make(kind, strength=strength), rng=galsim.BaseDeviate(41), **batch,
        )  # fmt: skip

    def size(some):
        moments = galsim.utilities.unweighted_moments(some)
        return moments["Mxx"] + moments["Myy"]

    drawn, still = image(), image(strength=0.0)
    # By FFT 800,000 e- come in photons of fractional flux: single precision of 1089 pixels
    # of 46,000 e- at most (2e-3 each), and integers that are rounded (0.29 each, 5 sigma).
    error = {"phot": 0.0, "fft": 5 * 0.29 * 33 if dtype == np.int32 else 2.2}[method]
    assert drawn.added_flux == pytest.approx(drawn.array.sum(dtype=float), abs=error)
    # 5 sigma of Poisson; nothing is lost, 10 sigma of the star from the edge.
    assert drawn.added_flux == pytest.approx(8e5, abs=5 * np.sqrt(8e5))
    # GalSim's sensor gives 0.27 %, the table of itl_sta3800c more (diffusion is smaller, so
    # the star is).  Of the same photons some 2000 electrons end a pixel further out: the
    # growth is good to 3 %.
    assert 0.002 < size(drawn) / size(still) - 1 < 0.006
    if method == "phot" and dtype == np.float32:
        # GalSim draws integers batch by batch on fresh images: no charge is left to act.
        np.testing.assert_array_equal(image(maxN=70_000).array, drawn.array)


@BOTH
def test_draw_image_adds_to_an_image(kind):
    star = galsim.Gaussian(sigma=0.5, flux=1e5)
    image = galsim.ImageF(33, 33, scale=0.3, init_value=50.0)
    for n in range(2):
        added = star.drawImage(
            image, method="phot", sensor=make(kind), add_to_image=True, poisson_flux=False,
            rng=galsim.BaseDeviate(300 + n),
        ).added_flux  # fmt: skip
        assert added == 1e5
    assert image.array.sum(dtype=float) == 2e5 + 50 * 33**2


def pool(sensor, recalc=True):
    """Draw batches of objects into one image, as imSim's photon pooling does."""
    image = galsim.ImageF(200, 200)
    added = 0.0
    for batch in range(3):
        for sub in range(3):
            some = photons(40_000, seed=100 + 10 * batch + sub, full=True, width=1.5)
            some.x += 60.0 + 30 * sub
            some.y += 100.0
            added += sensor.accumulate(
                some, image, resume=batch + sub > 0, recalc=recalc and sub == 0
            )
    return image.array, added


@BOTH
def test_photon_pooling_in_processes(kind):
    """One sensor, nrecalc = 0, one float32 image, boundaries renewed once a batch."""
    sensor = make(kind, nrecalc=0)
    with ProcessPoolExecutor(2) as executor:
        away = [executor.submit(pool, sensor) for _ in range(2)]
        away = [future.result() for future in away]
    here, added = pool(sensor)
    for pixels, flux in away:
        np.testing.assert_array_equal(pixels, here)
        assert flux == added
    assert here.sum(dtype=float) == added > 300_000
    # The renewals are what makes stars wider: without them the charge does not act.
    still, _ = pool(make(kind, nrecalc=0), recalc=False)
    assert here.max() < still.max()
