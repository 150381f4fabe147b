"""``bfsensor correct`` as a user runs it: raw files, LSST's exposures, many files, stars."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from click.testing import CliRunner

from bfsensor import DistortionTable
from bfsensor.cli import correct as command
from bfsensor.cli.main import main
from bfsensor.measure.correct import correct_edges
from bfsensor.sensor.corrected_files import (
    Correction,
    FileOptions,
    band_wavelengths,
    read_parts,
)
from bfsensor.sensor.table_correction import correct_table
from bfsensor.sensor.weight_maps import corrected_variance
from bfsensor.table.quadrant_shifts import quadrant_shifts

NAME = "itl_sta3800c"
ITL = DistortionTable.load(NAME)


def scene(ny=60, nx=48, seed=4, peak=8e4, sky=200.0):
    """Stars of several peaks, two of them on the border of the amplifiers."""
    rng = np.random.default_rng(seed)
    y, x = np.indices((ny, nx))
    image = np.full((ny, nx), sky)
    for at_y, at_x, part in ((20, 24, 1.0), (41, 23.5, 0.6), (12, 10, 0.3), (45, 38, 0.8)):
        at = at_y + rng.uniform(-0.4, 0.4), at_x + rng.uniform(-0.4, 0.4)
        image += part * peak * np.exp(-0.5 * ((y - at[0]) ** 2 + (x - at[1]) ** 2) / 1.3**2)
    return image


def run(*args):
    return CliRunner().invoke(main, ["correct", *map(str, args)])


def electrons(path, image, **cards):
    header = fits.Header({"BUNIT": "electron", **cards})
    fits.PrimaryHDU(image.astype(np.float32), header).writeto(path)
    return path


def raw(path, image, gains=(2.0, 1.6), width=20):
    """Two amplifiers that are read towards each other's far sides, with overscan, as integers."""
    ny, nx = image.shape
    half = nx // 2
    hdus = [fits.PrimaryHDU(header=fits.Header({"IMGTYPE": "object"}))]
    for n, gain in enumerate(gains):
        part = image[:, n * half : (n + 1) * half]
        part = part[:, ::-1] if n else part
        level = 1000.0 + 3 * np.arange(ny)[:, None] + 100 * n
        adu = np.concatenate([part / gain + level, np.repeat(level, width, 1)], axis=1)
        hdu = fits.ImageHDU(np.rint(adu).astype(np.uint16), name=f"amp{n}")
        hdu.header["DATASEC"] = f"[1:{half},1:{ny}]"
        hdu.header["BIASSEC"] = f"[{half + 1}:{half + width},1:{ny}]"
        ends = (nx, half + 1) if n else (1, half)
        hdu.header["DETSEC"] = f"[{ends[0]}:{ends[1]},1:{ny}]"
        hdu.header["GAIN"] = gain
        hdus.append(hdu)
    hdus.append(fits.BinTableHDU(Table({"a": [1, 2]}), name="notes"))
    fits.HDUList(hdus).writeto(path)
    return path


def test_an_image_in_electrons(tmp_path):
    image = scene().astype(np.float32)
    path = electrons(tmp_path / "in.fits", image, OBJECT="stars")
    out = tmp_path / "out.fits"
    result = run(path, "--table", NAME, "--band", "r", "--sky", 500, "-o", out)
    assert result.exit_code == 0, result.output
    with fits.open(out) as hdus:
        found, header = hdus[0].data, hdus[0].header
    expected = correct_table(image + 500.0, ITL, wavelengths=band_wavelengths("r")) - 500
    np.testing.assert_allclose(found, expected, rtol=3e-7, atol=3e-3)
    assert np.abs(found - image).max() > 500
    assert header["OBJECT"] == "stars" and header["BUNIT"] == "electron"
    assert (header["BFCORR"], header["BFTABLE"], header["BFSKY"]) == ("table", NAME, 500.0)
    assert header["BFWAVEL"] == pytest.approx(621.5)
    assert "bfsensor" in str(header["HISTORY"])
    assert not list(tmp_path.glob("*.unfinished"))
    again = run(out, "--table", NAME, "-o", tmp_path / "twice.fits")
    assert (
        again.exit_code == 1
        and "was corrected for the brighter-fatter effect" in again.output
    )


def test_amplifiers_are_corrected_as_one_sensor(tmp_path):
    """Raw files: gains by amplifier, overscan, readout towards both sides, other extensions kept."""
    image = scene()
    path, out = raw(tmp_path / "raw.fits", image), tmp_path / "out.fits"
    result = run(path, "--table", NAME, "-o", out, "--json")
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["files"][0]["pixels"] == image.size
    expected = correct_table(image, ITL)
    with fits.open(path) as before, fits.open(out) as after:
        assert [h.name for h in after] == [h.name for h in before]
        assert after["notes"].data["a"].tolist() == [1, 2]
        assert (
            after[1].data.shape == before[1].data.shape and after[1].header["GAIN"] == 2.0
        )
        left, right = 2.0 * after[1].data[:, :24], 1.6 * after[2].data[:, 23::-1]
        np.testing.assert_allclose(after[1].data[:, 24:].mean(), 0, atol=1)
        assert before[0].header["IMGTYPE"] == "object" and "BFCORR" in after[0].header
    # Whole ADU: half an electron and its correction.
    found = np.concatenate([left, right], axis=1)
    np.testing.assert_allclose(found, expected, atol=2.0)
    assert np.abs(found - image)[:, 22:26].max() > 500


def test_what_is_saturated_in_the_file_is_masked(tmp_path):
    image = scene()
    image[30, 20] = 4e5
    (part,) = read_parts(
        raw(tmp_path / "raw.fits", np.minimum(image, 64e3 * 2)), FileOptions()
    )
    assert part.mask[30, 20] == (part.image[30, 20] >= 65535 * 2) == np.False_
    (part,) = read_parts(
        raw(tmp_path / "full.fits", np.minimum(image, 64534 * 2 - 180)), FileOptions()
    )
    assert not part.mask.any()
    mask = np.zeros(image.shape, np.uint8)
    mask[30, 20] = 1
    fits.writeto(tmp_path / "bad.fits", mask)
    out = tmp_path / "out.fits"
    path = electrons(tmp_path / "in.fits", np.minimum(image, 1.5e5))
    result = run(
        path, "--table", NAME, "--mask", tmp_path / "bad.fits", "-o", out, "--json"
    )
    assert json.loads(result.stdout)["files"][0]["masked"] == 1
    expected = correct_table(np.minimum(image, 1.5e5), ITL, mask=mask)
    np.testing.assert_allclose(fits.getdata(out), expected, rtol=1e-6, atol=0.02)


def test_exposures_of_lsst(tmp_path):
    """Image, mask and variance: the planes of the mask count, the other extensions stay."""
    image = scene()
    bits = np.zeros(image.shape, np.int32)
    bits[30, 20], bits[31, 20], bits[5, 5] = 1 << 3, 1 << 1, 1 << 5
    planes = {"MP_SAT": 1, "MP_CR": 3, "HIERARCH MP_DETECTED": 5}
    hdus = fits.HDUList([
        fits.PrimaryHDU(),
        fits.ImageHDU(image.astype(np.float32), fits.Header({"BUNIT": "electron"}), name="IMAGE"),
        fits.ImageHDU(bits, fits.Header(planes), name="MASK"),
        fits.ImageHDU(image.astype(np.float32), name="VARIANCE"),
    ])  # fmt: skip
    path, out = tmp_path / "exposure.fits", tmp_path / "out.fits"
    hdus.writeto(path)
    result = run(path, "--table", NAME, "-o", out, "--json")
    assert json.loads(result.stdout)["files"][0]["masked"] == 2
    expected = correct_table(image, ITL, mask=(bits & 0b1010) > 0)
    with fits.open(out) as after:
        np.testing.assert_allclose(after["IMAGE"].data, expected, rtol=1e-6, atol=0.02)
        np.testing.assert_array_equal(after["MASK"].data, bits)


def test_kernels_and_edges_of_one_level(tmp_path):
    image = scene()
    image[50, 5] = np.nan
    path = electrons(tmp_path / "in.fits", image)
    found = {}
    for kind in ("kernel", "edges"):
        out = tmp_path / f"{kind}.fits"
        result = run(path, "--table", NAME, "--with", kind, "--level", 2e4, "-o", out)
        assert result.exit_code == 0, result.output
        found[kind] = fits.getdata(out)
        assert fits.getheader(out)["BFLEVEL"] == 2e4
        assert np.isnan(found[kind]).sum() == 1
    clean = np.where(np.isnan(image), np.nanmedian(image), image)
    shifts = quadrant_shifts(ITL, background=2e4, tail_slope=None)
    np.testing.assert_allclose(
        found["edges"][:40], correct_edges(clean, *shifts)[:40], rtol=1e-6, atol=0.02
    )
    assert np.nanmax(np.abs(found["kernel"] - found["edges"])) > 20


def test_light_of_a_file(tmp_path):
    path = electrons(tmp_path / "in.fits", scene())
    light = tmp_path / "light.csv"
    light.write_text("wavelength,photons\n950,2\n1000,1\n")
    result = run(path, "--table", NAME, "--light", light, "-o", tmp_path / "out.fits")
    assert result.exit_code == 0, result.output
    expected = correct_table(
        scene().astype(np.float32), ITL, wavelengths=[950, 1000], photons=[2, 1]
    )
    np.testing.assert_allclose(fits.getdata(tmp_path / "out.fits"), expected, rtol=1e-6)
    light.write_text("nm,photons\n950,2\n")
    result = run(path, "--table", NAME, "--light", light, "-o", tmp_path / "no.fits")
    assert result.exit_code == 1 and "columns wavelength [nm] and photons" in result.output


def test_many_files_go_on_after_an_interruption(tmp_path, monkeypatch):
    files = [electrons(tmp_path / f"in_{n}.fits", scene(seed=n)) for n in range(3)]
    out = tmp_path / "corrected"
    arguments = (*files, "--table", NAME, "-o", out, "--workers", 1)
    work, done = command._correct, []

    def interrupted(task):
        if len(done) == 2:
            raise KeyboardInterrupt
        done.append(task.path)
        return work(task)

    monkeypatch.setattr(command, "_correct", interrupted)
    assert run(*arguments).exit_code == 130
    assert len(list(out.glob("*.fits"))) == 2
    # Killed before the second was put in its place.
    note = next(p for p in (tmp_path / "corrected.unfinished").glob("*.json")
                if json.loads(p.read_text())["name"] == "in_1.fits")  # fmt: skip
    (out / "in_1.fits").rename(note.with_suffix(".fits"))
    first = (out / "in_0.fits").read_bytes()
    done.clear()
    result = run(*arguments)
    assert result.exit_code == 0, result.output
    monkeypatch.undo()
    assert done == [str(files[2])] and len(list(out.iterdir())) == 3
    assert (out / "in_0.fits").read_bytes() == first
    assert not list(tmp_path.glob("*.unfinished"))
    again = run(*arguments)
    assert again.exit_code == 1 and "in_0.fits exists; give --overwrite" in again.output
    assert run(*arguments, "--overwrite").exit_code == 0


def test_stars_are_measured_before_and_after(tmp_path):
    """Stars that a linear effect widened; the figure is drawn."""
    rng = np.random.default_rng(31)
    y, x = np.indices((240, 240))
    files = []
    for n in range(2):
        image = np.full((240, 240), 100.0)
        for k, peak in enumerate(np.linspace(1e4, 1.1e5, 16)):
            at = 30 + 60 * (k // 4) + rng.uniform(-0.5, 0.5, 1), 30 + 60 * (k % 4)
            image += peak * np.exp(
                -0.5 * ((y - at[0]) ** 2 + (x - at[1]) ** 2) / (1.5 + n) ** 2
            )
        # What the sensor adds, to first order: the opposite of what the correction takes.
        image = 2 * image - correct_table(image, ITL)
        files.append(electrons(tmp_path / f"stars_{n}.fits", rng.normal(image, 5.0)))
    arguments = (*files, "--table", NAME, "-o", tmp_path / "out", "--measure", 5000)
    result = run(*arguments, "--plot", tmp_path / "stars.png", "--json", "--workers", 1)
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    before, after = found["before"], found["after"]
    # Noise and places within pixels put a few off the lines.
    assert 26 <= before["stars"] == after["stars"] <= 32
    assert 0.7 < before["x"] < 1.3 and 0.7 < before["y"] < 1.5
    for axis in "xy":
        assert abs(after[axis]) < 0.04 * before[axis] + 4 * after[f"{axis}_error"]
        assert after[f"{axis}_error"] < 0.05
    assert (tmp_path / "stars.png").stat().st_size > 10_000
    text = run(*arguments, "--overwrite", "--workers", 1).output
    assert f"before: {before['stars']} stars grow by +" in text and "after:" in text


def test_wrong_use_is_refused(tmp_path):
    path = electrons(tmp_path / "in.fits", scene())
    counts = tmp_path / "counts.fits"
    fits.writeto(counts, scene().astype(np.float32))
    (tmp_path / "other").mkdir()
    same = electrons(tmp_path / "other" / "in.fits", scene())
    out = tmp_path / "out.fits"
    for arguments, status, message in (
        ((path, "--table", NAME), 2, "Missing option '-o'"),
        ((path, "--table", "no_device", "-o", out), 1, "neither a built-in table"),
        ((counts, "--table", NAME, "-o", out), 1, "image: no gain in the header, and a correc"),
        ((path, "--table", NAME, "-o", path), 1, "the output is the file itself"),
        ((path, same, "--table", NAME, "-o", tmp_path / "new"), 1, "2 of the files have this name"),
        ((path, counts, "--table", NAME, "-o", path), 1, "is a file, and 2 files need a folder"),
        ((path, "--table", NAME, "-o", out, "--plot", "a.png"), 2, "--plot: only with --measure"),
        ((path, "--table", NAME, "-o", out, "--measure", 1e9), 1, "no star in any file"),
        ((path, "--table", NAME, "-o", out, "--sky", "nan"), 1, "sky = nan e- must be finite"),
        ((path, "--table", NAME, "-o", tmp_path / "no" / "out.fits"), 1, "no is not a folder"),
    ):  # fmt: skip
        result = run(*arguments)
        assert result.exit_code == status and message in result.output, result.output
    with pytest.raises(Exception, match=r"band = 'w' must be one of u, g, r"):
        band_wavelengths("w")
    with pytest.raises(Exception, match=r"kind = 'magic' must be one of table, kernel"):
        Correction(NAME, "magic").check()
    assert Path(path).exists()


def test_variances_of_an_image(tmp_path):
    image = scene().astype(np.float32)
    path = electrons(tmp_path / "in.fits", image)
    mask = np.zeros(image.shape, np.uint8)
    mask[3, 4] = 1
    fits.PrimaryHDU(mask).writeto(tmp_path / "mask.fits")
    out = tmp_path / "out.fits"
    words = (
        "--table",
        NAME,
        "--sky",
        500,
        "--variance",
        6.0,
        "--mask",
        tmp_path / "mask.fits",
    )
    result = run(path, *words, "-o", out)
    assert result.exit_code == 0, result.output
    with fits.open(out) as hdus:
        assert [hdu.name for hdu in hdus] == ["PRIMARY", "VARIANCE"]
        assert hdus["VARIANCE"].header["BUNIT"] == "electron**2"
        assert hdus[0].header["BFNOISE"] == 6.0
        found, variance = hdus[0].data, hdus["VARIANCE"].data
    assert np.isinf(variance[3, 4])
    known = corrected_variance(found + 500.0, ITL, read_noise=6.0)
    good = mask == 0
    assert variance[good] == pytest.approx(known[good], rel=1e-6)
    # The read noise of the brightest pixel is amplified by more than a tenth.
    assert variance.flat[found.argmax()] > found.max() + 500 + 1.1 * 36


def test_variances_of_amplifiers_are_in_their_unit_and_order(tmp_path):
    path = raw(tmp_path / "raw.fits", scene())
    out = tmp_path / "out.fits"
    assert run(path, "--table", NAME, "--variance", 5.0, "-o", out).exit_code == 0
    with fits.open(out) as hdus:
        names = [hdu.name for hdu in hdus]
        assert names == [
            "PRIMARY",
            "AMP0",
            "AMP1",
            "NOTES",
            "VARIANCE_AMP0",
            "VARIANCE_AMP1",
        ]
        for n, gain in enumerate((2.0, 1.6)):
            light = gain * hdus[f"AMP{n}"].data[:, :24]
            variance = hdus[f"VARIANCE_AMP{n}"].data
            assert variance.shape == hdus[f"AMP{n}"].data.shape
            assert np.isinf(variance[:, 24:]).all()
            known = corrected_variance(light, ITL, read_noise=5.0) / gain**2
            assert variance[:, :24] == pytest.approx(known, rel=1e-5)


def test_a_read_noise_below_zero_is_refused_before_anything_is_written(tmp_path):
    path = electrons(tmp_path / "in.fits", scene())
    out = tmp_path / "out.fits"
    result = run(path, "--table", NAME, "--variance", -1.0, "-o", out)
    assert result.exit_code == 1 and "read_noise = -1.0" in result.output
    assert not out.exists()


def test_a_file_with_a_variance_of_its_own_gets_no_second_one(tmp_path):
    path = tmp_path / "in.fits"
    image = fits.PrimaryHDU(scene().astype(np.float32), fits.Header({"BUNIT": "electron"}))
    own = fits.ImageHDU(np.ones((60, 48), np.float32), name="VARIANCE")
    mask = fits.ImageHDU(np.zeros((60, 48), np.int32), name="MASK")
    image.name = "IMAGE"
    fits.HDUList([image, mask, own]).writeto(path)
    out = tmp_path / "out.fits"
    result = run(path, "--table", NAME, "--variance", 5.0, "-o", out)
    assert result.exit_code == 1 and "has an extension VARIANCE" in result.output
    assert not out.exists()
    assert run(path, "--table", NAME, "-o", out, "--overwrite").exit_code == 0
