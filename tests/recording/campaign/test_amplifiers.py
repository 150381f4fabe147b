"""Frames in readout order: sections, flips, masks, and the sensor put together."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits

from bfsensor.errors import RecordingError
from bfsensor.recording.campaign.amplifiers import assemble, read_exposure
from bfsensor.recording.campaign.campaign import read_campaign

PRACTICE = Path(__file__).parents[3].parent / "shared" / "practice" / "practice_a"
NY, NX, PRE, OVER, ROWS = 12, 20, 3, 5, 2
FLIPS = {"A": (0, 0), "B": (1, 0), "C": (0, 1), "D": (1, 1)}


def scene():
    """A sensor whose pixel (x, y) holds 1000 + 100 y + x."""
    y, x = np.mgrid[: 2 * NY, : 2 * NX]
    return 1000 + 100 * y + x


def write_sensor(path, pack=None, floating=False, **cards):
    """Four amplifiers read out from the corners; prescan 1, overscan 2, rows below 3."""
    hdus = [
        fits.PrimaryHDU(header=fits.Header({"IMGTYPE": "FLAT", "EXPTIME": 1.0, **cards}))
    ]
    for name, (right, top) in FLIPS.items():
        frame = np.full((NY + ROWS, PRE + NX + OVER), 3)
        frame[:NY, :PRE], frame[:NY, PRE + NX :] = 1, 2
        part = scene()[NY * top : NY * (top + 1), NX * right : NX * (right + 1)]
        frame[:NY, PRE : PRE + NX] = part[:: -1 if top else 1, :: -1 if right else 1]
        xs = (2 * NX, NX + 1) if right else (1, NX)
        ys = (2 * NY, NY + 1) if top else (1, NY)
        header = fits.Header(
            {
                "DATASEC": f"[{PRE + 1}:{PRE + NX},1:{NY}]",
                "BIASSEC": f"[{PRE + NX + 2}:{PRE + NX + OVER},1:{NY + ROWS}]",
                "DETSEC": f"[{xs[0]}:{xs[1]},{ys[0]}:{ys[1]}]", "CCDGAIN": 1.5,
            }
        )  # fmt: skip
        pixels = frame.astype(np.float32 if floating else np.uint16)
        if pack:
            # Without the level, floats would be quantised.
            options = {"compression_type": pack, "quantize_level": 0.0}
            hdus.append(fits.CompImageHDU(pixels, header, name=name, **options))
        else:
            hdus.append(fits.ImageHDU(pixels, header, name=name))
    fits.HDUList(hdus).writeto(path)


def read_one(folder):
    campaign = read_campaign(folder)
    return read_exposure(campaign, campaign.exposures[0])


@pytest.mark.parametrize(
    ("pack", "floating"),
    [(None, False), ("RICE_1", False), ("GZIP_2", False), (None, True), ("GZIP_2", True)],
)
def test_frames_and_the_sensor(tmp_path, pack, floating):
    write_sensor(tmp_path / "a.fits", pack, floating)
    frames = read_one(tmp_path)
    assert [one.name for one in frames] == list(FLIPS)
    for one in frames:
        assert one.pixels.dtype == np.float32
        assert (one.prescan == 1).all() and one.prescan.shape == (NY, PRE)
        # The first column of the overscan is there though BIASSEC leaves it out.
        assert (one.serial_overscan == 2).all() and one.serial_overscan.shape == (NY, OVER)
        assert (one.parallel_overscan == 3).all()
        assert one.parallel_overscan.shape == (ROWS, NX)
        assert (one.flip_x, one.flip_y) == tuple(map(bool, FLIPS[one.name]))
        assert (one.gain, one.noise, one.bad.sum()) == (1.5, None, 0)
    np.testing.assert_array_equal(assemble(frames), scene())
    # Each corner of the sensor is the first pixel that its amplifier reads.
    corners = [float(one.image[0, 0]) for one in frames]
    assert corners == [float(scene()[y, x]) for y in (0, -1) for x in (0, -1)]


def test_one_image_with_two_amplifiers(tmp_path):
    """Stored as the sensor lies: the right half has its overscan on the left."""
    row = np.r_[1, 1, 10:20, 2, 2, 2, 3, 3, 3, 20:30, 1, 1]
    fits.PrimaryHDU(
        np.tile(row, (6, 1)).astype(np.uint16), fits.Header({"IMGTYPE": "FLAT"})
    ).writeto(tmp_path / "a.fits")
    (tmp_path / "campaign.yaml").write_text(
        "amplifiers:\n"
        "- {name: L, window: '[1:15,1:6]', data: '[3:12,1:6]', bias: '[13:15,1:6]',\n"
        "   detector: '[1:10,1:6]', gain: 2.0, saturation: 19}\n"
        "- {name: R, window: '[16:30,1:6]', data: '[28:19,1:6]', bias: '[16:18,1:6]',\n"
        "   detector: '[20:11,1:6]'}\n"
    )
    left, right = read_one(tmp_path)
    assert left.image[0].tolist() == list(range(10, 20))
    assert right.image[0].tolist() == list(range(29, 19, -1))
    assert set(right.serial_overscan.ravel()) == {3.0} and set(right.prescan.ravel()) == {
        1.0
    }
    assert assemble([left, right])[0].tolist() == list(range(10, 30))
    assert (left.gain, right.gain) == (2.0, None)
    assert left.mask.sum() == 6 and right.mask.sum() == 0


def test_what_is_bad(tmp_path):
    write_sensor(tmp_path / "a.fits")
    with fits.open(tmp_path / "a.fits", mode="update") as hdus:
        hdus["B"].data[2, PRE + 4] = 65535
    (tmp_path / "campaign.yaml").write_text(f"masks: ['[{2 * NX - 1}:{2 * NX},1:{NY}]']\n")
    frames = read_one(tmp_path)
    bad = assemble(frames, {one.name: one.mask for one in frames})
    expected = np.zeros_like(bad)
    expected[:NY, -2:] = 1
    expected[2, 2 * NX - 5] = 1
    np.testing.assert_array_equal(bad, expected)
    (tmp_path / "campaign.yaml").write_text("masks: [mask.fits]\n")
    fits.PrimaryHDU(expected.astype(np.uint8)).writeto(tmp_path.parent / "mask.fits")
    (tmp_path.parent / "mask.fits").rename(tmp_path / "mask.fits")
    (tmp_path / "campaign.yaml").write_text("masks: [mask.fits]\nexcluded: [mask.fits]\n")
    again = read_one(tmp_path)
    np.testing.assert_array_equal(
        assemble(again, {one.name: one.mask for one in again}), expected
    )


def test_not_finite_is_bad(tmp_path):
    write_sensor(tmp_path / "a.fits", floating=True)
    with fits.open(tmp_path / "a.fits", mode="update") as hdus:
        hdus["A"].data[0, PRE] = np.nan
    first, *others = read_one(tmp_path)
    assert first.mask[0, 0] and first.bad.sum() == 1
    assert not any(one.bad.any() for one in others)


def test_a_sensor_cannot_be_put_together(tmp_path):
    write_sensor(tmp_path / "a.fits")
    frames = read_one(tmp_path)
    with pytest.raises(RecordingError, match="overlaps"):
        assemble([*frames, frames[0]])
    with pytest.raises(RecordingError, match=r"A: an image of shape \(3, 3\)"):
        assemble(frames, {one.name: np.zeros((3, 3)) for one in frames})
    with fits.open(tmp_path / "a.fits", mode="update") as hdus:
        del hdus["C"].header["DETSEC"]
    with pytest.raises(RecordingError, match="C: no DETSEC"):
        assemble(read_one(tmp_path))


def test_overlapping_amplifiers_are_named(tmp_path):
    write_sensor(tmp_path / "a.fits")
    with fits.open(tmp_path / "a.fits", mode="update") as hdus:
        hdus["B"].header["DETSEC"] = hdus["A"].header["DETSEC"]
    said = [str(one) for one in read_campaign(tmp_path).warnings]
    assert any(text.startswith("DETSEC of A and B overlap") for text in said)


def test_a_file_that_changed_after_the_campaign_was_read(tmp_path):
    write_sensor(tmp_path / "a.fits")
    campaign = read_campaign(tmp_path)
    fits.PrimaryHDU(np.zeros((5, 5), np.uint16)).writeto(
        tmp_path / "a.fits", overwrite=True
    )
    with pytest.raises(RecordingError, match=r"a\.fits: cannot be read"):
        read_exposure(campaign, campaign.exposures[0])


def test_a_practice_campaign():
    if not PRACTICE.is_dir():
        pytest.skip(f"no campaign in {PRACTICE}")
    campaign = read_campaign(PRACTICE)
    assert campaign.kinds() == {"bias": 14, "dark": 8, "flat": 88, "spot": 42}
    assert len(campaign.pairs()) == 44 and not campaign.set_aside
    frames = read_exposure(campaign, campaign.of("spot")[6])
    sensor = assemble(frames)
    assert sensor.shape == (256, 256)
    # Spots 30 pixels apart on one grid across both amplifiers: the power at that period
    # stands out of the row sums, and its phase is one and the same on both sides.
    columns = sensor.mean(axis=0) - np.median(sensor)
    phase = [
        np.angle((half * np.exp(-2j * np.pi * x / 30)).sum())
        for half, x in zip(np.split(columns[8:248], 2), np.split(np.arange(8, 248), 2), strict=True)
    ]  # fmt: skip
    assert abs(np.angle(np.exp(1j * (phase[0] - phase[1])))) < 0.3
