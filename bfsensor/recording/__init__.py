"""Recordings: campaigns of raw exposures and tables that others reduced, with their conditions."""

from typing import TYPE_CHECKING

from bfsensor._lazy import lazy_names

if TYPE_CHECKING:
    from bfsensor.recording.campaign.amplifiers import AmplifierFrame, read_exposure
    from bfsensor.recording.campaign.campaign import Campaign, read_campaign
    from bfsensor.recording.campaign.exposures import Exposure
    from bfsensor.recording.campaign.inspection import Inspection, inspect_campaign
    from bfsensor.recording.campaign.questions import OpenQuestion, open_questions
    from bfsensor.recording.raw.images import AmplifierImage, read_images
    from bfsensor.recording.tables.area_changes import AreaChangeTable, read_area_changes
    from bfsensor.recording.tables.covariance_tables import (
        CovarianceTable,
        read_covariances,
    )
    from bfsensor.recording.tables.lsst_datasets import (
        BrighterFatterKernel,
        DistortionMatrix,
        PhotonTransferDataset,
    )
    from bfsensor.recording.tables.measured import MeasuredTable, read_measured
    from bfsensor.recording.tables.reduced import (
        RadialProfile,
        SpotTable,
        read_profile,
        read_spots,
    )
    from bfsensor.recording.tables.setting_tables import SettingTable, read_setting_table
else:
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "campaign.amplifiers": ["AmplifierFrame", "read_exposure"],
            "campaign.campaign": ["Campaign", "read_campaign"],
            "campaign.exposures": ["Exposure"],
            "campaign.inspection": ["Inspection", "inspect_campaign"],
            "campaign.questions": ["OpenQuestion", "open_questions"],
            "raw.images": ["AmplifierImage", "read_images"],
            "tables.area_changes": ["AreaChangeTable", "read_area_changes"],
            "tables.covariance_tables": ["CovarianceTable", "read_covariances"],
            "tables.lsst_datasets": [
                "BrighterFatterKernel",
                "DistortionMatrix",
                "PhotonTransferDataset",
            ],
            "tables.measured": ["MeasuredTable", "read_measured"],
            "tables.reduced": ["RadialProfile", "SpotTable", "read_profile", "read_spots"],
            "tables.setting_tables": ["SettingTable", "read_setting_table"],
        },
    )

__all__ = [
    "AmplifierFrame",
    "AmplifierImage",
    "AreaChangeTable",
    "BrighterFatterKernel",
    "Campaign",
    "CovarianceTable",
    "DistortionMatrix",
    "Exposure",
    "Inspection",
    "MeasuredTable",
    "OpenQuestion",
    "PhotonTransferDataset",
    "RadialProfile",
    "SettingTable",
    "SpotTable",
    "inspect_campaign",
    "open_questions",
    "read_area_changes",
    "read_campaign",
    "read_covariances",
    "read_exposure",
    "read_images",
    "read_measured",
    "read_profile",
    "read_setting_table",
    "read_spots",
]
