"""Figures of devices, distortion tables, electron paths, spots and sweeps, drawn into given axes."""

from typing import TYPE_CHECKING

from bfsensor._lazy import lazy_names

if TYPE_CHECKING:
    from bfsensor.plots.camera import figure_for_camera
    from bfsensor.plots.device import (
        draw_charge_cross_sections,
        draw_potential_profiles,
        figure_for_device,
    )
    from bfsensor.plots.paths import draw_collected_paths, draw_electron_paths
    from bfsensor.plots.spots import (
        draw_build_up,
        draw_growth,
        draw_moved_light,
        figure_for_spots,
    )
    from bfsensor.plots.sweep import draw_sweep, figure_for_sweep
    from bfsensor.plots.table import (
        draw_area_changes,
        draw_depth_response,
        draw_pixel_boundaries,
        draw_response,
        figure_for_table,
    )
else:
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "camera": ["figure_for_camera"],
            "device": [
                "draw_charge_cross_sections",
                "draw_potential_profiles",
                "figure_for_device",
            ],
            "paths": ["draw_collected_paths", "draw_electron_paths"],
            "spots": [
                "draw_build_up",
                "draw_growth",
                "draw_moved_light",
                "figure_for_spots",
            ],
            "sweep": ["draw_sweep", "figure_for_sweep"],
            "table": [
                "draw_area_changes",
                "draw_depth_response",
                "draw_pixel_boundaries",
                "draw_response",
                "figure_for_table",
            ],
        },
    )

__all__ = [
    "draw_area_changes",
    "draw_build_up",
    "draw_charge_cross_sections",
    "draw_collected_paths",
    "draw_depth_response",
    "draw_electron_paths",
    "draw_growth",
    "draw_moved_light",
    "draw_pixel_boundaries",
    "draw_potential_profiles",
    "draw_response",
    "draw_sweep",
    "figure_for_camera",
    "figure_for_device",
    "figure_for_spots",
    "figure_for_sweep",
    "figure_for_table",
]
