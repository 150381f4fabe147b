"""Sources of a diagnosis: exposures of a campaign, and the baseline that a user names."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from bfsensor.device.device import Device
from bfsensor.diagnose.data.exposure_info import LAMP_ERROR
from bfsensor.diagnose.data.reduced_channels import StatedTable
from bfsensor.diagnose.model.baseline import Baseline, read_edges
from bfsensor.diagnose.model.device_baseline import TABLES, baseline_of_device, write_edges
from bfsensor.diagnose.model.device_solver import DeviceSolver
from bfsensor.diagnose.model.free_baseline import free_baseline
from bfsensor.diagnose.model.left_out_physics import physics_left_out
from bfsensor.diagnose.model.table_baseline import baseline_of_table
from bfsensor.effects.device_parameter import SILICON
from bfsensor.errors import DeviceError, DiagnosisError
from bfsensor.recording.campaign.amplifiers import AmplifierFrame, read_exposure
from bfsensor.recording.campaign.campaign import Campaign
from bfsensor.recording.campaign.exposures import Exposure
from bfsensor.recording.tables.area_changes import AreaChangeTable
from bfsensor.recording.tables.covariance_tables import CovarianceTable
from bfsensor.recording.tables.measured import MeasuredTable, read_measured
from bfsensor.recording.tables.reduced import find_reduced, holds_images


class CampaignSource:
    """Exposures of a campaign, read one at a time as :func:`~bfsensor.diagnose.diagnose` needs them.

    Parameters
    ----------
    campaign : Campaign
        From :func:`bfsensor.recording.campaign.campaign.read_campaign`.

    Attributes
    ----------
    campaign : Campaign
        The same campaign.
    exposures : sequence of Exposure
        Exposures in order of time, with the settings of their groups.
    lamp_error : float
        Relative error of a lamp monitor reading.
    shape : tuple of int
        Rows and columns of the sensor [pixel].

    Raises
    ------
    DiagnosisError
        There are several amplifiers and the header does not state their places on the sensor,
        or no exposure can be used.

    Examples
    --------
    Open a folder of recordings::

        source = CampaignSource(read_campaign("recordings/"))
        print(len(source.exposures), source.shape)
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
                    "known: give DETSEC in the headers, or sections in campaign.yaml"
                )
            x, y = layout.origin or (0, 0)
            down, across = layout.data
            rows = max(rows, y + down.stop - down.start)
            columns = max(columns, x + across.stop - across.start)
        if not rows:
            raise DiagnosisError(f"{campaign.folder}: no exposure can be used")
        self.shape = (rows, columns)

    def read(self, exposure: Exposure) -> Sequence[AmplifierFrame]:
        """Read the frames of one exposure.

        Parameters
        ----------
        exposure : Exposure
            One of ``exposures``.

        Returns
        -------
        sequence of AmplifierFrame
            One frame for each amplifier, in the campaign's order.
        """
        return read_exposure(self.campaign, exposure)


def _settled(campaign: Campaign) -> list[Exposure]:
    """Exposures with the settings of their group, as logged readings scatter about a set point.

    Pairs are taken from the manifest; without one, flats are paired later by their levels.
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
    """Read a reduced recording (a_ij or covariances) from a file, or from a folder without images.

    Parameters
    ----------
    path : Path
        File or folder.

    Returns
    -------
    recording : AreaChangeTable or CovarianceTable, or None
        None where the path is a folder with images, or without any reduced recording: a campaign.

    Raises
    ------
    DiagnosisError
        The path holds neither a_ij nor covariances, or more than one such table.
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


def find_reduced_recordings(
    paths: Sequence[Path], conditions: Sequence[tuple[str, Mapping[str, str]]] = ()
) -> CovarianceTable | list[StatedTable] | None:
    """Read reduced recordings of one sensor: a table of covariances, or some tables of a_ij.

    Parameters
    ----------
    paths : sequence of Path
        One file or folder, or several files of a_ij.
    conditions : sequence of (str, mapping of str to str)
        Name of a file, '' for all, and quantities with units that hold for it, with the keys
        back_bias, wavelength, temperature and level (a number of electrons); they replace those of
        its header.

    Returns
    -------
    CovarianceTable, list of StatedTable, or None
        None where the one path is a folder with images: a campaign.

    Raises
    ------
    DiagnosisError
        One of several paths is no table of a_ij, conditions are given for what has none, name a
        file that is not given, or state gate voltages, which are the device's.
    """
    read = {path: find_reduced_recording(path) for path in paths}
    known = {n for p in paths for n in (str(p), p.name, p.stem)} | {""}
    for file, _ in conditions:
        if file not in known:
            names = ", ".join(p.name for p in paths)
            raise DiagnosisError(f"--at {file}: not one of the given recordings {names}")
    tables = [(p, t) for p, t in read.items() if isinstance(t, AreaChangeTable)]
    if len(tables) < len(paths):
        if len(paths) > 1 or conditions:
            odd = next(p for p in paths if not isinstance(read[p], AreaChangeTable))
            raise DiagnosisError(
                f"{odd}: several recordings, and --at, are allowed for tables of a_ij only (columns "
                "i_serial, j_parallel, cov_per_e, err_per_e)"
            )
        only = read[paths[0]]
        assert not isinstance(only, AreaChangeTable)
        return only
    return [
        _stated(p, t, [g for f, g in conditions if f in ("", str(p), p.name, p.stem)])
        for p, t in tables
    ]


def _stated(
    path: Path, table: AreaChangeTable, given: Sequence[Mapping[str, str]]
) -> StatedTable:
    """Table of a_ij with the condition of its header and of the options, which win."""
    measured = read_measured(table.path) if table.path.is_file() else MeasuredTable(table)
    level = None
    for settings in given:
        own = dict(settings)
        if "level" in own:
            level = _level(path, own.pop("level"))
        measured = measured.at(own)
    at = measured.condition
    if at.gate_high is not None or at.gate_low is not None:
        raise DiagnosisError(
            f"{path.name}: gate voltages are those of the baseline's device; state them in its file"
        )
    return StatedTable(table, at, level)


def _level(path: Path, text: str) -> float:
    """Level of flats [e-] from the text of an option."""
    try:
        level = float(text)
    except ValueError:
        level = np.nan
    if not 0 < level < np.inf:
        raise DiagnosisError(
            f"--at {path.name}: level = {text[:40]!r} must be a number of electrons above 0"
        )
    return level


def is_device(given: str | os.PathLike[str] | None) -> bool:
    """Whether a baseline's name is that of a device, which can be simulated.

    Raises
    ------
    DeviceError
        The name is that of a device file that cannot be read.
    """
    if given is not None and Path(given).suffix == ".toml":
        Device.load(given)
        return True
    try:
        Device.load("" if given is None else given)
    except DeviceError:
        return False
    return True


def find_baseline(
    given: str | os.PathLike[str] | None, *, card: str | os.PathLike[str] | None = None
) -> Baseline:
    """Read a baseline: edge displacements (.json), a table (.fits), a GalSim stem, or a device.

    For edge displacements the keyword-only argument is the path of a device card, with the
    spread of the free parameters, as in :func:`read_edges`.

    Parameters
    ----------
    given : str or path-like or None
        A file, the name of a built-in device, or 'none' for white noise with free area changes
        (:func:`bfsensor.diagnose.model.free_baseline.free_baseline`).

    Returns
    -------
    Baseline
        Shifts, with free parameters where the file or the name 'none' provides them.

    Raises
    ------
    DiagnosisError
        ``given`` is None, or none of these; names what is allowed.

    Examples
    --------
    >>> find_baseline("none").parameters
    ('a10', 'a01', 'a20', 'a02', 'a11')
    """
    if given is None:
        raise DiagnosisError(
            "no baseline: name one in campaign.yaml or with --baseline (edge displacements .json, "
            "a table .fits, a GalSim stem, a built-in device, or 'none' for an unknown sensor)"
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
    back_biases: Sequence[float | None],
    *,
    keep: Path,
    warming: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> Baseline:
    """Simulate the baseline of a device with free parameters, or read it from the cache.

    Parameters
    ----------
    given : str or path-like
        Name of a built-in device, or a device file.
    parameters : sequence of str
        Dotted names of the free parameters; ('all',) for all with an uncertainty.
    back_biases : sequence of float or None
        Back biases of the recordings [V]; None: the device's own.
    keep : Path
        Folder where the shifts are cached as ``baseline_KEY.json``.
    warming : bool
        Whether shifts change with temperature; needed for recordings at several temperatures.
    progress : callable, optional
        Called with (solutions made, solutions in all).

    Returns
    -------
    Baseline
        As :func:`baseline_of_device` makes it.

    Raises
    ------
    DiagnosisError
        ``given`` is None or no device: tables and edge displacements have no parameters.

    Examples
    --------
    This takes seconds to minutes of CPU time the first time::

        simulate_baseline("itl_sta3800c", ("silicon.thickness",), [-60.0], keep=Path("cache"))
    """
    if given is None or Path(given).suffix in (".json", ".fits"):
        raise DiagnosisError(
            "free parameters need a device as baseline, by name or .toml, not "
            f"{given or 'no baseline'}"
        )
    try:
        device = Device.load(given)
    except DeviceError as error:
        raise DiagnosisError(
            f"free parameters need a device as baseline: {error}"
        ) from None
    own = device.operating_point.back_bias
    back_biases = sorted({own if b is None else float(b) for b in back_biases})
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
            keep=keep / "solutions",
            progress=progress,
        )
        keep.mkdir(parents=True, exist_ok=True)
        write_edges(baseline, path)
    found = read_edges(path, card=path)
    solver = DeviceSolver(
        device.to_toml(), tuple(dict.fromkeys(b for _, b in found.edges)),
        tuple(dict.fromkeys(w for w, _ in found.edges)), bool(found.slopes), True, keep / "solutions",
    )  # fmt: skip
    return replace(found, solver=solver)


def with_physics(
    baseline: Baseline, given: str | os.PathLike[str], *, keep: Path
) -> Baseline:
    """Add candidate effects for physics that a simulated baseline leaves out.

    Parameters
    ----------
    baseline : Baseline
        From :func:`simulate_baseline`.
    given : str or path-like
        Device of the baseline.
    keep : Path
        Folder where solutions are cached; they take half a minute of CPU time the first time.
    """
    pieces = physics_left_out(Device.load(given), baseline, keep=keep)
    return replace(baseline, pieces=pieces)


def reduced_states(
    recording: CovarianceTable | Sequence[StatedTable],
) -> list[tuple[float | None, float | None]]:
    """Back biases [V] and temperatures [K] of reduced recordings; None where they are not stated."""
    if isinstance(recording, CovarianceTable):
        biases = np.unique(recording.back_bias)
        return [(float(b) if np.isfinite(b) else None, None) for b in biases]
    return [(t.condition.back_bias, t.condition.temperature) for t in recording]


def asked_of(baseline: Baseline) -> str:
    """Sentence on the quantities of a device, and the physics, that a diagnosis compares.

    Parameters
    ----------
    baseline : Baseline
        From :func:`simulate_baseline`, with or without :func:`with_physics`.
    """
    pieces = [f"{k.word} {k.variant}".strip().replace("_", " ") for k in baseline.pieces]
    own = [n for n in baseline.parameters if n not in baseline.accuracy]
    text = f"fitted within their stated uncertainties: {', '.join(own)}"
    if baseline.accuracy:
        errors = [
            f"{n.removeprefix('mesh.').replace('_', ' in ')} {100 * baseline.spread[n]:.2g} %"
            for n in baseline.accuracy
        ]
        text += (
            f"; errors of calculated shifts by the mesh, fitted too: {', '.join(errors)}"
        )
    if pieces:
        text += f"; sought besides the library of effects: {', '.join(pieces)}"
        asked = {k.variant for k in baseline.pieces} | {
            SILICON[n] for n in baseline.parameters if n in SILICON
        }
        lacking = [
            v for v in (*SILICON.values(), "fewer_gates", "more_gates") if v not in asked
        ]
        if lacking:
            names = ", ".join(lacking).replace("_", " ")
            text += (
                f"; not sought, as such a device cannot be or could not be solved: {names}"
            )
    return text
