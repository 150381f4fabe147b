"""Tables as files: the bits that were written come back, damage is refused."""

from __future__ import annotations

import dataclasses
import pickle

import numpy as np
import pytest
from astropy.io import fits
from hypothesis import given, settings
from hypothesis import strategies as st

from bfsensor.device.device import Device
from bfsensor.errors import TableError
from bfsensor.table.table import DistortionTable
from tests.table.rough_tables import ARRAYS, CHARGES, DEPTHS, make_table, refusal


def is_quadrant(path):
    with fits.open(path) as hdus:
        return hdus[0].header["QUADRANT"]


@pytest.mark.parametrize("symmetric", [True, False])
@pytest.mark.parametrize("vertices", [2, 3, 4])
@pytest.mark.parametrize("reach", [1, 2])
def test_reading_gives_the_bits_that_were_written(symmetric, vertices, reach, tmp_path):
    table = make_table(
        77 + vertices, symmetric=symmetric, vertices=vertices, reach=reach,
        full_well=173_999.5, errors={"tracing [um]": 1 / 3}, provenance={"µ": "ü \\ \n"},
        device_text="\n" + Device.load("e2v_ccd250").to_toml(),
    )  # fmt: skip
    path = tmp_path / "table.fits"
    table.write(path)
    again = DistortionTable.read(path)
    assert again == table
    for name in ARRAYS:
        assert (getattr(again, name) + 0.0).tobytes() == (
            getattr(table, name) + 0.0
        ).tobytes()
    assert again.device_text == table.device_text
    assert dict(again.errors) == dict(table.errors)
    assert dict(again.provenance) == dict(table.provenance)
    assert is_quadrant(path) is symmetric
    assert [p.name for p in tmp_path.iterdir()] == ["table.fits"]


def test_a_table_without_well_and_device(tmp_path):
    table = make_table()
    table.write(tmp_path / "table.fits")
    again = DistortionTable.read(tmp_path / "table.fits")
    assert again == table
    assert np.isnan(again.full_well)
    assert again.device_text == ""


@pytest.mark.parametrize("name", ARRAYS)
@pytest.mark.parametrize("place", [0, -1])
def test_only_bitwise_symmetry_is_stored_as_a_quadrant(name, place, tmp_path):
    table = make_table()
    array = getattr(table, name).copy()
    flat = array[1, 0, 2].reshape(-1)
    # The smallest step of single precision, in one number.
    flat[place] = np.nextafter(np.float32(flat[place]), np.float32(1))
    other = dataclasses.replace(table, **{name: array})
    assert other.symmetric
    assert other != table
    table.write(tmp_path / "exact.fits")
    other.write(tmp_path / "nearly.fits")
    assert is_quadrant(tmp_path / "exact.fits")
    assert not is_quadrant(tmp_path / "nearly.fits")
    assert DistortionTable.read(tmp_path / "nearly.fits") == other
    sizes = [(tmp_path / f"{n}.fits").stat().st_size for n in ("exact", "nearly")]
    assert sizes[0] < sizes[1]


def test_units_and_checksums_are_in_the_file(tmp_path):
    make_table(full_well=1e5).write(tmp_path / "table.fits")
    with fits.open(tmp_path / "table.fits") as hdus:
        units = {hdu.name: hdu.header.get("BUNIT") for hdu in hdus[1:]}
        assert all("CHECKSUM" in hdu.header for hdu in hdus)
        assert all("DATASUM" in hdu.header for hdu in hdus)
    assert units == {
        "CORNERS": "um", "HORIZONTAL": "um", "VERTICAL": "um", "CHARGES": "electron",
        "BACKGROUNDS": "electron", "DEPTHS": "um", "META": None, "DEVICE": None,
    }  # fmt: skip


def test_pickling():
    table = make_table(errors={"a": 1.0}, provenance={"b": "c"})
    assert pickle.loads(pickle.dumps(table)) == table


def test_arrays_cannot_be_changed_behind_the_table():
    table = make_table()
    with pytest.raises(ValueError, match="read-only"):
        table.corners[...] = 0


def test_existing_files_are_kept(tmp_path):
    path = tmp_path / "table.fits"
    make_table(3).write(path)
    before = path.read_bytes()
    assert refusal(make_table(4).write, path) == (
        f"{path} exists; say overwrite to replace it"
    )
    assert path.read_bytes() == before
    make_table(4).write(path, overwrite=True)
    assert DistortionTable.read(path) == make_table(4)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """A table, the bytes of its file, and a place to damage them."""
    folder = tmp_path_factory.mktemp("damage")
    table = make_table(device_text="name = 'x'\n", charges=CHARGES[:2], depths=DEPTHS[:1])
    table.write(folder / "table.fits")
    return table, (folder / "table.fits").read_bytes(), folder / "damaged.fits"


@settings(max_examples=60, deadline=None)
@given(part=st.floats(0, 1, exclude_max=True), block=st.booleans())
def test_truncated_files_are_refused(written, part, block):
    _, content, path = written
    length = int(part * len(content))
    path.write_bytes(content[: length // 2880 * 2880 if block else length])
    assert refusal(DistortionTable.read, path).startswith(f"{path}: ")


@settings(max_examples=100, deadline=None)
@given(place=st.floats(0, 1, exclude_max=True), flip=st.integers(1, 255))
def test_damage_is_refused_or_harmless(written, place, flip):
    table, content, path = written
    damaged = bytearray(content)
    damaged[int(place * len(content))] ^= flip
    path.write_bytes(damaged)
    try:
        again = DistortionTable.read(path)
    except TableError as error:
        assert str(error).startswith(f"{path}: ")  # noqa: PT017
    else:
        assert again == table  # in the padding or a comment


def test_a_flipped_bit_in_a_shift_is_found(written):
    table, content, path = written
    number = np.array(table.corners[1, 0, 0, -1, -1, 0], ">f4").tobytes()
    assert content.count(number) == 1
    path.write_bytes(
        content.replace(number, bytes([number[0], number[1] ^ 1, *number[2:]]))
    )
    message = refusal(DistortionTable.read, path)
    assert message.startswith(f"{path}: not a FITS file, or damaged: ")
    assert "Checksum verification failed for HDU ('CORNERS'" in message


def test_other_files_are_refused(tmp_path, written):
    path = tmp_path / "other.fits"
    assert refusal(DistortionTable.read, path) == f"{path}: no such file"
    for content in (b"", b"a,b\n1,2\n", bytes(range(256)) * 30):
        path.write_bytes(content)
        assert refusal(DistortionTable.read, path).startswith(
            f"{path}: not a FITS file, or damaged: "
        )
    fits.PrimaryHDU(np.ones((3, 3))).writeto(path, overwrite=True)
    assert refusal(DistortionTable.read, path) == (
        f"{path}: not a distortion table (no SCHEMA = 'bfsensor distortion table')"
    )
    path.write_bytes(written[1])
    with fits.open(path) as hdus:
        hdus[0].header["SCHEMAV"] = 2
        hdus.writeto(path, overwrite=True, checksum=True)
    assert refusal(DistortionTable.read, path) == (
        f"{path}: schema version 2 is not 1, the one this version of bfsensor reads"
    )


@pytest.mark.parametrize("key", ["REACH", "VERTICES", "PITCHX", "QUADRANT", "THICKNSS"])
def test_a_missing_entry_is_refused_by_name(key, tmp_path, written):
    path = tmp_path / "table.fits"
    path.write_bytes(written[1])
    with fits.open(path) as hdus:
        del hdus[0].header[key]
        hdus.writeto(path, overwrite=True, checksum=True)
    message = refusal(DistortionTable.read, path)
    assert message.startswith(f"{path}: not a FITS file, or damaged: ")
    assert key in message
