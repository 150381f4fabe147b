"""Campaigns: reading and checking a folder of raw exposures of one sensor by their headers."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bfsensor.device.condition import Condition
from bfsensor.errors import RecordingError
from bfsensor.recording.campaign.consistency import (
    check_gains,
    check_keywords,
    check_layout,
    check_pairs,
    check_units,
    set_aside_contradictions,
    set_aside_duplicates,
    set_aside_other_layouts,
)
from bfsensor.recording.campaign.exposures import (
    Caution,
    Exposure,
    Progress,
    SetAside,
    count_of,
    find_pairs,
    group_conditions,
    named,
)
from bfsensor.recording.campaign.manifest import Entry, gather, set_order
from bfsensor.recording.campaign.settings import CampaignSettings, read_settings
from bfsensor.recording.raw.headers import SUFFIXES
from bfsensor.recording.raw.masks import read_masks
from bfsensor.recording.raw.sections import AmplifierLayout

__all__ = [
    "Campaign", "Caution", "Exposure", "SetAside", "read_campaign",
]  # fmt: skip

_QUANTITIES = (
    "exposure_time", "mjd", "wavelength", "filter", "back_bias", "gate_high", "gate_low",
    "temperature", "lamp",
)  # fmt: skip


@dataclass(frozen=True)
class Campaign:
    """Exposures of one sensor, with their conditions, amplifiers, pairs and warnings.

    Attributes
    ----------
    folder : Path
        Folder of the files.
    name : str
        Name in campaign.yaml, else that of the folder.
    exposures : tuple of Exposure
        Exposures that are used, in the order of time.
    set_aside : tuple of SetAside
        Files that are not used, each with its reason.
    warnings : tuple of Caution
        Warnings, each once.
    amplifiers : tuple of AmplifierLayout
        Amplifiers in the order of the files; all exposures have the same.
    settings : CampaignSettings
        Entries of campaign.yaml.
    has_manifest : bool
        True where a manifest.ecsv lists exposures.

    Examples
    --------
    >>> flats = tuple(Exposure(n, Path(f"f{n}.fits"), "flat", n, 2.0, pair=0) for n in (0, 1))
    >>> campaign = Campaign(Path("run_1"), "run_1", flats)
    >>> campaign.kinds(), len(campaign.pairs(exposure_time=2.0))
    ({'flat': 2}, 1)
    """

    folder: Path
    name: str
    exposures: tuple[Exposure, ...]
    set_aside: tuple[SetAside, ...] = ()
    warnings: tuple[Caution, ...] = ()
    amplifiers: tuple[AmplifierLayout, ...] = ()
    settings: CampaignSettings = field(default_factory=CampaignSettings)
    has_manifest: bool = False

    @property
    def card(self) -> Path | None:
        """JSON file of the nominal device, ``device_card`` in campaign.yaml; None without one."""
        return self.settings.device_card

    @property
    def baseline(self) -> Path | str | None:
        """Source of the simulation's prediction: a file of the folder, or a device's name."""
        if not self.settings.baseline:
            return None
        path = self.folder / self.settings.baseline
        return path if path.exists() else self.settings.baseline

    @property
    def files(self) -> list[Path]:
        """All files that say anything: frames, set aside ones too, and the folder's texts."""
        texts = [
            p for end in ("yaml", "ecsv", "json") for p in self.folder.glob(f"*.{end}")
        ]
        named = [p for p in (self.card, self.baseline) if isinstance(p, Path)]
        frames = [e.path for e in self.exposures] + [s.path for s in self.set_aside]
        return sorted({*texts, *named, *frames})

    @property
    def spot_grid(self) -> float | None:
        """Pitch of the mask of spots [pixel]; None where campaign.yaml states none."""
        return self.settings.spot_grid

    @property
    def lamp_error(self) -> float | None:
        """Relative error of one reading of the lamp monitor; None where not stated."""
        return self.settings.lamp_error

    @cached_property
    def _conditions(self) -> dict[str, dict[Condition, tuple[Exposure, ...]]]:
        kinds = {one.kind for one in self.exposures}
        return {kind: group_conditions(self.of(kind)) for kind in kinds}

    @cached_property
    def masks(self) -> dict[str, NDArray[np.bool_]]:
        """Masks of bad pixels from campaign.yaml, by amplifier, in readout order."""
        return read_masks(self.folder, self.settings.masks, self.amplifiers)

    def of(self, kind: str) -> tuple[Exposure, ...]:
        """Give the exposures of a kind.

        Parameters
        ----------
        kind : str
            Kind such as 'flat'; see :class:`Exposure`.

        Returns
        -------
        exposures : tuple of Exposure
            Exposures in the order of time; empty where there are none.
        """
        return tuple(one for one in self.exposures if one.kind == kind)

    def kinds(self) -> dict[str, int]:
        """Count the exposures of each kind.

        Returns
        -------
        kinds : dict of str to int
            Numbers of exposures, in the order in which kinds first occur.
        """
        out: dict[str, int] = {}
        for one in self.exposures:
            out[one.kind] = out.get(one.kind, 0) + 1
        return out

    def conditions(self, kind: str = "flat") -> dict[Condition, tuple[Exposure, ...]]:
        """Group the exposures of a kind by their settings, the largest group first.

        Sorted readings whose neighbours differ by no more than
        :data:`bfsensor.recording.campaign.exposures.TOLERANCES` count as one setting, so that a
        slow drift stays one setting however far it goes.

        Parameters
        ----------
        kind : str
            Kind of the exposures.

        Returns
        -------
        conditions : dict of Condition to tuple of Exposure
            Exposures by condition; empty where there are none.
        """
        return dict(self._conditions.get(kind, {}))

    def pairs(
        self, condition: Condition | None = None, *, exposure_time: float | None = None
    ) -> tuple[tuple[Exposure, Exposure], ...]:
        """Give the pairs of flats, in the order of time.

        Parameters
        ----------
        condition : Condition, optional
            One of :meth:`conditions`; by default all.
        exposure_time : float, optional
            Exposure time of the pairs [s], to the relative tolerance of pairs; by default all.

        Returns
        -------
        pairs : tuple of (Exposure, Exposure)
            The two flats of each pair.

        Raises
        ------
        RecordingError
            The campaign has no flats at the condition.
        """
        flats = self.of("flat")
        if condition is not None:
            if condition not in self.conditions():
                there = "; ".join(str(one) for one in self.conditions())
                raise RecordingError(
                    f"no flats at {condition}; there are flats at: {there or 'no condition'}"
                )
            flats = self.conditions()[condition]
        if exposure_time is not None:
            off = self.settings.pair_tolerance * exposure_time
            flats = tuple(
                one
                for one in flats
                if one.exposure_time is not None
                and abs(one.exposure_time - exposure_time) <= off
            )
        groups: dict[int, list[Exposure]] = {}
        for one in flats:
            if one.pair is not None:
                groups.setdefault(one.pair, []).append(one)
        return tuple((a[0], a[1]) for a in groups.values() if len(a) == 2)

    def exposure_times(self, condition: Condition) -> tuple[float, ...]:
        """Give the different exposure times of the pairs at a condition.

        Parameters
        ----------
        condition : Condition
            One of :meth:`conditions`.

        Returns
        -------
        times : tuple of float
            Exposure times that differ by more than the tolerance of pairs, ascending [s].
        """
        times: list[float] = []
        for first, _ in self.pairs(condition):
            seconds = first.exposure_time or 0.0
            off = self.settings.pair_tolerance * seconds
            if not any(abs(seconds - one) <= off for one in times):
                times.append(seconds)
        return tuple(sorted(times))

    def without(self, exposure: Exposure, reason: str) -> Campaign:
        """Return a copy with one more exposure set aside; its partner is no longer in a pair.

        Parameters
        ----------
        exposure : Exposure
            One of its exposures.
        reason : str
            Reason for setting it aside.

        Returns
        -------
        campaign : Campaign
            The copy.
        """
        left = tuple(
            replace(one, pair=None)
            if one.pair is not None and one.pair == exposure.pair
            else one
            for one in self.exposures
            if one.number != exposure.number
        )
        aside = (*self.set_aside, SetAside(exposure.path, reason))
        return replace(self, exposures=left, set_aside=aside)

    def with_warnings(self, *more: Caution) -> Campaign:
        """Return a copy with further warnings; those that it already has are not repeated.

        Parameters
        ----------
        *more : Caution
            Warnings to add.

        Returns
        -------
        campaign : Campaign
            The copy.
        """
        new = tuple(one for one in dict.fromkeys(more) if one not in self.warnings)
        return replace(self, warnings=(*self.warnings, *new))


def read_campaign(
    folder: str | os.PathLike[str], *, progress: Progress | None = None
) -> Campaign:
    """Read the headers of a folder of recordings, and check them against one another.

    Pixels are not kept, and only parts of each file are read (all of it where manifest.ecsv has
    SHA-256 sums); :func:`bfsensor.recording.inspect_campaign` checks the pixels.

    Parameters
    ----------
    folder : path-like
        Folder with raw FITS files of one sensor, each exposure a file of its own.  It may also
        hold ``campaign.yaml`` (:data:`bfsensor.recording.campaign.settings.ENTRIES`) and
        ``manifest.ecsv`` with a row for each exposure
        (:data:`bfsensor.recording.campaign.manifest.COLUMNS`).
    progress : callable, optional
        Function that is called with the number of files done and the number of all.

    Returns
    -------
    campaign : Campaign
        The exposures, with warnings and the files that are not used.

    Raises
    ------
    RecordingError
        The folder does not exist, campaign.yaml or manifest.ecsv cannot be read, or no exposure
        can be used.  A file that is broken, cut short, a duplicate, or contradicts its manifest
        or the other files raises nothing: it is named in ``set_aside``.

    Notes
    -----
    Pairs are those of the manifest's column 'pair'; without it, flats that follow one another
    directly, of equal exposure time and settings.  Files without a row in the manifest have the
    conditions of their headers.

    Examples
    --------
    >>> import tempfile
    >>> import numpy as np
    >>> from astropy.io import fits
    >>> header = fits.Header({"IMGTYPE": "FLAT", "EXPTIME": 2.0, "VBB": -60.0})
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     for n in range(2):
    ...         header["MJD-OBS"] = 60000.0 + n
    ...         data = np.full((8, 8), 900 + n, np.uint16)
    ...         fits.PrimaryHDU(data, header).writeto(f"{folder}/{n}.fits")
    ...     campaign = read_campaign(folder)
    >>> campaign.kinds(), len(campaign.pairs()), [str(c) for c in campaign.conditions()]
    ({'flat': 2}, 1, ['back bias -60 V'])
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise RecordingError(f"{folder}: no such folder")
    settings = read_settings(folder)
    entries, has_manifest = gather(folder, settings, progress)
    if not entries:
        inner = sorted(one.name for one in folder.iterdir() if one.is_dir())
        names = ", ".join(inner[:3]) + (" ..." if len(inner) > 3 else "")
        more = f"; folders in it are not searched, give one of them: {names}"
        raise RecordingError(
            f"{folder}: no FITS files (names that end in {', '.join(SUFFIXES)})"
            + (more if inner else "")
        )
    set_aside_duplicates(entries)
    amplifiers = set_aside_other_layouts(entries)
    warnings = set_aside_contradictions(entries)
    entries = set_order(entries)
    aside = tuple(SetAside(one.path, one.reason) for one in entries if one.reason)
    if len(aside) == len(entries):
        rest = f" (and {len(aside) - 1} more)" if len(aside) > 1 else ""
        raise RecordingError(
            f"{folder}: none of {count_of(len(aside), 'exposure')} can be used: {aside[0]}{rest}"
        )
    exposures = _paired(_exposures(entries), settings)
    strays = [one for one in entries if has_manifest and one.row is None and not one.reason]
    if strays:
        paths = {entry.path for entry in strays}
        these = [one for one in exposures if one.path in paths]
        warnings.append(
            Caution(
                "manifest", f"{len(strays)} files have no row in the manifest "
                f"({named(these)})",
                "they are used with the conditions of their headers; add rows, or leave them out in "
                "campaign.yaml: excluded: [FILE, ...]",
                tuple(one.number for one in these),
            )
        )  # fmt: skip
    lost = settings.baseline if "." in settings.baseline else ""
    if lost and not (folder / lost).exists():
        warnings.append(
            Caution(
                "baseline",
                f"{lost}, the baseline of campaign.yaml, is not there",
                "no prediction to compare with; give a file in the folder, or a device's name",
            )
        )
    warnings += [Caution("settings", text) for text in settings.remarks]
    warnings += check_layout(amplifiers)
    warnings += check_gains(amplifiers, entries)
    warnings += check_keywords(exposures, entries)
    warnings += check_units(exposures)
    warnings += check_pairs(exposures)
    campaign = Campaign(
        folder=folder,
        name=settings.name or folder.resolve().name,
        exposures=exposures,
        set_aside=aside,
        amplifiers=amplifiers,
        settings=settings,
        has_manifest=has_manifest,
    )
    _ = campaign.masks  # Faulty masks are refused here, before pixels are read.
    return campaign.with_warnings(*warnings)


def _exposures(entries: Sequence[Entry]) -> tuple[Exposure, ...]:
    """Make exposures of the entries that are used, in their order."""
    used = [(k, one) for k, one in enumerate(entries) if not one.reason]
    numbers = [one.said.get("number") for _, one in used]
    own = None not in numbers and len(set(numbers)) == len(numbers)

    def label(one: Entry) -> str | None:
        value = one.said.get("pair")
        return None if value is None else str(value)

    labels = list(dict.fromkeys(label(one) for _, one in used))
    return tuple(
        Exposure(
            number=int(one.said["number"]) if own else k, path=one.path, kind=one.said["kind"],
            position=k, pair=None if label(one) is None else labels.index(label(one)),
            **{name: one.said.get(name) for name in _QUANTITIES},
        )
        for k, one in used
    )  # fmt: skip


def _paired(
    exposures: tuple[Exposure, ...], settings: CampaignSettings
) -> tuple[Exposure, ...]:
    """Pair the flats, unless the manifest states pairs."""
    flats = [one for one in exposures if one.kind == "flat"]
    if any(one.pair is not None for one in flats):
        return exposures
    pairs = find_pairs(flats, tolerance=settings.pair_tolerance)
    number = {one.number: k for k, pair in enumerate(pairs) for one in pair}
    return tuple(replace(one, pair=number.get(one.number)) for one in exposures)
