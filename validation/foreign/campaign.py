"""Campaign folders, sets of them, truths and commitments.

A set is a folder OUT with campaigns NAME, ``commitments.json`` (SHA-256 of each truth's file, in
which a salt stands) and ``set.json`` (how it was made; the hash of the master salt).  Truths lie in
another folder, NAME.json, beside ``master_salt.json``, which is published after opening.

Seeds: development trials have seeds from 10,000,000 on and no salt, so that anyone makes the same
ones; scored trials have seeds from 50,000,000 on and a master salt of 256 bits drawn when the set is
begun, so that nobody can make them before they are opened.
"""

from __future__ import annotations

import hashlib
import json
import os
import secrets
import shutil
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from astropy.table import Table

from validation.foreign.bench import NOMINAL_GAIN, NOMINAL_NOISE, Bench
from validation.foreign.device import DEVICES, baseline_edges, device_card
from validation.foreign.headers import (
    file_name,
    hdus,
    keyword_entries,
    lamp_entry,
    manifest_row,
)
from validation.foreign.law import Law
from validation.foreign.laws import CLASSES, LAWS, OUTSIDE, laws_of
from validation.foreign.layout import Layout, draw_layout
from validation.foreign.nuisances import NUISANCES, draw_nuisances
from validation.foreign.plan import SIZES, Plan, draw_plan
from validation.foreign.strength import Estimator, find_amplitude

SEEDS = {"dev": 10_000_000, "scored": 50_000_000}
"""First seed of each kind of set; --seed counts from there."""

SEEDS_IN_A_SET = 10_000_000

SNR = (3.0, 5000.0)
"""Range of wanted projected SNRs, drawn log-uniform: the range that the project's proof asks for."""

KINDS = ("null",) * 5 + ("outside",) * 2 + ("several",) * 3 + ("single",) * 10
"""Kinds of campaigns in each twenty."""


@dataclass(frozen=True)
class Wish:
    """What is wanted of a set.

    Attributes
    ----------
    name : str
        'dev' or 'scored'.
    size : str
        S, M, X or T.
    word, law : str
        Class and law of all campaigns; '' to draw them.
    null : bool
        Only nulls.
    nuisances : str
        'some', 'all', 'none' or words.
    seed : int
        Counts from the first seed of the kind of set.
    snr : float or None
        Wanted projected SNR of all laws.
    """

    name: str = "dev"
    size: str = "S"
    word: str = ""
    law: str = ""
    null: bool = False
    nuisances: str = "some"
    seed: int = 0
    snr: float | None = None

    def __post_init__(self) -> None:
        if self.name not in SEEDS:
            raise ValueError(f"set {self.name!r}: dev or scored")
        if self.size not in SIZES:
            raise ValueError(f"size {self.size!r}: one of {', '.join(SIZES)}")
        if not 0 <= self.seed < SEEDS_IN_A_SET:
            raise ValueError(f"seed {self.seed}: 0 to {SEEDS_IN_A_SET - 1}")
        if self.word and self.word not in CLASSES:
            raise ValueError(f"class {self.word!r}: one of {', '.join(CLASSES)}")
        if self.law:
            owners = [w for w, n in LAWS if n == self.law and self.word in ("", w)]
            if not owners:
                raise ValueError(
                    f"law {self.law!r}: there is none of that name"
                    + (f" in {self.word}, which has {', '.join(laws_of(self.word))}"
                       if self.word else "")
                )  # fmt: skip
            if len(owners) > 1:
                raise ValueError(
                    f"law {self.law!r}: give --class, it is in {', '.join(owners)}"
                )
            object.__setattr__(self, "word", owners[0])
        if self.nuisances not in ("some", "all", "none"):
            words = {w.strip() for w in self.nuisances.split(",")}
            if wrong := sorted(words - set(NUISANCES)):
                raise ValueError(
                    f"nuisances {', '.join(wrong)}: all, none, some, or of {', '.join(NUISANCES)}"
                )


def rng_of(wish: Wish, number: int, salt: str, use: int = 0) -> np.random.Generator:
    """The stream that decides one campaign of a set."""
    words = [int(salt[i : i + 8], 16) for i in range(0, len(salt), 8)]
    return np.random.default_rng([SEEDS[wish.name] + wish.seed, number, use, *words])


def classes_of(wish: Wish, number: int, salt: str) -> list[tuple[str, str]]:
    """Classes and laws of a campaign.

    Kinds are dealt in twenties and classes one after the other, so that a set of a few hundred has
    every class about as often.

    Examples
    --------
    >>> classes_of(Wish(word="tearing", law="ragged"), 4, "")
    [('tearing', 'ragged')]
    >>> classes_of(Wish(null=True), 4, "")
    []
    """
    if wish.null:
        return []
    own = rng_of(wish, number, salt, 1)
    if wish.word:
        return [(wish.word, wish.law or str(own.choice(laws_of(wish.word))))]
    dealt = rng_of(wish, number // len(KINDS), salt, 2).permutation(KINDS)
    kind = dealt[number % len(KINDS)]
    named = [w for w in CLASSES if w != OUTSIDE]
    singles = int(np.sum(dealt[: number % len(KINDS)] == "single"))
    turn = number // len(KINDS) * KINDS.count("single") + singles
    order = rng_of(wish, turn // len(named), salt, 3).permutation(named)
    if kind == "null":
        return []
    if kind == "outside":
        return [(OUTSIDE, str(own.choice(laws_of(OUTSIDE))))]
    if kind == "single":
        words = [str(order[turn % len(named)])]
    else:
        words = [str(w) for w in own.choice(named, int(own.integers(2, 4)), replace=False)]
    return [(w, str(own.choice(laws_of(w)))) for w in words]


@dataclass
class Made:
    """A campaign that is drawn: the bench, its laws with their strengths, and the truth."""

    bench: Bench
    nuisances: list[Law]
    truth: dict[str, Any]
    layout: Layout
    plan: Plan

    @property
    def monitor(self) -> bool:
        """Whether the lamp's monitor is recorded."""
        return all(n.values.get("monitor", True) for n in self.nuisances)


def draw_campaign(
    wish: Wish, number: int, salt: str, name: str, layout: Layout | None = None
) -> Made:
    """Draw layout, plan, device, nuisances, laws and strengths; a layout that is given stays."""
    rng = rng_of(wish, number, salt)
    chosen = classes_of(wish, number, salt)
    needs = frozenset().union(*(LAWS[c].needs for c in chosen))
    without = frozenset().union(*(LAWS[c].beside for c in chosen))
    pixels = SIZES[wish.size].pixels
    drawn = draw_layout(rng, wish.size, pixels, needs)
    layout = drawn if layout is None else layout
    plan = draw_plan(rng, wish.size, bool(layout.spots), needs)
    key = str(rng.choice(list(DEVICES), p=[0.6, 0.2, 0.2]))
    seed = int(rng.integers(2**31))
    plain = Bench(layout, plan, DEVICES[key], seed)
    nuisances = draw_nuisances(rng, plain.setting, wish.nuisances, without)
    bench = Bench(layout, plan, DEVICES[key], seed, laws=nuisances)
    laws, effects = [], []
    estimator = Estimator(bench) if chosen else None
    for word, law_name in chosen:
        law = LAWS[word, law_name]()
        law.values = law.draw(rng, bench.setting)
        low, high = np.log(SNR)
        wanted = float(np.exp(rng.uniform(low, high))) if wish.snr is None else wish.snr
        start = None
        if not type(law).scaled:
            ends = np.log(type(law).limits)
            start = float(np.exp(rng.uniform(*ends)))
        assert estimator is not None
        found = find_amplitude(estimator, law, wanted, start=start)
        if found["limited"] and SNR[0] < found["snr"] < wanted and wish.snr is None:
            # what is wanted lies beyond what a real sensor has: drawn anew below that
            wanted = float(np.exp(rng.uniform(low, np.log(found["snr"]))))
            found = find_amplitude(
                estimator, law, wanted, start=law.size * wanted / found["snr"]
            )
        laws.append(law)
        effects.append(effect_truth(law, found))
    final = Bench(layout, plan, DEVICES[key], seed, laws=[*nuisances, *laws])
    truth = {
        "campaign": name,
        "effects": effects,
        "nuisances": [
            {"kind": n.word, "parameters": n.truth(), "source": n.source} for n in nuisances
        ],
        "size": wish.size,
        "amplifiers": layout.amplifiers,
        "pixels": layout.pixels,
        "layout": layout.truth(),
        "plan": plan.truth(),
        "device": {"nominal": key, "true": dict(final.device.__dict__)},
        "gains": final.gains,
        "noises": final.noises,
        "set": wish.name,
        "seed": SEEDS[wish.name] + wish.seed,
        "number": number,
        "bench_seed": seed,
    }
    return Made(final, nuisances, truth, layout, plan)


def effect_truth(law: Law, found: dict[str, Any]) -> dict[str, Any]:
    """Entry of a truth: numbers stand in ``parameters``, places and words in ``shape``."""
    values = law.truth()
    numbers = {
        k: v
        for k, v in values.items()
        if isinstance(v, int | float) and not isinstance(v, bool)
    }
    return {
        "class": law.word,
        "law": law.name,
        "parameters": numbers,
        "shape": {k: v for k, v in values.items() if k not in numbers},
        "snr": found["snr"],
        "snr_wanted": found["wanted"],
        "snr_limited": found["limited"],
        "snr_squares": {k: float(v) for k, v in found["parts"].items() if v > 0},
        "source": law.source,
    }


def write_campaign(
    folder: Path,
    made: Made,
    salt: str,
    truth_file: Path,
    *,
    progress: Callable[[Iterable], Iterable] | None = None,
) -> str:
    """Write a campaign beside and rename it when it is whole; return the truth's hash.

    Raises
    ------
    ValueError
        The folder is there already.
    """
    if folder.exists():
        raise ValueError(f"{folder}: is there already; give another folder")
    beside = folder.with_name(f".{folder.name}.part")
    shutil.rmtree(beside, ignore_errors=True)
    beside.mkdir(parents=True)
    layout, name, rows = made.layout, folder.name, []
    exposures = made.plan.exposures()
    for e in exposures if progress is None else progress(exposures):
        taken = made.bench.take(e)
        at = beside / file_name(taken, layout)
        hdus(name, taken, layout, monitor=made.monitor).writeto(at)
        digest = hashlib.sha256(at.read_bytes()).hexdigest() if layout.manifest else ""
        rows.append(manifest_row(taken, at.name, digest, layout, monitor=made.monitor))
    if layout.manifest:
        table = Table(rows=rows)
        table["seq"] = table["seq"].astype(np.int64)
        table.write(beside / "manifest.ecsv", format="ascii.ecsv")
    nominal = made.bench.nominal
    overscans = {
        k: getattr(layout, k) for k in ("prescan", "serial_overscan", "parallel_overscan")
    }
    card = device_card(name, nominal, layout.pixels, layout.pixels, overscans, layout.spots)
    _write_json(beside / "device_card.json", card)
    conditions = made.plan.conditions()
    _write_json(beside / "baseline_edges.json", baseline_edges(nominal, conditions))
    (beside / "campaign.yaml").write_text(description(made))
    truth = {**made.truth, "salt": salt}
    truth_file.parent.mkdir(parents=True, exist_ok=True)
    _write_json(truth_file, truth)
    digest = hashlib.sha256(truth_file.read_bytes()).hexdigest()
    (beside / "commitment.txt").write_text(digest + "\n")
    os.replace(beside, folder)
    return digest


def description(made: Made) -> str:
    """Text of campaign.yaml."""
    layout = made.layout
    entries: dict[str, Any] = {"schema": "bfsensor-campaign-1", "sensor": "VCCD2"}
    if layout.manifest:
        entries["manifest"] = "manifest.ecsv"
    entries |= {"device_card": "device_card.json", "baseline": "baseline_edges.json"}
    if made.monitor:
        entries["lamp_monitor"] = lamp_entry(layout)
    if layout.spots:
        entries["spots"] = {"grid_px": layout.spots}
    if keywords := keyword_entries(layout):
        entries["keywords"] = keywords
    if layout.storage == "single":
        entries["amplifiers"] = layout.yaml_amplifiers(NOMINAL_GAIN, NOMINAL_NOISE)
    return yaml.safe_dump(entries, sort_keys=False)


def _write_json(path: Path, content: Any) -> None:
    beside = path.with_name(path.name + ".part")
    beside.write_text(json.dumps(content, indent=1))
    os.replace(beside, path)


def make_set(
    out: Path,
    sealed: Path,
    wish: Wish,
    count: int,
    *,
    progress: Callable[[Iterable, str], Iterable] | None = None,
) -> list[str]:
    """Make a set, or go on with one; campaigns that are there are not made again.

    Returns
    -------
    made : list of str
        Names of the campaigns made now.

    Raises
    ------
    ValueError
        The folder holds a set that was begun with another wish.
    """
    out.mkdir(parents=True, exist_ok=True)
    sealed.mkdir(parents=True, exist_ok=True)
    salt_file = sealed / "master_salt.json"
    if wish.name == "dev":
        salt = ""
    elif salt_file.exists():
        salt = json.loads(salt_file.read_text())["master_salt"]
    else:
        salt = secrets.token_hex(32)
        _write_json(salt_file, {"master_salt": salt})
    about = {
        "made_by": "python -m validation.foreign make",
        **wish.__dict__,
        "first_seed": SEEDS[wish.name] + wish.seed,
        "master_salt_sha256": hashlib.sha256(salt.encode()).hexdigest() if salt else None,
    }
    if (out / "set.json").exists():
        before = json.loads((out / "set.json").read_text())
        if before != about:
            raise ValueError(
                f"{out}/set.json: begun as {before}, not as {about}; give another folder"
            )
    _write_json(out / "set.json", about)
    commitments_file = out / "commitments.json"
    made_now = []
    for number in range(count):
        name = f"f{number:04d}"
        folder, truth_file = out / name, sealed / f"{name}.json"
        if folder.exists():
            digest = (folder / "commitment.txt").read_text().strip()
        else:
            made = draw_campaign(wish, number, salt, name)
            # a salt of its own, so that one truth can be opened without the others
            seal = hashlib.sha256(f"{salt}/{number}".encode()).hexdigest()[:32]
            seal = seal if salt else secrets.token_hex(16)
            bar = None if progress is None else (lambda x, n=name: progress(x, n))
            digest = write_campaign(folder, made, seal, truth_file, progress=bar)
            made_now.append(name)
        known = (
            json.loads(commitments_file.read_text()) if commitments_file.exists() else {}
        )
        known[name] = digest
        _write_json(commitments_file, dict(sorted(known.items())))
    return made_now
