"""What shear_bias and psf_requirement of validation measure, against what shares no code."""

from __future__ import annotations

import galsim
import numpy as np
import pytest
from astropy.table import Table

from bfsensor.errors import MeasurementError
from validation.psf_requirement import psf_requirement
from validation.psf_requirement.psf_requirement import (
    MODELS,
    Model,
    collect,
    draw_models,
    isotropic_table,
    mean_change,
    over_peaks,
    run,
    share_light,
    star_light,
)
from validation.psf_requirement.shear_bias import (
    adaptive_shape,
    open_shape,
    regaussianised_bias,
    shear_bias,
)

NULL = {"strength": 0.0, "diffusion_factor": 0.0}


def gaussian(trace, e1):
    """A Gaussian of a trace [pixel^2] and a distortion."""
    xx, yy = 0.5 * trace * (1 + e1), 0.5 * trace * (1 - e1)
    return galsim.Gaussian(sigma=(xx * yy) ** 0.25).shear(e1=e1)


def moments(profile):
    """Second moments (xx, yy) of a drawn profile, without weights or pixels."""
    image = profile.drawImage(nx=241, ny=241, scale=0.2, method="no_pixel", dtype=float)
    at = 0.2 * (np.arange(241) - 120)
    total = image.array.sum()
    return np.array([(image.array.sum(n) @ at**2) / total for n in (0, 1)])


@pytest.mark.parametrize(
    ("size_error", "shape_error", "psf_shape", "size_ratio"),
    [(0.02, 0.0, 0.0, 1.0), (-0.03, 0.004, 0.05, 0.7), (0.05, -0.01, -0.1, 2.0)],
)
def test_formula_is_what_subtracted_moments_give(
    size_error, shape_error, psf_shape, size_ratio
):
    trace = 3.0
    psf = gaussian(trace, psf_shape)
    model = moments(gaussian(trace * (1 + size_error), psf_shape + shape_error))
    shears = {}
    for g in (-0.02, 0.02):
        # A shear at the same trace, so that none of its second order is left.
        galaxy = gaussian(trace / size_ratio, galsim.Shear(g1=g).e1)
        left = moments(galsim.Convolve(galaxy, psf)) - model
        shears[g] = 0.5 * (left[0] - left[1]) / left.sum()
    slope = (shears[0.02] - shears[-0.02]) / 0.04
    zero = 0.5 * (shears[0.02] + shears[-0.02])
    bias = shear_bias(size_error, shape_error, psf_shape=psf_shape, size_ratio=size_ratio)
    # e = 2 g / (1 + g^2), and moments of the drawn profiles are good to 1e-6.
    assert (1 + bias.m) / (1 + 0.02**2) == pytest.approx(slope, abs=2e-5)
    assert bias.c == pytest.approx(zero, abs=2e-6)
    assert abs(bias.m) > 0.015


def test_formula_refuses_what_leaves_no_galaxy():
    with pytest.raises(MeasurementError, match=r"it must be below 0\.5"):
        shear_bias(0.6, 0.0, size_ratio=2.0)
    with pytest.raises(MeasurementError, match="size_ratio = 0"):
        shear_bias(0.1, 0.0, size_ratio=0.0)


@pytest.mark.parametrize(("size", "e1"), [(1.02, 0.0), (1.0, -0.01), (0.99, 0.005)])
def test_of_gaussians_regaussianisation_gives_the_formula(size, e1):
    true, wrong = gaussian(5.0, 0.0), gaussian(5.0 * size, e1)
    images = [p.drawImage(nx=33, ny=33, scale=1, dtype=float).array for p in (true, wrong)]
    shapes = [adaptive_shape(image) for image in images]
    found = regaussianised_bias(true, images[1] - images[0], size_ratio=0.8)
    expected = shear_bias(
        shapes[1].trace / shapes[0].trace - 1, shapes[1].e1 - shapes[0].e1, size_ratio=0.8
    )
    # Pixels are no Gaussians, and its responsivity is good to a few per cent.
    assert found.m == pytest.approx(expected.m, rel=0.05, abs=1e-5)
    assert found.c == pytest.approx(expected.c, rel=0.05, abs=1e-6)


def test_regaussianisation_has_no_steps():
    """With its default cuts it jumps by a tenth between these two."""
    psf = galsim.Kolmogorov(fwhm=3.5)
    images = [
        psf.dilate(factor).drawImage(nx=33, ny=33, scale=1, dtype=float).array
        for factor in (1.0, 1.011, 1.017)
    ]
    shares = []
    for wrong in images[1:]:
        grown = adaptive_shape(wrong).trace / adaptive_shape(images[0]).trace - 1
        found = regaussianised_bias(psf, wrong - images[0])
        shares.append(found.m / shear_bias(grown, 0.0).m)
    assert shares[0] == pytest.approx(shares[1], rel=0.01)
    assert 0.7 < shares[0] < 1.0


def test_shapes_of_an_ellipse():
    image = (
        gaussian(6.0, 0.08).shift(0.3, -0.2).drawImage(nx=41, ny=41, scale=1, dtype=float)
    )
    # A pixel adds 1/6 to the trace, and makes the ellipse rounder by as much.
    trace, e1 = 6.0 + 1 / 6, 0.08 * 6.0 / (6.0 + 1 / 6)
    found = adaptive_shape(image.array)
    assert (found.trace, found.e1, found.e2) == pytest.approx(
        (trace, e1, 0), rel=2e-3, abs=1e-7
    )
    found = open_shape(image.array, (0.3, -0.2), 15.0)
    assert (found.trace, found.e1) == pytest.approx((trace, e1), rel=1e-4)
    assert abs(found.e2) < 1e-4


def test_no_moments_of_nothing():
    with pytest.raises(MeasurementError, match="no adaptive moments"):
        adaptive_shape(np.zeros((21, 21)))


def test_without_strength_photons_stay_where_pixels_are():
    """GalSim's plain sensor only counts photons in squares."""
    photons, _, _ = star_light(5e3, 100.0, "g", 71)
    plain = collect(galsim.Sensor(), photons)
    assert np.array_equal(collect(Model(NULL).sensor(5, 1.0), photons), plain)
    moved = collect(Model({"diffusion_factor": 0.0}).sensor(5, 1.0), photons)
    assert np.abs(moved - plain).sum() > 50


def test_stars_without_the_effect_are_shared_by_those_alone_that_agree():
    photons, _, _ = star_light(3e3, 50.0, "z", 72)
    plain = {}
    for model in MODELS.values():
        image = collect(model.sensor(6, 0.0), photons)
        assert np.array_equal(plain.setdefault(model.light, image), image)
    assert len({image.tobytes() for image in plain.values()}) == len(plain)


def test_light_of_a_star():
    photons, centre, electrons = star_light(40e3, 200.0, "y", 73)
    image = collect(Model(NULL).sensor(7, 1.0), photons)
    assert max(np.abs(centre)) < 0.5
    # y light is partly not absorbed; 0.6 % of a Kolmogorov star is outside of the stamp.
    expected = 0.994 * electrons + 200.0 * image.size
    assert image.sum() == pytest.approx(
        expected, abs=5 * np.sqrt(expected) + 0.002 * electrons
    )
    assert len(photons) > 1.1 * expected
    # GalSim's silicon would collect 1.7 times as many.
    other = Model({**NULL, "absorption": "galsim"})
    image = collect(other.sensor(7, 1.0), share_light(other, photons, "y"))
    assert image.sum() == pytest.approx(
        expected, abs=5 * np.sqrt(expected) + 0.005 * expected
    )
    assert 900 < photons.wavelength.min() < photons.wavelength.max() < 1150


def test_isotropic_table_is_the_same_along_both_axes():
    table = isotropic_table()
    depth = float(table.depths[-1])
    areas = table.area_changes(charge=1e5, depth=depth)
    assert areas == pytest.approx(areas.T, abs=1e-4)
    q = table.reach
    itl = MODELS["whole"].sensor(1, 1.0).table.area_changes(charge=1e5, depth=depth)
    assert itl[q + 1, q] > 2 * itl[q, q + 1]
    assert areas[q + 1, q] == pytest.approx(0.5 * (itl[q + 1, q] + itl[q, q + 1]), rel=1e-3)


def test_a_star_grows_and_no_feedback_leaves_its_electrons():
    chosen = {name: MODELS[name] for name in ("whole", "no feedback", "never renewed")}
    whole, half, never = draw_models(chosen, 20e3, 0.0, "r", 74)
    # Antilogus et al. 2014: growth of a few per cent at most; the photons are the same.
    assert 2e-3 < whole["size"] < 1e-2
    assert half["size"] == pytest.approx(whole["size"], rel=0.1)
    assert half["size"] != whole["size"]
    assert never["size"] == never["e1"] == never["open_size"] == 0.0


@pytest.fixture
def small_run(tmp_path, monkeypatch):
    monkeypatch.setattr(psf_requirement, "PEAKS", {1e3: 2})
    monkeypatch.setattr(psf_requirement, "DARK", 0.0)
    kept = {name: MODELS[name] for name in ("whole", "nearest pixels")}
    monkeypatch.setattr(psf_requirement, "MODELS", kept)
    return tmp_path / "rows.ecsv", kept


def test_what_is_there_is_not_drawn_again(small_run):
    path, kept = small_run
    said = []
    run(path, "peaks", said.append)
    first = Table.read(path, format="ascii.ecsv")
    assert len(first) == 4 and len(said) == 2
    run(path, "peaks", said.append)
    assert len(said) == 2
    kept["nine tenths"] = MODELS["nine tenths"]
    run(path, "peaks", said.append)
    again = Table.read(path, format="ascii.ecsv")
    assert len(again) == 6 and list(again[:4]["size"]) == list(first["size"])


def rows_of(changes):
    """Rows of one number for each (model, peak, seed)."""
    return Table(rows=[
        {"model": m, "band": "r", "sky": 800.0, "peak": p, "seed": s, "size": v}
        for (m, p, s), v in changes.items()
    ])  # fmt: skip


def test_differences_are_those_of_the_same_stars():
    rng = np.random.default_rng(75)
    noise = rng.normal(0, 1, 6)
    rows = rows_of(
        {("whole", 1e5, s): 3.0 + noise[s] for s in range(6)}
        | {("other", 1e5, s): 2.0 + noise[s] for s in range(6)}
    )
    value, error = mean_change(rows, "whole", "size")
    assert value == pytest.approx(3.0 + noise.mean())
    assert error == pytest.approx(noise.std(ddof=1) / np.sqrt(6))
    value, error = mean_change(rows, "whole", "size", less="other")
    assert value == pytest.approx(1.0) and error == pytest.approx(0.0, abs=1e-12)
    with pytest.raises(MeasurementError, match="no rows of 'absent'"):
        mean_change(rows, "absent", "size")


def test_mean_over_magnitudes():
    """Stars evenly spread in magnitude: the mean of a change in proportion to the peak."""
    peaks = np.geomspace(10e3, 130e3, 40)
    rows = rows_of({("whole", p, s): p for p in peaks for s in (0, 1)})
    value, error = over_peaks(rows, "whole", "size")
    assert value == pytest.approx((130e3 - 10e3) / np.log(13), rel=1e-3)
    assert error == 0
