"""Coupling of pixels and memory of the readout in tables of a_ij."""

from dataclasses import replace

import numpy as np
import pytest

from bfsensor.diagnose.data.reduced_channels import StatedTable, measure_reduced
from bfsensor.diagnose.diagnosis import diagnose_measured
from bfsensor.diagnose.fit.baseline_fit import fit_bounded
from bfsensor.diagnose.model.baseline import Baseline
from bfsensor.effects.bf_long_range import BrighterFatterLongRange
from bfsensor.effects.cti_serial import CtiSerial
from bfsensor.effects.effect import Layout, Shot
from bfsensor.effects.electronic_memory import ElectronicMemory, Settling
from bfsensor.effects.interpixel_coupling import InterpixelCoupling
from bfsensor.response.edge_response import LEVEL
from tests.diagnose.data.test_tables_of_areas import areas_at, fixed, table_of

COUPLING = InterpixelCoupling({"ax": 3e-3, "ay": 2e-3})
MEMORY = ElectronicMemory({"alpha": 4e-3})
SETTLING = Settling({"alpha": 4e-3, "tau": 2.0})


def predicted(effect, baseline, level):
    """Change of a_ij of lags from 0 to 4 by an effect."""
    measured = measure_reduced([StatedTable(table_of(areas_at(), 3), level=level)], reach=4)
    predictor, _ = fit_bounded(measured, baseline)
    (channel,) = measured.channels
    more = predictor.with_effects((effect,), predictor.start)
    change = more.predict(channel, more.start) - predictor.predict(channel, predictor.start)
    out = np.zeros((5, 5))
    out[channel.axes["j"], channel.axes["i"]] = change
    return out


def on_pixels(effect, images):
    """Images of one amplifier [e-] after an effect."""
    shot, rng = Shot("flat", 0, 1.0), np.random.default_rng(5)
    if effect.changes("store"):
        return [
            effect.store(image, shot, Layout(image.shape, (), ()), rng, {})
            for image in images
        ]
    return effect.amplify(list(images), shot, Layout(images[0].shape, (), ()))


@pytest.mark.parametrize("effect", [COUPLING, MEMORY, SETTLING], ids=lambda e: e.name)
def test_areas_of_drawn_flats(effect):
    """White flats, a gain from their variance, C / level^2: the change is that of the table."""
    level, side, flats = 2000.0, 1024, 12
    rng = np.random.default_rng(17)
    found = []
    for _ in range(flats):
        image = rng.poisson(level, (side, side)).astype(float)
        (seen,) = on_pixels(effect, [image])
        seen = seen[:, 64:]
        left = seen - seen.mean()
        gain = seen.mean() / left.var()
        mean = gain * seen.mean()
        row = [left[:, 1:] * left[:, :-1], left[:, 2:] * left[:, :-2]]
        both = [left[1:] * left[:-1], left[1:, 1:] * left[:-1, :-1]]
        found.append([gain**2 * x.mean() / mean**2 for x in (*row, *both)])
    error = 1 / (level * side * np.sqrt(flats))
    empty = Baseline("empty", {key: (0 * kx, 0 * ky) for key, (kx, ky) in fixed().edges.items()},
                     {}, {}, fixed().reference)  # fmt: skip
    a = predicted(effect, empty, level)
    np.testing.assert_allclose(
        np.mean(found, 0), [a[0, 1], a[0, 2], a[1, 0], a[1, 1]], atol=3.5 * error, rtol=3e-3
    )
    assert a[0, 1] > 8 * error and abs(a[0, 0]) < 1e-15


def test_coupling_of_silicons_response():
    """Of brighter-fatter flats too: closed form and coupling on a grid of another size by numpy."""
    side, level = 64, 60_000.0
    a = areas_at(LEVEL)
    wide = np.zeros((side, side))
    at = np.arange(-4, 5)
    wide[np.ix_(at, at)] = a[np.ix_(abs(at), abs(at))]
    a_k = np.fft.fft2(wide).real
    x, y = np.meshgrid(*[2 * np.pi * np.fft.fftfreq(side)] * 2)
    kernel = 1 - 2 * COUPLING["ax"] * (1 - np.cos(x)) - 2 * COUPLING["ay"] * (1 - np.cos(y))
    power = np.expm1(2 * a_k * level) / (2 * a_k)
    change = np.fft.ifft2((kernel**2 - 1) * power).real / level**2
    change[0, 0] -= (kernel**2 - 1).mean() / level
    found = predicted(COUPLING, fixed(), level)
    # The baseline reaches farther than the table.
    np.testing.assert_allclose(found[:2, :3], change[:2, :3], rtol=5e-3, atol=2e-11)


def test_what_a_table_does_not_hold_changes_nothing():
    """The share of a transfer is unknown without the number of transfers."""
    assert not predicted(CtiSerial({"cti": 1e-5}), fixed(), LEVEL).any()


@pytest.mark.parametrize(
    ("effect", "name"),
    [
        (InterpixelCoupling({"ax": 1e-3, "ay": 1e-3}), "interpixel_coupling"),
        (ElectronicMemory({"alpha": 1e-3}), "electronic_memory"),
        (BrighterFatterLongRange({"amp": 4e-8, "power": 3.0}), "bf_long_range"),
    ],
    ids=["coupling", "memory", "long range"],
)
def test_each_is_named(effect, name):
    """The readout is no brighter-fatter physics, nor the other way round."""
    drawn = table_of(areas_at(), 13, error=1e-9)
    measured = measure_reduced([StatedTable(drawn, level=LEVEL)], reach=4)
    more = predicted(effect, fixed(), LEVEL)
    (channel,) = measured.channels
    values = channel.values + more[channel.axes["j"], channel.axes["i"]]
    measured = replace(measured, channels=(replace(channel, values=values),))
    found = diagnose_measured(measured, fixed())
    assert found.attribution is not None
    assert [r.effect.word for r in found.attribution.found] == [name]
