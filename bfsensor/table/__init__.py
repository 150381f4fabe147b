"""Distortion tables: planned, built, read and written as FITS, for GalSim and for LSST."""

from typing import TYPE_CHECKING

from bfsensor._lazy import lazy_names

if TYPE_CHECKING:
    from bfsensor.table.build import build_table
    from bfsensor.table.build_image_charge import (
        build_fitted_table,
        build_image_charge_table,
    )
    from bfsensor.table.galsim_format import read_galsim, write_galsim
    from bfsensor.table.lsst_format import make_distortion_matrix, make_kernel, solve_kernel
    from bfsensor.table.quadrant_shifts import QuadrantShifts
    from bfsensor.table.table import DistortionTable
    from bfsensor.table.table_plan import TablePlan, plan_table
else:
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "build": ["build_table"],
            "build_image_charge": ["build_fitted_table", "build_image_charge_table"],
            "galsim_format": ["read_galsim", "write_galsim"],
            "lsst_format": ["make_distortion_matrix", "make_kernel", "solve_kernel"],
            "quadrant_shifts": ["QuadrantShifts"],
            "table": ["DistortionTable"],
            "table_plan": ["TablePlan", "plan_table"],
        },
    )

__all__ = [
    "DistortionTable",
    "QuadrantShifts",
    "TablePlan",
    "build_fitted_table",
    "build_image_charge_table",
    "build_table",
    "make_distortion_matrix",
    "make_kernel",
    "plan_table",
    "read_galsim",
    "solve_kernel",
    "write_galsim",
]
