"""Readers of reduced recordings: tables of a_ij, covariances, spots, profiles and settings."""

from typing import TYPE_CHECKING

from bfsensor._lazy import lazy_names

if TYPE_CHECKING:
    from bfsensor.recording.tables.area_changes import AreaChangeTable, read_area_changes
    from bfsensor.recording.tables.covariance_tables import (
        CovarianceTable,
        from_photon_transfer,
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
            "area_changes": ["AreaChangeTable", "read_area_changes"],
            "covariance_tables": [
                "CovarianceTable",
                "from_photon_transfer",
                "read_covariances",
            ],
            "lsst_datasets": [
                "BrighterFatterKernel",
                "DistortionMatrix",
                "PhotonTransferDataset",
            ],
            "measured": ["MeasuredTable", "read_measured"],
            "reduced": ["RadialProfile", "SpotTable", "read_profile", "read_spots"],
            "setting_tables": ["SettingTable", "read_setting_table"],
        },
    )

__all__ = [
    "AreaChangeTable",
    "BrighterFatterKernel",
    "CovarianceTable",
    "DistortionMatrix",
    "MeasuredTable",
    "PhotonTransferDataset",
    "RadialProfile",
    "SettingTable",
    "SpotTable",
    "from_photon_transfer",
    "read_area_changes",
    "read_covariances",
    "read_measured",
    "read_profile",
    "read_setting_table",
    "read_spots",
]
