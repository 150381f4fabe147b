"""Raw FITS: sections, overscan, gain and conditions, from files written here."""

from __future__ import annotations

import numpy as np
import pytest
from astropy.io import fits

from bfsensor.errors import RecordingError
from bfsensor.measure.flat_pairs import flat_covariances
from bfsensor.recording.raw.fits_images import read_bias, read_raw

NX, NY, OVER = 60, 50, 16
LEVEL, GAIN = 900.0, 1.5
DATASEC, BIASSEC = "[4:63,1:50]", "[64:79,1:50]"


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
    assert {one.exposure_time for one in found} == {12.5}
    assert found[1].conditions["FILTER"] == "r"
    assert found[0].gain == GAIN and found[0].unit == "electron"
    (second,) = read_raw(path, extensions=["SEG2"], gain={"SEG2": 3.0})
    np.testing.assert_allclose(second.image, 2 * found[1].image)
    unnamed = write_frame(tmp_path / "b.fits", frames, names=["", ""])
    assert [one.name for one in read_raw(unnamed)] == ["image 1", "image 2"]


def test_sections_by_hand(tmp_path):
    path = write_frame(tmp_path / "a.fits", [raw_frame(56)])
    sections = {"left": ("[4:33,1:50]", BIASSEC), "right": ("[34:63,1:50]", BIASSEC)}
    left, right = read_raw(path, sections=sections, gain={"left": 1.0, "right": 2.0})
    (whole,) = read_raw(path, gain=1.0)
    np.testing.assert_allclose(np.hstack([left.image, right.image / 2]), whole.image)


def test_a_bias_instead_of_overscan(tmp_path):
    frames = [raw_frame(60 + k, signal=1e-9, ramp=0.3, noise=2.0) for k in range(4)]
    paths = [
        write_frame(tmp_path / f"bias{k}.fits", [frame], {"GAIN": GAIN})
        for k, frame in enumerate(frames)
    ]
    bias = read_bias(paths, overscan=None)
    np.testing.assert_allclose(bias["image"], np.mean(frames, 0)[:, 3 : 3 + NX])
    flat = write_frame(tmp_path / "flat.fits", [raw_frame(65, ramp=0.3)], {"GAIN": GAIN})
    (found,) = read_raw(flat, overscan=None, bias=bias)
    assert found.image.mean() == pytest.approx(20_000, abs=5)
    assert (found.overscan, found.overscan_pixels) == ("none", 0)
    assert np.isnan(found.overscan_level)


def test_saturation_and_gain_unknown(tmp_path):
    frame = np.rint(raw_frame(66)).astype(np.uint16)
    frame[7, 10], frame[8, 11] = 65535, 50000
    path = write_frame(tmp_path / "a.fits", [frame])
    (found,) = read_raw(path)
    assert found.unit == "adu" and np.isnan(found.gain)
    assert np.argwhere(found.mask).tolist() == [[7, 7]]
    path = write_frame(tmp_path / "b.fits", [frame], {"SATURATE": 40000})
    assert np.argwhere(read_raw(path)[0].mask).tolist() == [[7, 7], [8, 8]]


@pytest.mark.parametrize(
    ("cards", "options", "message"),
    [
        (
            {"BIASSEC": None},
            {},
            "BIASSEC is missing; give sections, or say overscan=None and a bias",
        ),
        (
            {"DATASEC": "[63:4,1:50]"},
            {},
            "DATASEC = '[63:4,1:50]' runs backwards; flip the image and say so yourself",
        ),
        (
            {"DATASEC": "[4:63,1:51]"},
            {},
            "DATASEC = '[4:63,1:51]' leaves the image, 79 x 50 pixels",
        ),
        ({"DATASEC": "4:63"}, {}, "DATASEC = '4:63' is not like '[1:512,1:2000]'"),
        (
            {"BIASSEC": "[64:79,2:50]"},
            {},
            "BIASSEC has the rows 2 to 50, not all of 1 to 50; "
            "overscan='median' needs no rows",
        ),
        ({}, {"skip": 16}, "skip = 16 leaves nothing of BIASSEC"),
        ({"GAIN": -1.0}, {}, "gain = -1 e-/ADU must be above 0"),
        ({}, {"gain": {"C00": 1.0}}, "no gain for it among C00"),
        (
            {},
            {"bias": np.zeros((3, 3))},
            "bias of shape (3, 3) for a data section of (50, 60)",
        ),
    ],
)
def test_refusals(tmp_path, cards, options, message):
    path = write_frame(tmp_path / "a.fits", [raw_frame(67)], cards)
    with pytest.raises(RecordingError) as caught:
        read_raw(path, **options)
    assert str(caught.value) == f"{path}: image: {message}"


def test_refusals_without_a_frame(tmp_path):
    with pytest.raises(RecordingError, match="overscan = 'rows' is not one of row median"):
        read_raw(tmp_path / "none.fits", overscan="rows")
    with pytest.raises(RecordingError, match=r"none\.fits: cannot be read"):
        read_raw(tmp_path / "none.fits")
    (tmp_path / "text.fits").write_text("no FITS")
    with pytest.raises(RecordingError, match=r"text\.fits: cannot be read"):
        read_raw(tmp_path / "text.fits")
    fits.PrimaryHDU(np.zeros((2, 3, 4))).writeto(tmp_path / "cube.fits")
    with pytest.raises(RecordingError, match="holds no two-dimensional image"):
        read_raw(tmp_path / "cube.fits")
    path = write_frame(tmp_path / "a.fits", [raw_frame(67)])
    with pytest.raises(RecordingError, match="no extension 3; it has 0 'PRIMARY'"):
        read_raw(path, extensions=[3])
    with pytest.raises(RecordingError, match="no bias frame was given"):
        read_bias([])
