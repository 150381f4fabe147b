"""The device simulator: meshes, electrostatics, wells, pixel boundaries, edges of the sensor."""

from typing import TYPE_CHECKING

from bfsensor._lazy import lazy_names

if TYPE_CHECKING:
    from bfsensor.simulate.boundaries import PixelBoundaries, find_boundaries
    from bfsensor.simulate.boundary_tangent import boundary_changes
    from bfsensor.simulate.charge_field import ImageCharge
    from bfsensor.simulate.edge_field import EdgeField, solve_edge
    from bfsensor.simulate.edge_shift import EdgeShift, trace_edge
    from bfsensor.simulate.far_field import FarField
    from bfsensor.simulate.field import Field
    from bfsensor.simulate.full_depletion import full_depletion_voltage
    from bfsensor.simulate.image_charge import (
        area_changes,
        displace_boundaries,
        trace_boundaries,
    )
    from bfsensor.simulate.mesh import Mesh, Surfaces, make_mesh
    from bfsensor.simulate.poisson import Electrostatics, Potential
    from bfsensor.simulate.tangent import Tangent
    from bfsensor.simulate.unit_cell import solve_unit_cell, tile
    from bfsensor.simulate.well import barrier, full_well
else:
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "boundaries": ["PixelBoundaries", "find_boundaries"],
            "boundary_tangent": ["boundary_changes"],
            "charge_field": ["ImageCharge"],
            "edge_field": ["EdgeField", "solve_edge"],
            "edge_shift": ["EdgeShift", "trace_edge"],
            "far_field": ["FarField"],
            "field": ["Field"],
            "full_depletion": ["full_depletion_voltage"],
            "image_charge": ["area_changes", "displace_boundaries", "trace_boundaries"],
            "mesh": ["Mesh", "Surfaces", "make_mesh"],
            "poisson": ["Electrostatics", "Potential"],
            "tangent": ["Tangent"],
            "unit_cell": ["solve_unit_cell", "tile"],
            "well": ["barrier", "full_well"],
        },
    )

__all__ = [
    "EdgeField",
    "EdgeShift",
    "Electrostatics",
    "FarField",
    "Field",
    "ImageCharge",
    "Mesh",
    "PixelBoundaries",
    "Potential",
    "Surfaces",
    "Tangent",
    "area_changes",
    "barrier",
    "boundary_changes",
    "displace_boundaries",
    "find_boundaries",
    "full_depletion_voltage",
    "full_well",
    "make_mesh",
    "solve_edge",
    "solve_unit_cell",
    "tile",
    "trace_boundaries",
    "trace_edge",
]
