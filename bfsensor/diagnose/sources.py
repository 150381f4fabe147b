"""Campaigns as the channels take them, and the baseline that a campaign names."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from bfsensor.diagnose.baseline import Baseline, read_edges
from bfsensor.diagnose.free_baseline import free_baseline
from bfsensor.diagnose.table_baseline import baseline_of_table
from bfsensor.errors import DiagnosisError
from bfsensor.recording.amplifiers import AmplifierFrame, read_exposure
from bfsensor.recording.area_changes import AreaChangeTable
from bfsensor.recording.campaign import Campaign
from bfsensor.recording.covariance_tables import CovarianceTable
from bfsensor.recording.exposures import Exposure
from bfsensor.recording.reduced import find_reduced, holds_images

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
        self.exposures: Sequence[Exposure] = _settled(campaign)
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


def _settled(campaign: Campaign) -> list[Exposure]:
    """Exposures with the settings of their group: readings that jitter are one condition.

    Pairs are the manifest's or nobody's: without one, flats are paired as their levels allow.
    """
    settled = {}
    for kind in campaign.kinds():
        for condition, members in campaign.conditions(kind).items():
            for one in members:
                settled[one.number] = replace(
                    one, wavelength=condition.wavelength, back_bias=condition.back_bias,
                    temperature=condition.temperature,
                    pair=one.pair if campaign.has_manifest else None,
                )  # fmt: skip
    return [settled[one.number] for one in campaign.exposures]


def find_reduced_recording(path: Path) -> AreaChangeTable | CovarianceTable | None:
    """Read the reduced recording that a path is, or that is all a folder holds.

    Returns
    -------
    recording : AreaChangeTable or CovarianceTable, or None
        None where the path is a folder with images, or with nothing known: a campaign.

    Raises
    ------
    DiagnosisError
        It holds neither a_ij nor covariances, or more than one such table.
    """
    if path.is_dir() and holds_images(path):
        return None
    found = find_reduced(path)
    if not found and not path.is_file():
        return None
    tables = [one for one in found if isinstance(one, AreaChangeTable | CovarianceTable)]
    if len(tables) != 1:
        names = ", ".join(f"{one.path.name} ({one.what})" for one in found)
        raise DiagnosisError(
            f"{path}: one table of a_ij or of covariances can be diagnosed at a time, there are "
            f"{len(tables)} of {len(found)} reduced recordings: {names}"
        )
    return tables[0]


def find_baseline(
    given: str | os.PathLike[str] | None, *, card: str | os.PathLike[str] | None = None
) -> Baseline:
    """Read a baseline: edge displacements (.json), a table (.fits), a GalSim stem, or a device.

    Parameters
    ----------
    given : str or path-like
        A file, the name of a built-in device, or 'none' for white noise with shifts that
        float (:func:`bfsensor.diagnose.free_baseline.free_baseline`).
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
            "a table .fits, a GalSim stem, a built-in device, or none where nothing is known)"
        )
    if os.fspath(given) == "none":
        return free_baseline()
    path = Path(given)
    if path.suffix == ".json":
        return read_edges(path, card=card)
    return baseline_of_table(given)
