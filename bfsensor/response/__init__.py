"""The response of pixel edges to an electron: solved, with derivatives, and emulated."""

from typing import TYPE_CHECKING

from bfsensor._lazy import lazy_names

if TYPE_CHECKING:
    from bfsensor.response.edge_response import EdgeResponse, area_matrix, solve_response
    from bfsensor.response.emulator import DeviceEmulator
    from bfsensor.response.vertices import Displacements, vertex_fractions
else:
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "edge_response": ["EdgeResponse", "area_matrix", "solve_response"],
            "emulator": ["DeviceEmulator"],
            "vertices": ["Displacements", "vertex_fractions"],
        },
    )

__all__ = [
    "DeviceEmulator",
    "Displacements",
    "EdgeResponse",
    "area_matrix",
    "solve_response",
    "vertex_fractions",
]
