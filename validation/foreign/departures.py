"""Departures that a reading of the diagnosis tried by hand in 2026, made by this bench's laws.

256 x 256 pixels, no spots, as they were there: trapping as a power of the signal, a gain with a
kink, four nuisances together, sixteen amplifiers with heavy-tailed noise.  Numbers are drawn by the
bench (a power of 0.776, a kink of 2.75 %, tails of 6 degrees of freedom), where the reading had 0.5,
1.2 % and 4.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import NamedTuple

from validation.foreign.campaign import Wish, draw_campaign, write_campaign
from validation.foreign.layout import Layout

TWO = Layout(amplifiers=2, spots=0)
SIXTEEN = Layout(amplifiers=16, rows=2, spots=0)


class Departure(NamedTuple):
    """Name of a campaign, what is wanted of it, and its layout."""

    name: str
    wish: Wish
    layout: Layout = TWO


STRENGTH = 300.0
"""Projected SNR of the two laws.  Chosen: far above any threshold, so that names and not power are
tested; at twice the value the same must be said."""

BENCH = "bad_column,bias_drift,exposure_time,lamp_flicker"
"""The four nuisances."""

DEPARTURES = (
    Departure("nothing", Wish(null=True, nuisances="none", seed=7_000_000)),
    Departure("root_trapping", Wish(word="cti_serial", law="volume_filling", nuisances="none",
                                    seed=7_010_000, snr=STRENGTH)),
    Departure("kinked_gain", Wish(word="gain_nonlinearity", law="kink", nuisances="none",
                                  seed=7_020_000, snr=STRENGTH)),
    Departure("four_nuisances", Wish(null=True, nuisances=BENCH, seed=7_030_000)),
    Departure("heavy_tails", Wish(null=True, nuisances="heavy_tailed_noise,tracks",
                                  seed=7_040_000), SIXTEEN),
    Departure("tracks", Wish(null=True, nuisances="tracks", seed=7_050_000), SIXTEEN),
)  # fmt: skip


def make_departures(out: Path, sealed: Path) -> list[str]:
    """Make the campaigns that are not there yet.

    Returns
    -------
    made : list of str
        Their names.
    """
    made, known = [], {}
    for one in DEPARTURES:
        if not (out / one.name).exists():
            drawn = draw_campaign(one.wish, 0, "", one.name, one.layout)
            write_campaign(out / one.name, drawn, "", sealed / f"{one.name}.json")
            made.append(one.name)
        known[one.name] = (out / one.name / "commitment.txt").read_text().strip()
    (out / "commitments.json").write_text(json.dumps(known, indent=2) + "\n")
    return made
