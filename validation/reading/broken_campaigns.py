"""Twelve ways to break a campaign, and what reading it says to each.

``python -m validation.reading.broken_campaigns [CAMPAIGN]`` copies a small campaign (a folder in the
format of campaigns; without one a synthetic one of 24 exposures is made), breaks each copy in
one way, reads it, and prints what was kept, set aside and warned of.  One row for each goes
to ``validation/results/broken_campaigns.ecsv``.  The check fails where an exposure is neither
kept nor set aside by name, or where a breakage goes unmentioned.
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from astropy.io import fits
from astropy.table import Table

from bfsensor.errors import RecordingError
from bfsensor.recording.campaign.campaign import Campaign, read_campaign
from bfsensor.recording.campaign.inspection import inspect_campaign
from bfsensor.recording.campaign.questions import open_questions
from validation.common.write_results import write_results

NY, NX, PRESCAN, OVERSCAN, ROWS = 96, 80, 8, 24, 16
GAIN, NOISE, PEDESTAL, RATE = 2.2, 2.5, 1000.0, 2000.0
AMPLIFIERS = {"SEGMENT10": f"[1:{NX},1:{NY}]", "SEGMENT11": f"[{2 * NX}:{NX + 1},1:{NY}]"}
LADDER = (0.5, 0.5, 2.0, 2.0, 6.0, 6.0, 12.0, 12.0, 20.0, 20.0)
RESULTS = "validation/results/broken_campaigns.ecsv"


def make_campaign(folder: Path, seed: int = 8411) -> Path:
    """Write biases, darks and flats of a sensor with white noise only, and a manifest."""
    rng = np.random.default_rng(seed)
    plan = [("BIAS", 0.0)] * 10 + [("DARK", 5.0)] * 2
    plan += [("FLAT", t) for t in (*LADDER, *LADDER[3:1:-1])]
    folder.mkdir(parents=True, exist_ok=True)
    mjd, rows = 60000.0, []
    for number, (kind, seconds) in enumerate(plan):
        name = f"{kind.lower()}_{number:04d}.fits"
        lit = kind == "FLAT"
        cards = {
            "IMGTYPE": kind, "TESTTYPE": kind, "SEQNUM": number, "MJD-OBS": mjd,
            "EXPTIME": seconds, "MONOWL": 620.0 if lit else 0.0, "CCDTEMP": -100.0,
            "VBB": -60.0, "PARLHI": 4.0, "PARLLO": -8.0, "CCDGAIN": GAIN, "CCDNOISE": NOISE,
            "MONDIODE": 100.0 if lit else 0.0, "DETSIZE": f"[1:{2 * NX},1:{NY}]",
        }  # fmt: skip
        hdus = [fits.PrimaryHDU(header=fits.Header(cards))]
        for segment, place in AMPLIFIERS.items():
            shape = (NY + ROWS, PRESCAN + NX + OVERSCAN)
            frame = PEDESTAL + NOISE * rng.standard_normal(shape)
            if lit:
                flat = rng.poisson(GAIN * RATE * seconds, (NY, NX)) / GAIN
                frame[:NY, PRESCAN : PRESCAN + NX] += flat
            sections = {
                "DATASEC": f"[{PRESCAN + 1}:{PRESCAN + NX},1:{NY}]",
                "BIASSEC": f"[{PRESCAN + NX + 1}:{shape[1]},1:{shape[0]}]", "DETSEC": place,
            }  # fmt: skip
            pixels = np.clip(np.rint(frame), 0, 65535).astype(np.uint16)
            hdus.append(fits.ImageHDU(pixels, fits.Header(sections), name=segment))
        fits.HDUList(hdus).writeto(folder / name, overwrite=True)
        rows.append((name, kind, number, mjd, seconds, 620.0, -60.0, -100.0, 100.0 * lit))
        mjd += (seconds + 5.0) / 86400.0
    names = (
        "file",
        "imgtype",
        "seq",
        "mjd",
        "exptime",
        "wavelength",
        "vbb",
        "temp",
        "diode",
    )
    Table(rows=rows, names=names).write(folder / "manifest.ecsv", format="ascii.ecsv")
    return folder


def copy_campaign(source: Path, target: Path) -> Path:
    """Copy part of a campaign: every bias and dark, flats and spots to 40 files at most.

    The sums of the manifest are left out: a breakage is to be found by what it is.
    """
    target.mkdir(parents=True)
    table = Table.read(source / "manifest.ecsv", format="ascii.ecsv")
    if "sha256" in table.colnames:
        table.remove_column("sha256")
    table = table[:40]
    for name in table["file"]:
        shutil.copy(source / str(name), target / str(name))
    table.write(target / "manifest.ecsv", format="ascii.ecsv")
    return target


# -- the twelve --------------------------------------------------------------------------


def truncate(folder: Path) -> None:
    """Cut one flat to 60 % of its bytes."""
    path = _flats(folder)[2]
    content = path.read_bytes()
    path.write_bytes(content[: int(0.6 * len(content))])


def swap_detsec(folder: Path) -> None:
    """Exchange DETSEC of the amplifiers in three flats."""
    for path in _flats(folder)[:3]:
        images, cards = _read(path)
        a, b = images[1][1]["DETSEC"], images[2][1]["DETSEC"]
        images[1][1]["DETSEC"], images[2][1]["DETSEC"] = b, a
        _write(path, images, cards)


def mix_sizes(folder: Path) -> None:
    """Take four rows off two flats."""
    for path in _flats(folder)[:2]:
        images, cards = _read(path)
        for k in range(1, len(images)):
            pixels, own = images[k]
            rows, less = len(pixels), len(pixels) - 4
            own["BIASSEC"] = own["BIASSEC"].replace(f"1:{rows}]", f"1:{less}]")
            images[k] = (pixels[:-4], own)
        _write(path, images, cards)


def lose_biases(folder: Path) -> None:
    """Delete all biases, and their rows."""
    table = _manifest(folder)
    for name in table["file"][table["imgtype"] == "BIAS"]:
        (folder / str(name)).unlink()
    _write_manifest(folder, table[table["imgtype"] != "BIAS"])


def saturate_pairs(folder: Path) -> None:
    """Cut the brightest flats off a little below their mean."""
    table = _manifest(folder)
    flats = table[table["imgtype"] == "FLAT"]
    for name in flats["file"][flats["exptime"] == flats["exptime"].max()]:
        images, cards = _read(folder / str(name))
        for pixels, _ in images[1:]:
            level = np.percentile(pixels, 40)
            pixels[pixels > level] = level
        _write(folder / str(name), images, cards)


def double_gain(folder: Path) -> None:
    """Write twice the gain into all headers."""
    for path in sorted(folder.glob("*.fits*")):
        images, cards = _read(path)
        cards["CCDGAIN"] *= 2
        _write(path, images, cards)


def duplicate(folder: Path) -> None:
    """Copy one flat in the place of another, and one under a new name."""
    flats = _flats(folder)
    shutil.copy(flats[1], flats[3])
    shutil.copy(flats[5], folder / "flat_again.fits")


def put_nan(folder: Path) -> None:
    """Make two flats floating point, with five pixels and a third of them not a number."""
    for path, share in zip(_flats(folder)[:2], (0.0, 0.33), strict=True):
        images, cards = _read(path)
        for k in range(1, len(images)):
            pixels = images[k][0].astype(np.float32)
            pixels[40, 30:35] = np.nan
            pixels[: int(share * len(pixels))] = np.nan
            images[k] = (pixels, images[k][1])
        _write(path, images, cards)


def lose_rows(folder: Path) -> None:
    """Take three rows off the manifest, and put one in for a file that is not there."""
    table = _manifest(folder)
    table["file"] = table["file"].astype("U40")
    table["file"][14] = "not_there.fits"
    _write_manifest(folder, table[3:])


def wrong_units(folder: Path) -> None:
    """Exposure times in ms and back bias with the other sign, in headers and manifest."""
    table = _manifest(folder)
    table["exptime"] *= 1000
    table["vbb"] *= -1
    _write_manifest(folder, table)
    for path in sorted(folder.glob("*.fits*")):
        images, cards = _read(path)
        cards["EXPTIME"] *= 1000
        cards["VBB"] *= -1
        _write(path, images, cards)


def exchange_axes(folder: Path) -> None:
    """Transpose all images, and their sections with them."""
    for path in sorted(folder.glob("*.fits*")):
        images, cards = _read(path)
        for k in range(1, len(images)):
            pixels, own = images[k]
            for card in ("DATASEC", "BIASSEC", "DETSEC"):
                x, y = own[card].strip("[]").split(",")
                own[card] = f"[{y},{x}]"
            images[k] = (pixels.T.copy(), own)
        _write(path, images, cards)


def empty(folder: Path) -> None:
    """Delete everything."""
    for path in folder.iterdir():
        path.unlink()


BREAKAGES: dict[str, tuple[Callable[[Path], None], str]] = {
    "truncated FITS": (truncate, "truncated"),
    "swapped DETSEC": (swap_detsec, "by its DETSEC"),
    "mixed sizes": (mix_sizes, "pixels, in"),
    "missing biases": (lose_biases, "no biases"),
    "saturated pairs": (saturate_pairs, "below that of lower levels"),
    "wrong gain by 2": (double_gain, "by mean over variance"),
    "duplicated exposures": (duplicate, "the same pixels as"),
    "NaN pixels": (put_nan, "not finite"),
    "missing manifest rows": (lose_rows, "no row in the manifest"),
    "wrong units": (wrong_units, "in ms?"),
    "axes exchanged": (exchange_axes, "x and y are exchanged"),
    "empty folder": (empty, "no FITS files"),
}
"""What breaks a campaign, and words that reading it must say."""


def read_broken(folder: Path) -> tuple[Campaign | None, list[str]]:
    """Read a campaign as ``bfsensor check`` does; all that it says."""
    try:
        campaign = inspect_campaign(read_campaign(folder)).campaign
    except RecordingError as error:
        return None, [str(error)]
    said = [str(one) for one in (*campaign.set_aside, *campaign.warnings)]
    return campaign, said + [str(one) for one in open_questions(campaign)]


def files_of(folder: Path) -> set[str]:
    """Names of the files and of the manifest's rows."""
    names = {path.name for path in folder.glob("*.fits*")}
    if (folder / "manifest.ecsv").exists():
        names |= {str(name) for name in _manifest(folder)["file"]}
    return names


def measure(name: str, make: Callable[[Path], Path]) -> dict[str, object]:
    """Break one copy and read it; a row of the results."""
    change, word = BREAKAGES[name]
    with tempfile.TemporaryDirectory() as place:
        whole = make(Path(place) / "campaign")
        _, before = read_broken(whole)
        change(whole)
        names = files_of(whole)
        campaign, said = read_broken(whole)
    new = [text.replace(str(whole), "CAMPAIGN") for text in said if text not in before]
    kept = {one.path.name for one in campaign.exposures} if campaign else set()
    aside = {one.path.name for one in campaign.set_aside} if campaign else set()
    return {
        "breakage": name, "files": len(names), "kept": len(kept), "set_aside": len(aside),
        "unaccounted": len(names - kept - aside) if campaign else 0,
        "named": any(word in text for text in new), "said": " | ".join(new),
    }  # fmt: skip


def main() -> None:
    """Break, read, print and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("campaign", nargs="?", type=Path)
    parser.add_argument("-o", "--output", default=RESULTS)
    given = parser.parse_args()
    rows = []
    for name in BREAKAGES:
        row = measure(
            name,
            make_campaign
            if given.campaign is None
            else lambda target: copy_campaign(given.campaign, target),
        )
        rows.append(row)
        print(f"{name}: {row['kept']} of {row['files']} kept, {row['set_aside']} set aside")
        for text in str(row["said"]).split(" | "):
            print(f"    {text}")
    command = "python -m validation.reading.broken_campaigns"
    source = "" if given.campaign is None else given.campaign.name
    write_results(Table(rows=rows), given.output, f"{command} {source}".strip())
    lost = [row["breakage"] for row in rows if row["unaccounted"] or not row["named"]]
    if lost:
        raise SystemExit(f"not named, or exposures lost: {lost}")


def _flats(folder: Path) -> list[Path]:
    return sorted(folder.glob("flat_*"))


def _manifest(folder: Path) -> Table:
    return Table.read(folder / "manifest.ecsv", format="ascii.ecsv")


def _write_manifest(folder: Path, table: Table) -> None:
    table.write(folder / "manifest.ecsv", format="ascii.ecsv", overwrite=True)


def _read(path: Path) -> tuple[list[tuple[np.ndarray, fits.Header]], fits.Header]:
    """Images with their headers (none in the primary), and the primary header."""
    with fits.open(path) as hdus:
        cards = hdus[0].header.copy()
        return [
            (np.zeros(0) if hdu.data is None else np.array(hdu.data), hdu.header.copy())
            for hdu in hdus
        ], cards


def _write(
    path: Path, images: list[tuple[np.ndarray, fits.Header]], cards: fits.Header
) -> None:
    """Write images back, uncompressed."""
    hdus = [fits.PrimaryHDU(header=cards)]
    for pixels, own in images[1:]:
        kept = fits.Header(
            {k: own[k] for k in ("DATASEC", "BIASSEC", "DETSEC", "CHANNEL") if k in own}
        )
        hdus.append(fits.ImageHDU(pixels, kept, name=own.get("EXTNAME", "")))
    fits.HDUList(hdus).writeto(path, overwrite=True)


if __name__ == "__main__":
    main()
