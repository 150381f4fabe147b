"""Campaign folders: same bits from the same seed, readable, sealed; arrays equal files."""

import hashlib
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from click.testing import CliRunner

from validation.concealed import campaign as writer
from validation.concealed.__main__ import main
from validation.concealed.arrays import iterate_exposures
from validation.concealed.campaign import truth_matches, write_campaign
from validation.concealed.library import EFFECTS, draw_effects, make_effect
from validation.concealed.plan import SIZES, Geometry, Size, exposures_of

PRACTICE = Path(__file__).parents[3].parent / "shared" / "practice"
TINY = Size(64, 1, 1, dithers=1, flat_seconds=(1.0, 60.0), spot_seconds=(30.0,))


@pytest.fixture(autouse=True)
def tiny(monkeypatch):
    monkeypatch.setitem(SIZES, "S", TINY)


def _write(folder, **kwargs):
    effects = [make_effect("cti_serial", {"cti": 2e-6})]
    return write_campaign(folder, seed=77, effects=effects, salt="00", **kwargs)


def test_the_same_seed_gives_the_same_files(tmp_path):
    for place in ("one", "two"):
        _write(tmp_path / place / "c")
    names = sorted(p.name for p in (tmp_path / "one" / "c").iterdir())
    assert names == sorted(p.name for p in (tmp_path / "two" / "c").iterdir())
    for name in names:
        one, two = ((tmp_path / p / "c" / name).read_bytes() for p in ("one", "two"))
        assert one == two, name
    write_campaign(tmp_path / "three" / "c", seed=78, salt="00")
    flat = next(n for n in names if n.startswith("flat"))
    assert (tmp_path / "three" / "c" / flat).read_bytes() != (
        tmp_path / "one" / "c" / flat
    ).read_bytes()


def test_files_hold_the_arrays_and_what_headers_say(tmp_path):
    _write(tmp_path / "c", withheld_folder=tmp_path / "held")
    manifest = Table.read(tmp_path / "c" / "manifest.ecsv")
    effects = [make_effect("cti_serial", {"cti": 2e-6})]
    taken = list(iterate_exposures(TINY, seed=77, effects=effects))
    assert [t.exposure.file for t in taken] == list(manifest["file"])
    g = Geometry(64)
    for row, t in zip(manifest, taken, strict=True):
        path = tmp_path / "c" / row["file"]
        assert hashlib.sha256(path.read_bytes()).hexdigest() == row["sha256"]
        with fits.open(path) as units:
            head = units[0].header
            assert (head["IMGTYPE"], head["EXPTIME"], head["SEQNUM"]) == (
                row["imgtype"],
                row["exptime"],
                row["seq"],
            )
            assert head["MONDIODE"] == row["diode"]
            for unit, frame in zip(units[1:], t.frames, strict=True):
                assert unit.data.dtype == np.uint16
                assert np.array_equal(unit.data, frame)
            assert units[1].header["DATASEC"] == f"[9:{8 + g.width},1:64]"
            assert units[2].header["DETSEC"] == "[64:33,1:64]"
    held = [e for e in exposures_of(TINY) if e.withheld]
    assert sorted(p.name for p in (tmp_path / "held" / "c").iterdir()) == sorted(
        e.file for e in held
    )


@pytest.mark.skipif(
    not PRACTICE.exists(), reason="practice campaigns are not in this place"
)
def test_the_same_form_as_practice_campaigns(tmp_path):
    """Keywords, sections, manifest columns and the keys of every JSON, value by value where fixed."""
    write_campaign(tmp_path / "c", seed=5, salt="00")
    theirs, ours = PRACTICE / "practice_a", tmp_path / "c"
    for kind in ("bias", "dark", "flat", "spot"):
        with (
            fits.open(sorted(theirs.glob(f"{kind}*"))[0]) as a,
            fits.open(sorted(ours.glob(f"{kind}*"))[0]) as b,
        ):
            for x, y in zip(a, b, strict=True):
                assert list(x.header) == list(y.header)
                assert [x.header.comments[k] for k in x.header] == [
                    y.header.comments[k] for k in y.header
                ]
                assert type(x) is type(y)
    a, b = (Table.read(p / "manifest.ecsv") for p in (theirs, ours))
    assert a.colnames == b.colnames and [a[c].dtype.kind for c in a.colnames] == [
        b[c].dtype.kind for c in b.colnames
    ]
    for name in ("device_card.json", "baseline_edges.json"):
        a, b = (json.loads((p / name).read_text()) for p in (theirs, ours))
        assert list(a) == list(b)
        for key in ("nominal", "spread_1sigma", "absorption_um", "note"):
            assert a.get(key) == b.get(key)
    a, b = (json.loads((p / "truth.json").read_text()) for p in (theirs, ours))
    assert set(a) <= set(b)


@pytest.mark.skipif(
    not PRACTICE.exists(), reason="practice campaigns are not in this place"
)
def test_the_plan_is_that_of_practice_campaigns(monkeypatch):
    monkeypatch.undo()
    theirs = Table.read(PRACTICE / "practice_a" / "manifest.ecsv")
    ours = [e for e in exposures_of(SIZES["S"]) if not e.withheld]
    assert [e.file for e in ours] == list(theirs["file"])
    assert np.allclose([e.mjd for e in ours], theirs["mjd"], atol=2e-8)
    for name, column in (("seconds", "exptime"), ("wavelength", "wavelength")):
        assert [getattr(e, name) for e in ours] == list(theirs[column])
    assert [e.back_bias for e in ours] == list(theirs["vbb"])
    assert [e.temperature for e in ours] == list(theirs["temp"])
    classes = json.loads((PRACTICE / "taxonomy.json").read_text())["classes"]
    assert set(EFFECTS) <= set(classes)  # words may be added before a maker is


def test_the_truth_is_sealed_and_elsewhere(tmp_path):
    _write(tmp_path / "c", truth_folder=tmp_path / "sealed")
    truth = tmp_path / "sealed" / "c.json"
    assert not (tmp_path / "c" / "truth.json").exists()
    for path in (tmp_path / "c").iterdir():
        assert b"cti_serial" not in path.read_bytes()
    assert truth_matches(tmp_path / "c", truth)
    told = json.loads(truth.read_text())
    assert told["effects"] == [{"class": "cti_serial", "parameters": {"cti": 2e-6}}]
    told["effects"] = []
    truth.write_text(json.dumps(told))
    assert not truth_matches(tmp_path / "c", truth)


def test_command_makes_what_is_asked(tmp_path):
    run = CliRunner().invoke
    asked = ["make", str(tmp_path), "--class", "cti_serial", "--amplitude", "cti=1e-6"]
    result = run(main, [*asked, "--seed", "4", "--name", "a"])
    assert result.exit_code == 0, result.output
    truth = json.loads((tmp_path / "a_0000" / "truth.json").read_text())
    assert truth["effects"][0]["parameters"] == {"cti": 1e-6}
    result = run(main, ["make", str(tmp_path), "--null-fraction", "1", "--name", "n"])
    assert json.loads((tmp_path / "n_0000" / "truth.json").read_text())["effects"] == []
    again = run(main, [*asked, "--name", "a"])
    assert again.exit_code == 1 and "holds files already" in again.output
    wrong = run(main, [*asked[:-1], "tau=3", "--name", "b"])
    assert wrong.exit_code == 2 and "a parameter of --class" in wrong.output


def test_draws_have_the_fractions_asked_for():
    """1000 draws: each fraction to 4 sigma; all classes come, no class twice in one campaign."""
    rng = np.random.default_rng(6)
    drawn = [draw_effects(rng) for _ in range(1000)]
    number = np.array([len(d) for d in drawn])
    foreign = np.mean([any(e.word == "outside_library" for e in d) for d in drawn])
    for seen, expected in (
        ((number == 0).mean(), 0.25),
        (foreign, 0.12),
        ((number > 1).mean(), 0.16),
    ):
        assert abs(seen - expected) < 4 * np.sqrt(expected * (1 - expected) / 1000)
    assert {e.word for d in drawn for e in d} == set(EFFECTS)
    assert all(len({e.word for e in d}) == len(d) for d in drawn)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: make_effect("cti", {}), "class = 'cti': one of adc_bits"),
        (lambda: make_effect("cti_serial", {"f": 1}), "needs \\['cti'\\]"),
        (lambda: make_effect("dark_hot", {"rate": 1.0}, "x"), "variant = 'x'"),
        (lambda: draw_effects(np.random.default_rng(1), null_fraction=1.5), "at most 1"),
        (lambda: list(iterate_exposures("XL", seed=1)), "size = 'XL': one of T, S, M, L"),
        (lambda: Geometry(65, 2), "a multiple of the amplifiers"),
        (lambda: write_campaign("nowhere", seed=1, size="Q"), "size = 'Q'"),
    ],
)
def test_refusals(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_four_amplifiers_read_their_strips():
    size = replace(TINY, condition_pairs=0, dithers=0)
    taken = [
        t
        for t in iterate_exposures(size, seed=9, amplifiers=4)
        if t.exposure.kind == "FLAT"
    ]
    assert len(taken[0].frames) == 4 and taken[0].frames[3].shape == (80, 48)
    assert writer.SPOT_GRID == 30
