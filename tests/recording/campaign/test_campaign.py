"""Campaigns: what is kept, set aside and said; twelve broken ones."""

from __future__ import annotations

import gzip
import pickle
import shutil

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table

from bfsensor.errors import RecordingError
from bfsensor.recording.campaign import questions
from bfsensor.recording.campaign.campaign import read_campaign
from bfsensor.recording.campaign.frame_statistics import FrameStatistics, PairStatistics
from bfsensor.recording.campaign.inspection import inspect_campaign
from bfsensor.recording.campaign.level_checks import (
    check_pedestals,
    check_saturation,
    measure_gains,
)
from bfsensor.recording.raw.headers import scan_file
from tests.broken_campaigns import (
    BREAKAGES,
    GAIN,
    LADDER,
    RATE,
    copy_campaign,
    make_campaign,
    measure,
    read_broken,
)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    return make_campaign(tmp_path_factory.mktemp("whole") / "campaign")


@pytest.fixture
def copied(whole, tmp_path):
    return shutil.copytree(whole, tmp_path / "copy")


def edit(path, **cards):
    with fits.open(path, mode="update") as hdus:
        for key, value in cards.items():
            if value is None:
                hdus[0].header.remove(key.replace("_", "-"))
            else:
                hdus[0].header[key.replace("_", "-")] = value


def messages(campaign):
    return [str(one) for one in campaign.warnings]


def test_a_whole_campaign(whole):
    campaign = read_campaign(whole)
    assert campaign.kinds() == {"bias": 10, "dark": 2, "flat": 12}
    assert campaign.set_aside == ()
    assert campaign.warnings == ()
    (condition,) = campaign.conditions()
    assert str(condition) == "620 nm, back bias -60 V, gates -8/4 V, 173.2 K"
    assert campaign.exposure_times(condition) == tuple(sorted(set(LADDER)))
    assert len(campaign.pairs()) == 6
    assert len(campaign.pairs(condition, exposure_time=2.0)) == 2
    flat = campaign.of("flat")[0]
    assert (flat.exposure_time, flat.lamp, flat.wavelength) == (0.5, 100.0, 620.0)
    assert flat.temperature == pytest.approx(173.15)
    assert campaign.of("bias")[0].wavelength is None
    layout = campaign.amplifiers[1]
    assert (layout.shape, layout.serial_overscan, layout.parallel_overscan) == (
        (96, 80), 24, 16,
    )  # fmt: skip
    assert layout.flip_x and not campaign.amplifiers[0].flip_x


def test_pickling(whole):
    campaign = read_campaign(whole)
    assert pickle.loads(pickle.dumps(campaign)) == campaign


def test_the_manifest_is_not_needed(copied):
    with_list = read_campaign(copied)
    (copied / "manifest.ecsv").unlink()
    without = read_campaign(copied)
    assert (with_list.has_manifest, without.has_manifest) == (True, False)
    assert with_list.exposures == without.exposures


def test_pixels_give_levels_gains_and_nothing_to_warn_of(whole):
    campaign = read_campaign(whole)
    found = inspect_campaign(campaign)
    assert found.campaign == campaign
    assert len(found.frames) == 24 * 2 and len(found.pairs) == 6 * 2
    for pair in found.pairs:
        seconds = next(
            e.exposure_time for e in campaign.exposures if e.number == pair.first
        )
        # 2000 ADU/s, less an overscan level good to 0.1 ADU; shot noise of 7680 pixels.
        assert pair.level == pytest.approx(RATE * seconds, abs=2 + 0.02 * RATE**0.5 * 5)
        expected = pair.level / GAIN + 2.5**2
        # sqrt(2 / n) = 1.6 %; the cut at 5 sigma takes 1e-5.
        assert pair.variance == pytest.approx(expected, rel=5 * (2 / pair.pixels) ** 0.5)
    for gain in measure_gains(found.frames, found.pairs).values():
        assert gain == pytest.approx(GAIN, rel=0.05)


@pytest.mark.parametrize("name", BREAKAGES)
def test_broken_campaigns(whole, name):
    row = measure(name, lambda target: shutil.copytree(whole, target))
    assert row["named"], row["said"]
    assert row["unaccounted"] == 0
    kept = {
        "truncated FITS": 23, "swapped DETSEC": 21, "mixed sizes": 22, "missing biases": 14,
        "duplicated exposures": 22, "NaN pixels": 23, "empty folder": 0,
    }  # fmt: skip
    assert row["kept"] == kept.get(name, 24)


@pytest.mark.parametrize("name", BREAKAGES)
def test_whole_campaigns_say_none_of_it(whole, name):
    _, said = read_broken(whole)
    assert not any(BREAKAGES[name][1] in text for text in said)


def test_missing_keywords_name_the_question_once(copied):
    (copied / "manifest.ecsv").unlink()
    for path in copied.glob("flat*"):
        edit(path, MONDIODE=None)
    (one,) = read_campaign(copied).warnings
    assert (one.topic, one.message, one.exposures) == ("missing", "no lamp monitor", ())
    # The keyword that was looked for, and how to state another.
    assert "MONDIODE" in one.closes and "keywords: {lamp: " in one.closes
    for path in sorted(copied.glob("*.fits"))[:2]:
        edit(path, VBB=None)
    (one,) = [w for w in read_campaign(copied).warnings if "back bias" in w.message]
    assert (one.topic, one.exposures) == ("missing", (0, 1))
    assert "2 of 24" in one.message and "(bias_0000.fits, bias_0001.fits)" in one.message
    assert "VBB" in one.closes and "keywords: {back_bias: " in one.closes


def test_a_file_that_contradicts_the_manifest_is_set_aside(copied):
    edit(copied / "flat_0015.fits", EXPTIME=9.0)
    campaign = read_campaign(copied)
    (aside,) = campaign.set_aside
    assert aside.path.name == "flat_0015.fits"
    assert "exposure_time 2 in the manifest, 9 in the header" in aside.reason
    assert [one.path.name for one in campaign.of("flat") if one.pair is None] == [
        "flat_0014.fits"
    ]


def test_pairs_are_not_made_across_a_gap(copied):
    """The second of four equal flats is lost: the first stays alone, 3 and 4 are a pair."""
    (copied / "manifest.ecsv").unlink()
    for number in (14, 15, 16, 17):
        edit(copied / f"flat_00{number}.fits", EXPTIME=2.0)
    (copied / "flat_0015.fits").write_bytes(b"nothing")
    pairs = [(a.number, b.number) for a, b in read_campaign(copied).pairs()]
    assert (16, 17) in pairs and not any({14, 16} <= set(p) for p in pairs)


def test_sums_of_the_manifest_are_held_against_the_files(copied):
    from bfsensor.recording.raw.headers import file_sha256

    table = Table.read(copied / "manifest.ecsv")
    table["sha256"] = [file_sha256(copied / name) for name in table["file"]]
    table.write(copied / "manifest.ecsv", overwrite=True)
    assert read_campaign(copied).set_aside == ()
    with (copied / "flat_0016.fits").open("r+b") as stream:
        stream.seek(-5000, 2)
        stream.write(b"\x00\x07")
    (aside,) = read_campaign(copied).set_aside
    assert "SHA-256" in aside.reason and aside.path.name == "flat_0016.fits"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("schema: other-2", "schema = 'other-2' is not 'bfsensor-campaign-1'"),
        ("[1, 2]", "must be a mapping"),
        ("a: [", "not readable as YAML"),
        ("manifest: list.ecsv", "list.ecsv is not there"),
        ("spots: {grid_px: wide}", "grid_px = 'wide' must be a finite number above 0"),
        ("keywords: {gian: GAIN}", "'gian' is not one of"),
        ("masks: ['[1:9]']", "is not like"),
        ("amplifiers: [{data: '[1:2,1:2]'}]", "must have a name"),
    ],
)
def test_wrong_settings_are_refused(copied, text, words):
    (copied / "campaign.yaml").write_text(text)
    with pytest.raises(RecordingError) as caught:
        read_campaign(copied)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_folders_inside_a_folder_without_files_are_named(copied, tmp_path):
    with pytest.raises(RecordingError, match=r"folders .*: copy$"):
        read_campaign(tmp_path)


def test_settings_are_used(copied):
    (copied / "campaign.yaml").write_text(
        "name: run 3\nexcluded: {flat_0012*: shutter stuck}\nspots: {grid_px: 30}\n"
        "lamp_monitor: {keyword: MONDIODE, relative_error: 1e-4}\ncolour: red\n"
        "keywords: {wavelength: {value: 500}}\nbaseline: itl_sta3800c\n"
    )
    campaign = read_campaign(copied)
    assert (campaign.name, campaign.spot_grid, campaign.lamp_error) == ("run 3", 30.0, 1e-4)
    assert campaign.baseline == "itl_sta3800c"
    assert [str(one) for one in campaign.set_aside] == [
        "flat_0012.fits: excluded: shutter stuck"
    ]
    assert {one.wavelength for one in campaign.of("flat")} == {500.0}
    assert any("colour is not known" in text for text in messages(campaign))


def test_damage_that_headers_do_not_show(copied, tmp_path):
    """A tile-compressed file with wrong bytes inside: found when its pixels are read."""
    path = copied / "flat_0016.fits"
    with fits.open(path) as hdus:
        packed = [hdus[0].copy()]
        packed += [
            fits.CompImageHDU(h.data, h.header, name=h.name, compression_type="GZIP_1")
            for h in hdus[1:]
        ]
        fits.HDUList(packed).writeto(path, overwrite=True)
    content = bytearray(path.read_bytes())
    ((start, length), _) = scan_file(path).spans
    middle = start + length // 2
    content[middle : middle + 2000] = bytes(2000)
    path.write_bytes(content)
    campaign = read_campaign(copied)
    assert campaign.set_aside == ()
    found = inspect_campaign(campaign).campaign
    (aside,) = found.set_aside
    assert aside.path == path and "cannot be read" in aside.reason
    assert len(found.pairs()) == len(campaign.pairs()) - 1


def test_damage_in_rice_compressed_tiles(copied):
    path = copied / "flat_0016.fits"
    with fits.open(path) as hdus:
        packed = [hdus[0].copy()]
        packed += [fits.CompImageHDU(h.data, h.header, name=h.name) for h in hdus[1:]]
        fits.HDUList(packed).writeto(path, overwrite=True)
    content = bytearray(path.read_bytes())
    ((start, length), _) = scan_file(path).spans
    content[start + length // 2 : start + length - 200] = b"\xff" * (length // 2 - 200)
    path.write_bytes(content)
    (aside,) = inspect_campaign(read_campaign(copied)).campaign.set_aside
    assert aside.path == path and "cannot be read: decompression" in aside.reason


def test_gains_that_cannot_be_meant_or_that_differ_are_named(copied):
    for number in range(12, 24):
        edit(copied / f"flat_00{number}.fits", CCDGAIN=0 if number < 20 else 2.0)
    *gains, units = read_campaign(copied).warnings
    for one, name in zip(gains, ("SEGMENT10", "SEGMENT11"), strict=True):
        assert one.topic == "gain" and one.message.startswith(f"{name}: ")
        assert (
            "2.2 in 12 files, none in 8 files, 2 in 4 files; 2.2 e-/ADU is" in one.message
        )
        assert "keywords: {gain: {value: " in one.closes
    assert units.topic == "units" and units.message.startswith("CCDGAIN = 0 ")
    assert "(8 exposures)" in units.message


def test_an_overscan_that_cannot_be_used_is_named(copied):
    """Trimmed images often still have the keyword; the biases give the level."""
    for path in copied.glob("*.fits"):
        with fits.open(path, mode="update") as hdus:
            hdus[2].header["BIASSEC"] = "[200:230,1:112]"
    found = inspect_campaign(read_campaign(copied))
    (one,) = found.campaign.warnings
    assert one.topic == "overscan" and "112 x 112 pixels" in one.message
    assert one.message.startswith("SEGMENT11: BIASSEC = '[200:230,1:112]'")
    assert "amplifiers: [{name: ..., bias: " in one.closes
    one, other = (
        [f.level for f in found.frames if f.amplifier == name]
        for name in ("SEGMENT10", "SEGMENT11")
    )
    # Noise of 2.5 ADU; the median of ten biases' levels is good to 0.05 ADU.
    assert np.allclose(one, other, atol=5 * (2 * 40000 / GAIN / 7680) ** 0.5 + 0.3)


def test_conditions_and_photodiode_in_extensions(tmp_path):
    """As test stands write them: voltages and a current against time in extensions."""
    t = np.linspace(0, 20, 2001)
    # 2 nA for 8 s on 0.1 nA of dark current; the shutter is open for EXPTIME.
    current = -(0.1e-9 + 2e-9 * ((t > 5) & (t <= 13)))
    columns = [
        fits.Column("AMP0_MEAS_TIMES", "D", array=t), fits.Column("AMP0_A_CURRENT", "D", array=current)
    ]  # fmt: skip
    cards = fits.Header({"IMGTYPE": "FLAT", "EXPTIME": 8.0})
    volts = fits.Header({"V_BSS": -70.0, "V_P1H": 3.0, "V_P1L": -8.0})
    fits.HDUList(
        [
            fits.PrimaryHDU(header=cards),
            fits.ImageHDU(np.ones((4, 4), np.uint16), name="SEGMENT10"),
            fits.ImageHDU(header=volts, name="CCD_COND"),
            fits.BinTableHDU.from_columns(columns, name="AMP0.MEAS_TIMES"),
        ]
    ).writeto(tmp_path / "a.fits")
    (one,) = read_campaign(tmp_path).exposures
    assert (one.back_bias, one.gates) == (-70.0, (3.0, -8.0))
    # Two samples of 10 ms at the edges.
    assert one.lamp == pytest.approx(2.0, abs=2 * 0.01 / 8)


@pytest.mark.parametrize("part", [1.0, 0.5])
def test_gzipped_files(whole, tmp_path, part):
    for number in (14, 15):
        content = gzip.compress((whole / f"flat_00{number}.fits").read_bytes())
        size = len(content) if number == 14 else int(part * len(content))
        (tmp_path / f"flat_{number}.fits.gz").write_bytes(content[:size])
    campaign = read_campaign(tmp_path)
    assert len(campaign.exposures) == (2 if part == 1.0 else 1)
    if part < 1:
        assert [one.path.name for one in campaign.set_aside] == ["flat_15.fits.gz"]
    assert inspect_campaign(campaign).campaign.exposures == campaign.exposures


def test_steps_of_lamp_and_pedestal(tmp_path):
    folder = make_campaign(tmp_path / "steps", seed=8412)
    for path in sorted(folder.glob("*.fits"))[18:]:
        with fits.open(path, mode="update") as hdus:
            for hdu in hdus[1:]:
                hdu.data += np.uint16(60)
    with fits.open(folder / "flat_0021.fits", mode="update") as hdus:
        for hdu in hdus[1:]:
            hdu.data[:96, 8:88] = hdu.data[:96, 8:88] // 2
    said = messages(inspect_campaign(read_campaign(folder)).campaign)
    # 2688 overscan pixels of 2.5 ADU each: 0.07 ADU for the difference of two frames.
    steps = [t for t in said if "the overscan steps by" in t and "at flat_0018.fits" in t]
    assert [abs(float(t.split()[5]) - 60) < 0.3 for t in steps] == [True, True]
    assert any(t.startswith("1 pair of unequal levels") for t in said)
    assert any("off by more than 20%" in t and "flat_002" in t for t in said)


def test_a_ladder_that_climbs_with_time(copied):
    """Without the two flats at its end, the level rises with time throughout."""
    (copied / "campaign.yaml").write_text("excluded: [flat_0022.fits, flat_0023.fits]\n")
    (one,) = read_campaign(copied).warnings
    assert one.topic == "time"
    assert "exposure times" in one.message and "nonlinearity" in one.closes


@pytest.mark.parametrize(("fall", "reported"), [(4.5, False), (5.5, True)])
def test_a_variance_that_falls_by_five_errors_is_a_full_well(whole, fall, reported):
    """The error is the scatter of variances of simulated pairs, known to 1 %."""
    rng = np.random.default_rng(31)
    pixels, before, after = 1000, 400.0, 290.0
    noise = rng.standard_normal((2, 4000, pixels)).var(axis=2)
    error = (before * noise[0] - after * noise[1]).std()
    pairs = [
        PairStatistics(0, 1, "C0", 1e4, before, pixels, 0.0),
        PairStatistics(2, 3, "C0", 2e4, before - fall * error, pixels, 0.0),
    ]
    assert bool(check_saturation(read_campaign(whole), [], pairs)) is reported


@pytest.mark.parametrize(("step", "reported"), [(2.5, False), (4.0, True)])
def test_a_pedestal_steps_where_it_moves_by_more_than_three_times_the_noise(
    whole, step, reported
):
    """Twelve overscans of a scatter of 0.02 and a noise of 5 ADU; the second half is higher."""
    campaign, noise = read_campaign(whole), 5.0
    rng = np.random.default_rng(32)
    frames = [
        FrameStatistics(
            exposure=one.number, amplifier="C0", pedestal=pedestal, noise=noise, level=0.0,
            not_finite=0.0, saturated=0.0, top=0.0,
        )
        for one, pedestal in zip(
            campaign.exposures[:12],
            1000 + np.repeat([0.0, step * noise], 6) + 0.02 * rng.standard_normal(12),
            strict=True,
        )
    ]  # fmt: skip
    found = check_pedestals(campaign, frames)
    assert [one.exposures for one in found] == [(frames[6].exposure,)] * reported


def test_as_many_levels_as_asked_for_are_enough(whole, monkeypatch):
    campaign = read_campaign(whole)
    (condition,) = campaign.conditions()
    levels = len(campaign.exposure_times(condition))
    for asked, words in ((levels, []), (levels + 1, [f"pairs at {levels} levels"])):
        monkeypatch.setattr(questions, "LEVELS", asked)
        found = [one.because for one in questions.open_questions(campaign)]
        assert [text for text in found if text.startswith("pairs at")] == words


def test_part_of_a_practice_campaign(tmp_path):
    from tests.recording.campaign.test_amplifiers import PRACTICE

    if not PRACTICE.is_dir():
        pytest.skip(f"no campaign in {PRACTICE}")
    campaign = read_campaign(copy_campaign(PRACTICE, tmp_path / "part"))
    assert campaign.kinds() == {"bias": 10, "dark": 6, "flat": 24}
    assert campaign.set_aside == campaign.warnings == ()
    # A dark lies between the two pairs at 60 s.
    assert [(a.number, b.number) for a, b in campaign.pairs(exposure_time=60.0)] == [
        (28, 29), (31, 32),
    ]  # fmt: skip
