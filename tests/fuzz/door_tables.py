"""Doors of reduced recordings: a_ij, covariances, spots, values by setting, and profiles."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable
from itertools import takewhile
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from astropy.table import Table

from bfsensor.recording.tables.area_changes import read_area_changes
from bfsensor.recording.tables.covariance_tables import read_covariances
from bfsensor.recording.tables.reduced import read_profile, read_spots
from bfsensor.recording.tables.setting_tables import read_setting_table
from tests.fuzz.mutations import close, harmless, mutate_text, pick, short
from tests.fuzz.outcomes import Case, Door

Rows = list[dict[str, str]]


def rows_of(data: bytes, *, ecsv: bool) -> tuple[Rows, dict[str, Any]]:
    """Rows of a table as texts, and the header's entries; ValueError where it is no table.

    It is read without astropy: comments are left out, the first line that is left has the names.
    """
    lines = data.decode().splitlines()
    delimiter = ","
    meta: dict[str, Any] = {}
    if ecsv:
        header = [line[2:] for line in takewhile(lambda line: line.startswith("#"), lines)]
        delimiter = " "
        try:
            meta = yaml.safe_load("\n".join(header[1:])) or {}
        except yaml.YAMLError as error:
            raise ValueError(str(error)) from None
        if isinstance(meta, dict):
            delimiter = meta.get("delimiter", " ")
    body = [line for line in lines if not line.startswith("#") and line.strip()]
    if not body:
        raise ValueError("no line has names")
    reader = csv.reader(
        io.StringIO("\n".join(body)), delimiter=delimiter, skipinitialspace=True
    )
    names, *rows = [[cell.strip() for cell in row] for row in reader]
    if any(len(row) > len(names) for row in rows):
        raise ValueError("a row has more cells than there are names")
    full = [row + [""] * (len(names) - len(row)) for row in rows]
    return [dict(zip(names, row, strict=True)) for row in full], meta


BLANK = ("", "nan")
"""Texts of cells in which nothing was measured."""


def number(text: str | None) -> float:
    """Number of a cell; nan for an empty or missing one, ValueError for anything else."""
    if text and text.lower().startswith("0x"):
        return float(int(text, 16))
    return float(text) if text not in (None, "") else float("nan")


class TableDoor(Door):
    """A table as comma-separated text or as ECSV, read by ``read`` and judged row by row."""

    columns: dict[str, Any] = {}  # noqa: RUF012
    meta: dict[str, Any] = {}  # noqa: RUF012
    endings: tuple[str, ...] = ("csv", "ecsv")
    read: Callable[[Path], Any]

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.texts = {}
        table = Table(self.columns)
        table.meta = dict(self.meta)
        for end in self.endings:
            path = folder / f"whole.{end}"
            table.write(path, format="ascii.ecsv" if end == "ecsv" else "ascii.csv")
            self.texts[end] = path.read_text()
            found = self.judge(type(self).read(path), self.texts[end].encode(), end)
            assert found == "", found

    def make(self, rng: np.random.Generator) -> Case:
        """Mutate a table of one of the two formats."""
        end = pick(rng, self.endings)
        text = self.texts[end]
        first = text[: text.rindex("#")].count("\n") + 2 if end == "ecsv" else 1
        if rng.random() < 0.08 and end == "csv":
            words, data, keeps = harmless(rng, text)
        else:
            first = int(rng.choice([0, first]))
            words, data, keeps = mutate_text(rng, text, first)
        path = self.write(f"rows.{end}", data)
        read = type(self).read
        return Case(
            f"{end}: {words}", lambda: read(path), lambda made: self.judge(made, data, end),
            (f"rows.{end}",), keeps,
        )  # fmt: skip

    def judge(self, made: Any, data: bytes, end: str) -> str:
        """Compare what was read with the rows of the file."""
        try:
            rows, header = rows_of(data, ecsv=end == "ecsv")
            entries = header.get("meta") or {}
            # YAML's ordered mapping is a list of pairs.
            entries = dict(entries)
            if not rows:
                return "a table without rows was accepted"
            return self.compare(made, rows, entries)
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            return f"no such table was accepted: {type(error).__name__} {short(str(error))}"

    def compare(self, made: Any, rows: Rows, meta: dict[str, Any]) -> str:
        """Say in what the object differs from the rows, or in which the rows are not allowed."""
        raise NotImplementedError


def differing(rows: Rows, column: str, own: Any, *, above: float = -np.inf) -> str:
    """Say where values differ from a column's, are not finite, or not above a limit."""
    if len(own) != len(rows):
        return f"{len(own)} values of {column} for {len(rows)} rows"
    for k, row in enumerate(rows):
        value = number(row[column])
        if not np.isfinite(value) or not value > above:
            return f"row {k + 1}: {column} = {row[column]!r} was accepted"
        if not close(own[k], value):
            return f"row {k + 1}: {column} = {own[k]} for {row[column]!r}"
    return ""


LAG_X, LAG_Y = (grid.ravel() for grid in np.meshgrid(np.arange(4), np.arange(3)))


class Areas(TableDoor):
    """Tables of a_ij: every row, its lag whole and from 0, its value finite, its error above 0."""

    name = "areas"
    columns = {  # noqa: RUF012
        "i_serial": LAG_X, "j_parallel": LAG_Y,
        "cov_per_e": -2e-6 / (1 + 9.0 * (LAG_X**2 + LAG_Y**2)) + 1e-9,
        "err_per_e": 1e-9 * (2.0 + LAG_X),
    }  # fmt: skip
    read = staticmethod(read_area_changes)

    def compare(self, made: Any, rows: Rows, meta: dict[str, Any]) -> str:
        """Look every row up in the matrices."""
        lags = [(number(row["i_serial"]), number(row["j_parallel"])) for row in rows]
        if any(not lag.is_integer() or lag < 0 for pair in lags for lag in pair):
            return "a lag that is not whole or below 0 was accepted"
        if len(set(lags)) < len(lags) or int(np.isfinite(made.a).sum()) != len(rows):
            return f"{int(np.isfinite(made.a).sum())} values for {len(rows)} rows"
        at = [(int(j), int(i)) for i, j in lags]
        return differing(rows, "cov_per_e", [made.a[one] for one in at]) or differing(
            rows, "err_per_e", [made.errors[one] for one in at], above=0.0
        )


LEVELS = np.repeat([2e3, 3e4, 8e4], 4)


class Covariances(TableDoor):
    """Tables of covariances: every row times the gain, with levels, gains and errors above 0."""

    name = "covariances"
    columns = {  # noqa: RUF012
        "amp": ["A"] * 12, "mu_adu": LEVELS / 2, "i": [0, 1, 0, 1] * 3, "j": [0, 0, 1, 1] * 3,
        "cov": np.where(np.arange(12) % 4 == 0, LEVELS, LEVELS**2 * 1e-7) / 4,
        "sigma": 0.01 + LEVELS / 1e4, "npix": [100_000] * 12, "npair": [3] * 12,
        "wavelength": [620.0] * 12, "vbb": [-50.0] * 12,
    }  # fmt: skip
    meta = {"gain": 2.0, "unit": "adu", "difference": False}  # noqa: RUF012
    endings = ("ecsv",)
    read = staticmethod(read_covariances)

    def compare(self, made: Any, rows: Rows, meta: dict[str, Any]) -> str:
        """Convert every row again."""
        gain, unit = meta.get("gain"), meta.get("unit", "electron")
        difference = meta.get("difference", False)
        if extra := set(meta) - {
            "gain",
            "unit",
            "difference",
            "kind",
            "__serialized_columns__",
        }:
            return f"the unknown header entries {short(extra)} were ignored"
        if type(difference) is not bool or unit not in ("electron", "adu"):
            return f"unit {unit}, difference {difference}"
        if "gain" not in rows[0] and (
            isinstance(gain, bool) or not 0 < float(gain) < np.inf
        ):
            return f"gain = {short(gain)} was accepted"
        names = {
            "wavelength": 0.0,
            "vbb": -np.inf,
            "npix": -1.0,
            "npair": -1.0,
            "i": -1,
            "j": -1,
        }
        if (
            extra := set(rows[0])
            - set(names)
            - {"amp", "mu_adu", "mu_e", "cov", "sigma", "gain"}
        ):
            return f"the unknown columns {short(extra)} were ignored"
        own = {"i": made.lag_x, "j": made.lag_y, "npix": made.pixels, "npair": made.pairs,
               "wavelength": made.wavelength, "vbb": made.back_bias}  # fmt: skip
        for name, above in names.items():
            if name not in rows[0]:
                continue
            blank = [
                name in ("wavelength", "vbb") and row[name].lower() in BLANK for row in rows
            ]
            if any(blank) and not np.array_equal(np.isnan(own[name]), blank):
                return f"{name} = {own[name]}"
            filled = [row for row, one in zip(rows, blank, strict=True) if not one]
            if wrong := differing(filled, name, own[name][~np.array(blank)], above=above):
                return wrong
        if [row.get("amp", "all") for row in rows] != made.amplifier.tolist():
            return "the names of the amplifiers changed"
        factor = (float(gain) ** 2 if unit == "adu" else 1.0) / (2 if difference else 1)
        level = "mu_e" if "mu_e" in rows[0] else "mu_adu"
        own_level = made.level / (float(gain) if level == "mu_adu" else 1.0)
        return (
            differing(rows, level, own_level, above=0.0)
            or differing(rows, "cov", made.covariance / factor)
            or differing(rows, "sigma", made.error / factor, above=0.0)
        )


class Spots(TableDoor):
    """Tables of spots: every quantity finite, sizes and errors above 0."""

    name = "spots"
    columns = {  # noqa: RUF012
        "flux": [1e4, 5e4, 1e5, 2e5], "sigma_x": [1.0, 1.01, 1.02, 1.04],
        "sigma_y": [1.1, 1.11, 1.12, 1.14], "sigma_x_error": [0.01] * 4,
        "sigma_y_error": [0.01] * 4, "x": [3.1, 4.2, 5.3, 6.4], "y": [1.1, 2.2, 3.3, 4.4],
        "wavelength": [620.0] * 4, "amp": ["A", "A", "B", "B"],
    }  # fmt: skip
    read = staticmethod(read_spots)

    def compare(self, made: Any, rows: Rows, meta: dict[str, Any]) -> str:
        """Compare each column."""
        if [row.get("amp", "") for row in rows] != made.group.tolist():
            return "the groups changed"
        known = {"flux": -np.inf, "sigma_x": 0.0, "sigma_y": 0.0, "x": -np.inf, "y": -np.inf,
                 "wavelength": 0.0}  # fmt: skip
        ends = {f"{name}_error" for name in known}
        others = {"amp", "peak", "back_bias", "vbb", "e1", "e2", "T", "kurtosis"} | ends
        lost = {*known, *ends} & set(self.columns) - set(rows[0])
        if lost & {"x", "y"} and "no positions" in "".join(made.warnings):
            lost -= {"x", "y"}
        if lost and (extra := set(rows[0]) - set(known) - others):
            return f"the unknown columns {short(extra)} were ignored, {lost} is lost"
        for name, above in known.items():
            if name in rows[0] and (
                wrong := differing(rows, name, made.values[name], above=above)
            ):
                return wrong
            error = f"{name}_error"
            if error in rows[0] and (
                wrong := differing(rows, error, made.errors[name], above=0.0)
            ):
                return wrong
        return ""


class SettingRows(TableDoor):
    """Tables of slopes by setting: every value finite, its error above 0, rows kept once."""

    name = "settings_table"
    columns = {  # noqa: RUF012
        "back_bias": [-60.0, -60.0, -40.0, -40.0], "wavelength": [620.0] * 4,
        "temperature": [173.0] * 4, "axis": ["x", "y", "x", "y"],
        "slope": [0.7, 0.9, 1.1, 1.3], "slope_error": [0.05, 0.06, 0.07, 0.08],
    }  # fmt: skip
    read = staticmethod(read_setting_table)

    def compare(self, made: Any, rows: Rows, meta: dict[str, Any]) -> str:
        """Compare each row; of rows that are repeated the first counts."""
        settings = ("back_bias", "wavelength", "temperature")
        if extra := set(rows[0]) - {*settings, "axis", "slope", "slope_error", "gate_high"}:
            return f"the unknown columns {short(extra)} were ignored"
        kept: Rows = []
        for row in rows:
            key = [number(row.get(k)) for k in (*settings, "slope")]
            key = [None if v != v else v for v in key] + [row["axis"]]
            if key not in [one["key"] for one in kept]:
                kept.append({**row, "key": key})
        if tuple(row["axis"] for row in kept) != made.axes or set(made.axes) - {"x", "y"}:
            return f"axes {made.axes}"
        limits = {"back_bias": -np.inf, "wavelength": 0.0, "temperature": 0.0}
        for name, above in limits.items():
            if name not in rows[0]:
                continue
            own = [getattr(one, name) for one in made.conditions]
            filled = [row for row in kept if row[name].lower() not in BLANK]
            empty = [row[name].lower() in BLANK for row in kept]
            if empty != [v is None for v in own]:
                return f"{name} = {own}"
            values = [v for v in own if v is not None]
            if wrong := differing(filled, name, values, above=above):
                return wrong
        if "slope_error" in rows[0]:
            empty = [row["slope_error"].lower() in BLANK for row in kept]
            if any(empty) and "without errors" not in " ".join(made.warnings):
                return "errors are missing, and no warning says so"
            filled = [row for row, one in zip(kept, empty, strict=True) if not one]
            values = [v for v, one in zip(made.errors, empty, strict=True) if not one]
            if wrong := differing(filled, "slope_error", values, above=0.0):
                return wrong
        return differing(kept, "slope", made.values)


class Profiles(TableDoor):
    """Radial profiles: radii that ascend, values and errors of the rows that have any."""

    name = "profile"
    columns = {  # noqa: RUF012
        "radius": np.arange(1000.0, 1014.0), "value": np.cos(np.arange(14.0)),
        "error": 0.01 + np.arange(14.0) / 1e3,
    }  # fmt: skip
    endings = ("ecsv",)
    read = staticmethod(read_profile)

    def compare(self, made: Any, rows: Rows, meta: dict[str, Any]) -> str:
        """Compare each column."""
        if extra := set(rows[0]) - {"radius", "value", "error"}:
            return f"the unknown columns {short(extra)} were ignored"
        if np.any(np.diff(made.radius) <= 0):
            return "radii do not ascend"
        return (
            differing(rows, "radius", made.radius)
            or differing(rows, "value", made.value)
            or ("error" in rows[0] and differing(rows, "error", made.error, above=0.0))
            or ""
        )
