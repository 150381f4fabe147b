"""Raw FITS: sections, overscan, gain and saturation, from files written here."""

from __future__ import annotations

import numpy as np
import pytest
from astropy.io import fits

from bfsensor.errors import RecordingError
from bfsensor.measure.flat_pairs import flat_covariances
from bfsensor.recording.raw.headers import scan_file
from bfsensor.recording.raw.images import read_images
from bfsensor.recording.raw.overscan import find_overscan
from bfsensor.recording.raw.sections import layout_of, overlaps

NX, NY, OVER = 60, 50, 16
LEVEL, GAIN = 900.0, 1.5
DATASEC, BIASSEC = "[4:63,1:50]", "[64:79,1:50]"


def read_raw(path, amplifiers=None, **options):
    return read_images(scan_file(path, amplifiers=amplifiers), **options)


def raw_frame(seed, *, noise=0.0, ramp=0.0, signal=20_000.0):
    """ADU: prescan of three columns, data, overscan; a pedestal that drifts with the row."""
    rng = np.random.default_rng(seed)
    frame = np.full((NY, 3 + NX + OVER), LEVEL) + ramp * np.arange(NY)[:, None]
    frame[:, 3 : 3 + NX] += rng.poisson(signal, (NY, NX)) / GAIN
    # Charge left behind comes out in the first overscan column.
    frame[:, 3 + NX] += 40.0
    return frame + noise * rng.standard_normal(frame.shape)


def write_frame(path, frames, cards=None, primary=None, names=None):
    """One image, or an extension for each of several."""
    header = {"DATASEC": DATASEC, "BIASSEC": BIASSEC, **(cards or {})}
    header = fits.Header({k: v for k, v in header.items() if v is not None})
    if len(frames) == 1 and names is None:
        fits.PrimaryHDU(frames[0], header).writeto(path)
        return path
    hdus = [fits.PrimaryHDU(header=fits.Header(primary or {}))]
    hdus += [
        fits.ImageHDU(frame, header, name=name)
        for frame, name in zip(frames, names or [""] * len(frames), strict=True)
    ]
    fits.HDUList(hdus).writeto(path)
    return path


@pytest.mark.parametrize("method", ["row median", "row mean"])
def test_rows_lose_their_own_pedestal(tmp_path, method):
    path = write_frame(tmp_path / "a.fits", [raw_frame(51, ramp=0.7)])
    (found,) = read_raw(path, gain=GAIN, overscan=method)
    assert found.image.shape == (NY, NX)
    assert (found.unit, found.gain, found.overscan) == ("electron", GAIN, method)
    assert found.overscan_pixels == OVER - 2
    np.testing.assert_allclose(
        found.image, (raw_frame(51)[:, 3 : 3 + NX] - LEVEL) * GAIN, atol=1e-8
    )
    # One number for the frame leaves the ramp of 0.7 ADU a row in it.
    (flat,) = read_raw(path, gain=GAIN, overscan="median")
    slope = np.polyfit(np.arange(NY), (flat.image - found.image).mean(1), 1)[0]
    assert slope == pytest.approx(0.7 * GAIN, rel=1e-6)


def test_the_first_overscan_columns_are_left_out(tmp_path):
    path = write_frame(tmp_path / "a.fits", [raw_frame(52)])
    means = [
        read_raw(path, gain=1.0, overscan="row mean", skip=skip)[0].image.mean()
        for skip in (0, 1)
    ]
    # 40 ADU in one of 16 columns.
    assert means[1] - means[0] == pytest.approx(40 / 16)


def test_noise_of_the_overscan(tmp_path):
    noise = 5.0
    path = write_frame(tmp_path / "a.fits", [raw_frame(53, noise=noise, ramp=0.7)])
    (found,) = read_raw(path, gain=GAIN)
    # 700 pixels: a MAD's error is 1.17 / sqrt(2 n) = 3 %; the rows' medians take 1 / 14.
    assert found.overscan_noise == pytest.approx(noise * GAIN, rel=0.09 + 0.07)
    assert found.overscan_level == pytest.approx(LEVEL + 0.7 * (NY - 1) / 2, abs=2.0)


@pytest.mark.parametrize(
    ("method", "factor"), [("row mean", 1.0), ("row median", np.pi / 2)]
)
def test_row_levels_correlate_pixels_as_stated(tmp_path, method, factor):
    """Noise 5 ADU, 14 pixels: 25 / 14 ADU^2 at every lag in x, pi / 2 of it for medians."""
    noise, found = 5.0, []
    for k in range(40):
        images = []
        for seed in (2 * k, 2 * k + 1):
            path = tmp_path / f"{seed}.fits"
            write_frame(path, [raw_frame(7000 + seed, noise=noise, signal=2000.0)])
            images.append(read_raw(path, overscan=method)[0].image)
        c = flat_covariances(*images, lags=3, unit="adu", clip=np.inf, box=None)
        found.append(c.covariances)
    mean, error = np.mean(found, 0), np.std(found, axis=0, ddof=1) / np.sqrt(len(found))
    # A median of 14 normals has 0.96 of the large-sample pi / 2 (order statistics).
    expected = factor * noise**2 / 14
    assert mean[0, 1:].mean() == pytest.approx(
        expected, abs=4 * error[0, 1:].max() / 3**0.5 + 0.05 * expected
    )
    assert abs(mean[1:, 1:].mean()) < 4 * error[1:, 1:].max() / 3


def test_each_extension_is_an_amplifier(tmp_path):
    frames = [raw_frame(54), raw_frame(55)]
    path = write_frame(
        tmp_path / "a.fits", frames, {"GAIN": GAIN}, names=["SEG1", "SEG2"],
        primary={"EXPTIME": 12.5, "FILTER": "r", "CCDTEMP": -100.0},
    )  # fmt: skip
    found = read_raw(path)
    assert [one.name for one in found] == ["SEG1", "SEG2"]
    assert found[0].gain == GAIN and found[0].unit == "electron"
    (second,) = read_raw(path, [{"name": "SEG2", "gain": 3.0}])
    np.testing.assert_allclose(second.image, 2 * found[1].image)
    unnamed = write_frame(tmp_path / "b.fits", frames, names=["", ""])
    assert [one.name for one in read_raw(unnamed)] == ["image 1", "image 2"]


def test_sections_by_hand(tmp_path):
    path = write_frame(tmp_path / "a.fits", [raw_frame(56)])
    left, right = read_raw(
        path,
        [
            {"name": "left", "data": "[4:33,1:50]", "bias": BIASSEC, "gain": 1.0},
            {"name": "right", "data": "[34:63,1:50]", "bias": BIASSEC, "gain": 2.0},
        ],
    )
    (whole,) = read_raw(path, gain=1.0)
    np.testing.assert_allclose(np.hstack([left.image, right.image / 2]), whole.image)


def test_sections_of_the_primary_header_are_those_of_all_extensions(tmp_path):
    """But for the place on the sensor, which is each amplifier's own."""
    frames = [raw_frame(57), raw_frame(58)]
    sections = {"DATASEC": DATASEC, "BIASSEC": BIASSEC}
    path = write_frame(
        tmp_path / "a.fits", frames, {"DATASEC": None, "BIASSEC": None},
        primary={**sections, "DETSEC": "[1:60,1:50]"}, names=["A", "B"],
    )  # fmt: skip
    own = write_frame(tmp_path / "b.fits", frames, names=["A", "B"])
    for one, other in zip(read_raw(path), read_raw(own), strict=True):
        np.testing.assert_array_equal(one.image, other.image)
    assert {one.origin for one in scan_file(path).amplifiers} == {None}


def test_a_reversed_data_section_is_read_in_the_order_of_readout(tmp_path):
    """The same amplifier stored forwards and backwards gives the same image."""
    frame = raw_frame(59, ramp=0.7)
    (forwards,) = read_raw(write_frame(tmp_path / "a.fits", [frame]))
    cards = {"DATASEC": "[76:17,50:1]", "BIASSEC": "[1:16,1:50]"}
    (backwards,) = read_raw(write_frame(tmp_path / "b.fits", [frame[::-1, ::-1]], cards))
    np.testing.assert_array_equal(backwards.image, forwards.image)


def test_columns_after_the_image_are_overscan_without_biassec(tmp_path):
    """A blank BIASSEC counts as none."""
    (named,) = read_raw(write_frame(tmp_path / "a.fits", [raw_frame(61)]))
    for number, cards in enumerate(({"BIASSEC": None}, {"BIASSEC": " "})):
        path = write_frame(tmp_path / f"{number}.fits", [raw_frame(61)], cards)
        np.testing.assert_array_equal(read_raw(path)[0].image, named.image)


@pytest.mark.parametrize(
    ("bias", "columns"),
    [
        ("[64:79,1:50]", (65, 79)),
        ("[65:79,1:50]", (65, 79)),  # the header leaves the first column out already
        ("[70:79,1:50]", (69, 79)),
        ("[1:3,1:50]", (0, 1)),  # before the image
        ("[4:63,41:50]", (3, 63)),  # above it: no column is next to it
    ],
)
def test_overscan_columns_next_to_the_image_are_left_out(bias, columns):
    rows = "1:40" if "41" in bias else "1:50"
    cards = {"DATASEC": f"[4:63,{rows}]", "BIASSEC": bias}
    found = find_overscan(layout_of("x", "A", 0, (50, 79), cards))
    assert found is not None and (found[1].start, found[1].stop) == columns


def test_an_overscan_above_the_image_has_one_level_only(tmp_path):
    frame = raw_frame(62)
    frame[40:, 3:63] = LEVEL
    cards = {"DATASEC": "[4:63,1:40]", "BIASSEC": "[4:63,41:50]"}
    path = write_frame(tmp_path / "a.fits", [frame], cards)
    (found,) = read_raw(path, overscan="median")
    np.testing.assert_array_equal(found.image, frame[:40, 3:63] - LEVEL)
    with pytest.raises(RecordingError, match="BIASSEC has the rows 41 to 50, not all of 1"):
        read_raw(path)


def test_saturation_and_gain_unknown(tmp_path):
    frame = np.rint(raw_frame(66)).astype(np.uint16)
    frame[7, 10], frame[8, 11] = 65535, 50000
    path = write_frame(tmp_path / "a.fits", [frame])
    (found,) = read_raw(path)
    assert found.unit == "adu" and np.isnan(found.gain)
    assert np.argwhere(found.mask).tolist() == [[7, 7]]
    path = write_frame(tmp_path / "b.fits", [frame], {"SATURATE": 40000})
    assert np.argwhere(read_raw(path)[0].mask).tolist() == [[7, 7], [8, 8]]
    masks = {"image": np.eye(NY, NX, dtype=bool)}
    found = read_images(scan_file(path), masks=masks)[0].mask
    np.testing.assert_array_equal(found, masks["image"])  # 7, 7 and 8, 8 are among them
    found = read_images(scan_file(path), masks={"image": ~masks["image"]})[0].mask
    assert found.sum() == NY * NX - NY + 2


@pytest.mark.parametrize(
    ("cards", "words"),
    [
        ({}, "no gain in the header"),
        ({"GAIN": -1.0}, "GAIN = -1.0"),
        ({"GAIN": "HIGH"}, "GAIN = 'HIGH'"),
    ],
)
def test_an_image_without_a_gain_says_why(tmp_path, cards, words):
    path = write_frame(tmp_path / "a.fits", [raw_frame(66)], cards)
    (found,) = read_raw(path)
    assert found.unit == "adu" and np.isnan(found.gain)
    assert found.no_gain.startswith(words)
    (given,) = read_raw(path, gain=2.0)
    assert (given.unit, given.no_gain, given.gain) == ("electron", "", 2.0)
    np.testing.assert_array_equal(given.image, 2 * found.image)


@pytest.mark.parametrize(
    ("cards", "options", "words"),
    [
        (
            {"DATASEC": None, "BIASSEC": None},
            {},
            ("BIASSEC", "campaign.yaml", "--sections", "--overscan none"),
        ),
        ({"DATASEC": "[4:63,1:51]"}, {}, ("DATASEC = '[4:63,1:51]'", "79 x 50 pixels")),
        ({"DATASEC": "4:63"}, {}, ("DATASEC = '4:63'", "'[1:512,1:2000]'")),
        ({"BIASSEC": "[64:79,2:50]"}, {}, ("2 to 50", "1 to 50", "'median'")),
        ({}, {"skip": 16}, ("skip = 16",)),
    ],
)
def test_refusals(tmp_path, cards, options, words):
    path = write_frame(tmp_path / "a.fits", [raw_frame(67)], cards)
    with pytest.raises(RecordingError) as caught:
        read_raw(path, **options)
    message = str(caught.value)
    assert message.startswith(f"{path}: image: ")
    assert [word for word in words if word not in message] == []


def test_refusals_without_a_frame(tmp_path):
    with pytest.raises(RecordingError, match=r"none\.fits: cannot be read"):
        read_raw(tmp_path / "none.fits")
    (tmp_path / "text.fits").write_text("no FITS")
    with pytest.raises(RecordingError, match=r"text\.fits: cannot be read"):
        read_raw(tmp_path / "text.fits")
    fits.PrimaryHDU(np.zeros((2, 3, 4))).writeto(tmp_path / "cube.fits")
    with pytest.raises(RecordingError, match="holds a cube of 2 images of 4 x 3 pixels"):
        read_raw(tmp_path / "cube.fits")
    path = write_frame(tmp_path / "a.fits", [raw_frame(67)])
    with pytest.raises(RecordingError, match=r"a\.fits: A: no image in HDU 3 .*: 0$"):
        read_raw(path, [{"name": "A", "hdu": 3}])
    with pytest.raises(RecordingError, match="overscan = 'rows' is not one of row median"):
        read_raw(path, overscan="rows")
    for gain in (float("nan"), 0.0, float("inf")):
        with pytest.raises(
            RecordingError, match=f"gain = {gain:g} e-/ADU must be from 0.0001"
        ):
            read_raw(path, gain=gain)


def test_amplifiers_overlap_where_they_share_a_pixel():
    """Windows of a sensor drawn at random, beside, above and across each other; pixel by pixel."""
    rng = np.random.default_rng(47)
    layouts, covered = [], np.zeros((30, 12, 12), bool)
    for n, pixels in enumerate(covered):
        x, y = rng.integers(0, 8, 2)
        nx, ny = rng.integers(1, 5, 2)
        pixels[y : y + ny, x : x + nx] = True
        section = f"[{x + 1}:{x + nx},{y + 1}:{y + ny}]"
        layouts.append(layout_of("x", f"{n}", 1, (ny, nx), {"DETSEC": section}))
    shared = {
        (f"{a}", f"{b}")
        for a in range(30) for b in range(a + 1, 30) if (covered[a] & covered[b]).any()
    }  # fmt: skip
    assert set(overlaps(layouts)) == shared and 20 < len(shared) < 400
