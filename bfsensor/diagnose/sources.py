"""Campaigns as the channels take them, and the baseline that a campaign names."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from bfsensor.diagnose.baseline import Baseline, read_edges
from bfsensor.diagnose.table_baseline import baseline_of_table
from bfsensor.errors import DiagnosisError
from bfsensor.recording.amplifiers import AmplifierFrame, read_exposure
from bfsensor.recording.campaign import Campaign
from bfsensor.recording.exposures import Exposure

LAMP_ERROR = 1e-3
"""Relative error of a lamp monitor of which campaign.yaml does not tell (assumed)."""


class CampaignSource:
    """Exposures of a campaign, read one by one.

    Parameters
    ----------
    campaign : Campaign
        From :func:`bfsensor.recording.campaign.read_campaign`.

    Raises
    ------
    DiagnosisError
        The amplifiers' places on the sensor are not known and there are several.
    """

    def __init__(self, campaign: Campaign) -> None:
        self.campaign = campaign
        self.exposures: Sequence[Exposure] = campaign.exposures
        self.lamp_error = campaign.lamp_error or LAMP_ERROR
        rows, columns = 0, 0
        for layout in campaign.amplifiers:
            if layout.origin is None and len(campaign.amplifiers) > 1:
                raise DiagnosisError(
                    f"{campaign.folder}: where amplifier {layout.name} lies on the sensor is not "
                    "known: give DETSEC, or sections in campaign.yaml"
                )
            x, y = layout.origin or (0, 0)
            down, across = layout.data
            rows = max(rows, y + down.stop - down.start)
            columns = max(columns, x + across.stop - across.start)
        if not rows:
            raise DiagnosisError(f"{campaign.folder}: no exposure can be used")
        self.shape = (rows, columns)

    def read(self, exposure: Exposure) -> Sequence[AmplifierFrame]:
        """Frames of an exposure, in the order of the amplifiers."""
        return read_exposure(self.campaign, exposure)


def find_baseline(
    given: str | os.PathLike[str] | None, *, card: str | os.PathLike[str] | None = None
) -> Baseline:
    """Read a baseline: edge displacements (.json), a table (.fits), a GalSim stem, or a device.

    Parameters
    ----------
    given : str or path-like
        A file, or the name of a built-in device.
    card : path-like, optional
        Device card with the spread of the parameters, for edge displacements.

    Raises
    ------
    DiagnosisError
        None of these, or none given; names what is allowed.
    """
    if given is None:
        raise DiagnosisError(
            "no baseline: name one in campaign.yaml or with --baseline (edge displacements .json, "
            "a table .fits, a GalSim stem, or a built-in device)"
        )
    path = Path(given)
    if path.suffix == ".json":
        return read_edges(path, card=card)
    return baseline_of_table(given)
