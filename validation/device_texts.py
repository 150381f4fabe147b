"""Write the text of each shipped device file into its table, where no solution depends on the change.

``python -m validation.device_texts [NAME ...]``: a table holds the text of the device that
it was made of.  Quantities that move no boundary (``[transport]``), uncertainties, origins and sources
may change later in ``tables/NAME/device.toml``; this writes them into ``tables/NAME/table.fits``
and leaves all arrays as they are, bit for bit.  A device with other physics is refused:
such a table must be made again.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
from astropy.io import fits

from bfsensor import Device, DistortionTable
from bfsensor.device.device import builtin_devices
from bfsensor.device.shipped import tables_dir
from bfsensor.errors import TableError
from bfsensor.files import written_whole


def write_device_text(table: Path, device: Device) -> bool:
    """Write a device into a table; returns whether the file changed.

    Raises
    ------
    TableError
        The table was made of a device with other physics.
    """
    text = device.to_toml()
    held = DistortionTable.read(table).device_text
    if held == text:
        return False
    if Device.from_toml(held).physics != device.physics:
        raise TableError(f"{table}: made of a device with other physics; make it again")
    with fits.open(table, memmap=False) as hdus:
        n = hdus.index_of("DEVICE")
        hdus[n] = fits.ImageHDU(np.frombuffer(text.encode(), np.uint8), name="DEVICE")
        with written_whole(table, TableError) as beside:
            hdus.writeto(beside, checksum=True, overwrite=True)
    return True


def main() -> int:
    """Write the texts that differ; 1 where a table must be made again."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help="devices; all by default")
    faults = 0
    for name in parser.parse_args().names or builtin_devices():
        table = tables_dir() / name / "table.fits"
        if not table.exists():
            continue
        try:
            changed = write_device_text(table, Device.load(name))
        except TableError as error:
            print(error, file=sys.stderr)
            faults = 1
        else:
            print(f"{name}: {'text written' if changed else 'as it was'}")
    return faults


if __name__ == "__main__":
    sys.exit(main())
