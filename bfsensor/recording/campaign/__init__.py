"""Campaigns: folders of raw exposures of one sensor, listed, checked and read."""

from typing import TYPE_CHECKING

from bfsensor._lazy import lazy_names

if TYPE_CHECKING:
    from bfsensor.recording.campaign.amplifiers import AmplifierFrame, read_exposure
    from bfsensor.recording.campaign.campaign import Campaign, read_campaign
    from bfsensor.recording.campaign.exposures import Caution, Exposure, SetAside
    from bfsensor.recording.campaign.frame_statistics import FrameStatistics, PairStatistics
    from bfsensor.recording.campaign.inspection import Inspection, inspect_campaign
    from bfsensor.recording.campaign.questions import OpenQuestion, open_questions
    from bfsensor.recording.campaign.settings import CampaignSettings, read_settings
else:
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "amplifiers": ["AmplifierFrame", "read_exposure"],
            "campaign": ["Campaign", "read_campaign"],
            "exposures": ["Caution", "Exposure", "SetAside"],
            "frame_statistics": ["FrameStatistics", "PairStatistics"],
            "inspection": ["Inspection", "inspect_campaign"],
            "questions": ["OpenQuestion", "open_questions"],
            "settings": ["CampaignSettings", "read_settings"],
        },
    )

__all__ = [
    "AmplifierFrame",
    "Campaign",
    "CampaignSettings",
    "Caution",
    "Exposure",
    "FrameStatistics",
    "Inspection",
    "OpenQuestion",
    "PairStatistics",
    "SetAside",
    "inspect_campaign",
    "open_questions",
    "read_campaign",
    "read_exposure",
    "read_settings",
]
