"""Diagnosis: compare recordings with a simulation, locate the mismatch, find effects behind it."""

from typing import TYPE_CHECKING

from bfsensor._lazy import lazy_names

if TYPE_CHECKING:
    from bfsensor.diagnose.data.channels import Channel
    from bfsensor.diagnose.data.measure_channels import MeasuredChannels, measure_channels
    from bfsensor.diagnose.data.reduced_channels import measure_reduced
    from bfsensor.diagnose.detect.locate import Mismatch
    from bfsensor.diagnose.diagnosis import diagnose, diagnose_measured
    from bfsensor.diagnose.explain.attribution import Attribution
    from bfsensor.diagnose.fit.baseline_fit import BaselineFit
    from bfsensor.diagnose.model.baseline import Baseline, read_edges
    from bfsensor.diagnose.model.device_baseline import baseline_of_device
    from bfsensor.diagnose.model.free_baseline import free_baseline
    from bfsensor.diagnose.model.open_baseline import (
        CampaignSource,
        find_baseline,
        simulate_baseline,
    )
    from bfsensor.diagnose.model.table_baseline import baseline_of_table
    from bfsensor.diagnose.plan.advice import RecordingPlan
    from bfsensor.diagnose.plan.predict_conditions import (
        Prediction,
        predict_conditions,
        read_conditions,
    )
    from bfsensor.diagnose.report.diagnosis_result import Diagnosis
    from bfsensor.diagnose.report.html_report import write_report
else:
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "data.channels": ["Channel"],
            "data.measure_channels": ["MeasuredChannels", "measure_channels"],
            "data.reduced_channels": ["measure_reduced"],
            "detect.locate": ["Mismatch"],
            "diagnosis": ["diagnose", "diagnose_measured"],
            "explain.attribution": ["Attribution"],
            "fit.baseline_fit": ["BaselineFit"],
            "model.baseline": ["Baseline", "read_edges"],
            "model.device_baseline": ["baseline_of_device"],
            "model.free_baseline": ["free_baseline"],
            "model.open_baseline": ["CampaignSource", "find_baseline", "simulate_baseline"],
            "model.table_baseline": ["baseline_of_table"],
            "plan.advice": ["RecordingPlan"],
            "plan.predict_conditions": [
                "Prediction",
                "predict_conditions",
                "read_conditions",
            ],
            "report.diagnosis_result": ["Diagnosis"],
            "report.html_report": ["write_report"],
        },
    )

__all__ = [
    "Attribution",
    "Baseline",
    "BaselineFit",
    "CampaignSource",
    "Channel",
    "Diagnosis",
    "MeasuredChannels",
    "Mismatch",
    "Prediction",
    "RecordingPlan",
    "baseline_of_device",
    "baseline_of_table",
    "diagnose",
    "diagnose_measured",
    "find_baseline",
    "free_baseline",
    "measure_channels",
    "measure_reduced",
    "predict_conditions",
    "read_conditions",
    "read_edges",
    "simulate_baseline",
    "write_report",
]
