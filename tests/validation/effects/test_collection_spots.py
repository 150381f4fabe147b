"""Predicted spots: fit, places and steps, halos of neighbours, blooming."""

from __future__ import annotations

import numpy as np
import pytest

from bfsensor.diagnose.data.spot_channels import stamp_moments
from bfsensor.diagnose.data.spot_widths import fit_widths
from bfsensor.diagnose.model.spot_predictions import (
    grow_spots,
    predict_spots,
    representative_phases,
)
from bfsensor.effects.effect import Law
from bfsensor.measure.spot_fit import fit_spots
from bfsensor.measure.spots import Stamps
from validation.concealed.card import NOMINAL, shifts_at
from validation.concealed.scene import spot_grid, spot_scene


def nominal_shifts() -> tuple[np.ndarray, np.ndarray]:
    found = shifts_at(NOMINAL, 620, -60)
    return np.asarray(found.kx), np.asarray(found.ky)


def test_widths_are_those_of_the_channels_fit():
    kx, ky = nominal_shifts()
    phases = np.random.default_rng(5).uniform(-0.5, 0.5, (6, 2))
    images = grow_spots(
        kx, ky, sigma=(1.06, 1.1), phases=phases, flux=9e5, halo=((0.02, 4.0),)
    )[-1]
    stamps = images[:, 5:-5, 5:-5]
    known = fit_spots(
        Stamps(stamps), weights="equal", largest_offset=2.0, limit=1e6, correct_bias=False
    )
    found = fit_widths(stamps[None], (1.0, 1.0), np.zeros((6, 2)))
    assert found.sigma_x[0] == pytest.approx(known.sigma_x, abs=2e-7)
    assert found.sigma_y[0] == pytest.approx(known.sigma_y, abs=2e-7)
    np.testing.assert_allclose(found.centre_x[0], known.centre_x, atol=2e-6)


@pytest.mark.parametrize("law", [Law(), Law(bend=3e-6), Law(loss=3e-7)])
def test_few_places_and_steps_are_enough(law):
    kx, ky = nominal_shifts()
    phases = np.random.default_rng(77).uniform(-0.5, 0.5, (120, 2))
    grow = {"sigma": (1.06, 1.02), "flux": 1e6, "law": law}
    few = representative_phases(phases)
    coarse, fine = (grow_spots(kx, ky, phases=few, steps=n, **grow)[-1] for n in (12, 96))
    many = grow_spots(kx, ky, phases=phases, **grow)[-1]

    def widths(images, centres):
        fit = fit_widths(images[None, :, 5:-5, 5:-5], (1.1, 1.1), centres)
        return np.array([fit.sigma_x[0], fit.sigma_y[0]])

    # Errors of such widths are 2e-4 in the smallest campaigns.
    assert np.abs(widths(coarse, few) - widths(fine, few)).max() < 1e-4
    assert np.abs(widths(coarse, few) - widths(many, phases)).max() < 5e-5


def test_halo_of_a_grid_of_spots_reaches_its_neighbours():
    """The mean image within a whole grid, drawn spot by spot by the other engine."""
    places = spot_grid(256)
    phases = np.full((1, 2), 0.1)
    sigma, share, wide = (1.06, 1.06), 0.05, 8.0
    scene = spot_scene(places + 0.1, np.full(len(places), 95e3), sigma, 256)
    beyond = (np.hypot(1.06, wide),) * 2
    scene.add(spot_scene(places + 0.1, np.full(len(places), 5e3), beyond, 256))
    stamps = [
        scene.light[int(y) - 10 : int(y) + 11, int(x) - 10 : int(x) + 11] for x, y in places
    ]
    zero = np.zeros((3, 3))
    mean = grow_spots(
        zero, zero, sigma=sigma, phases=phases, flux=1e5, steps=2, halo=((share, wide),),
        neighbours=(30.0, 7 / 8),
    )[-1]  # fmt: skip
    # float32 scene; what lies beyond the next spots is left out.
    np.testing.assert_allclose(mean[0], np.mean(stamps, axis=0), rtol=2e-3, atol=0.02)
    moments = stamp_moments(mean, *phases.T)
    found = predict_spots(
        zero, zero, sigma=sigma, phases=phases, fluxes=moments["flux"], halo=((share, wide),),
        neighbours=(30.0, 7 / 8),
    )  # fmt: skip
    # Read as less than the light was: the halo lies under its own background.
    assert found["flux"][0] == pytest.approx(moments["flux"][0] - 1e5, abs=1.0)
    assert found["wings"][0] == pytest.approx(moments["wings"][0], rel=1e-6)


def test_spots_bloom_along_the_column_and_keep_their_charge():
    kx, ky = nominal_shifts()
    phases = np.array([[0.1, -0.2], [-0.3, 0.3]])
    images = grow_spots(
        kx,
        ky,
        sigma=(1.06, 1.06),
        phases=phases,
        flux=1e6,
        steps=24,
        law=Law(full_well=7e4),
    )
    assert images.max() <= 7e4 * (1 + 2e-5)
    np.testing.assert_allclose(images[-1].sum((1, 2)), 1e6, rtol=1e-4)
    fluxes = np.array([2e5, 4e5, 7e5, 1e6])
    ask = {"sigma": (1.06, 1.06), "phases": phases, "fluxes": fluxes}
    full, plain = (
        predict_spots(kx, ky, law=law, **ask) for law in (Law(full_well=7e4), Law())
    )
    growth = full["sigma_y"] - plain["sigma_y"]
    assert abs(growth[0]) < 1e-4 and 0.05 < growth[2] < growth[3]
    assert np.all(full["sigma_x"] - plain["sigma_x"] < growth + 1e-4)


def test_spots_that_spill_are_predicted_at_their_own_places():
    """Interpolation between centres, against the prediction of spots at the place itself."""
    kx, ky = nominal_shifts()
    law, flux = Law(full_well=6e4), 8e5
    ask = {"sigma": (1.25, 1.3), "law": law}
    own = [np.array([[0.05, 0.35]]), np.array([[-0.4, -0.1]]), np.array([[0.45, 0.4]])]
    phases = np.array([[-0.4, -0.2], [-0.1, 0.4], [0.2, -0.4], [0.4, 0.2]])
    fluxes = np.full(len(own), flux)
    found = predict_spots(kx, ky, phases=phases, fluxes=fluxes, places=own, **ask)
    for n, place in enumerate(own):
        alone = predict_spots(kx, ky, phases=place, fluxes=fluxes[:1], **ask)
        for name in ("sigma_x", "sigma_y"):
            assert found[name][n] == pytest.approx(alone[name][0], abs=3e-3)
    mean = predict_spots(kx, ky, phases=phases, fluxes=fluxes[:1], **ask)
    away = np.abs(found["sigma_x"] - mean["sigma_x"])
    assert away.max() > 5e-3, "the place matters"
