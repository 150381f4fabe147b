"""What a_ij two pixels away depend on besides the device: mesh, level, light, size of the patch.

``python -m validation.device_fit.lag_two`` solves the unfitted devices about a uniform background,
one thing changed at a time.  The patch is periodic, mirrored at charge and half period: 12 pixels
in tables and fits, here also 18 and 24; what its images do is taken off by their far field, and
once left in. Rows of kind 'lag2' [1/e-] replace those in ``validation/results/device_fit.ecsv``.
"""

from __future__ import annotations

import argparse
import time
from typing import Any
from unittest.mock import patch

from bfsensor.device.device import Device
from bfsensor.response.edge_response import area_matrix, solve_response
from bfsensor.response.periodic_images import Images
from validation.device_fit.device_fit import DEVICES, append, row

COMMAND = "python -m validation.device_fit.lag_two"
LIGHT = "light of 950 nm"
LEFT = "images left in"
ASKED: dict[str, dict[str, Any]] = {
    "itl, 16 cells": {},
    "e2v, 16 cells": {},
    "e2v, 24 cells": {"cells": 24},
    "itl, 24 cells": {"cells": 24},
    "itl, 48 cells": {"cells": 48, "refine_z": 0},
    "itl, level 10,000 e-": {"level": 10e3},
    "itl, level 80,000 e-": {"level": 80e3},
    f"itl, {LIGHT}": {},
    "itl, period 18": {"period": 18},
    "itl, period 24": {"period": 24},
    "e2v, period 24": {"period": 24},
    f"itl, {LEFT}": {},
    f"itl, period 18, {LEFT}": {"period": 18},
    f"itl, period 24, {LEFT}": {"period": 24},
}
"""Device and what is changed, by name of the row."""

LAGS = ((0, 0), (1, 0), (0, 1), (1, 1), (2, 0), (0, 2), (2, 2), (3, 0), (0, 3), (4, 4))


def leave(self: Images, moved: Any) -> tuple[Any, float]:
    """Take nothing off."""
    return moved, 0.0


def main() -> None:
    """Solve each and write the rows."""
    argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    ).parse_args()
    begin = time.process_time()
    rows = []
    for name, changed in ASKED.items():
        device = Device.load(DEVICES[name[:3]])
        taken_off = leave if LEFT in name else Images.taken_off
        with patch.object(Images, "taken_off", taken_off):
            found = solve_response(device, **{"cells": 16, **changed})
        wavelength = 950.0 if LIGHT in name else None
        a = area_matrix(*found.edges(wavelength, device.operating_point.temperature))
        middle = len(a) // 2
        rows += [row("lag2", name, i, j, after=a[middle + j, middle + i]) for i, j in LAGS]
        print(f"{name}: " + " ".join(f"{one['after']:.3e}" for one in rows[-len(LAGS) :]))
    seconds = round(time.process_time() - begin, 1)
    append("lag2", rows, command=COMMAND, cpu_s=seconds)


if __name__ == "__main__":
    main()
