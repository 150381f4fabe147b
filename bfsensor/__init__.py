"""Device physics of thick CCDs: from a device file to the brighter-fatter effect.

The names used most often are here; the others are in the subpackages, ``bfsensor.device``,
``bfsensor.table``, ``bfsensor.measure`` and so on, each of which lists its public names in
``__all__``.  A name that is in none of these lists may change without notice.
``bfsensor.diagnose`` is a subpackage: the function of this name is ``bfsensor.diagnose.diagnose``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from bfsensor._lazy import lazy_names

if TYPE_CHECKING:
    from bfsensor.device.condition import Condition
    from bfsensor.device.device import Device, builtin_devices
    from bfsensor.device.poisson_ccd import import_poisson_ccd
    from bfsensor.diagnose.data.measure_channels import measure_channels
    from bfsensor.diagnose.diagnosis import diagnose_measured
    from bfsensor.diagnose.model.baseline import Baseline
    from bfsensor.diagnose.model.free_baseline import free_baseline
    from bfsensor.diagnose.model.open_baseline import CampaignSource, find_baseline
    from bfsensor.diagnose.report.diagnosis_result import Diagnosis
    from bfsensor.diagnose.report.html_report import write_report
    from bfsensor.direct.flat_exposure import FlatPlan, simulate_flat
    from bfsensor.direct.spot_exposure import SpotPlan, simulate_spot
    from bfsensor.effects.effect import Effect
    from bfsensor.effects.library import make_effect
    from bfsensor.errors import (
        BFSensorError,
        ConvergenceError,
        DeviceError,
        DiagnosisError,
        EffectError,
        FitError,
        MeasurementError,
        RecordingError,
        SensorError,
        SensorTypeError,
        SimulationError,
        SweepError,
        TableError,
    )
    from bfsensor.fit.data import DataSet
    from bfsensor.fit.fit import fit_device
    from bfsensor.fit.result import FitResult
    from bfsensor.measure.correct import correct_edges, correct_kernel
    from bfsensor.measure.covariance_fit import fit_covariances
    from bfsensor.measure.curve import CovarianceCurve, measure_curve
    from bfsensor.measure.flat_pairs import FlatCovariances, flat_covariances
    from bfsensor.measure.slopes import BFSlope, bf_slopes
    from bfsensor.measure.spot_fit import fit_spots
    from bfsensor.measure.spot_result import SpotFit
    from bfsensor.measure.spots import cut_stamps, find_spots
    from bfsensor.measure.toy import predict_pair
    from bfsensor.measure.toy_array import predict_array
    from bfsensor.recording.campaign.amplifiers import read_exposure
    from bfsensor.recording.campaign.campaign import Campaign, read_campaign
    from bfsensor.recording.campaign.inspection import inspect_campaign
    from bfsensor.recording.campaign.questions import open_questions
    from bfsensor.response.edge_response import solve_response
    from bfsensor.response.emulator import DeviceEmulator
    from bfsensor.sensor.brighter_fatter import BrighterFatterSensor
    from bfsensor.sensor.flats import draw_flat
    from bfsensor.sensor.shift_maps import ShiftMap
    from bfsensor.sensor.silicon_sensor import SiliconSensor
    from bfsensor.sensor.table_correction import correct_table
    from bfsensor.sweeps.device_sweep import sweep_device
    from bfsensor.sweeps.rows import DeviceSweep
    from bfsensor.table.build import build_table
    from bfsensor.table.galsim_format import read_galsim, write_galsim
    from bfsensor.table.lsst_format import make_distortion_matrix, make_kernel
    from bfsensor.table.quadrant_shifts import quadrant_shifts
    from bfsensor.table.table import DistortionTable
    from bfsensor.table.table_plan import plan_table
else:
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "device.condition": ["Condition"],
            "device.device": ["Device", "builtin_devices"],
            "device.poisson_ccd": ["import_poisson_ccd"],
            "diagnose.data.measure_channels": ["measure_channels"],
            "diagnose.diagnosis": ["diagnose_measured"],
            "diagnose.model.baseline": ["Baseline"],
            "diagnose.model.free_baseline": ["free_baseline"],
            "diagnose.model.open_baseline": ["CampaignSource", "find_baseline"],
            "diagnose.report.diagnosis_result": ["Diagnosis"],
            "diagnose.report.html_report": ["write_report"],
            "direct.flat_exposure": ["FlatPlan", "simulate_flat"],
            "direct.spot_exposure": ["SpotPlan", "simulate_spot"],
            "effects.effect": ["Effect"],
            "effects.library": ["make_effect"],
            "errors": [
                "BFSensorError",
                "ConvergenceError",
                "DeviceError",
                "DiagnosisError",
                "EffectError",
                "FitError",
                "MeasurementError",
                "RecordingError",
                "SensorError",
                "SensorTypeError",
                "SimulationError",
                "SweepError",
                "TableError",
            ],
            "fit.data": ["DataSet"],
            "fit.fit": ["fit_device"],
            "fit.result": ["FitResult"],
            "measure.correct": ["correct_edges", "correct_kernel"],
            "measure.covariance_fit": ["fit_covariances"],
            "measure.curve": ["CovarianceCurve", "measure_curve"],
            "measure.flat_pairs": ["FlatCovariances", "flat_covariances"],
            "measure.slopes": ["BFSlope", "bf_slopes"],
            "measure.spot_fit": ["fit_spots"],
            "measure.spot_result": ["SpotFit"],
            "measure.spots": ["cut_stamps", "find_spots"],
            "measure.toy": ["predict_pair"],
            "measure.toy_array": ["predict_array"],
            "recording.campaign.amplifiers": ["read_exposure"],
            "recording.campaign.campaign": ["Campaign", "read_campaign"],
            "recording.campaign.inspection": ["inspect_campaign"],
            "recording.campaign.questions": ["open_questions"],
            "response.edge_response": ["solve_response"],
            "response.emulator": ["DeviceEmulator"],
            "sensor.brighter_fatter": ["BrighterFatterSensor"],
            "sensor.flats": ["draw_flat"],
            "sensor.shift_maps": ["ShiftMap"],
            "sensor.silicon_sensor": ["SiliconSensor"],
            "sensor.table_correction": ["correct_table"],
            "sweeps.device_sweep": ["sweep_device"],
            "sweeps.rows": ["DeviceSweep"],
            "table.build": ["build_table"],
            "table.galsim_format": ["read_galsim", "write_galsim"],
            "table.lsst_format": ["make_distortion_matrix", "make_kernel"],
            "table.quadrant_shifts": ["quadrant_shifts"],
            "table.table": ["DistortionTable"],
            "table.table_plan": ["plan_table"],
        },
    )

__version__ = "0.1.0"

__all__ = [
    "BFSensorError",
    "BFSlope",
    "Baseline",
    "BrighterFatterSensor",
    "Campaign",
    "CampaignSource",
    "Condition",
    "ConvergenceError",
    "CovarianceCurve",
    "DataSet",
    "Device",
    "DeviceEmulator",
    "DeviceError",
    "DeviceSweep",
    "Diagnosis",
    "DiagnosisError",
    "DistortionTable",
    "Effect",
    "EffectError",
    "FitError",
    "FitResult",
    "FlatCovariances",
    "FlatPlan",
    "MeasurementError",
    "RecordingError",
    "SensorError",
    "SensorTypeError",
    "ShiftMap",
    "SiliconSensor",
    "SimulationError",
    "SpotFit",
    "SpotPlan",
    "SweepError",
    "TableError",
    "__version__",
    "bf_slopes",
    "build_table",
    "builtin_devices",
    "correct_edges",
    "correct_kernel",
    "correct_table",
    "cut_stamps",
    "diagnose_measured",
    "draw_flat",
    "find_baseline",
    "find_spots",
    "fit_covariances",
    "fit_device",
    "fit_spots",
    "flat_covariances",
    "free_baseline",
    "import_poisson_ccd",
    "inspect_campaign",
    "make_distortion_matrix",
    "make_effect",
    "make_kernel",
    "measure_channels",
    "measure_curve",
    "open_questions",
    "plan_table",
    "predict_array",
    "predict_pair",
    "quadrant_shifts",
    "read_campaign",
    "read_exposure",
    "read_galsim",
    "simulate_flat",
    "simulate_spot",
    "solve_response",
    "sweep_device",
    "write_galsim",
    "write_report",
]


def _register() -> None:
    from bfsensor.galsim import register_when_loaded

    register_when_loaded()


_register()
