"""Files of any number type, scaled, compressed, cut short or with holes, and tables likewise."""

from __future__ import annotations

import gzip
import re

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import MaskedColumn, Table

from bfsensor.errors import RecordingError
from bfsensor.recording.raw.headers import scan_file
from bfsensor.recording.raw.images import read_images
from bfsensor.recording.tables.calibration_tables import read_tables, write_tables

CARDS = {"DATASEC": "[1:32,1:20]", "BIASSEC": "[33:42,1:20]"}


def read_raw(path, **options):
    return read_images(scan_file(path), **options)


def frame():
    """ADU: 32 columns of data 1500 above 10 of overscan, both with noise."""
    data = np.round(1000 + 5 * np.random.default_rng(777).standard_normal((20, 42)))
    data[:, :32] += 1500
    return data


def write(path, data, hdu=fits.PrimaryHDU, **cards):
    image = hdu(data, fits.Header({**CARDS, **cards}))
    hdus = [image] if hdu is fits.PrimaryHDU else [fits.PrimaryHDU(), image]
    fits.HDUList(hdus).writeto(path, overwrite=True)
    return path


def write_scaled(path, stored, scale, zero, **cards):
    """Integers of 16 bits with BSCALE and BZERO, byte by byte as a camera writes them."""
    header = fits.Header(
        {
            "SIMPLE": True, "BITPIX": 16, "NAXIS": 2, "NAXIS1": stored.shape[1],
            "NAXIS2": stored.shape[0], **CARDS, "BSCALE": scale, "BZERO": zero, **cards,
        }
    )  # fmt: skip
    content = stored.astype(">i2").tobytes()
    path.write_bytes(header.tostring().encode() + content + b"\0" * (-len(content) % 2880))
    return path


@pytest.fixture
def plain(tmp_path):
    (found,) = read_raw(write(tmp_path / "plain.fits", frame()))
    return found


# -- number types ----------------------------------------------------------------------


@pytest.mark.parametrize("kind", [">f4", "<f8", ">i2", "<u2", ">i4", "<u4", "<i8"])
def test_any_number_type_and_byte_order(tmp_path, plain, kind):
    (found,) = read_raw(write(tmp_path / "a.fits", frame().astype(kind)))
    np.testing.assert_array_equal(found.image, plain.image)
    assert found.image.dtype == np.float64 and found.image.dtype.isnative
    assert not found.mask.any()


@pytest.mark.parametrize("kind", ["RICE_1", "GZIP_1", "GZIP_2"])
def test_compressed_files(tmp_path, plain, kind):
    data = frame().astype(np.uint16)
    data[3, 4] = 65535

    def compressed(image, header):
        return fits.CompImageHDU(image, header, compression_type=kind)

    (found,) = read_raw(write(tmp_path / "a.fits.fz", data, compressed))
    assert np.argwhere(found.mask).tolist() == [[3, 4]]
    np.testing.assert_array_equal(found.image[~found.mask], plain.image[~found.mask])


def test_files_in_gzip(tmp_path, plain):
    path = write(tmp_path / "a.fits", frame())
    (tmp_path / "a.fits.gz").write_bytes(gzip.compress(path.read_bytes()))
    (found,) = read_raw(tmp_path / "a.fits.gz")
    np.testing.assert_array_equal(found.image, plain.image)


@pytest.mark.parametrize(
    ("scale", "zero"), [(1.0, 32768.0), (0.5, 16384.0), (-1.0, 20000.0)]
)
def test_the_end_of_the_range_of_scaled_integers_is_saturated(tmp_path, scale, zero):
    """BSCALE makes floats of them; what cannot be higher is saturated all the same."""
    stored = np.round((frame() - zero) / scale)
    top = 32767 if scale > 0 else -32768
    stored[5, 6] = top
    stored[7, 8] = top - np.sign(top)
    (found,) = read_raw(write_scaled(tmp_path / "a.fits", stored, scale, zero))
    assert np.argwhere(found.mask).tolist() == [[5, 6]]
    expected = stored * scale + zero
    expected = expected[:, :32] - np.median(expected[:, 34:], axis=1, keepdims=True)
    np.testing.assert_array_equal(found.image, expected)


# -- holes -----------------------------------------------------------------------------


def test_blank_pixels_are_masked_and_do_not_count_as_overscan(tmp_path, plain):
    stored = frame()
    stored[6, 6] = stored[5, 35] = stored[9, 34:] = -5
    path = write_scaled(tmp_path / "a.fits", stored, 1.0, 0.0, BLANK=-5)
    (found,) = read_raw(path)
    expected = np.zeros((20, 32), bool)
    expected[6, 6] = True
    expected[9] = True  # its overscan is all blank
    np.testing.assert_array_equal(found.mask, expected)
    by_row = np.median(np.delete(stored[5, 34:], 1))
    np.testing.assert_array_equal(found.image[5], stored[5, :32] - by_row)
    untouched = [row for row in range(20) if row not in (5, 6, 9)]
    np.testing.assert_array_equal(found.image[untouched], plain.image[untouched])
    assert np.isfinite([found.overscan_level, found.overscan_noise]).all()
    for method in ("row mean", "median"):
        assert read_raw(path, overscan=method)[0].mask.sum() == (
            33 if method != "median" else 1
        )


def test_an_overscan_without_a_number_is_refused(tmp_path):
    data = frame()
    data[:, 32:] = np.nan
    with pytest.raises(RecordingError, match=r"a\.fits: image: .*overscan.*finite"):
        read_raw(write(tmp_path / "a.fits", data))


# -- keywords without a usable value ---------------------------------------------------


@pytest.mark.parametrize("level", [0, -1.0])
def test_a_saturation_level_of_nothing_masks_nothing(tmp_path, plain, level):
    (found,) = read_raw(write(tmp_path / "a.fits", frame(), SATURATE=level))
    np.testing.assert_array_equal(found.mask, plain.mask)
    (found,) = read_raw(write(tmp_path / "a.fits", frame(), SATURATE=2490.0))
    np.testing.assert_array_equal(found.mask, frame()[:, :32] >= 2490)


def test_a_logical_value_is_no_gain(tmp_path):
    (found,) = read_raw(write(tmp_path / "a.fits", frame(), GAIN=True))
    assert found.unit == "adu" and np.isnan(found.gain)
    assert found.no_gain == "GAIN = True is not a number"


@pytest.mark.parametrize(
    ("section", "words"),
    [
        ("[0:0,0:0]", "BIASSEC = '[0:0,0:0]' begins below 1"),
        ("[43:60,1:20]", r"BIASSEC = '[43:60,1:20]' leaves the image, 42 x 20 pixels"),
        ("none", "BIASSEC = 'none' is not like '[1:512,1:2000]'"),
    ],
)
def test_an_overscan_that_is_not_wanted_may_be_nowhere(tmp_path, section, words):
    path = write(tmp_path / "a.fits", frame(), BIASSEC=section)
    (found,) = read_raw(path, overscan=None)
    np.testing.assert_array_equal(found.image, frame()[:, :32])
    with pytest.raises(
        RecordingError, match=re.escape(f"a.fits: image: {words}")
    ) as caught:
        read_raw(path)
    # Both ways out are named.
    assert "--sections" in str(caught.value) and "--overscan none" in str(caught.value)


def test_keywords_that_astropy_cannot_parse_are_no_fault_of_the_file(tmp_path, plain):
    path = write(tmp_path / "a.fits", frame())
    content = path.read_bytes()
    at = content.find(b"END" + 77 * b" ")
    broken = b"GAIN    = 2.2E+".ljust(80) + b"OTHER   = 'not closed".ljust(80)
    end = at + len(broken)
    path.write_bytes(content[:at] + broken + b"END".ljust(80) + content[end + 80 :])
    (found,) = read_raw(path)
    np.testing.assert_array_equal(found.image, plain.image)
    assert found.no_gain == "GAIN = '2.2E+' is not a number"


def test_a_text_table_is_no_image(tmp_path, plain):
    """Its NAXIS is 2, too."""
    path = write(tmp_path / "a.fits", frame(), fits.ImageHDU)
    with fits.open(path, mode="append") as hdus:
        hdus.append(fits.TableHDU.from_columns([fits.Column("A", "F8.2", array=[1.0])]))
    (found,) = read_raw(path)
    np.testing.assert_array_equal(found.image, plain.image)


# -- files cut short -------------------------------------------------------------------


def test_a_file_cut_short_never_gives_fewer_amplifiers(tmp_path):
    """Only a cut at the end of an extension cannot be seen."""
    path = tmp_path / "a.fits"
    header = fits.Header(CARDS)
    hdus = [fits.ImageHDU(frame(), header, name=name) for name in ("A", "B")]
    fits.HDUList([fits.PrimaryHDU(), *hdus]).writeto(path)
    whole = path.read_bytes()
    ends = (len(whole) - 2880) // 2 + 2880, len(whole)
    for length in range(100, len(whole), 730):
        if length in ends:
            continue
        path.write_bytes(whole[:length])
        with pytest.raises(RecordingError, match=r"a\.fits: "):
            read_raw(path)
    path.write_bytes(whole + b"\0" * 2880)
    assert [one.name for one in read_raw(path)] == ["A", "B"]


def test_tables_cut_short_are_refused(tmp_path):
    path = tmp_path / "a.fits"
    write_tables(path, [Table({"A": [1.0, 2.0], "B": ["x", ""]})], overwrite=False)
    whole = path.read_bytes()
    for length in (0, 100, 2880, 4000, 5760, 7000):
        path.write_bytes(whole[:length])
        with pytest.raises(RecordingError, match=r"a\.fits: "):
            read_tables(path)


def test_empty_cells_are_nan_or_no_text(tmp_path):
    path = tmp_path / "a.ecsv"
    table = Table({"A": MaskedColumn([1.0, 2.0], mask=[False, True]), "B": ["x", ""]})
    write_tables(path, [table], overwrite=False)
    (found,) = read_tables(path)
    np.testing.assert_array_equal(found["A"], [1.0, np.nan])
    assert list(found["B"]) == ["x", ""]
    table["A"] = MaskedColumn([1, 2], mask=[False, True])
    write_tables(path, [table], overwrite=True)
    with pytest.raises(RecordingError, match=r"a\.ecsv: column A has empty cells"):
        read_tables(path)
    path.write_text(path.read_text().replace("int64", "int65"))
    with pytest.raises(RecordingError, match=r"a\.ecsv: cannot be read"):
        read_tables(path)
