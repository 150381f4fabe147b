"""Fits of device parameters, with errors, to a_ij, B-F slopes, saturation and diffusion widths."""

from typing import TYPE_CHECKING

from bfsensor._lazy import lazy_names

if TYPE_CHECKING:
    from bfsensor.fit.camera_areas import CameraAreas, read_camera_areas
    from bfsensor.fit.camera_device import drift_model, stand_in_device, with_fit
    from bfsensor.fit.camera_fit import CameraFit, fit_camera
    from bfsensor.fit.data import DataSet, area_data, data_set, select
    from bfsensor.fit.degeneracies import Combination
    from bfsensor.fit.device_at import fitted_device
    from bfsensor.fit.fit import fit_device
    from bfsensor.fit.fit_figures import figure_for_fit
    from bfsensor.fit.image_charge_fit import ImageChargeFit, fit_image_charge
    from bfsensor.fit.posterior_draws import CurvedPosterior, sample_posterior
    from bfsensor.fit.result import FitResult, FittedSet
else:
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "camera_areas": ["CameraAreas", "read_camera_areas"],
            "camera_device": ["drift_model", "stand_in_device", "with_fit"],
            "camera_fit": ["CameraFit", "fit_camera"],
            "data": ["DataSet", "area_data", "data_set", "select"],
            "degeneracies": ["Combination"],
            "device_at": ["fitted_device"],
            "fit": ["fit_device"],
            "fit_figures": ["figure_for_fit"],
            "image_charge_fit": ["ImageChargeFit", "fit_image_charge"],
            "posterior_draws": ["CurvedPosterior", "sample_posterior"],
            "result": ["FitResult", "FittedSet"],
        },
    )

__all__ = [
    "CameraAreas",
    "CameraFit",
    "Combination",
    "CurvedPosterior",
    "DataSet",
    "FitResult",
    "FittedSet",
    "ImageChargeFit",
    "area_data",
    "data_set",
    "drift_model",
    "figure_for_fit",
    "fit_camera",
    "fit_device",
    "fit_image_charge",
    "fitted_device",
    "read_camera_areas",
    "sample_posterior",
    "select",
    "stand_in_device",
    "with_fit",
]
