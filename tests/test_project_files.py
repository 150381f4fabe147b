"""Files about the project: they parse, and say the same as pyproject.toml."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest
import yaml

import bfsensor

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
CONDA = {"matplotlib": "matplotlib-base"}
"""What conda-forge calls by another name; the plain one brings a graphical toolkit."""


def read(name):
    return yaml.safe_load((ROOT / name).read_text(encoding="utf-8"))


def spec(requirement):
    """Name and lowest version of a requirement, of pip's or conda's form."""
    name, lowest = re.fullmatch(r"([\w-]+)\s*(?:>=\s*([\d.]+))?", requirement).groups()
    return CONDA.get(name, name), lowest


def required(*extras):
    """Requirements of the package and of some extras, as conda names them."""
    given = PROJECT["dependencies"] + [
        line for extra in extras for line in PROJECT["optional-dependencies"][extra]
    ]
    return {spec(line) for line in given if not line.startswith("bfsensor[")}


def test_conda_asks_for_what_pip_asks_for():
    run = read("conda/recipe.yaml")["requirements"]["run"]
    assert {spec(line) for line in run if "python" not in line} == required()
    found = {spec(line) for line in read("environment.yml")["dependencies"]}
    apart = {("python", "3.11"), ("pip", None), ("hatchling", None)}
    assert found == required("plots", "dask", "dev") | apart


def test_the_recipe_builds_this_package():
    recipe = read("conda/recipe.yaml")
    assert recipe["schema_version"] == 1 and recipe["package"]["name"] == PROJECT["name"]
    assert recipe["build"]["noarch"] == "python"
    (command,) = PROJECT["scripts"].items()
    assert recipe["build"]["python"]["entry_points"] == [" = ".join(command)]
    assert f">={recipe['context']['python_min']}" == PROJECT["requires-python"]
    assert recipe["about"]["license"] == PROJECT["license"]
    assert (ROOT / recipe["about"]["license_file"]).is_file()
    assert "bfsensor" in recipe["tests"][0]["python"]["imports"]


def test_the_version_is_the_same_everywhere():
    assert read("CITATION.cff")["version"] == bfsensor.__version__
    assert read("conda/recipe.yaml")["context"]["version"] == bfsensor.__version__
    assert f"## {bfsensor.__version__}" in (ROOT / "CHANGELOG.md").read_text()


def test_the_workflow_tests_the_versions_that_are_declared():
    workflow = read(".github/workflows/tests.yml")
    assert set(workflow[True]) == {"push", "pull_request"}  # YAML 1.1 reads `on` as true
    job = workflow["jobs"]["tests"]
    matrix = job["strategy"]["matrix"]
    assert matrix["os"] == ["ubuntu-latest", "macos-latest"]
    kinds = [line.split(" :: ") for line in PROJECT["classifiers"]]
    declared = [k[2] for k in kinds if k[1] == "Python" and "." in k[-1]]
    assert matrix["python"] == declared == ["3.11", "3.12", "3.13"]


def test_the_workflow_runs_the_command_of_the_readme(tmp_path):
    """Its shell lines find the command; here it is printed instead of run."""
    import subprocess

    (step,) = (
        s["run"]
        for s in read(".github/workflows/tests.yml")["jobs"]["tests"]["steps"]
        if "run" in s
    )
    shown = subprocess.run(
        ["bash", "-euc", step.replace("bash -euc", "echo")],
        cwd=ROOT, capture_output=True, text=True, check=True,
    ).stdout.strip()  # fmt: skip
    assert shown.startswith("python3 -m venv") and shown.endswith("pytest")
    assert f"\n{shown}\n" in (ROOT / "README.md").read_text()


def test_linters_before_a_commit_are_those_of_the_project():
    (repository,) = read(".pre-commit-config.yaml")["repos"]
    assert repository["repo"].endswith("/ruff-pre-commit")
    assert [hook["id"] for hook in repository["hooks"]] == ["ruff-check", "ruff-format"]
    lowest = dict(
        spec(line) for line in PROJECT["optional-dependencies"]["dev"] if "ruff" in line
    )
    version = tuple(map(int, repository["rev"].removeprefix("v").split(".")))
    assert version >= tuple(map(int, lowest["ruff"].split(".")))


@pytest.mark.parametrize("name", ["CONTRIBUTING.md", "RELEASING.md"])
def test_files_that_a_page_names_exist(name):
    text = (ROOT / name).read_text()
    paths = re.findall(r"`((?:[\w.-]+/)*[\w.-]+\.(?:md|py|toml|yaml|yml|cff|txt))`", text)
    assert paths
    made_by_users = {"campaign.yaml", "report.json"}
    assert [p for p in paths if p not in made_by_users and not (ROOT / p).is_file()] == []
