"""The site has the pages that its users look for, and its inner links lead somewhere."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from bfsensor.diagnose.report.class_words import CLASS_WORDS
from tests.docs.examples import PAGES
from tests.docs.pages import DOCS

ROOT = DOCS.parent
WRITTEN = {"reference/api.md", "concepts/effects.md", "gallery/index.md"}
"""Pages that are written when the site is built, beside those of the reference."""

TASKS = {
    "size against flux": ("star_growth", r"strength.*moments_sigma"),
    "SED, colour": ("colour", r"WavelengthSampler"),
    "switching physics off": ("switch_off", r"charge_response"),
    "configuration files": ("configuration", r"type: BrighterFatter"),
    "imSim": ("imsim", r"image\.sensor\.type.*focal_plane"),
    "own sensor": ("own_device", r"bfsensor device new"),
    "own camera": ("own_camera", r"bfsensor table --from .*--thickness"),
    "voltages": ("sweeps", r"bfsensor sweep .*back_bias"),
    "fit": ("fit", r"bfsensor fit "),
    "photon transfer curve": ("photon_transfer", r"measure_curve"),
    "export of kernels": ("kernels", r"bfsensor export bfk"),
    "correction": ("correction", r"correct_kernel"),
    "findings into images": ("effects_in_images", r"effects=.*report\.json"),
    "what a folder holds": ("recordings", r"bfsensor check"),
    "why recordings disagree": ("diagnosis", r"bfsensor diagnose"),
}


def entries(page):
    """Pages that the tables of contents of a page list, relative to docs/."""
    text = PAGES[page]
    found = []
    for tree in re.findall(r"```{toctree}\n(?::[^\n]*\n)*\n(.*?)```", text, re.DOTALL):
        for line in tree.split("\n"):
            if line:
                target = re.sub(r".*<(.*)>$", r"\1", line)
                there = (
                    DOCS / target[1:] if target[0] == "/" else (DOCS / page).parent / target
                )
                found.append(f"{there.relative_to(DOCS).as_posix()}.md")
    return found


def test_the_table_of_contents_has_seven_sections():
    assert entries("index.md") == [
        f"{section}/index.md"
        for section in (
            "start", "howto", "concepts", "reference", "gallery", "validation", "developing"
        )
    ]  # fmt: skip
    assert len(entries("start/index.md")) == 4 and len(entries("howto/index.md")) >= 10


def test_every_page_is_in_one_table_of_contents():
    listed = [entry for page in PAGES for entry in entries(page)]
    assert len(listed) == len(set(listed))
    assert set(PAGES) - {"index.md"} <= set(listed)
    assert set(listed) - set(PAGES) == WRITTEN | {"validation/index.md"}


@pytest.mark.parametrize("task", TASKS)
def test_every_task_has_its_page(task):
    page, needed = TASKS[task]
    assert f"howto/{page}.md" in entries("howto/index.md")
    assert re.search(needed, PAGES[f"howto/{page}.md"], re.DOTALL)


def slugs(text):
    """Anchors that headings of a page get."""
    heads = re.findall(
        r"^#{1,3} (.*)$", re.sub(r"```.*?```", "", text, flags=re.DOTALL), re.M
    )
    return {
        re.sub(r"[^\w -]", "", head.lower()).strip().replace(" ", "-") for head in heads
    }


def links():
    for page, text in PAGES.items():
        plain = re.sub(r"```.*?```", "", text, flags=re.DOTALL)
        for target in re.findall(r"\]\(([^)\s]+)\)", plain):
            if not target.startswith(("http:", "https:")):
                yield pytest.param(page, target, id=f"{page}:{target}")


@pytest.mark.parametrize(("page", "target"), list(links()))
def test_inner_links_lead_somewhere(page, target):
    path, _, anchor = target.partition("#")
    there = (DOCS / page).parent / path if path else DOCS / page
    full = Path(re.sub(r"/\./", "/", str(there))).resolve()
    if not full.is_relative_to(DOCS):
        # The site turns links to the checkout's files into its own.
        assert full.exists() and full.is_relative_to(ROOT)
        return
    name = full.relative_to(DOCS).as_posix()
    if name.startswith("gallery/"):
        example = full.with_suffix(".py").name
        assert (DOCS / "examples" / example).is_file()
    elif name == "concepts/effects.md":
        assert not anchor or anchor in CLASS_WORDS
    elif name.startswith("validation/"):
        folder = full.stem
        assert folder == "index" or (ROOT / "validation" / folder / "README.md").is_file()
    elif name in PAGES:
        assert not anchor or anchor in slugs(PAGES[name]), f"no heading {anchor} in {name}"
    else:
        assert full.is_file(), f"{page}: {target} leads nowhere"


def test_pictures_are_there():
    for page, text in PAGES.items():
        for target in re.findall(r"!\[[^]]*\]\(([^)\s]+)\)", text):
            assert ((DOCS / page).parent / target).resolve().is_file(), (page, target)
