"""The direct simulation: electrons one by one, whose charge changes the field for the next."""

from typing import TYPE_CHECKING

from bfsensor._lazy import lazy_names

if TYPE_CHECKING:
    from bfsensor.direct.cloud import fe55_cloud, trace_cloud
    from bfsensor.direct.exposure_plan import ExposurePlan
    from bfsensor.direct.flat_exposure import Flat, FlatPlan, simulate_flat
    from bfsensor.direct.spot_exposure import Spot, SpotPlan, simulate_spot, spot_electrons
    from bfsensor.direct.transport import Electrons, Tracer, Transport
else:
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "cloud": ["fe55_cloud", "trace_cloud"],
            "exposure_plan": ["ExposurePlan"],
            "flat_exposure": ["Flat", "FlatPlan", "simulate_flat"],
            "spot_exposure": ["Spot", "SpotPlan", "simulate_spot", "spot_electrons"],
            "transport": ["Electrons", "Tracer", "Transport"],
        },
    )

__all__ = [
    "Electrons",
    "ExposurePlan",
    "Flat",
    "FlatPlan",
    "Spot",
    "SpotPlan",
    "Tracer",
    "Transport",
    "fe55_cloud",
    "simulate_flat",
    "simulate_spot",
    "spot_electrons",
    "trace_cloud",
]
