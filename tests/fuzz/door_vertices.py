"""Doors of distortions: GalSim's vertex files, and tables in FITS."""

from __future__ import annotations

import io
import re
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits

from bfsensor.sensor.silicon_sensor import SiliconSensor
from bfsensor.table.galsim_format import read_galsim, read_sides
from bfsensor.table.table import DistortionTable
from tests.fuzz.door_devices import SHIPPED
from tests.fuzz.mutations import close, harmless, mutate_bytes, mutate_text, pick, short
from tests.fuzz.outcomes import Case, Door
from tests.table.smooth_tables import make_table

STEM_KEYS = (
    "SensorThickness", "PixelSizeX", "PixelBoundaryNx", "PixelBoundaryNy", "NumVertices",
    "CollectedCharge_0_0", "Vbb", "Vparallel_lo", "Vparallel_hi", "NumPhases", "CollectingPhases",
    "CCDTemperature", "ChannelStopWidth", "FieldOxideTaper", "qfh",
)  # fmt: skip
"""Keys of a configuration that GalSim's sensor reads."""

ABOVE_0 = (
    "SensorThickness", "PixelSizeX", "PixelBoundaryNx", "NumVertices", "CollectedCharge_0_0",
    "NumPhases", "CCDTemperature",
)  # fmt: skip


class Stem(Door):
    """STEM.cfg and STEM.dat: as a table and as a sensor; vertices are compared line by line."""

    name = "galsim_stem"

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.cfg = (SHIPPED / "lsst_itl_50_8.cfg").read_text()
        self.dat = (SHIPPED / "lsst_itl_50_8.dat").read_text()
        self.write("stem.cfg", self.cfg.encode())
        self.write("stem.dat", self.dat.encode())
        SiliconSensor(str(folder / "stem"))
        assert (
            judge_stem(read_galsim(folder / "stem"), self.cfg, self.dat, folder / "stem")
            == ""
        )

    def make(self, rng: np.random.Generator) -> Case:
        """Mutate one of the two files."""
        texts, keeps = {"cfg": self.cfg, "dat": self.dat}, False
        end = pick(rng, ("cfg", "dat"))
        if end == "cfg" and rng.random() < 0.7:
            words, data = _set_key(rng, self.cfg)
        elif end == "cfg" and rng.random() < 0.2:
            words, data, keeps = harmless(rng, self.cfg)
        else:
            words, data, keeps = mutate_text(rng, texts[end], first=end == "dat")
        for one, text in texts.items():
            self.write(f"stem.{one}", data if one == end else text.encode())
        stem = self.folder / "stem"
        read = pick(rng, (read_galsim, SiliconSensor))

        def judge(made: Any) -> str:
            given = {**texts, end: data.decode(errors="replace")}
            return judge_stem(made, given["cfg"], given["dat"], stem)

        return Case(
            f"{end}: {words}", lambda: read(str(stem)), judge, ("stem.cfg", "stem.dat"), keeps,
            (OSError,) if read is SiliconSensor else (),
        )  # fmt: skip


def _set_key(rng: np.random.Generator, text: str) -> tuple[str, bytes]:
    """Give one of the keys that GalSim reads another value."""
    from tests.fuzz.mutations import NUMBERS, OTHERS

    key = pick(rng, STEM_KEYS)
    new = pick(rng, NUMBERS + OTHERS[:8])
    changed = re.sub(
        rf"^({key}\s*=\s*)[^#\n]*", lambda m: f"{m[1]}{new} ", text, flags=re.MULTILINE
    )
    return f"{key} becomes {short(new)}", changed.encode()


def judge_stem(made: Any, cfg: str, dat: str, stem: Path) -> str:
    """Compare a table or a sensor with the numbers and vertices of its files."""
    given: dict[str, set[str]] = {}
    for line in cfg.split("\n"):
        key, sign, value = line.split("#")[0].partition("=")
        if sign:
            given.setdefault(key.strip(), set()).add(value.strip())
    values = {}
    for key in STEM_KEYS:
        texts = given.get(key, set())
        if len(texts) > 1:
            return f"{key} is given as {sorted(texts)}, of which one was taken"
        # The table takes no voltages: those that cannot be a device's leave it without one.
        if isinstance(made, DistortionTable) and key not in STEM_KEYS[:6]:
            continue
        if not texts:
            if key in ("FieldOxideTaper", "qfh", "CollectedCharge_0_0", "PixelBoundaryNy"):
                return f"{key} is gone"
            return f"{key} is missing"
        try:
            values[key] = float(next(iter(texts)))
        except ValueError:
            return f"{key} = {short(texts)} was accepted"
        if not np.isfinite(values[key]):
            return f"{key} = {values[key]} was accepted"
        if key in ABOVE_0 and values[key] <= 0:
            return f"{key} = {values[key]} was accepted, which is not above 0"
    if isinstance(made, DistortionTable):
        own = {
            "SensorThickness": made.thickness, "PixelSizeX": made.pitch[0],
            "PixelBoundaryNx": 2 * made.reach + 1, "PixelBoundaryNy": 2 * made.reach + 1,
            "NumVertices": made.vertices, "CollectedCharge_0_0": made.charges[0],
        }  # fmt: skip
        nominal = made.nominal()
        lines = (
            nominal.horizontal + made.horizontal[0, 0, 0],
            nominal.vertical + made.vertical[0, 0, 0],
        )
    else:
        own = {key: made.config[key] for key in values}
        sides, points = read_sides(f"{stem}.cfg", f"{stem}.dat")
        inner = points[1:-1]
        lines = tuple(
            shift[:, :, 1:-1] + at
            for shift, at in zip(sides[::-1], _nominal(values, inner), strict=True)
        )
    for key, value in own.items():
        if not close(value, values[key]):
            return f"{key} = {value} for {values[key]}"
    return _judge_vertices(lines, dat, int(values["PixelBoundaryNx"]), values["PixelSizeX"])


def _nominal(values: dict[str, float], inner: Any) -> tuple[Any, Any]:
    """Positions of undisturbed vertices on lines along x and along y."""
    n, pitch = int(values["PixelBoundaryNx"]), values["PixelSizeX"]
    line = (np.arange(n + 1) - n / 2) * pitch
    at = line[:-1, None] + inner * pitch
    x = np.stack(np.broadcast_arrays(at[None], line[:, None, None]), -1)
    y = np.stack(np.broadcast_arrays(line[None, :, None], at[:, None]), -1)
    return x, y


def _judge_vertices(lines: tuple[Any, Any], dat: str, n: int, pitch: float) -> str:
    """Find every vertex of each side among those of the pixel nearer to the charge."""
    rows = []
    for line in dat.split("\n")[1:]:
        try:
            rows.append([float(word) for word in line.split("#")[0].split()])
        except ValueError:
            return f"the line {short(line)} was accepted"
    try:
        all_rows = np.array([row for row in rows if row])
        grid = all_rows.reshape(n, n, -1, 5).transpose(1, 0, 2, 3)
    except ValueError:
        return "rows of another number were accepted"
    if not np.isfinite(all_rows).all():
        return "values that are not finite were accepted"
    if (np.abs(all_rows[:, 3:] - all_rows[:, :2]) >= pitch).any():
        return "a vertex a pixel or more from its pixel was accepted"
    middle = grid[n // 2, n // 2, 0, :2]
    at = grid[..., 3:] - middle
    for axis, line in enumerate(lines):
        for k in range(n + 1):
            near = k if k <= n // 2 else k - 1
            for m in range(n):
                own = line[k, m] if axis == 0 else line[m, k]
                there = at[near, m] if axis == 0 else at[m, near]
                far = np.abs(own[:, None] - there[None]).max(-1).min(1).max()
                if far > 1e-4:
                    return (
                        f"a vertex of line {k} at pixel {m} is {far:g} um from the file's"
                    )
    return ""


SCALARS = {
    "PITCHX": (lambda t: t.pitch[0], 0.0), "PITCHY": (lambda t: t.pitch[1], 0.0),
    "THICKNSS": (lambda t: t.thickness, 0.0), "FULLWELL": (lambda t: t.full_well, 0.0),
    "VERTICES": (lambda t: t.vertices, 0.0), "REACH": (lambda t: t.reach, -1.0),
}  # fmt: skip
"""Header keywords of a table: the attribute, and what it must be above."""

FLAGS = {"SYMMETRC": lambda t: t.symmetric}

CARDS = (
    0, -1, 1, 2.5, 1e30, 1e-300, True, False, "10", "T", "no", "mm", "", "x" * 60, 10, 3, 99999999,
)  # fmt: skip
"""Values of header keywords."""


class TableFile(Door):
    """A table in FITS: bytes are changed, or contents are and checksums with them."""

    name = "table"

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        levels = {"charges": [0.0, 5e4], "backgrounds": [0.0, 2e4], "depths": [50.0, 100.0]}
        self.table = make_table(
            **levels, reach=1, vertices=2, full_well=2e5, device_text="name = 'a'"
        )
        path = folder / "whole.fits"
        self.table.write(path)
        self.data = path.read_bytes()
        assert DistortionTable.read(path) == self.table

    def make(self, rng: np.random.Generator) -> Case:
        """Mutate bytes, a header keyword, an array, or the list of extensions."""
        if rng.random() < 0.5:
            words, data, _ = mutate_bytes(rng, self.data)
            judge = self._unchanged
        else:
            way = pick(rng, (self._card, self._card, self._array, self._extension))
            words, data, judge = way(rng)
        path = self.write("camera.fits", data)
        return Case(words, lambda: DistortionTable.read(path), judge, ("camera.fits",))

    def _unchanged(self, made: DistortionTable) -> str:
        return "" if made == self.table else "another table was read"

    def _signed(self, hdus: fits.HDUList) -> bytes:
        """Bytes of extensions, with checksums."""
        out = io.BytesIO()
        for hdu in hdus:
            for key in ("CHECKSUM", "DATASUM"):
                hdu.header.remove(key, ignore_missing=True)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            hdus.writeto(out, checksum=True, output_verify="ignore")
        return out.getvalue()

    def _card(self, rng: np.random.Generator) -> tuple[str, bytes, Any]:
        """Change a keyword of a header."""
        hdus = fits.open(io.BytesIO(self.data))
        key = pick(
            rng, (*SCALARS, *FLAGS, "QUADRANT", "BUNIT", "SCHEMA", "SCHEMAV", "UNKNOWN")
        )
        number = int(rng.integers(7)) if key == "BUNIT" else 0
        value = pick(rng, CARDS)
        if key in hdus[number].header and repr(value) == repr(hdus[number].header[key]):
            value = -7
        if rng.random() < 0.1:
            hdus[number].header.remove(key, ignore_missing=True)
            value = None
        else:
            hdus[number].header[key] = value

        def judge(made: DistortionTable) -> str:
            if key in SCALARS and value is not None:
                read, low = SCALARS[key]
                number = isinstance(value, int | float) and not isinstance(value, bool)
                right = number and read(made) == value > low
                return "" if right else f"{key} = {read(made)} for {short(value)}"
            if key in FLAGS:
                right = isinstance(value, bool) and FLAGS[key](made) is value
                return "" if right else f"{key} is {FLAGS[key](made)} for {short(value)}"
            if key == "BUNIT" and value in (None, ""):
                return self._unchanged(made)  # a unit that is not stated is the schema's
            if key == "UNKNOWN" or value is True or (key == "FULLWELL" and value is None):
                return "" if key == "FULLWELL" else self._unchanged(made)
            return f"{key} = {short(value)} was accepted"

        return (
            f"keyword {key} of HDU {number} becomes {short(value)}",
            self._signed(hdus),
            judge,
        )

    def _array(self, rng: np.random.Generator) -> tuple[str, bytes, Any]:
        """Change the data of an extension."""
        hdus = fits.open(io.BytesIO(self.data))
        name = pick(
            rng, ("CORNERS", "HORIZONTAL", "VERTICAL", "CHARGES", "BACKGROUNDS", "DEPTHS")
        )
        old = np.array(hdus[name].data)
        factor = float(pick(rng, (-1.0, 1.1, 1e-3, 1e3, 1e6, 1e30, np.nan, np.inf)))
        way = int(rng.integers(5))
        new = old.copy()
        with np.errstate(all="ignore"):
            if way == 0:
                new *= factor
            elif way == 1:
                new.flat[int(rng.integers(new.size))] *= factor
            elif way == 2:
                new = new[..., :-1]
            elif way == 3:
                new = np.concatenate([new, new[-1:]])
            else:
                new = new[::-1].copy()
        what = (
            f"times {factor:g}",
            f"one value times {factor:g}",
            "shorter",
            "longer",
            "reversed",
        )
        hdus[name].data = new

        def judge(made: DistortionTable) -> str:
            own = getattr(made, name.lower())
            if not np.isfinite(own).all():
                return "values that are not finite were accepted"
            if name in ("CHARGES", "BACKGROUNDS", "DEPTHS"):
                right = (
                    np.array_equal(own, new) and own[0] >= 0 and (np.diff(own) > 0).all()
                )
                return "" if right else f"{name} = {own}"
            ny, nx = own.shape[3:5]
            stored = own[:, :, :, ny // 2 :, nx // 2 :]
            if stored.shape != new.shape or not np.allclose(stored, new):
                return "the array is not the file's"
            if np.abs(own).max() >= 10.0:
                return f"a vertex {np.abs(own).max():g} um from its place was accepted"
            return ""

        return f"{name} is {what[way]}", self._signed(hdus), judge

    def _extension(self, rng: np.random.Generator) -> tuple[str, bytes, Any]:
        """Delete, repeat, rename or exchange extensions."""
        hdus = fits.open(io.BytesIO(self.data))
        at, other = (int(k) for k in rng.integers(1, len(hdus), size=2))
        way = int(rng.integers(4))
        name, second = hdus[at].name, hdus[other].name
        # Arrays of one shape that changed places cannot be told apart but by their physics.
        if way == 3 and np.shape(hdus[at].data) == np.shape(hdus[other].data):
            way = 0
        if way == 0:
            del hdus[at]
        elif way == 1:
            again = hdus[at].copy()
            if again.data is not None:
                again.data = again.data[::-1].copy()
            hdus.append(again)
        elif way == 2:
            hdus[at].header["EXTNAME"] = pick(rng, ("OTHER", "", second))
        else:
            hdus[at].data, hdus[other].data = hdus[other].data, hdus[at].data
        what = (
            "deleted",
            "repeated with other data",
            "renamed",
            f"exchanged with {second}",
        )
        return f"extension {name} is {what[way]}", self._signed(hdus), self._unchanged
