"""Campaigns as the channels take them, and the baseline that a campaign names."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Sequence
from pathlib import Path

from bfsensor.device import Device
from bfsensor.diagnose.baseline import Baseline, read_edges
from bfsensor.diagnose.device_baseline import baseline_of_device, write_edges
from bfsensor.diagnose.table_baseline import baseline_of_table
from bfsensor.errors import DeviceError, DiagnosisError
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


def simulate_baseline(
    given: str | os.PathLike[str] | None,
    parameters: Sequence[str],
    back_biases: Sequence[float],
    *,
    keep: Path,
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
    progress : callable, optional
        Called with (tables made, tables in all).

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
    text = "\n".join([device.to_toml(), *parameters, *(f"{b:g}" for b in back_biases)])
    path = keep / f"baseline_{hashlib.sha256(text.encode()).hexdigest()[:12]}.json"
    if not path.exists():
        baseline = baseline_of_device(
            device, parameters=parameters, back_biases=back_biases, progress=progress
        )
        keep.mkdir(parents=True, exist_ok=True)
        write_edges(baseline, path)
    return read_edges(path, card=path)
