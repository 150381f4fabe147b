"""Predictions against what shares no code with them: series, another engine's spots, our tables."""

import json

import numpy as np
import pytest

from bfsensor.device.condition import Condition
from bfsensor.device.shipped import tables_dir
from bfsensor.diagnose.model.baseline import read_edges
from bfsensor.diagnose.model.flat_predictions import flat_covariances_of
from bfsensor.diagnose.model.spot_predictions import grow_spots, predict_spots
from bfsensor.diagnose.model.table_baseline import baseline_of_table
from bfsensor.errors import DiagnosisError
from bfsensor.measure.covariance_model import model_covariances
from bfsensor.measure.growth import measure_growth
from bfsensor.response.edge_response import area_matrix
from bfsensor.table.table import DistortionTable
from validation.concealed.card import NOMINAL as CARD
from validation.concealed.card import baseline_edges, shifts_at
from validation.concealed.collect import Response, collect
from validation.concealed.scene import spot_scene


def shifts():
    found = shifts_at(CARD, 620, -60)
    return np.asarray(found.kx), np.asarray(found.ky)


def test_flats_agree_with_the_published_series():
    a = area_matrix(*shifts())
    middle = len(a) // 2
    levels = np.array([5e3, 3e4, 1e5])
    found = flat_covariances_of(a, levels, lags=4)
    series = model_covariances(levels, a[middle:, middle:], powers=10)[:, :5, :5]
    gap = np.abs(found - series) / levels[:, None, None]
    # The array of the closed form is periodic, 48 pixels wide.
    assert gap.max() < 1e-5


def test_flats_are_poisson_without_shifts_and_lose_nothing():
    levels = [1e4, 1e5]
    nothing = flat_covariances_of(np.zeros((5, 5)), levels, lags=2)
    np.testing.assert_allclose(nothing[:, 0, 0], levels)
    assert np.abs(nothing[:, 1:, 1:]).max() < 1e-6


def test_spots_conserve_charge_and_stay_without_shifts():
    kx, ky = shifts()
    phases = np.array([[0.1, -0.3], [0.4, 0.2]])
    images = grow_spots(kx, ky, sigma=(1.1, 1.0), phases=phases, flux=1e6)
    np.testing.assert_allclose(images[-1].sum((1, 2)), 1e6, rtol=1e-9)
    found = predict_spots(
        0 * kx, 0 * ky, sigma=(1.1, 1.0), phases=phases, fluxes=[1e5, 1e6]
    )
    np.testing.assert_allclose(found["sigma_x"], 1.1, rtol=1e-4)
    np.testing.assert_allclose(found["sigma_y"], 1.0, rtol=1e-4)


def test_growth_agrees_with_the_concealed_engine():
    """Its steps, edges and light are its own; both start from the same shifts."""
    found = shifts_at(CARD, 620, -60)
    pixels, flux, sigma = 64, 1e6, (1.06, 1.12)
    rng = np.random.default_rng(11)
    places = np.array([(x, y) for y in range(12, 60, 20) for x in range(12, 60, 20)], float)
    places += rng.uniform(-0.5, 0.5, places.shape)
    scene = spot_scene(places, np.full(len(places), flux), sigma, pixels)
    on, off = [], []
    for seed in range(4):
        noisy = collect(scene, Response.of(found, pixels), np.random.default_rng(seed))
        plain = np.random.default_rng(seed).poisson(scene.light)
        for x, y in np.round(places).astype(int):
            stamp = np.s_[y - 6 : y + 7, x - 6 : x + 7]
            on.append(noisy[stamp])
            off.append(plain[stamp])
    phases = places - np.round(places)
    kx, ky = np.asarray(found.kx), np.asarray(found.ky)
    grow = {"sigma": sigma, "phases": phases, "flux": flux}
    ours, plain = (grow_spots(f * kx, f * ky, **grow)[-1][:, 4:-4, 4:-4] for f in (1, 0))
    theirs = measure_growth(np.array(on)[:, None], np.array(off)[:, None], stamp=11)
    predicted = measure_growth(ours[:, None], plain[:, None], stamp=11).growth[0]
    error = theirs.growth_error[0]
    assert (error < 0.01 * theirs.growth[0]).all()
    np.testing.assert_array_less(
        np.abs(predicted - theirs.growth[0]), 4 * error + 0.01 * theirs.growth[0]
    )


def test_table_as_baseline_keeps_its_areas():
    table = DistortionTable.read(tables_dir() / "itl_sta3800c" / "table.fits")
    baseline = baseline_of_table("itl_sta3800c")
    middle = baseline.level
    change = table.area_changes(
        charge=middle + 100, background=middle, depth=float(table.depths[-1])
    ) / (100 * np.prod(table.pitch))
    edges, held = baseline.at(Condition(wavelength=480.0))
    a = area_matrix(*edges)
    assert held and abs(a.sum()) < 1e-18
    n, r = len(a) // 2, table.reach
    np.testing.assert_allclose(
        a[n : n + 3, n : n + 3], change[r : r + 3, r : r + 3], rtol=4e-3
    )
    red = area_matrix(*baseline.at(Condition(wavelength=950.0))[0])
    assert abs(red[n, n]) < 0.97 * abs(a[n, n])


def test_edges_file_and_its_parameters(tmp_path):
    path, card = tmp_path / "edges.json", tmp_path / "card.json"
    path.write_text(json.dumps(baseline_edges()))
    card.write_text(json.dumps({"spread_1sigma": {"thickness": 1.0, "h": 0.06}}))
    baseline = read_edges(path, card=card)
    assert set(baseline.parameters) == {"thickness", "h"}
    plain, held = baseline.at(
        Condition(wavelength=620.0, back_bias=-60.0, temperature=173.0)
    )
    assert held
    shifted, _ = baseline.at(
        Condition(wavelength=620.0, back_bias=-60.0, temperature=173.0), {"h": 0.06}
    )
    truth = shifts_at({**CARD, "h": CARD["h"] + 0.06}, 620, -60)
    n = len(plain[0]) // 2
    a, b, c = (area_matrix(*e)[n, n] for e in (plain, shifted, (truth.kx, truth.ky)))
    assert b - a == pytest.approx(c - a, rel=0.02)
    assert not baseline.at(Condition(wavelength=620.0, back_bias=-50.0, temperature=173.0))[
        1
    ]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{}", "not a file of edge displacements"),
        ('{"conditions": {"red": {"kx": [[0]], "ky": [[0]]}}}', "WAVELENGTH_BACKBIAS"),
        ('{"conditions": {"620_-60": {"kx": [[0, 1]], "ky": [[0, 1]]}}}', "odd sides"),
        ('{"conditions": {}}', "no boundary shifts"),
    ],
)
def test_edges_files_that_are_none(tmp_path, text, message):
    path = tmp_path / "edges.json"
    path.write_text(text)
    with pytest.raises(DiagnosisError, match=message):
        read_edges(path)


def test_no_such_baseline():
    with pytest.raises(DiagnosisError, match="nowhere: not a baseline"):
        baseline_of_table("nowhere")
