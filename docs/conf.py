"""Settings of the documentation: ``sphinx-build -W docs build/docs`` from a checkout."""

import inspect
import re
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(0, str(Path(__file__).resolve().parent))

import effect_figures
import reference_pages
from numpydoc.docscrape import NumpyDocString

from bfsensor import __version__

project = "bfsensor"
author = "The bfsensor developers"
copyright = "The bfsensor developers, BSD 3-clause licence"
version = release = __version__

extensions = [
    "sphinx.ext.autodoc", "sphinx.ext.autosummary", "sphinx.ext.mathjax", "numpydoc", "myst_parser",
    "sphinx_click", "sphinx_gallery.gen_gallery",
]  # fmt: skip
exclude_patterns = [
    "examples/*",
    "gallery/**/*.ipynb",
    "sg_execution_times.rst",
    "**/sg_execution_times.rst",
]
myst_heading_anchors = 3
numpydoc_show_class_members = False
autosummary_generate = True
toc_object_entries_show_parents = "hide"
autodoc_typehints = "none"  # the parameters' types stand in their table
templates_path = ["_templates"]
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_theme = "pydata_sphinx_theme"
html_title = "bfsensor"
html_theme_options = {
    "show_prev_next": False,
    "secondary_sidebar_items": ["page-toc"],
    "header_links_before_dropdown": 6,
}
sphinx_gallery_conf = {
    "examples_dirs": "examples",
    "gallery_dirs": "gallery",
    "filename_pattern": r"\.py$",
    "abort_on_example_error": True,
    "min_reported_time": 1e9,
    "show_memory": False,
}


def own_methods(module: str, name: str) -> list[str]:
    """Public methods of a class that this package defines: not those of GalSim or of tuples."""
    import bfsensor

    kind = getattr(sys.modules[module], name, None) or getattr(bfsensor, name)
    return sorted(
        word
        for word, member in inspect.getmembers(kind, callable)
        if not word.startswith("_")
        and getattr(member, "__module__", "").startswith("bfsensor")
        and inspect.getdoc(member)
        and not inspect.isclass(member)
    )


autosummary_context = {"own_methods": own_methods}
suppress_warnings = ["config.cache"]  # of that function, which cannot be pickled


def class_text(kind: type) -> str:
    """Turn the docstring of a class of effects into Markdown, its example into a code block."""
    parts = NumpyDocString(inspect.getdoc(kind) or "")
    texts = [parts["Summary"], parts["Extended Summary"], parts["Notes"]]
    texts += [parameter.desc for parameter in parts["Parameters"]]
    lines = [to_markdown("\n".join(text)) for text in texts if any(text)]
    if parts["Examples"]:
        lines += ["```pycon\n" + "\n".join(parts["Examples"]).strip() + "\n```"]
    return "\n\n".join(lines)


def to_markdown(text: str) -> str:
    """Turn a docstring's marks of code and formulae into those of Markdown pages."""
    text = re.sub(r"``([^`]+)``", r"`\1`", text)
    text = re.sub(r":math:`([^`]+)`", r"{math}`\1`", text)
    text = re.sub(r":\w+:`~?([^`]+)`", r"`\1`", text)
    return re.sub(
        r"^\.\. math::((?:\n?[ \t]+.*|\n(?=\n[ \t]))+)",
        lambda found: "```{math}\n" + inspect.cleandoc(found[1]) + "\n```",
        text,
        flags=re.MULTILINE,
    )


def write_effects() -> None:
    """Write the page of effect classes from the library itself, and draw their pictures."""
    from bfsensor.diagnose.report.class_words import CLASS_WORDS, LAW_WORDS
    from bfsensor.effects.device_parameter import DeviceParameter
    from bfsensor.effects.library import LIBRARY

    concepts = Path(__file__).with_name("concepts")
    effect_figures.draw_once(concepts / "effects")
    lines = [
        "# Classes of effects",
        "",
        "A diagnosis looks for these effects, and `BrighterFatterSensor(effects=...)` draws them.",
        "Ranges are those in which a diagnosis seeks an effect; pictures show stronger ones where",
        "that makes them clearer.",
        "",
    ]
    kinds = (*LIBRARY, DeviceParameter)
    lines += [
        "A class is named by what only it can do: where it acts, in which order of readout, and on",
        "which overscan. Within a class a diagnosis names the law (`law` in report.json):",
        "",
        "| class | law | meaning | source |",
        "|---|---|---|---|",
    ]
    for kind in sorted(kinds, key=lambda k: (k.word, k.variant)):
        name = f"{kind.word}:{kind.variant}".rstrip(":")
        law, meaning = LAW_WORDS.get(name, (kind.variant, ""))
        lines += [f"| {kind.word} | {law} | {meaning} | {kind.source} |"]
    lines += [""]
    for word in sorted({kind.word for kind in kinds}):
        shown = effect_figures.PICTURES[word]
        lines += [f"## {word}", "", CLASS_WORDS[word].capitalize() + ".", ""]
        lines += [
            f"```{{figure}} effects/{word}.png",
            f":alt: {word}",
            "",
            shown.caption,
            "```",
        ]
        lines += [""]
        for kind in (k for k in kinds if k.word == word):
            name = f"{kind.word}:{kind.variant}".rstrip(":")
            law = LAW_WORDS.get(name, (kind.variant, ""))[0]
            if law:
                lines += [f"**{law}**", ""]
            lines += [class_text(kind), ""]
            if kind.parameters:
                lines += ["| parameter | unit | from | to |", "|---|---|---|---|"]
                lines += [
                    f"| {p.name} | {p.unit} | {p.low:g} | {p.high:g} |"
                    for p in kind.parameters
                ]
                lines += [""]
            lines += [f"Source: {kind.source}.", ""]
    concepts.joinpath("effects.md").write_text("\n".join(lines))


ROOMS = {
    "device": "Devices", "simulate": "Simulation", "response": "Response of pixel edges",
    "table": "Distortion tables", "sensor": "Sensors for GalSim", "sweeps": "Sweeps",
    "direct": "Direct simulation", "measure": "Measurement", "recording": "Recordings",
    "effects": "Effects", "fit": "Fits of devices", "diagnose": "Diagnosis", "errors": "Errors",
}  # fmt: skip


def write_api() -> None:
    """Write the page of the public names that stand at the top of the package."""
    import bfsensor

    by_room: dict[str, list[str]] = {}
    for name in bfsensor.__all__:
        if not name.startswith("__"):
            module = getattr(bfsensor, name).__module__
            by_room.setdefault(module.split(".")[1], []).append(name)
    lines = ["# Python", "", "Names load what they need when they are first used.", ""]
    for room, title in ROOMS.items():
        names = sorted(by_room.pop(room, []))
        if names:
            lines += [f"## {title}", "", "```{eval-rst}", ".. currentmodule:: bfsensor"]
            lines += [".. autosummary::", "   :toctree: generated", ""]
            lines += [f"   {name}" for name in names] + ["```", ""]
    if by_room:
        raise ValueError(f"rooms without a title: {sorted(by_room)}")
    Path(__file__).with_name("reference").joinpath("api.md").write_text("\n".join(lines))


def write_validation() -> None:
    """Copy the pages of the claims, whose links to files that are no pages become names."""
    pages = Path(__file__).with_name("validation")
    pages.mkdir(exist_ok=True)
    claims = Path(__file__).resolve().parents[1] / "validation"
    for path in [claims / "README.md", *sorted(claims.glob("*/README.md"))]:
        text = path.read_text()
        text = re.sub(r"\]\((\w+)/README\.md\)", r"](\1.md)", text)
        text = re.sub(r"\[([^]]+)\]\((?!https?:|\w+\.md)[^)]+\)", r"`\1`", text)
        name = "index" if path.parent == claims else path.parent.name
        (pages / f"{name}.md").write_text(text)
    folders = sorted(p.stem for p in pages.glob("*.md") if p.stem != "index")
    tree = "\n".join(["```{toctree}", ":hidden:", "", *folders, "```", ""])
    with (pages / "index.md").open("a") as page:
        page.write("\n" + tree)


def link_pages(app: object, name: str, source: list[str]) -> None:
    """Turn links to the checkout's files, which a reader of the repository follows, into the site's."""
    text = re.sub(
        r"\]\(\.\./\.\./validation/(\w+)/README\.md\)", r"](../validation/\1.md)", source[0]
    )
    text = text.replace("](../../validation/README.md)", "](../validation/index.md)")
    source[0] = re.sub(r"(?<!!)\[([^]]+)\]\(\.\./\.\./[^)]+\)", r"`\1`", text)


def write_reference() -> None:
    """Write the pages of the files that the package reads and writes."""
    folder = Path(__file__).with_name("reference")
    for name, make in reference_pages.PAGES.items():
        (folder / name).write_text(make() + "\n")


# Written before Sphinx looks which pages there are.
write_api()
write_reference()
write_effects()
write_validation()


def setup(app: object) -> None:
    """Links of the repository become the site's."""
    app.connect("source-read", link_pages)  # type: ignore[attr-defined]
