"""Campaigns with very few recordings: a diagnosis of what they allow, or one clear error."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits

from bfsensor.diagnose.data.reduced_channels import measure_reduced
from bfsensor.diagnose.diagnosis import diagnose, diagnose_measured
from bfsensor.diagnose.model.free_baseline import free_baseline
from bfsensor.diagnose.model.open_baseline import (
    CampaignSource,
    find_baseline,
    find_reduced_recording,
)
from bfsensor.errors import MeasurementError
from bfsensor.recording.campaign.campaign import read_campaign
from tests.measured import measure_once

OFFSET, NOISE, GAIN, SIDE = 200.0, 4.0, 2.0, 160


def write(folder, kinds, *, seed, coupling=0.0):
    """Exposures in order: (kind, seconds, level [e-], temperature)."""
    rng = np.random.default_rng(seed)
    for n, (kind, seconds, level, temperature) in enumerate(kinds):
        electrons = rng.poisson(level, (SIDE, SIDE)).astype(float)
        electrons[:, 1:] += coupling * electrons[:, :-1] - coupling * electrons[:, 1:]
        image = OFFSET + electrons / GAIN + rng.normal(0, NOISE, electrons.shape)
        header = fits.Header(
            {
                "IMGTYPE": kind,
                "EXPTIME": seconds,
                "CCDTEMP": temperature,
                "MJD-OBS": 60000 + n,
            }
        )
        data = np.round(image).astype(np.uint16)
        fits.PrimaryHDU(data, header).writeto(folder / f"{n:03d}.fits")


def run(folder):
    source = CampaignSource(read_campaign(folder))
    return diagnose(source, free_baseline(), explain=False)


def test_one_pair_of_flats_alone(tmp_path):
    """No bias, overscan, lamp or voltage; the cooler's thermostat steps by 0.4 K."""
    flats = [("FLAT", 5.0, 2e4, -5.2), ("FLAT", 5.0, 2e4, -4.8)]
    write(tmp_path, flats, seed=61)
    found = run(tmp_path)
    assert "flat_cov" in found.mismatch.chi2 and not found.mismatch.detected
    assert any("zero level is not known" in n for n in found.notes)
    assert any("fewer than two levels" in n for n in found.notes)
    assert found.location()["lags"] == []


def test_biases_are_the_zero_of_flats_without_overscan(tmp_path):
    write(tmp_path, [("BIAS", 0.0, 0, -5.0)] * 2 + [("FLAT", 5.0, 2e4, -5.0)] * 2, seed=63)
    found = run(tmp_path)
    (mean,) = (c for c in found.measured.channels if c.word == "flat_mean")
    np.testing.assert_allclose(mean.values, 2e4 / GAIN, rtol=1e-3)
    assert found.measured.read_noise[0] == pytest.approx(NOISE, rel=0.05)
    assert not any("zero level" in n for n in found.notes)
    # Without an overscan a bias says nothing of the image's level above it.
    (level,) = (c for c in found.measured.channels if c.word == "bias_level")
    assert set(level.axes["what"]) == {"rows", "usual rows"}


def test_a_coupling_of_pixels_is_found_at_two_levels(tmp_path):
    flats = [("FLAT", t, v, -5.0) for t, v in ((1.0, 4e3), (20.0, 8e4)) for _ in range(2)]
    write(tmp_path, [("BIAS", 0.0, 0, -5.0)] * 2 + flats, seed=65, coupling=0.05)
    found = run(tmp_path)
    assert found.mismatch.detected and [1, 0] in found.location()["lags"]


def test_biases_alone(tmp_path):
    write(tmp_path, [("BIAS", 0.0, 0, -5.0)] * 4, seed=67)
    found = run(tmp_path)
    assert set(found.mismatch.chi2) == {"bias_cov", "bias_level"}
    assert not found.mismatch.detected and found.location()["lags"] == []


def test_masked_pixels_of_one_amplifier_without_detsec_are_left_out(tmp_path):
    """A dark rim, masked: neither the covariances nor the map see it."""
    write(tmp_path, [("BIAS", 0.0, 0, -5.0)] * 2 + [("FLAT", 5.0, 2e4, -5.0)] * 2, seed=71)
    for path in tmp_path.glob("*.fits"):
        with fits.open(path, mode="update") as hdus:
            hdus[0].data[:, :4] = 210
    assert run(tmp_path).mismatch.detected
    (tmp_path / "campaign.yaml").write_text(f"masks: ['[1:4,1:{SIDE}]']\n")
    found = run(tmp_path)
    assert "flat_map" not in found.location()["channels"]
    (cov,) = (c for c in found.measured.channels if c.word == "flat_cov")
    np.testing.assert_allclose(cov.values[0], 2e4 / GAIN**2 + NOISE**2, rtol=0.05)


@pytest.mark.parametrize(
    ("kinds", "message"),
    [
        ([("FLAT", 5.0, 2e4, -5.0), ("FLAT", 5.0, 2.3e4, -5.0)], "make no pair"),
        ([("FLAT", 5.0, 2e4, -5.0), ("FLAT", 6.0, 2e4, -5.0)], "2 flats make no pair of equal"),
        ([("BIAS", 0.0, 0, -5.0)], r"biases 1 \(2 are needed\)"),
        ([("FE55", 0.0, 10, -5.0)] * 2, "no bias, flat, dark or spots among 2 fe55"),
    ],
)  # fmt: skip
def test_nothing_to_say(tmp_path, kinds, message):
    write(tmp_path, kinds, seed=69)
    with pytest.raises(MeasurementError, match=message):
        run(tmp_path)


SBIG = Path(__file__).parents[2].parent / "shared" / "recordings" / "sbig_flats"


@pytest.fixture(scope="module", params=["langford", "bergeson"])
def sbig(request):
    if not SBIG.is_dir():
        pytest.skip(f"no recordings in {SBIG}")
    measured = measure_once(CampaignSource(read_campaign(SBIG / request.param)))
    return request.param, diagnose_measured(measured, free_baseline(), explain=False)


@pytest.mark.slow
def test_sbig_readout_not_brighter_fatter(sbig):
    """The biases' serial lag is -0.032 of the variance; flats' changes its sign with the level."""
    name, found = sbig
    assert {"bias_cov", "bias_level"} <= set(found.location()["channels"])
    (bias,) = (c for c in found.measured.channels if c.word == "bias_cov")
    assert bias.values[1] / bias.values[0] == pytest.approx(-0.032, abs=0.004)
    if name == "langford":
        # Near 19 kADU the neighbour loses: no area that floats may take that.
        assert [1, 0] in found.location()["lags"]
        assert "a10" not in found.fit.pulls
    said = [n for n in found.measured.notes if n.startswith("flats of unlike exposure")]
    assert "not the brighter-fatter effect" in said[0]
    assert "lag (1, 0) changes its sign" in said[1]


@pytest.mark.slow
def test_sbig_unequal_flats_give_means_alone(sbig):
    """One pair each has covariances: of a triple, and of three flats whose first is 13 % off."""
    name, found = sbig
    (cov,) = (c for c in found.measured.channels if c.word == "flat_cov")
    assert len(cov) == 25
    means = [c for c in found.measured.channels if c.word == "flat_mean"]
    exposures = sorted(e for mean in means for e in mean.axes["exposure"].tolist())
    assert len(exposures) == len(set(exposures)) == {"langford": 20, "bergeson": 27}[name]
    assert {5, 6} <= set(exposures)
    low, high = {"langford": (20e3, 26e3), "bergeson": (15e3, 19e3)}[name]
    ordered = sorted(found.measured.unlike, key=lambda p: p.level)
    quiet = max(p.level for p in ordered if not p.rises)
    assert low < min(p.level for p in ordered if p.level > quiet) < high


DATA = Path(__file__).parents[1] / "data"


@pytest.mark.parametrize(
    ("kind", "baseline", "detected"),
    [
        ("itl", "itl_sta3800c_60", False),
        ("itl", "lsst_itl_50_32", False),
        ("e2v", "e2v_ccd250_70", False),
        ("e2v", "e2v_ccd250", True),
        ("e2v", "lsst_e2v_50_32", True),
    ],
)
def test_measured_areas_beside_tables(kind, baseline, detected):
    """With stated errors ours at the measured voltage agree with both sensors; -50 V not with E2V's."""
    path = DATA / f"{kind}_covariances_21oct19.csv"
    predicted = find_baseline(baseline)
    recording = find_reduced_recording(path)
    measured = measure_reduced(recording, reach=predicted.reach)
    found = diagnose_measured(measured, predicted, explain=False, scaled=False)
    assert found.mismatch.detected == detected
    (channel,) = found.fit.channels
    assert len(channel) == 24


def test_errors_of_far_lags_contradict_what_stated_ones_allow():
    """Far lags of the ITL table scatter by a tenth of its errors: scaled, no fixed table fits it."""
    path = DATA / "itl_covariances_21oct19.csv"
    predicted = find_baseline("itl_sta3800c_60")
    measured = measure_reduced(find_reduced_recording(path), reach=predicted.reach)
    found = diagnose_measured(measured, predicted, explain=False)
    assert found.mismatch.detected
    (said,) = (n for n in found.notes if "far lags" in n)
    assert "all errors of the table are multiplied by 0.14" in said
    (stated,) = (n for n in found.notes if n.startswith("with the errors as stated"))
    assert float(stated.split()[-1]) > 0.5


def test_temperatures_are_in_kelvin_from_the_header_on(tmp_path):
    """A mistake of 273 K would change a dark current that doubles in 3 K by a factor of 2e10."""
    write(
        tmp_path, [("BIAS", 0.0, 0, -95.0)] * 2 + [("FLAT", 5.0, 2e4, -95.0)] * 2, seed=73
    )
    campaign = read_campaign(tmp_path)
    assert campaign.exposures[0].temperature == pytest.approx(178.15)
    source = CampaignSource(campaign)
    assert source.exposures[0].temperature == pytest.approx(178.15)
    (flat,) = (c for c in run(tmp_path).measured.channels if c.word == "flat_cov")
    np.testing.assert_allclose(flat.axes["temperature"], 178.15, atol=0.01)
