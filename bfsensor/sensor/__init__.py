"""Sensors for GalSim that apply distortion tables to photons, and flats drawn from pixel areas."""

from typing import TYPE_CHECKING

from bfsensor._lazy import lazy_names

if TYPE_CHECKING:
    from bfsensor.sensor.brighter_fatter import BrighterFatterSensor
    from bfsensor.sensor.effect_reports import read_effects
    from bfsensor.sensor.exposures import correct_exposure
    from bfsensor.sensor.flats import draw_flat, iterate_flat
    from bfsensor.sensor.focal_plane import FocalPlane
    from bfsensor.sensor.forward_check import DrawnAgain, draw_again
    from bfsensor.sensor.shift_maps import ShiftMap
    from bfsensor.sensor.silicon_sensor import SiliconSensor
    from bfsensor.sensor.table_correction import correct_table
    from bfsensor.sensor.weight_maps import corrected_variance
else:
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "brighter_fatter": ["BrighterFatterSensor"],
            "effect_reports": ["read_effects"],
            "focal_plane": ["FocalPlane"],
            "exposures": ["correct_exposure"],
            "forward_check": ["DrawnAgain", "draw_again"],
            "flats": ["draw_flat", "iterate_flat"],
            "shift_maps": ["ShiftMap"],
            "silicon_sensor": ["SiliconSensor"],
            "table_correction": ["correct_table"],
            "weight_maps": ["corrected_variance"],
        },
    )

__all__ = [
    "BrighterFatterSensor",
    "DrawnAgain",
    "FocalPlane",
    "ShiftMap",
    "SiliconSensor",
    "correct_exposure",
    "correct_table",
    "corrected_variance",
    "draw_again",
    "draw_flat",
    "iterate_flat",
    "read_effects",
]
