"""Texts of devices in shipped tables: written where no solution depends on the change."""

import shutil

import numpy as np
import pytest
from astropy.io import fits

from bfsensor import Device, DistortionTable
from bfsensor.device.device import builtin_devices
from bfsensor.device.shipped import tables_dir
from bfsensor.errors import TableError
from validation.device_texts import write_device_text


@pytest.mark.parametrize("name", builtin_devices())
def test_shipped_tables_hold_the_text_of_their_device_file(name):
    assert DistortionTable.load(name).device_text == Device.load(name).to_toml()


def test_nothing_but_the_text_changes(tmp_path):
    shipped = tables_dir() / "itl_sta3800c_2019" / "table.fits"
    path = tmp_path / "table.fits"
    shutil.copy(shipped, path)
    device = Device.load("itl_sta3800c_2019")
    assert not write_device_text(path, device)
    assert path.read_bytes() == shipped.read_bytes()
    wider = device.with_value("transport.diffusion", "2.5")
    assert write_device_text(path, wider)
    assert Device.from_toml(DistortionTable.read(path).device_text) == wider
    with fits.open(shipped) as before, fits.open(path, checksum=True) as after:
        assert [h.name for h in before] == [h.name for h in after]
        for old, new in zip(before, after, strict=True):
            if old.name != "DEVICE" and old.data is not None:
                assert old.data.dtype == new.data.dtype
                assert np.array_equal(old.data, new.data)
                # A checksum's card holds its date.
                cards = [dict(h.header) for h in (old, new)]
                for card in cards:
                    card.pop("CHECKSUM", None)
                assert cards[0] == cards[1]
    with pytest.raises(TableError, match="other physics"):
        write_device_text(path, device.with_value("back_bias", "-51 V"))
