"""``bfsensor check`` as a user runs it."""

import json
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from click.testing import CliRunner

from bfsensor.cli.main import main
from bfsensor.recording.campaign.campaign import read_campaign
from bfsensor.recording.campaign.questions import open_questions
from tests.broken_campaigns import lose_biases, make_campaign, truncate

SHARED = Path(__file__).parents[3] / "shared"


def check(*arguments):
    return CliRunner().invoke(main, ["check", *map(str, arguments)])


@pytest.fixture
def campaign(tmp_path):
    return make_campaign(tmp_path / "run_12")


def test_what_a_campaign_holds(campaign):
    truncate(campaign)
    result = check(campaign)
    assert result.exit_code == 0, result.output
    lines = result.output.splitlines()
    assert lines[0] == (
        "run_12: 23 exposures (10 bias, 2 dark, 11 flat), from manifest and headers"
    )
    assert "5 pairs at 5 levels" in result.output
    assert (
        "2 amplifiers (SEGMENT10 to SEGMENT11): 80 x 96 pixels, prescan 8" in result.output
    )
    at = lines.index("set aside (1):")
    assert lines[at + 1].startswith("  flat_0014.fits: is truncated")
    assert any(line.startswith("left open (") for line in lines)


def test_json_says_the_same(campaign):
    full, quick = check(campaign, "--json"), check(campaign, "--json", "--headers")
    report, headers = json.loads(full.stdout), json.loads(quick.stdout)
    assert report["kinds"] == headers["kinds"] == {"bias": 10, "dark": 2, "flat": 12}
    (flats,) = [row for row in report["conditions"] if row["kind"] == "flat"]
    assert flats["pairs_by_exposure_time"] == {"0.5": 1, "2": 2, "6": 1, "12": 1, "20": 1}
    # 2000 ADU/s at 0.5 to 20 s.
    assert flats["levels_adu"] == pytest.approx([1000, 40000], rel=2e-3)
    (flats,) = [row for row in headers["conditions"] if row["kind"] == "flat"]
    assert "levels_adu" not in flats
    assert report["set_aside"] == [] and report["warnings"] == []


def test_questions_close_when_recordings_answer_them(campaign):
    before = {one.question for one in open_questions(read_campaign(campaign))}
    assert not any("correlated noise" in text or "lamp:" in text for text in before)
    assert any(text.startswith("chromatic effect") for text in before)
    # Two pairs at another wavelength, by the manifest.
    table = Table.read(campaign / "manifest.ecsv")
    table["wavelength"][-2:] = 950.0
    table.write(campaign / "manifest.ecsv", overwrite=True)
    for name in table["file"][-2:]:
        with fits.open(campaign / name, mode="update") as hdus:
            hdus[0].header["MONOWL"] = 950.0
    after = {one.question for one in open_questions(read_campaign(campaign))}
    assert before - after == {"chromatic effect: untested"}
    lose_biases(campaign)
    (noise,) = [
        one for one in open_questions(read_campaign(campaign)) if "noise" in one.question
    ]
    assert (noise.because, noise.take) == ("no biases", "take 10 biases")


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda p: p / "nothing", "no such folder"),
        (lambda p: p, "no FITS files"),
    ],
)
def test_one_clear_line_for_bad_input(tmp_path, make, words):
    result = check(make(tmp_path))
    assert result.exit_code == 1
    assert words in result.output and len(result.output.splitlines()) == 1


def test_a_reduced_recording(tmp_path):
    path = tmp_path / "spots.csv"
    path.write_text("flux,sigma_x,sigma_y\n1e5,1.0,1.1\n2e5,1.1,1.2\n")
    for target in (path, tmp_path):
        result = check(target)
        assert result.exit_code == 0
        assert result.output.startswith("spots.csv: spots, 2 rows")
    assert json.loads(check(path, "--json").stdout)["reduced"][0]["file"] == "spots.csv"


@pytest.mark.parametrize("run", ["bergeson", "langford"])
def test_recordings_of_a_camera_without_keywords(run):
    folder = SHARED / "recordings" / "sbig_flats" / run
    if not folder.is_dir():
        pytest.skip(f"no {folder}")
    result = check(folder, "--json")
    assert result.exit_code == 0, result.output
    report = json.loads(result.stdout)
    assert report["kinds"] == {"bergeson": {"bias": 3, "flat": 27},
                               "langford": {"bias": 5, "flat": 20}}[run]  # fmt: skip
    assert report["set_aside"] == []
    said = [one["message"] for one in report["warnings"]]
    assert "no lamp monitor" in said
    assert any("from their names only" in text for text in said)
    # The illumination changed by 13 % between the first two of bergeson's equal flats.
    assert any("unequal levels" in text for text in said) == (run == "bergeson")


@pytest.mark.parametrize(
    ("own", "primary", "settings", "gain"),
    [
        # As the practice campaigns and LSST's test stands have it.
        ({}, {"CCDGAIN": 2.2}, "", 2.2),
        # A nominal gain for all, a measured one for the amplifier.
        ({"GAIN": 2.1}, {"CCDGAIN": 2.2}, "", 2.1),
        ({"GAIN": 100, "EGAIN": 0.25}, {}, "", 0.25),
        ({"GAIN": True}, {"GAIN": 1.5}, "", 1.5),
        ({"GAIN": "1.6"}, {}, "", 1.6),
        ({"GAIN": 1.5}, {}, "keywords: {gain: {value: 1.7}}", 1.7),
        ({}, {"MINE": 1.8}, "keywords: {gain: MINE}", 1.8),
        ({"GAIN": 1.5}, {}, "amplifiers: [{name: A, gain: 1.9}]", 1.9),
        ({"GAIN": 0}, {}, "", None),
        ({"GAIN": 2e4}, {}, "", None),
        ({"GAIN": "HIGH"}, {}, "", None),
    ],
)
def test_the_gain_that_check_reports_is_the_one_that_measure_applies(
    tmp_path, own, primary, settings, gain
):
    rng = np.random.default_rng(8611)
    sections = {"DATASEC": "[1:40,1:40]", "BIASSEC": "[41:60,1:40]"}
    files = [tmp_path / f"{n}.fits" for n in range(2)]
    for path in files:
        data = np.round(1000 + 2 * rng.standard_normal((40, 60)))
        data[:, :40] += rng.poisson(5000, (40, 40))
        kind = fits.Header({"IMGTYPE": "FLAT", "EXPTIME": 1.0, **primary})
        image = fits.ImageHDU(
            data.astype(np.uint16), fits.Header({**sections, **own}), name="A"
        )
        fits.HDUList([fits.PrimaryHDU(header=kind), image]).writeto(path)
    if settings:
        (tmp_path / "campaign.yaml").write_text(settings)
    (amplifier,) = json.loads(check(tmp_path, "--json").stdout)["amplifiers"]
    assert amplifier["gain"] == gain
    command = ["measure", "flats", *map(str, files), "--lags", "1", "--json"]
    found = json.loads(CliRunner().invoke(main, command).stdout)
    applied = found["summary"]["A gain"]
    assert applied.startswith("not known (" if gain is None else f"{gain} e-/ADU")
    # Shot noise of 1600 pixels and the biases of clipping are far below 1 %.
    assert found["rows"][0]["level"] == pytest.approx(5000 * (gain or 1.0), rel=0.01)
    assert found["rows"][0]["unit"] == ("adu" if gain is None else "electron")


def test_help_shows_an_example():
    assert "bfsensor check recordings/run_12" in check("--help").output
