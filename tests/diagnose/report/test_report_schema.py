"""Reports are as their schema says, and what is not is refused."""

from __future__ import annotations

import copy
import hashlib
import json
import time
from dataclasses import replace
from importlib.resources import files

import jsonschema
import numpy as np
import pytest

from bfsensor.diagnose.detect.locate import locate_mismatch
from bfsensor.diagnose.detect.scans import make_fitted_templates, make_templates
from bfsensor.diagnose.explain.nonparametric import Coefficient, OpenWorld
from bfsensor.diagnose.fit.baseline_fit import held_out
from bfsensor.diagnose.plan.advice import plan
from bfsensor.diagnose.report.diagnosis_result import NAMES, SCHEMA, Diagnosis, _plain
from bfsensor.diagnose.report.html_report import write_report
from bfsensor.diagnose.report.provenance import files_of, provenance_of
from tests.docs.pages import load, tables

PAGES = load("reference_pages")


@pytest.fixture(scope="module")
def schema():
    text = files("bfsensor.diagnose.report").joinpath("report.schema.json").read_text()
    found = json.loads(text)
    jsonschema.Draft202012Validator.check_schema(found)
    return found


@pytest.fixture(scope="module")
def faults(schema):
    validator = jsonschema.Draft202012Validator(schema)
    return lambda report: [
        f"{e.json_path}: {e.message}" for e in validator.iter_errors(report)
    ]


@pytest.fixture(scope="module")
def explained(fitted_loss, tied):
    measured, predictor, fit = fitted_loss
    return Diagnosis(
        campaign="run", baseline="virtual", measured=measured, fit=fit,
        mismatch=locate_mismatch(fit), heldout=held_out(predictor, fit, measured), attribution=tied,
        plan=plan(tied), predictor=predictor, notes=("a note",),
    )  # fmt: skip


@pytest.fixture(scope="module")
def outside(explained):
    """The same with a nonparametric term, and with a pair of flats of unlike exposure."""
    told = explained.attribution
    free = OpenWorld(
        groups=("mean by level",),
        coefficients=(Coefficient("S^2", -3e-3, 1e-5, {"power": 2, "lags": [(0, 1)]}),),
        by_group={"mean by level": ("S^2",)},
        folds={"held-out": told.heldout},
        scores={"mean by level": np.float64(12.0)},
        tests={"sum rule": {"p_value": 0.2, "value": 0.1, "error": 0.3}},
        nearest=(("charge_loss", 12.5),),
        alike={"mean by level": (("S^3", 2.0),)},
        mismatch=told.mismatch,
    )
    return replace(explained, attribution=replace(told, free_form=free, open_world=True))


def reports(explained, outside):
    alone = replace(explained, attribution=None, plan=Diagnosis.plan, heldout=np.nan)
    return {
        "explained": explained.to_report(), "outside": outside.to_report(),
        "alone": alone.to_report(),
    }  # fmt: skip


def test_reports_are_as_the_schema_says(explained, outside, faults):
    for name, report in reports(explained, outside).items():
        assert faults(json.loads(json.dumps(report))) == [], name
    assert outside.to_report()["free_form"]["coefficients"]["S^2"]["where"]["power"] == 2
    assert explained.to_report()["plan"][0]["recipe"] and explained.to_report()["findings"]


def test_the_written_report_is_as_the_schema_says(explained, faults, tmp_path, monkeypatch):
    monkeypatch.setattr(
        "bfsensor.diagnose.report.html_report.draw_figures", lambda diagnosis, folder: []
    )
    (tmp_path / "frame.fits").write_bytes(b"pixels")
    files = files_of(tmp_path, [tmp_path / "frame.fits", tmp_path / "absent.fits"])
    told = provenance_of(
        "bfsensor diagnose run", seed=1, files=files, began=time.monotonic()
    )
    write_report(explained, tmp_path, provenance=told)
    written = json.loads((tmp_path / "report.json").read_text())
    assert faults(written) == []
    assert written["provenance"]["files"] == {
        "frame.fits": hashlib.sha256(b"pixels").hexdigest()
    }
    assert hashlib.sha256(b"pixels").hexdigest() in (tmp_path / "report.html").read_text()


def objects(value, path=()):
    """Paths of all objects of a report that have fields of fixed names."""
    if isinstance(value, dict):
        yield path
        for key, inner in value.items():
            yield from objects(inner, (*path, key))
    elif isinstance(value, list):
        for n, inner in enumerate(value[:2]):
            yield from objects(inner, (*path, n))


def at(value, path):
    for key in path:
        value = value[key]
    return value


OPEN = ("class_probability", "channels", "parameters", "exposures", "keeps", "coefficients",
        "by_group", "alike", "scores", "tests", "folds", "held-out")  # fmt: skip
"""Mappings by names that differ between campaigns."""


@pytest.mark.slow
def test_an_unknown_missing_or_wrong_key_fails(explained, outside, faults, schema):
    whole = json.loads(json.dumps(outside.to_report()))
    checked = 0
    for path in objects(whole):
        if path[:1] == ("free_form",) and path[-1] == "where":
            continue  # what places a term differs between groups of terms
        if path and path[-1] in OPEN:
            continue
        changed = copy.deepcopy(whole)
        at(changed, path)["unknown_key"] = 1
        assert faults(changed), path
        checked += 1
        for key in at(whole, path):
            changed = copy.deepcopy(whole)
            own = at(whole, path)[key]
            at(changed, path)[key] = [None] if isinstance(own, dict) else {"no": None}
            assert faults(changed), (*path, key)
    assert checked > 30
    for key in schema["required"]:
        changed = {k: v for k, v in whole.items() if k != key}
        assert any(key in fault for fault in faults(changed))
    assert set(whole) <= set(schema["properties"]) == {*whole, "figures", "provenance"}


def leaves(part, path=""):
    """Every described part of the schema, with its path."""
    for name, one in part.get("properties", {}).items():
        yield f"{path}/{name}", one
        yield from leaves(one, f"{path}/{name}")
    for word in ("items", "additionalProperties"):
        inner = part.get(word)
        if isinstance(inner, dict):
            yield from leaves(inner, f"{path}/{word}")


def test_every_field_has_a_description_and_every_number_a_unit(schema):
    found = dict(leaves(schema))
    for name, part in schema["$defs"].items():
        assert part["description"]
        found |= dict(leaves(part, name))
    for path, one in found.items():
        assert one["description"].endswith("."), path
        kinds = [one.get("type"), one.get("items", {}).get("type")]
        inner = one.get("additionalProperties")
        kinds += (
            [inner.get("type")] if isinstance(inner, dict) and "unit" not in inner else []
        )
        if any(k in ("number", "integer", ["number", "null"]) for k in kinds):
            assert one.get("unit"), path


def test_the_schema_knows_the_channels_and_the_version(schema):
    assert set(schema["$defs"]["channel"]["enum"]) == set(NAMES)
    assert schema["properties"]["schema"]["const"] == schema["$id"] == SCHEMA


def test_places_of_all_templates_are_as_the_schema_says(schema, fitted_loss):
    """Also those of templates that nothing stands out in."""
    place = {"$ref": "#/$defs/where", "$defs": schema["$defs"]}
    validator = jsonschema.Draft202012Validator(place)
    _, _, fit = fitted_loss
    seen = set()
    for template in (*make_templates(fit.channels), *make_fitted_templates(fit)):
        where = _plain(template.where)
        assert not list(validator.iter_errors(where)), (template.family, where)
        seen |= set(where)
    assert len(seen) > 10


def test_the_page_has_every_field(schema):
    found = tables(PAGES.report_page())
    rows = {row[0].rstrip("* `") for row in found["The report"]}
    assert set(schema["properties"]) <= rows
    for name, part in schema["$defs"].items():
        for field in part.get("properties", {}):
            assert field in {row[0].rstrip("* `") for row in found[name]}
