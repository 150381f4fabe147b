"""``bfsensor measure`` as a user runs it, on files with known contents."""

import json

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from click.testing import CliRunner

from bfsensor.cli.main import main
from bfsensor.measure.spot_model import Shape, integrate_gaussian

GAIN = 2.0
TALL = 1.2
"""Width of the spots in y over that in x: exchanged axes are seen."""


def invoke(*arguments):
    return CliRunner().invoke(main, ["measure", *map(str, arguments)])


def write(path, electrons, name="amp1"):
    """A raw file: data and overscan in ADU, one extension."""
    ny, nx = electrons.shape
    rng = np.random.default_rng(5)
    adu = np.full((ny, nx + 20), 1000.0) + rng.normal(0, 2.0, (ny, nx + 20))
    adu[:, :nx] += electrons / GAIN
    hdu = fits.ImageHDU(adu.astype(np.float32), name=name)
    hdu.header["DATASEC"] = f"[1:{nx},1:{ny}]"
    hdu.header["BIASSEC"] = f"[{nx + 1}:{nx + 20},1:{ny}]"
    hdu.header["GAIN"] = GAIN
    fits.HDUList([fits.PrimaryHDU(), hdu]).writeto(path)
    return path


def ladder(tmp_path, slope=0.8):
    rng = np.random.default_rng(90)
    share = float(integrate_gaussian([0.0], [0.0], Shape(1.0, TALL), 1)[0, 0, 0])
    files = []
    for n, peak in enumerate((20e3, 40e3, 60e3, 80e3, 100e3, 120e3)):
        sigma = 1 + 0.01 * slope * peak / 5e4
        image = np.full((200, 200), 50.0)
        for y in range(10, 190, 20):
            for x in range(10, 190, 20):
                dx, dy = rng.uniform(-0.5, 0.5, 2)
                stamp = integrate_gaussian([dx], [dy], Shape(sigma, TALL * sigma), 15)[0]
                image[y - 7 : y + 8, x - 7 : x + 8] += peak / share * stamp
        files.append(write(tmp_path / f"ladder_{n}.fits", rng.poisson(image).astype(float)))
    return files


def test_spots_give_sizes_and_slopes(tmp_path):
    files = ladder(tmp_path)
    out = tmp_path / "spots.ecsv"
    result = invoke("spots", *files, "--threshold", 5000, "-o", out, "--json")
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    table = Table.read(out, format="ascii.ecsv")
    assert len(table) == 6 and (table["spots"] + table["dropped"] == 81).all()
    expected = 1 + 0.008 * np.arange(20e3, 121e3, 20e3) / 5e4
    for axis in "xy":
        size = expected * (TALL if axis == "y" else 1.0)
        assert (
            np.abs(table[f"sigma_{axis}"] - size) < 5 * table[f"sigma_{axis}_error"]
        ).all()
        text = next(v for k, v in found["summary"].items() if f"slope {axis}" in k)
        slope, error = float(text.split()[0]), float(text.split()[2])
        # Against the fitted peak, which falls as the width grows: 2 % more.
        assert abs(slope - 0.816) < 4 * error + 0.01 and error < 0.1
    plain = invoke("spots", files[0], "--threshold", 5000)
    assert "81 spots" in plain.output or "80 spots" in plain.output


def test_flats_give_covariances(tmp_path):
    rng = np.random.default_rng(91)
    files = [
        write(tmp_path / f"flat_{n}.fits", rng.poisson(level, (300, 300)).astype(float))
        for n, level in enumerate((5000, 5000, 20000, 20000))
    ]
    out = tmp_path / "flats.ecsv"
    result = invoke("flats", *files, "--lags", 2, "-o", out)
    assert result.exit_code == 0, result.output
    table = Table.read(out, format="ascii.ecsv")
    assert len(table) == 2 * 9 and set(table["unit"]) == {"electron"}
    for level in (5000, 20000):
        part = table[np.abs(table["level"] - level) < 0.01 * level]
        # Read noise of 2 ADU and its share in the overscan's median belong to the variance.
        variance = part[(part["lag_x"] == 0) & (part["lag_y"] == 0)][0]
        assert abs(variance["covariance"] - level - 16) < 5 * variance["error"] + 3
        others = part[(part["lag_x"] + part["lag_y"]) > 0]
        assert (np.abs(others["covariance"]) < 5 * others["error"] + 3).all()
    assert result.output.count("C10/C00") == 2


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["flats", "{0}"], "1 files"),
        (["spots", "{0}", "--threshold", "1e9"], "1e+09"),
        (["flats", "{1}", "{1}"], "text.fits"),
    ],
)
def test_one_clear_line_for_bad_input(tmp_path, arguments, message):
    good = write(tmp_path / "flat.fits", np.full((50, 50), 100.0))
    bad = tmp_path / "text.fits"
    bad.write_text("no FITS")
    result = invoke(*(a.format(good, bad) for a in arguments))
    assert result.exit_code == 1
    assert message in result.output and len(result.output.splitlines()) == 1


def test_spots_ask_for_the_gain(tmp_path):
    path = write(tmp_path / "adu.fits", np.full((50, 50), 100.0))
    with fits.open(path, mode="update") as hdus:
        del hdus[1].header["GAIN"]
    result = invoke("spots", path, "--threshold", 10)
    assert result.exit_code == 1 and "--gain" in result.output
    with fits.open(path, mode="update") as hdus:
        hdus[1].header["GAIN"] = 0
    result = invoke("spots", path, "--threshold", 10)
    assert result.exit_code == 1
    assert "GAIN = 0 " in result.output and "0.0001 to 10000 e-/ADU" in result.output


def test_a_campaign_yaml_beside_the_files_is_followed(tmp_path):
    """Two amplifiers in one image, one of them masked in part."""
    rng = np.random.default_rng(8612)
    files = [tmp_path / f"{n}.fits" for n in range(2)]
    for path in files:
        adu = np.full((60, 120), 1000.0)
        adu[:, :50] += rng.poisson(3000, (60, 50))
        adu[:, 50:100] += rng.poisson(6000, (60, 50))
        adu[:30, 50:100] = 9000.0
        fits.PrimaryHDU(adu.astype(np.uint16)).writeto(path)
    (tmp_path / "campaign.yaml").write_text(
        "amplifiers:\n"
        "- {name: L, data: '[1:50,1:60]', bias: '[101:120,1:60]', detector: '[1:50,1:60]',"
        " gain: 2}\n"
        "- {name: R, data: '[51:100,1:60]', bias: '[101:120,1:60]', detector: '[51:100,1:60]',"
        " gain: 3}\n"
        "masks: ['[51:100,1:30]']\n"
    )
    result = invoke("flats", *files, "--lags", 1, "--json")
    found = json.loads(result.stdout)
    assert [found["summary"][f"{name} gain"] for name in "LR"] == ["2 e-/ADU", "3 e-/ADU"]
    levels = {row["amplifier"]: row["level"] for row in found["rows"]}
    # Shot noise of 1500 pixels is 0.03 %.
    assert levels == {
        "L": pytest.approx(6000, rel=2e-3),
        "R": pytest.approx(18000, rel=2e-3),
    }
    (tmp_path / "campaign.yaml").write_text("masks: ['[1:9]']")
    result = invoke("flats", *files)
    assert result.exit_code == 1 and "masks = '[1:9]'" in result.output


def test_help_shows_examples():
    for name in ("spots", "flats"):
        assert f"bfsensor measure {name}" in invoke(name, "--help").output


def test_faults_name_file_and_amplifier(tmp_path):
    rng = np.random.default_rng(8110)
    image = rng.poisson(1000.0, (50, 50)).astype(float)
    first = write(tmp_path / "first.fits", image)
    small = write(tmp_path / "small.fits", image[:40])
    result = invoke("flats", first, first)
    assert result.output == (
        f"bfsensor: {first} and {first}: AMP1: the flats do not differ: the same image twice, or "
        "no noise\n"
    )
    result = invoke("flats", first, small)
    assert result.output == (
        f"bfsensor: {first} and {small}: AMP1: (50, 50) pixels in electron and (40, 50) in "
        "electron are no pair\n"
    )
    # Plateaus, as saturation leaves them, are no Gaussians.
    image[20:27, 20:27] = image[20:27, 35:42] = 5e4
    result = invoke("spots", write(tmp_path / "flat_top.fits", image), "--threshold", 1e4)
    assert result.exit_code == 1 and len(result.output.splitlines()) == 1
    assert "flat_top.fits: AMP1: " in result.output


def test_sections_stand_for_missing_cards(tmp_path):
    rng = np.random.default_rng(8613)
    files = [tmp_path / f"{n}.fits" for n in range(2)]
    for path in files:
        adu = np.full((80, 140), 1000.0)
        adu[:, :100] += rng.poisson(4000, (80, 100))
        adu[:, 100:] += rng.normal(0, 3, (80, 40))
        fits.PrimaryHDU(adu.round().astype(np.uint16)).writeto(path)
    result = invoke("flats", *files, "--lags", 1)
    assert result.exit_code == 1 and "--sections" in result.output
    whole = "data=[1:100,1:80],bias=[101:140,1:80]"
    found = json.loads(
        invoke("flats", *files, "--lags", 1, "--sections", whole, "--json").stdout
    )
    # 8000 pixels in each of two flats: the mean is known to 63 / sqrt(16000) = 0.5 ADU.
    assert {row["amplifier"] for row in found["rows"]} == {"image"}
    assert found["rows"][0]["level"] == pytest.approx(4000, abs=4)
    halves = (
        "name=L,hdu=0,data=[1:50,1:80],bias=[101:140,1:80],detector=[1:50,1:80]",
        "name=R,data=[51:100,1:80],bias=[101:140,1:80],detector=[51:100,1:80]",
    )
    given = [part for text in halves for part in ("--sections", text)]
    found = json.loads(invoke("flats", *files, "--lags", 1, *given, "--json").stdout)
    assert {row["amplifier"] for row in found["rows"]} == {"L", "R"}
    for text, message in (
        ("bias=[1:2,1:3]", "'bias=[1:2,1:3]'"),
        ("data=[1:2,1:3],gian=2", "gian=2"),
        ("data=1:2,1:3", "'data=1:2,1:3'"),
        ("data=[1:2,1:3],hdu=a", "hdu = 'a'"),
    ):
        result = invoke("flats", *files, "--sections", text)
        assert result.exit_code == 2 and message in result.output, result.output


def test_the_photon_transfer_figure_shows_the_pairs_and_their_fit():
    from bfsensor.measure.covariance_fit import fit_covariances
    from bfsensor.measure.curve import measure_curve
    from bfsensor.plots.photon_transfer import figure_for_photon_transfer

    rng = np.random.default_rng(8614)
    levels = np.linspace(2e3, 6e4, 7)
    curve = measure_curve([rng.poisson(mu, (2, 90, 90)) for mu in levels], lags=2)
    fit = fit_covariances(curve)
    figure = figure_for_photon_transfer({"A": curve}, {"A": fit})
    above, below = figure.axes
    shown = above.containers[0].lines[0].get_xydata()
    np.testing.assert_allclose(shown[:, 0] * 1e3, curve.levels)
    np.testing.assert_allclose(shown[:, 1], curve.covariances[:, 0, 0] / curve.levels)
    line = above.lines[-1].get_xydata()[-1]
    assert line[1] == pytest.approx(fit.model(curve.levels[-1])[0, 0, 0] / curve.levels[-1])
    ratios = [one.lines[0].get_ydata() / 100 for one in below.containers]
    for ratio, (j, i) in zip(ratios, ((0, 1), (1, 0)), strict=True):
        expected = curve.covariances[:, j, i] / curve.covariances[:, 0, 0]
        np.testing.assert_allclose(ratio, expected)


def test_flats_draw_a_figure(tmp_path):
    rng = np.random.default_rng(8615)
    files = [
        write(tmp_path / f"{n}.fits", rng.poisson(5e3, (60, 60)).astype(float))
        for n in range(2)
    ]
    result = invoke("flats", *files, "--lags", 1, "--figure", tmp_path / "ptc.png")
    assert result.exit_code == 0, result.output
    assert f"figure: {tmp_path / 'ptc.png'}" in result.output
    assert (tmp_path / "ptc.png").read_bytes().startswith(b"\x89PNG")
    result = invoke("flats", *files, "--lags", 1, "--figure", tmp_path / "ptc.nothing")
    assert result.exit_code == 1 and "ptc.nothing: no figure: " in result.output
