"""Dark current in flats, and tracks in darks, as predicted and as counted in simulated exposures."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import label

from bfsensor.diagnose.data.dark_channels import LEAST_PIXELS
from bfsensor.diagnose.data.dark_channels import OUTLIER as MEASURED
from bfsensor.effects import cosmic_rays, make_effect
from bfsensor.effects.cosmic_rays import OUTLIER, TRACK_PIXELS
from bfsensor.effects.effect import Layout, Segment, Shot

ROWS, COLUMNS, NOISE, DARKS = 128, 96, 5.0, 40
SEGMENTS = tuple(
    Segment(x, 0, COLUMNS, ROWS, serial_overscan=8)
    for x in (0, COLUMNS)
)  # fmt: skip
LAYOUT = Layout(
    (ROWS, 2 * COLUMNS), SEGMENTS, shots=(), gains=(1.0, 1.0), read_noise=(NOISE, NOISE),
    thickness=100.0, pixel=10.0,
)  # fmt: skip


def axes(**given: object) -> dict[str, np.ndarray]:
    return {name: np.asarray(value) for name, value in given.items()}


def test_the_measurement_counts_what_the_effect_predicts() -> None:
    assert (LEAST_PIXELS, MEASURED) == (TRACK_PIXELS, OUTLIER)


def test_tracks_of_darks() -> None:
    effect = make_effect("cosmic_rays", {"rate": 30.0})
    rng, found = np.random.default_rng(5), 0
    for number in range(DARKS):
        dark = effect.store(
            np.zeros(LAYOUT.shape), Shot("dark", number, 60.0), LAYOUT, rng, {}
        )
        groups = label(dark > OUTLIER * NOISE, np.ones((3, 3)))[0]
        found += int((np.bincount(groups.ravel())[1:] >= TRACK_PIXELS).sum())
    x = axes(what=["tracks"], amp=[-1], time=[60.0 * DARKS], x=[-1], exposure=[-1])
    said = effect.dark_map(x, LAYOUT)[0]
    # Darks here also hold the tracks of the readout, 5 s of 65.
    assert found * 60 / 65 == pytest.approx(said, abs=4 * said**0.5)
    assert said > 200
    np.testing.assert_allclose(effect.modes("dark_map", x, LAYOUT)[:, -1], said**0.5)


@pytest.mark.parametrize(
    ("variant", "values"),
    [("dark", {"rate": 0.5}), ("hot", {"rate": 40.0, "columns": 1, "x1": COLUMNS + 3}),
     ("glow", {"rate": 2.0, "length": 40.0, "corner": 1})],
)  # fmt: skip
def test_dark_current_is_in_means_of_flats(variant: str, values: dict[str, float]) -> None:
    effect = make_effect("dark_hot", values, variant)
    flat = effect.store(
        np.zeros(LAYOUT.shape), Shot("flat", 0, 200.0), LAYOUT, np.random.default_rng(6), {}
    )
    means = [flat[:, s.x : s.x + COLUMNS].mean() for s in SEGMENTS]
    x = axes(
        amp=[0, 1], time=[200.0, 200.0], temperature=[173.15, 173.15], level=[1e4, 1e4]
    )
    said = effect.flat_mean(x, LAYOUT)
    np.testing.assert_allclose(means, said, rtol=0.03, atol=0.02)
    assert said[1] > 50


def test_without_clipping_tracks_add_their_own_autocorrelation(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Image by image of 60 tracks; a clip of 1e4 standard deviations excludes no pixel."""
    found = cosmic_rays.make_tracks(60, 100.0, 10.0, np.random.default_rng(651), (0, 0))
    monkeypatch.setattr(cosmic_rays, "_tracks", lambda *_: found)
    excess, _ = cosmic_rays._excess.__wrapped__(100.0, 10.0, (0, 0), 1e4, 2)
    total = np.zeros((5, 5))
    for n in range(60):
        y, x, charge = (v[found.owner == n] for v in (found.y, found.x, found.charge))
        image = np.zeros((np.ptp(y) + 5, np.ptp(x) + 5))
        image[y - y.min() + 2, x - x.min() + 2] = charge
        for j in range(-2, 3):
            for i in range(-2, 3):
                total[2 + j, 2 + i] += (image * np.roll(image, (-j, -i), (0, 1))).sum() / 60
    # Directions are isotropic: the mean over the symmetries of the square is taken.
    turned = [np.rot90(t, k) for t in (total, total.T) for k in range(4)]
    for level in excess:
        np.testing.assert_allclose(level, np.mean(turned, axis=0), rtol=1e-9)


def test_what_leaves_the_sensor_does_not_come_back_on_the_other_side() -> None:
    """Halves of a sensor of 24 pixels, as wide as tracks are long, get the same charge."""
    effect, rng = make_effect("cosmic_rays", {"rate": 30.0}), np.random.default_rng(652)
    shot = Shot("dark", 0, 1e5)  # 440 tracks
    images = np.array(
        [effect.store(np.zeros((24, 24)), shot, LAYOUT, rng, {}) for _ in range(60)]
    )
    for axis in (1, 2):
        low, high = (part.sum((1, 2)) for part in np.split(images, 2, axis))
        uneven = (high - low) / (high + low)
        error = uneven.std(ddof=1) / np.sqrt(60)
        assert abs(uneven.mean()) < 4 * error and error < 0.01


def test_the_scatter_of_pairs_is_that_of_the_number_of_their_tracks() -> None:
    """Two flats of 40 s and readouts of 5 s: 30 a minute on 256 x 256 pixels."""
    tracks = 2 * 30.0 * (40 + 5) / 60 * ROWS * COLUMNS / 256**2
    effect = make_effect("cosmic_rays", {"rate": 30.0})
    _, single = cosmic_rays._excess(100.0, 10.0, LAYOUT.shape, LAYOUT.clip, LAYOUT.lags)
    found = effect._few(0, cosmic_rays.LEVELS[-1], 40.0, LAYOUT)
    assert found == pytest.approx(single[-1] / np.sqrt(tracks), rel=1e-9) and found > 0.1
