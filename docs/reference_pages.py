"""Pages of the reference that are written from the code: keys of files and fields of reports."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from importlib.resources import files
from typing import Any

from bfsensor.device.device import ORIGINS
from bfsensor.device.file_keys import SECTION_MEANINGS, DeviceKey, device_keys
from bfsensor.device.parts import LISTS, Implant
from bfsensor.recording.campaign.file_keys import (
    CAMPAIGN_KEYS,
    FileKey,
    header_quantities,
    manifest_columns,
)


def _table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> list[str]:
    """Lines of a table; a bar inside a cell would end it."""
    lines = [list(head), *(list(row) for row in rows)]
    out = [
        "| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in lines
    ]
    return [out[0], "|" + "---|" * len(lines[0]), *out[1:], ""]


DEVICE_INTRODUCTION = """# Keys of device files

A device file is TOML. It begins with `name`, a text, which is required. Every quantity is a text
with its unit, such as `thickness = "100 um"`; any unit of the same dimension is read. An inline
table states what is known about a value:

```toml
[silicon]
thickness = {{ value = "100 um", uncertainty = "5 um", origin = "published", source = "data sheet" }}
```

`uncertainty` is one standard deviation and serves as prior in fits. `origin` is one of {origins}.
A key that is not listed here is refused. `bfsensor device check FILE` reports what is wrong with a
file; `bfsensor device new FILE --from NAME` copies the file of a shipped device.
"""

CAMPAIGN_INTRODUCTION = """# Keys of campaign.yaml and manifest.ecsv

Both files are optional and lie in the folder of the exposures. campaign.yaml states what headers do
not, or state wrongly; manifest.ecsv lists the exposures. Every key may be missing. A key that is
not listed is passed over with a warning.

## campaign.yaml
"""

HEADERS_INTRODUCTION = """## Quantities of headers

`keywords:` takes these names. Headers are searched for the keywords in this order; the first that
is there decides. A unit in brackets at the start of a keyword's comment replaces the one of the
table. A value outside the range counts as not stated.
"""

MANIFEST_INTRODUCTION = """## Columns of manifest.ecsv

The table is ECSV with one row for each exposure. A column's own unit replaces the one below. Case
does not matter in names of columns. Where manifest and header differ, the manifest decides and a
warning names both values.
"""

REPORT_INTRODUCTION = """# Fields of report.json

`bfsensor diagnose` writes report.json beside report.html. Its JSON Schema (draft 2020-12) comes
with the package:

```python
import json
from importlib.resources import files

text = files("bfsensor.diagnose.report").joinpath("report.schema.json").read_text()
schema = json.loads(text)
```

Each number has a unit; 1 stands for a pure number. Fields marked * may be absent.

## The report
"""


def device_file_page() -> str:
    """Keys of device files."""
    lines = [DEVICE_INTRODUCTION.format(origins=", ".join(ORIGINS))]
    by_section: dict[str, list[DeviceKey]] = {}
    for key in device_keys():
        by_section.setdefault(key.section, []).append(key)
    implants = [name for name in by_section if name.endswith(".implant]]")]
    for section, keys in by_section.items():
        if section in implants:
            continue
        word = section.strip("[]")
        lines += [f"## {section}", "", SECTION_MEANINGS.get(word, _note_of(word)), ""]
        lines += _device_table(keys)
    lines += [
        "## Implants",
        "",
        "The same keys hold in " + ", ".join(f"`{n}`" for n in implants) + ".",
    ]
    lines += ["Depths count from the surface of the silicon at the gates.", ""]
    return "\n".join(lines + _device_table(by_section[implants[0]]))


def _note_of(word: str) -> str:
    """Say how often a section inside another may stand."""
    inner = word.split(".")[-1]
    many = any(entry == inner for entry, kind in LISTS.values() if kind is not Implant)
    return "The section may stand several times." if many else "The section is optional."


def _device_table(keys: Iterable[DeviceKey]) -> list[str]:
    head = "key", "unit", "default", "allowed", "meaning"
    return _table(
        head, ((f"`{k.key}`", k.unit, k.default, k.allowed, k.meaning) for k in keys)
    )


def campaign_page() -> str:
    """Keys of campaign.yaml, keywords of headers, columns of manifest.ecsv."""
    lines = [CAMPAIGN_INTRODUCTION]
    head = "key", "unit", "allowed", "meaning", "example"
    lines += _table(head, (_campaign_row(k) for k in CAMPAIGN_KEYS))
    lines += [HEADERS_INTRODUCTION]
    lines += _table(
        ("quantity", "unit", "unit in headers", "allowed", "keywords", "meaning"),
        (
            (
                f"`{q.name}`",
                q.unit,
                q.header_unit,
                q.allowed,
                ", ".join(q.keywords),
                q.meaning,
            )
            for q in header_quantities()
        ),
    )
    lines += [MANIFEST_INTRODUCTION]
    head = "column", "unit", "allowed", "meaning"
    lines += _table(
        head, ((f"`{k.key}`", k.unit, k.allowed, k.meaning) for k in manifest_columns())
    )
    return "\n".join(lines)


def _campaign_row(k: FileKey) -> tuple[str, ...]:
    return f"`{k.key}`", k.unit, k.allowed, k.meaning, f"`{k.example}`"


def report_schema() -> dict[str, Any]:
    """Give the schema of report.json that the package ships."""
    path = files("bfsensor.diagnose.report").joinpath("report.schema.json")
    found: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return found


def report_page() -> str:
    """Fields of report.json."""
    schema = report_schema()
    lines = [REPORT_INTRODUCTION]
    lines += _schema_table(schema)
    for name, part in schema["$defs"].items():
        lines += [f"## {name}", "", part["description"], ""]
        if "enum" in part:
            lines += [", ".join(f"`{word}`" for word in part["enum"]) + ".", ""]
        else:
            lines += _schema_table(part)
    return "\n".join(lines)


def _schema_table(part: dict[str, Any]) -> list[str]:
    return _table(("field", "type", "unit", "meaning"), _fields(part, ""))


def _fields(part: dict[str, Any], prefix: str) -> Iterator[tuple[str, str, str, str]]:
    """Rows of an object's fields, and of objects that are described in their place."""
    needed = part.get("required", ())
    for name, one in part.get("properties", {}).items():
        star = "" if name in needed else " *"
        yield f"`{prefix}{name}`{star}", _kind(one), one.get("unit", ""), one["description"]
        yield from _inside(one, f"{prefix}{name}")


def _inside(one: dict[str, Any], path: str) -> Iterator[tuple[str, str, str, str]]:
    values = one.get("additionalProperties")
    if isinstance(one.get("items"), dict):
        one, path = one["items"], f"{path}[]"
    elif isinstance(values, dict):
        one, path = values, f"{path}.NAME"
        if "unit" in one:
            yield f"`{path}`", _kind(one), one["unit"], one["description"]
    else:
        return
    yield from _fields(one, f"{path}.")


def _kind(one: dict[str, Any]) -> str:
    """Type of a field in words; parts that stand by themselves are links."""
    if "$ref" in one:
        name = one["$ref"].rpartition("/")[2]
        return f"[{name}](#{name})"
    if "anyOf" in one:
        return " or ".join(map(_kind, one["anyOf"]))
    if "const" in one:
        return f"`{json.dumps(one['const'])}`"
    if "enum" in one:
        return " or ".join(f"`{json.dumps(word)}`" for word in one["enum"])
    kind = one["type"]
    if kind == "array":
        return f"list of {_kind(one['items'])}"
    if kind == "object" and isinstance(one.get("additionalProperties"), dict):
        return f"mapping to {_kind(one['additionalProperties'])}"
    return " or ".join(kind) if isinstance(kind, list) else str(kind)


PAGES = {
    "device_file.md": device_file_page, "campaign_files.md": campaign_page,
    "report.md": report_page,
}  # fmt: skip
"""Files under docs/reference, and what writes each."""
