"""Sweeps of a device over its quantities, and resumable runs of independent points on executors."""

from typing import TYPE_CHECKING

from bfsensor._lazy import lazy_names

if TYPE_CHECKING:
    from bfsensor.sweeps.axes import Swept, parse_swept
    from bfsensor.sweeps.device_sweep import sweep_device
    from bfsensor.sweeps.executors import open_executor, run_points
    from bfsensor.sweeps.points import PointResponse, SweepPoint, solve_point
    from bfsensor.sweeps.rows import DeviceSweep, SweepRow
else:
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "axes": ["Swept", "parse_swept"],
            "device_sweep": ["sweep_device"],
            "executors": ["open_executor", "run_points"],
            "points": ["PointResponse", "SweepPoint", "solve_point"],
            "rows": ["DeviceSweep", "SweepRow"],
        },
    )

__all__ = [
    "DeviceSweep",
    "PointResponse",
    "SweepPoint",
    "SweepRow",
    "Swept",
    "open_executor",
    "parse_swept",
    "run_points",
    "solve_point",
    "sweep_device",
]
