"""Memory and time that reading a campaign of large sensors takes.

``python -m validation.performance.campaign_memory [--exposures 24] [--folder PLACE]`` writes pairs
of flats of a sensor of 16 amplifiers, 4096 x 4004 pixels with overscan, as plain and as
tile-compressed files, reads each set in a process of its own (headers, then all pixels, as
``bfsensor check`` does), and prints the peak of its memory and the time for each exposure.  Rows go
to ``validation/results/campaign_memory.ecsv``.
"""

from __future__ import annotations

import argparse
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from astropy.io import fits
from astropy.table import Table

from validation.common.write_results import write_results

NX, NY, PRESCAN, OVERSCAN, ROWS = 512, 2002, 10, 54, 46
RESULTS = "validation/results/campaign_memory.ecsv"


def make_large(folder: Path, exposures: int, compress: bool, seed: int = 8413) -> None:
    """Write pairs of flats at rising levels."""
    rng = np.random.default_rng(seed)
    folder.mkdir(parents=True)
    shape = (NY + ROWS, PRESCAN + NX + OVERSCAN)
    noise = rng.standard_normal(shape)
    for number in range(exposures):
        seconds = 2.0 * (1 + number // 2 % 8)
        level = 3000.0 * seconds
        cards = {"IMGTYPE": "FLAT", "EXPTIME": seconds, "SEQNUM": number,
                 "MJD-OBS": 60000 + number / 1000, "CCDGAIN": 1.5}  # fmt: skip
        hdus: list[fits.hdu.base.ExtensionHDU] = [
            fits.PrimaryHDU(header=fits.Header(cards))
        ]
        for amplifier in range(16):
            # Rolled noise: the same sums, other pixels.
            rolled = np.roll(noise, (number * 97 + amplifier * 31, number * 13), (0, 1))
            frame = 1000 + 5 * rolled
            light = np.s_[:NY, PRESCAN : PRESCAN + NX]
            frame[light] += level + (level / 1.5) ** 0.5 * rolled[light]
            column, top = amplifier % 8, amplifier // 8
            y = (NY + 1, 2 * NY) if not top else (NY, 1)
            header = fits.Header(
                {
                    "DATASEC": f"[{PRESCAN + 1}:{PRESCAN + NX},1:{NY}]",
                    "BIASSEC": f"[{PRESCAN + NX + 1}:{shape[1]},1:{shape[0]}]",
                    "DETSEC": f"[{column * NX + NX}:{column * NX + 1},{y[0]}:{y[1]}]",
                }
            )
            kind = fits.CompImageHDU if compress else fits.ImageHDU
            pixels = np.clip(frame, 0, 65535).astype(np.uint16)
            hdus.append(kind(pixels, header, name=f"SEGMENT{top}{column}"))
        fits.HDUList(hdus).writeto(folder / f"flat_{number:04d}.fits")


def read_large(folder: Path) -> None:
    """Read headers, then pixels; print times and the peak of memory of this process."""
    from bfsensor.recording.campaign.campaign import read_campaign
    from bfsensor.recording.campaign.inspection import inspect_campaign

    def peak() -> float:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024**2

    start = time.perf_counter()
    campaign = read_campaign(folder)
    headers = time.perf_counter() - start
    start = time.perf_counter()
    inspection = inspect_campaign(campaign)
    pixels = time.perf_counter() - start
    count = len(inspection.campaign.exposures)
    print(count, headers / count, pixels / count, peak())


def main() -> None:
    """Write, read in a process of its own, print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--exposures", type=int, default=24)
    parser.add_argument("--folder", type=Path, default=None)
    parser.add_argument("--read", type=Path, help="only read this folder")
    given = parser.parse_args()
    if given.read is not None:
        read_large(given.read)
        return
    rows = []
    for compress in (False, True):
        place = Path(tempfile.mkdtemp(dir=given.folder))
        try:
            make_large(place / "large", given.exposures, compress)
            size = sum(one.stat().st_size for one in (place / "large").iterdir()) / 1024**3
            command = [
                sys.executable,
                "-m",
                "validation.performance.campaign_memory",
                "--read",
            ]
            out = subprocess.run(
                [*command, str(place / "large")], capture_output=True, text=True, check=True
            ).stdout
        finally:
            shutil.rmtree(place)
        count, headers, pixels, peak = (float(word) for word in out.split())
        row = {
            "files": "tile-compressed" if compress else "plain", "exposures": int(count),
            "size_gb": round(size, 2), "headers_s": round(headers, 4),
            "pixels_s": round(pixels, 3),
            "memory_peak_gb": round(peak, 3),
        }  # fmt: skip
        rows.append(row)
        print(row)
    command = (
        f"python -m validation.performance.campaign_memory --exposures {given.exposures}"
    )
    write_results(Table(rows=rows), RESULTS, command, times="seconds for each exposure")


if __name__ == "__main__":
    main()
