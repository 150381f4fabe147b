"""Store the drift field of each shipped device in its table, so that a sensor solves nothing.

``python -m validation.drift_fields [NAME ...]``: one extension is added to
``tables/NAME/table.fits``, all that is there stays as it is, byte for byte.  Tables that
``bfsensor table`` makes have the extension.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from astropy.io import fits

from bfsensor import Device, DistortionTable
from bfsensor.device.device import builtin_devices
from bfsensor.device.shipped import tables_dir
from bfsensor.simulate.mean_field import mean_drift_field
from bfsensor.table.fits_format import drift_extension


def add_drift_field(path: Path) -> bool:
    """Add the drift field to a table that lacks it; returns whether it did."""
    table = DistortionTable.read(path)
    if table.drift_field.size or not table.device_text:
        return False
    hdu = drift_extension(mean_drift_field(Device.from_toml(table.device_text)))
    fits.append(path, hdu.data, hdu.header, checksum=True)
    return True


def main() -> int:
    """Add the fields that are missing."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help="devices; all by default")
    for name in parser.parse_args().names or builtin_devices():
        path = tables_dir() / name / "table.fits"
        if path.exists():
            print(f"{name}: {'field added' if add_drift_field(path) else 'as it was'}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
