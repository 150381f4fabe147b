"""Files of distortion tables: any values, any damaged byte, nothing halved."""

from __future__ import annotations

import os
from dataclasses import replace

import numpy as np
import pytest
from astropy.io import fits
from hypothesis import given, settings
from hypothesis import strategies as st

from bfsensor.errors import TableError
from bfsensor.table.table import DistortionTable
from tests.table.smooth_tables import DEPTHS, make_rough_table, make_table


@pytest.fixture(scope="module")
def table():
    return make_table(full_well=170_000.0)


TEXTS = st.text(st.characters(codec="utf-8"), max_size=40)
# A FITS card holds 20 characters of a number: all digits from 0.1 on.
NUMBERS = st.floats(0.1, 1e9)
# Vertices of a file lie less than a pixel from their places; the shifts of a rough table are below 3 um.
PITCHES = st.floats(3.0, 1e9)


@given(
    seed=st.integers(0, 2**32 - 1),
    pitch=st.tuples(PITCHES, PITCHES),
    full_well=NUMBERS | st.just(np.nan),
    errors=st.dictionaries(TEXTS, st.floats(), max_size=3),
    provenance=st.dictionaries(TEXTS, TEXTS, max_size=3),
    device_text=TEXTS,
)
@settings(max_examples=40, deadline=None)
def test_what_was_written_reads_back_equal(
    tmp_path_factory, seed, pitch, full_well, errors, provenance, device_text
):
    path = tmp_path_factory.mktemp("tables") / "table.fits"
    rough = make_rough_table(
        seed, reach=1, vertices=2, pitch=pitch, full_well=full_well, errors=errors,
        provenance=provenance, device_text=device_text,
    )  # fmt: skip
    rough.write(path)
    assert DistortionTable.read(path) == rough


@pytest.mark.parametrize("vertices", [1, 4, 5])
@pytest.mark.parametrize("reach", [0, 2])
def test_of_symmetric_tables_a_quadrant_is_stored(tmp_path, vertices, reach):
    table = make_table(vertices=vertices, reach=reach)
    # Nominal positions are symmetric to round-off only, single precision removes that.
    table.write(tmp_path / "whole.fits")
    assert DistortionTable.read(tmp_path / "whole.fits") == table
    with fits.open(tmp_path / "whole.fits") as hdus:
        assert hdus[0].header["QUADRANT"]
        assert hdus["VERTICAL"].shape[3:5] == (reach + 1, reach + 1)


@pytest.mark.parametrize("name", ["corners", "horizontal", "vertical"])
def test_one_bit_of_asymmetry_is_kept(tmp_path, table, name):
    array = getattr(table, name).copy()
    array[(1,) + (0,) * (array.ndim - 1)] += 1e-5
    bent = replace(table, **{name: array})
    bent.write(tmp_path / "bent.fits")
    assert DistortionTable.read(tmp_path / "bent.fits") == bent != table


def test_a_usual_table_takes_less_than_two_megabytes(tmp_path):
    table = make_table(
        np.linspace(0, 1.6e5, 7), [0.0, 4e4, 8e4, 1.4e5], DEPTHS, reach=4, vertices=32
    )
    table.write(tmp_path / "usual.fits")
    # 140 levels of a quadrant of 25 (2 + 2 x 64) numbers of 4 byte, and 2880-byte blocks.
    assert 140 * 25 * 130 * 4 < (tmp_path / "usual.fits").stat().st_size < 1.9e6


def test_headers_tell_people_what_the_file_is(tmp_path, table):
    known = replace(table, errors={"mesh [%]": 0.25}, provenance={"cells": "32"})
    known.write(tmp_path / "table.fits")
    with fits.open(tmp_path / "table.fits") as hdus:
        header = hdus[0].header
        assert header["SCHEMA"] == "bfsensor distortion table"
        assert [header["BUNIT"], hdus["CHARGES"].header["BUNIT"]] == ["um", "electron"]
        assert "cells = 32" in str(header["HISTORY"])
        assert "mesh [%] = 0.25" in str(header["COMMENT"])
        assert all("CHECKSUM" in hdu.header for hdu in hdus)
    assert [path.name for path in tmp_path.iterdir()] == ["table.fits"]


@pytest.fixture(scope="module")
def small_file(tmp_path_factory):
    """A written table and its bytes, few enough to damage each."""
    table = make_rough_table(7043, reach=0, vertices=1, device_text="[pixel]\n")
    path = tmp_path_factory.mktemp("small") / "small.fits"
    table.write(path)
    return table, path.read_bytes()


@given(data=st.data())
@settings(max_examples=150, deadline=None)
def test_a_damaged_byte_is_never_read_as_another_table(small_file, tmp_path_factory, data):
    table, whole = small_file
    telling = [at for at, byte in enumerate(whole) if byte not in b" \0"]
    at = data.draw(st.sampled_from(telling))
    value = data.draw(st.integers(0, 255))
    path = tmp_path_factory.mktemp("damaged") / "damaged.fits"
    path.write_bytes(whole[:at] + bytes([value]) + whole[at + 1 :])
    try:
        found = DistortionTable.read(path)
    except TableError as error:
        found, message = None, str(error)
    # Equal: the byte was not changed, or lies in what does not count.
    assert found == table or (found is None and "damaged.fits: " in message)


@pytest.mark.parametrize(
    "name",
    [
        "CORNERS",
        "HORIZONTAL",
        "VERTICAL",
        "CHARGES",
        "BACKGROUNDS",
        "DEPTHS",
        "META",
        "DEVICE",
    ],
)
def test_changed_data_are_refused_by_their_checksum(small_file, tmp_path, name):
    _, whole = small_file
    path = tmp_path / "changed.fits"
    path.write_bytes(whole)
    with fits.open(path) as hdus:
        at = hdus[name].fileinfo()["datLoc"] + 3
    path.write_bytes(whole[:at] + bytes([whole[at] ^ 1]) + whole[at + 1 :])
    with pytest.raises(TableError, match=r"changed.fits: .*damaged: .*[Cc]hecksum"):
        DistortionTable.read(path)


@given(data=st.data())
@settings(max_examples=60, deadline=None)
def test_truncated_files_are_refused(small_file, tmp_path_factory, data):
    _, whole = small_file
    blocks = st.integers(0, len(whole) // 2880 - 1).map(lambda n: n * 2880)
    end = data.draw(st.integers(0, len(whole) - 1) | blocks)
    path = tmp_path_factory.mktemp("short") / "short.fits"
    path.write_bytes(whole[:end])
    with pytest.raises(TableError, match=r"short.fits: "):
        DistortionTable.read(path)


def test_foreign_files_are_refused(tmp_path, small_file):
    with pytest.raises(TableError, match=r"absent.fits: no such file"):
        DistortionTable.read(tmp_path / "absent.fits")
    (tmp_path / "text.fits").write_text("not a table\n")
    with pytest.raises(TableError, match=r"text.fits: not a FITS file"):
        DistortionTable.read(tmp_path / "text.fits")
    with pytest.raises(TableError, match="not a FITS file"):
        DistortionTable.read(tmp_path)
    fits.PrimaryHDU(np.zeros((3, 3))).writeto(tmp_path / "image.fits")
    with pytest.raises(TableError, match=r"image.fits: not a distortion table"):
        DistortionTable.read(tmp_path / "image.fits")
    path = tmp_path / "later.fits"
    path.write_bytes(small_file[1])
    with fits.open(path, mode="update", checksum=True) as hdus:
        hdus[0].header["SCHEMAV"] = 2
    with pytest.raises(TableError, match=r"later.fits: schema version 2 is not 1"):
        DistortionTable.read(path)


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [("REACH", 3, "has the shape"), ("VERTICES", None, "VERTICES.* not found")],
)
def test_headers_that_contradict_the_data_are_refused(
    tmp_path, small_file, key, value, message
):
    path = tmp_path / "odd.fits"
    path.write_bytes(small_file[1])
    with fits.open(path, mode="update", checksum=True) as hdus:
        if value is None:
            del hdus[0].header[key]
        else:
            hdus[0].header[key] = value
    with pytest.raises(TableError, match=rf"odd.fits: .*{message}"):
        DistortionTable.read(path)


def test_files_are_only_replaced_when_told_and_never_halved(tmp_path, table, monkeypatch):
    path = tmp_path / "table.fits"
    table.write(path)
    other = replace(table, device_text="other")
    with pytest.raises(TableError, match=r"table.fits exists"):
        other.write(path)
    with monkeypatch.context() as patch:

        def fail(*_):
            raise OSError("disk full")

        patch.setattr(os, "replace", fail)
        with pytest.raises(TableError, match=r"table.fits: cannot be written: disk full"):
            other.write(path, overwrite=True)
    assert DistortionTable.read(path) == table
    other.write(path, overwrite=True)
    assert DistortionTable.read(path) == other
    assert [p.name for p in tmp_path.iterdir()] == ["table.fits"]
    with pytest.raises(TableError, match="cannot be written"):
        table.write(tmp_path / "absent" / "table.fits")
