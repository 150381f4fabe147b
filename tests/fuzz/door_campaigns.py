"""Doors of campaigns: campaign.yaml, manifest.ecsv, and the frames themselves."""

from __future__ import annotations

import io
import math
import re
import shutil
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from astropy.io import fits
from astropy.table import Table

from bfsensor.recording.campaign.campaign import Campaign, read_campaign
from bfsensor.recording.campaign.inspection import inspect_campaign
from tests.fuzz.door_tables import BLANK, number, rows_of
from tests.fuzz.mutations import (
    close,
    harmless,
    mutate_bytes,
    mutate_text,
    mutate_tree,
    pick,
    short,
)
from tests.fuzz.outcomes import Case, Door

SETTINGS = """schema: bfsensor-campaign-1
name: run 3
sensor: a test sensor
lamp_monitor: {keyword: MONDIODE, relative_error: 2.0e-4}
spots: {grid_px: 30}
keywords:
  exposure_time: {keyword: EXPTIME, unit: s, scale: 1.0}
  back_bias: {scale: -1}
  kind: {keyword: IMGTYPE, values: {offset: bias}}
amplifiers:
- {name: A, hdu: 0, data: '[1:16,1:12]', bias: '[17:24,1:12]', gain: 1.5, noise: 5}
masks: ['[1:2,1:3]']
excluded: {'spare*': broken}
pairs: {tolerance: 0.02}
nuisances: {shutter: electronic}
"""
"""A campaign.yaml with every entry that needs no other file."""

PLAN = (
    ("BIAS", 0.0),
    ("BIAS", 0.0),
    ("FLAT", 2.0),
    ("FLAT", 2.0),
    ("FLAT", 8.0),
    ("FLAT", 8.0),
)
"""Kinds and exposure times of the campaign."""


def make_frames(folder: Path) -> list[str]:
    """Write six small exposures and their manifest; the names of their files."""
    rng = np.random.default_rng(5717)
    rows = []
    for n, (kind, seconds) in enumerate(PLAN):
        cards = {
            "IMGTYPE": kind, "SEQNUM": n, "MJD-OBS": 60000.0 + n / 1e3, "EXPTIME": seconds,
            "MONOWL": 620.0, "CCDTEMP": -100.0, "VBB": 60.0, "PARLHI": 4.0, "PARLLO": -8.0,
            "MONDIODE": 100.0, "DATASEC": "[1:16,1:12]", "BIASSEC": "[17:24,1:12]",
            "DETSEC": "[1:16,1:12]", "GAIN": 1.5,
        }  # fmt: skip
        pixels = 1000 + 5 * rng.standard_normal((12, 24))
        if kind == "FLAT":
            pixels[:, :16] += rng.poisson(500 * seconds, (12, 16))
        name = f"{kind.lower()}_{n}.fits"
        hdu = fits.PrimaryHDU(np.rint(pixels).astype(np.uint16), fits.Header(cards))
        hdu.writeto(folder / name)
        rows.append((name, kind, n, 60000.0 + n / 1e3, seconds, 620.0, -100.0))
    names = ("file", "imgtype", "seq", "mjd", "exptime", "wavelength", "temp")
    Table(rows=rows, names=names).write(folder / "manifest.ecsv", format="ascii.ecsv")
    return [str(row[0]) for row in rows]


def said(campaign: Campaign) -> str:
    """All that a campaign says of its files and settings."""
    return " ".join(str(one) for one in (*campaign.set_aside, *campaign.warnings))


def unaccounted(campaign: Campaign, names: list[str]) -> str:
    """Say which files are neither used nor set aside."""
    found = {one.path.name for one in (*campaign.exposures, *campaign.set_aside)}
    lost = set(names) - found
    return f"{sorted(lost)} are neither used nor set aside" if lost else ""


class Settings(Door):
    """campaign.yaml; every entry is compared with the settings of the campaign that is read."""

    name = "campaign"

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.names = make_frames(folder)
        (folder / "manifest.ecsv").unlink()
        self.write("campaign.yaml", SETTINGS.encode())
        found = self.judge(read_campaign(folder), SETTINGS.encode())
        assert found == "", found

    def make(self, rng: np.random.Generator) -> Case:
        """Mutate the text or the tree of entries."""
        keeps = False
        way = rng.random()
        if way < 0.5:
            words, tree = mutate_tree(rng, yaml.safe_load(SETTINGS), (
                0, -1, 1e30, float("nan"), float("inf"), 1e-300, 10**400, True, None, "", "text",
                "7", [], [1.0, 2.0], {}, {"a": 1}, "x" * 5000, "\x1b[31m", 0.5, 3, "[1:3,1:99]",
            ))  # fmt: skip
            data = yaml.safe_dump(tree).encode()
        elif way < 0.58:
            words, data, keeps = harmless(rng, SETTINGS)
        elif way < 0.63:
            words, data, keeps = (
                "keys in another order",
                yaml.safe_dump(dict(reversed(yaml.safe_load(SETTINGS).items()))).encode(),
                True,
            )
        else:
            words, data, keeps = mutate_text(rng, SETTINGS)
        self.write("campaign.yaml", data)
        return Case(
            words, lambda: read_campaign(self.folder), lambda made: self.judge(made, data),
            ("campaign.yaml", ".fits"), keeps,
        )  # fmt: skip

    def judge(self, made: Campaign, data: bytes) -> str:
        """Compare the settings with the entries."""
        try:
            node = yaml.compose(data.decode())
            given = yaml.safe_load(data.decode()) or {}
        except (yaml.YAMLError, ValueError) as error:
            return f"no YAML was accepted: {short(str(error))}"
        if key := _twice(node):
            return f"the key {key} is given twice, and one was taken"
        own, words = made.settings, said(made)
        if wrong := unaccounted(made, self.names):
            return wrong
        for key in given:
            if (
                key not in yaml.safe_load(SETTINGS)
                and key
                not in (
                    "instrument",
                    "baseline",
                )
                and str(key)[:20] not in words
                and "is not known" not in words
            ):
                return f"the unknown entry {short(key)} was ignored"
        known = {
            "lamp_monitor": {"keyword", "relative_error"}, "spots": {"grid_px"},
            "pairs": {"tolerance"},
        }  # fmt: skip
        for key, allowed in known.items():
            entry = given.get(key) or {}
            ignored = isinstance(entry, dict) and set(entry) - allowed
            if not isinstance(entry, dict) or (ignored and f"{key}: " not in words):
                return f"{key}: {short(entry)} was accepted"
        numbers = {
            "lamp_monitor.relative_error": own.lamp_error, "spots.grid_px": own.spot_grid,
            "pairs.tolerance": own.pair_tolerance,
        }  # fmt: skip
        for key, value in numbers.items():
            section, name = key.split(".")
            stated = (given.get(section) or {}).get(name)
            if stated is None:
                continue
            right = not isinstance(stated, bool | list | dict) and close(value, stated)
            if not (right and math.isfinite(float(stated)) and float(stated) > 0):
                return f"{key} = {value} for {short(stated)}"
        texts = {"name": own.name, "sensor": own.sensor}
        for key, value in texts.items():
            stated = given.get(key, given.get("instrument", "") if key == "sensor" else "")
            if key == "sensor" and not stated:
                continue
            text = isinstance(stated, str | int | float) and not isinstance(stated, bool)
            if stated is not None and not (
                text and value == str(stated) and len(value) < 300
            ):
                return f"{key} = {short(value)} for {short(stated)}"
        return (
            self._judge_keywords(made, given.get("keywords") or {})
            or self._judge_amplifiers(made, given.get("amplifiers"))
            or self._judge_lists(made, given)
        )

    def _judge_keywords(self, made: Campaign, given: Any) -> str:
        """Compare the entry keywords."""
        for name, entry in given.items():
            own = made.settings.overrides.get(name)
            if own is None:
                return f"keywords: {short(name)} was ignored"
            if isinstance(entry, str | list):
                entry = {"keyword": entry}
            words = entry.get("keyword", [])
            words = [words] if isinstance(words, str) else words
            if list(own.keywords) != words or not all(
                isinstance(w, str) and w for w in words
            ):
                return f"keywords: {name}: keyword = {own.keywords} for {short(words)}"
            scale = entry.get("scale", 1.0)
            if isinstance(scale, bool) or not close(own.scale, scale) or not own.scale:
                return f"keywords: {name}: scale = {own.scale} for {short(scale)}"
            unit = entry.get("unit", "")
            if not isinstance(unit, str) or own.unit != unit:
                return f"keywords: {name}: unit = {own.unit!r} for {short(unit)}"
            values = entry.get("values") or {}
            stated = {str(k).strip().lower(): str(v) for k, v in values.items()}
            if dict(own.values) != stated or not all(
                isinstance(v, str) for v in values.values()
            ):
                return f"keywords: {name}: values = {short(own.values)} for {short(values)}"
        return ""

    def _judge_amplifiers(self, made: Campaign, given: Any) -> str:
        """Compare gain, noise and place of the amplifiers."""
        words = said(made)
        if given is None:
            return ""
        for entry, one in zip(given, made.amplifiers, strict=True):
            name = entry.get("name")
            text = isinstance(name, str | int | float) and not isinstance(name, bool)
            if not text or one.name != str(name) or len(one.name) > 300:
                return f"amplifiers: name = {short(one.name)} for {short(name)}"
            if "hdu" in entry and (
                type(entry["hdu"]) is not int or one.hdu != entry["hdu"]
            ):
                return f"amplifiers: hdu = {one.hdu} for {short(entry['hdu'])}"
            limits = {
                "gain": (1e-4, 1e4),
                "noise": (0.0, 1e5),
                "saturation": (1e-300, 1e300),
            }
            for key, (low, high) in limits.items():
                stated, own = entry.get(key), getattr(one, key)
                if stated is None:
                    continue
                number = not isinstance(stated, bool | list | dict)
                if own is None and f"campaign.yaml's {key}" in words:
                    continue
                if not (number and close(own, stated) and low <= own <= high):
                    return f"amplifiers: {key} = {own} for {short(stated)}"
        return ""

    def _judge_lists(self, made: Campaign, given: dict[Any, Any]) -> str:
        """Compare masks and exclusions."""
        masks = given.get("masks") or []
        masks = [masks] if isinstance(masks, str) else masks
        if list(made.settings.masks) != list(masks):
            return f"masks = {made.settings.masks} for {short(masks)}"
        for text in masks:
            ends = [int(n) for n in re.findall(r"\d+", text)]
            if not (
                len(ends) == 4 and max(ends[:2]) <= 16 and max(ends[2:]) <= 12 and min(ends)
            ):
                return f"the mask {text} was accepted"
        excluded = given.get("excluded") or []
        excluded = [excluded] if isinstance(excluded, str) else excluded
        if list(made.settings.excluded) != list(excluded):
            return f"excluded = {short(made.settings.excluded)} for {short(excluded)}"
        return ""


def _twice(node: Any) -> str:
    """Name a key that a mapping of the text has twice; '' where none."""
    if isinstance(node, yaml.MappingNode):
        keys = [key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode)]
        again = [key for key in keys if keys.count(key) > 1]
        return (
            again[0]
            if again
            else next(filter(None, (_twice(v) for _, v in node.value)), "")
        )
    if isinstance(node, yaml.SequenceNode):
        return next(filter(None, (_twice(v) for v in node.value)), "")
    return ""


class Manifest(Door):
    """manifest.ecsv; exposures must have the numbers of their rows, or a warning names them."""

    name = "manifest"

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.names = make_frames(folder)
        self.text = (folder / "manifest.ecsv").read_text()
        found = self.judge(read_campaign(folder), self.text.encode())
        assert found == "", found

    def make(self, rng: np.random.Generator) -> Case:
        """Mutate the manifest's text."""
        first = self.text[: self.text.rindex("#")].count("\n") + 2
        words, data, keeps = mutate_text(rng, self.text, int(rng.choice([0, first])))
        self.write("manifest.ecsv", data)
        return Case(
            words, lambda: read_campaign(self.folder), lambda made: self.judge(made, data),
            ("manifest.ecsv",), keeps,
        )  # fmt: skip

    def judge(self, made: Campaign, data: bytes) -> str:
        """Look every row's file up among the exposures."""
        if wrong := unaccounted(made, self.names):
            return wrong
        try:
            rows, _ = rows_of(data, ecsv=True)
        except (ValueError, KeyError) as error:
            return f"no such manifest was accepted: {short(str(error))}"
        words = said(made)
        whole = self.text.splitlines()[-7].split()
        given = set(rows[0] if rows else whole)
        if (lost := set(whole) - given) and (extra := given - set(whole)):
            return f"{short(extra)} was ignored, and {lost} is lost"
        by_name = {one.path.name: one for one in made.exposures}
        for row in rows:
            one = by_name.get(row.get("file", ""))
            if one is None:
                if row.get("file", "")[:30] not in words:
                    return f"the row of {short(row.get('file'))} was ignored"
                continue
            limits = {
                "exptime": ("exposure_time", 0.0, 1e300, 1.0), "temp": ("temperature", 1.0, 373.0, 1.0),
                "mjd": ("mjd", -np.inf, np.inf, 1.0), "wavelength": ("wavelength", 100, 3000, 1.0),
            }  # fmt: skip
            for column, (name, low, high, _) in limits.items():
                if (row.get(column) or "").lower() in BLANK:
                    continue
                if column == "wavelength" and one.kind == "bias":
                    continue
                try:
                    value = number(row[column])
                except ValueError:
                    return f"{one.path.name}: {column} = {row[column]!r} was accepted"
                value += 273.15 if column == "temp" else 0.0
                own = getattr(one, name)
                if not (np.isfinite(value) and low <= value <= high):
                    value = math.nan
                if own is not None and close(own, value, 1e-7):
                    continue
                # Warnings name the header's keyword, whose place the column takes.
                named = {column.upper(), name.upper(), one.path.name.upper(), "MONOWL ="}
                if any(word in words.upper() for word in named):
                    continue
                if column == "wavelength" and number(row[column]) == 0:
                    continue
                return f"{one.path.name}: {name} = {own} for {row[column]!r}"
        return ""


CARDS = (
    math.nan, math.inf, "nan", "inf", "-inf", 0, -1, 1e30, 10**18, "word", True, "", "[1:99,1:99]",
    "[0:1,1:1]", "[16:1,1:12]", 2.5, "x" * 60, "1e400", -32768,
)  # fmt: skip
"""Values of header keywords; those that FITS cannot write as numbers are written as texts."""


class Frames(Door):
    """One frame of six is damaged: the others stay, and the campaign is never lost."""

    name = "frames"

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.names = make_frames(folder)
        (folder / "manifest.ecsv").unlink()
        self.whole = {name: (folder / name).read_bytes() for name in self.names}
        inspect_campaign(read_campaign(folder))

    def make(self, rng: np.random.Generator) -> Case:
        """Damage one frame: header bytes, data bytes, a keyword, or pixels."""
        name = pick(rng, self.names)
        for other, data in self.whole.items():
            (self.folder / other).write_bytes(data)
        if rng.random() < 0.6:
            words, data = self._card(rng, self.whole[name])
        elif rng.random() < 0.7:
            size = 1800 if rng.random() < 0.7 else len(self.whole[name])
            words, start, _ = mutate_bytes(rng, self.whole[name][:size])
            data = start + self.whole[name][size:]
        else:
            words, data = self._pixels(rng, self.whole[name])
        (self.folder / name).write_bytes(data)

        def load() -> Campaign:
            return inspect_campaign(read_campaign(self.folder)).campaign

        return Case(
            f"{name}: {words}",
            load,
            lambda made: self.judge(made, name),
            (name,),
            keeps=True,
        )

    def _card(self, rng: np.random.Generator, data: bytes) -> tuple[str, bytes]:
        """Change a keyword, whatever the standard allows."""
        keys = (
            "IMGTYPE", "SEQNUM", "MJD-OBS", "EXPTIME", "MONOWL", "CCDTEMP", "VBB", "PARLHI",
            "MONDIODE", "DATASEC", "BIASSEC", "DETSEC", "GAIN", "BITPIX", "NAXIS", "NAXIS1",
            "NAXIS2", "BZERO", "BSCALE",
        )  # fmt: skip
        key, value = pick(rng, keys), pick(rng, CARDS)
        text = f"{value!r}" if isinstance(value, str) else f"{value}".upper().rjust(20)
        text = "                   T" if value is True else text
        card = f"{key:8}= {text}"[:80].ljust(80).encode()
        at = data.find(f"{key:8}=".encode())
        way = int(rng.integers(10))
        if way == 0:
            card, words = b" " * 80, f"{key} is blank"
        elif way == 1:
            other = data.find(b"EXPTIME =") if data.find(b"EXPTIME =") > 0 else 160
            other = data.find(b"EXPTIME")
            data = data[:other] + data[at : at + 80] + data[other + 80 :]
            return f"{key} is given twice, EXPTIME not at all", data
        else:
            words = f"{key} becomes {short(value)}"
        return words, data[:at] + card + data[at + 80 :]

    def _pixels(self, rng: np.random.Generator, data: bytes) -> tuple[str, bytes]:
        """Change the pixels and their type or shape."""
        with fits.open(io.BytesIO(data)) as hdus:
            pixels, header = np.array(hdus[0].data, float), hdus[0].header
        way = int(rng.integers(6))
        words = ("NaN", "one infinite", "transposed", "shorter", "1e300", "a cube")[way]
        if way == 0:
            pixels[: int(rng.integers(1, 12))] = np.nan
        elif way == 1:
            pixels[3, 3] = np.inf
        elif way == 2:
            pixels = pixels.T
        elif way == 3:
            pixels = pixels[: int(rng.integers(12))]
        elif way == 4:
            pixels *= 1e300
        else:
            pixels = np.stack([pixels, pixels])
        for key in ("BZERO", "BSCALE"):
            header.remove(key, ignore_missing=True)
        out = io.BytesIO()
        fits.PrimaryHDU(pixels, header).writeto(out)
        return f"pixels are {words}", out.getvalue()

    def judge(self, made: Campaign, name: str) -> str:
        """Look for the other frames, and for the header's exposure time."""
        if wrong := unaccounted(made, self.names):
            return wrong
        kept = {one.path.name: one for one in made.exposures}
        lost = [one for one in self.names if one not in kept and one != name]
        # Two flats of equal pixels or equal places are one of them a copy.
        if lost:
            return f"{lost} were set aside with {name}: {short(said(made))}"
        one = kept.get(name)
        if one is None:
            return ""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                with fits.open(self.folder / name) as hdus:
                    hdus.verify("silentfix")
                    stated = hdus[0].header.get("EXPTIME")
            except Exception as error:
                return f"{name} was used: {short(str(error))}"
        if stated is None or isinstance(stated, bool):
            return ""
        try:
            value = float(stated)
        except (TypeError, ValueError):
            value = math.nan
        if not (math.isfinite(value) and value >= 0):
            words = said(made)
            told = "EXPTIME" in words or "exposure time" in words
            return (
                ""
                if one.exposure_time is None and told
                else f"EXPTIME = {one.exposure_time}"
            )
        return "" if close(one.exposure_time, value) else f"EXPTIME = {one.exposure_time}"


def clear(folder: Path) -> None:
    """Remove all that is in a folder."""
    for path in folder.iterdir():
        shutil.rmtree(path) if path.is_dir() else path.unlink()
