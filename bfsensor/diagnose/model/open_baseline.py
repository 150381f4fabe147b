"""Campaigns as the channels take them, and the baseline that a campaign names."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from bfsensor.device.device import Device
from bfsensor.diagnose.model.baseline import Baseline, read_edges
from bfsensor.diagnose.model.device_baseline import TABLES, baseline_of_device, write_edges
from bfsensor.diagnose.model.free_baseline import free_baseline
from bfsensor.diagnose.model.left_out_physics import physics_left_out
from bfsensor.diagnose.model.table_baseline import baseline_of_table
from bfsensor.errors import DeviceError, DiagnosisError
from bfsensor.recording.campaign.amplifiers import AmplifierFrame, read_exposure
from bfsensor.recording.campaign.campaign import Campaign
from bfsensor.recording.campaign.exposures import Exposure
from bfsensor.recording.tables.area_changes import AreaChangeTable
from bfsensor.recording.tables.covariance_tables import CovarianceTable
from bfsensor.recording.tables.reduced import find_reduced, holds_images

LAMP_ERROR = 1e-3
"""Relative error of a lamp monitor of which campaign.yaml does not tell (assumed)."""


class CampaignSource:
    """Exposures of a campaign, read one by one.

    Parameters
    ----------
    campaign : Campaign
        From :func:`bfsensor.recording.campaign.campaign.read_campaign`.

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
        float (:func:`bfsensor.diagnose.model.free_baseline.free_baseline`).
    card : path-like, optional
        Device card with the spread of the parameters, for edge displacements.

    Returns
    -------
    Baseline

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


def simulate_baseline(
    given: str | os.PathLike[str] | None,
    parameters: Sequence[str],
    back_biases: Sequence[float],
    *,
    keep: Path,
    warming: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> Baseline:
    """Simulate a device with floating parameters, or read what an earlier run kept.

    Parameters
    ----------
    given : str or path-like
        Name of a built-in device, or a device file.
    parameters : sequence of str
        Which float; ('all',) for all with an uncertainty.
    back_biases : sequence of float
        Of the recordings [V].
    keep : Path
        Folder where the shifts are kept as ``baseline_KEY.json``.
    warming : bool
        Whether shifts follow the temperature, which recordings at several ask for.
    progress : callable, optional
        Called with (tables made, tables in all).

    Returns
    -------
    Baseline

    Raises
    ------
    DiagnosisError
        The baseline is no device: only a device can be simulated anew.
    """
    if given is None or Path(given).suffix in (".json", ".fits"):
        raise DiagnosisError(
            f"parameters float for a device, by name or .toml, not for {given or 'no baseline'}"
        )
    try:
        device = Device.load(given)
    except DeviceError as error:
        raise DiagnosisError(f"parameters float for a device: {error}") from None
    text = "\n".join([
        TABLES, device.to_toml(), *parameters, *(f"{b:g}" for b in back_biases), *["warming"] * warming,
    ])  # fmt: skip
    path = keep / f"baseline_{hashlib.sha256(text.encode()).hexdigest()[:12]}.json"
    if not path.exists():
        baseline = baseline_of_device(
            device,
            parameters=parameters,
            back_biases=back_biases,
            warming=warming,
            progress=progress,
        )
        keep.mkdir(parents=True, exist_ok=True)
        write_edges(baseline, path)
    return read_edges(path, card=path)


def with_physics(
    baseline: Baseline, given: str | os.PathLike[str], *, keep: Path
) -> Baseline:
    """Give a simulated device's baseline what the simulation may leave out, as candidates.

    Parameters
    ----------
    baseline : Baseline
        From :func:`simulate_baseline`.
    given : str or path-like
        The device that it was made of.
    keep : Path
        Folder where tables are kept: half a minute of CPU time the first time.
    """
    pieces = physics_left_out(Device.load(given), baseline, keep=keep)
    return replace(baseline, pieces=pieces)
