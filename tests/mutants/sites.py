"""Places in the package where a single changed line is a wrong result, found in its syntax trees."""

from __future__ import annotations

import ast
import random
import re
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]

LARGEST_SHARE = {"_kernels": 20}
"""Largest number of mutants of a room.  Chosen: each mutant of a kernel is compiled again, which takes
up to 100 CPU s; with twice as many a run takes up to half an hour longer."""

NOT_TRIED = re.compile(
    r"/(plots|report)/|_words\.py|figures|/(warm|messages|main|common|notice|code_folder"
    r"|compile_options|inner_compiler|config|imsim|threads|summary)\.py"
)
"""Files of pictures, of words for readers, of compilers and of other packages' conventions."""

WORDS = re.compile(
    r"(repr|str|describe|format|say|write_html|plot|draw|summar|warn|echo|log)"
)
"""Functions that make texts or pictures, by the beginning of their names."""

AXES = re.compile(r"(?P<before>(?:\w*_)?[dn]?)(?P<axis>[xy])(?P<after>[0-9s]?(?:_\w*)?)")

OPERATORS = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*"}
COMPARISONS = {ast.Lt: ("<", "<=", ">"), ast.LtE: ("<=", "<", ">="),
               ast.Gt: (">", ">=", "<"), ast.GtE: (">=", ">", "<=")}  # fmt: skip
EXTREMES = {"min": "max", "max": "min", "minimum": "maximum", "maximum": "minimum",
            "argmin": "argmax", "argmax": "argmin", "nanmin": "nanmax", "nanmax": "nanmin",
            "fmin": "fmax", "fmax": "fmin"}  # fmt: skip


@dataclass(frozen=True)
class Mutant:
    """One changed line."""

    file: str
    """Path from the root of the checkout."""
    line: int
    kind: str
    before: str
    after: str
    """The line without its indentation, as it is and as it is changed."""

    @property
    def room(self) -> str:
        """Sub-package of the file."""
        return self.file.split("/")[1]

    @property
    def content(self) -> tuple[str, str, str]:
        """Key that stays where lines above are added."""
        return self.file, self.before, self.after

    def apply(self, root: Path) -> None:
        """Write the changed line into a copy of the checkout."""
        path = root / self.file
        lines = path.read_text(encoding="utf-8").split("\n")
        old = lines[self.line - 1]
        assert old.strip() == self.before, f"{self.file}:{self.line} is '{old.strip()}'"
        lines[self.line - 1] = old[: len(old) - len(old.lstrip())] + self.after
        path.write_text("\n".join(lines), encoding="utf-8")


def known() -> list[Mutant]:
    """Five mutants that the tests of an earlier version did not notice, where their lines are now."""
    changes = (
        ("effects/cti_serial.py", "axis", 'layout.backwards("x"), -1)', ", -1)", ", -2)"),
        ("measure/flat_pairs.py", "axis", "products[1] / np.maximum", "np.maximum(pairs[1], 1)",
         "np.maximum(pairs[0], 1)"),
        ("recording/campaign/level_checks.py", "factor", "np.sqrt(2.0 / pair.pixels)", "2.0", "1.0"),
        ("diagnose/detect/candidate_screen.py", "sign", "prior -= 0.5 * beyond**2", "-=", "+="),
        ("_kernels/drift.py", "factor", "out[1] = y + h / 6.0 * (ay", "2.0 * cy", "1.9 * cy"),
    )  # fmt: skip
    found = []
    for name, kind, part, old, new in changes:
        lines = (ROOT / "bfsensor" / name).read_text(encoding="utf-8").split("\n")
        (at,) = (n for n, line in enumerate(lines) if part in line)
        line = lines[at].strip()
        found.append(Mutant(f"bfsensor/{name}", at + 1, kind, line, line.replace(old, new)))
    return found


def choose(*, seed: int, count: int) -> list[Mutant]:
    """Draw mutants at random: rooms by the root of their length, kinds and lines evenly.

    Rooms alternate, so that the first mutants of a long list are spread over all rooms as well.
    """
    files: dict[str, list[Path]] = defaultdict(list)
    for path in sorted((ROOT / "bfsensor").glob("*/**/*.py")):
        if path.name != "__init__.py" and not NOT_TRIED.search(path.as_posix()):
            files[path.relative_to(ROOT / "bfsensor").parts[0]].append(path)
    length = {
        room: sum(path.read_text(encoding="utf-8").count("\n") for path in paths) ** 0.5
        for room, paths in files.items()
    }
    ranked: list[tuple[float, Mutant]] = []
    for room, paths in files.items():
        share = count * length[room] / sum(length.values())
        share = min(round(share), LARGEST_SHARE.get(room, count))
        drawn = _draw([m for path in paths for m in mutants_of(path)], share, seed, room)
        ranked += [((n + 0.5) / share, mutant) for n, mutant in enumerate(drawn)]
    ranked.sort(key=lambda entry: entry[0])
    return [mutant for _, mutant in ranked[:count]]


def _draw(mutants: list[Mutant], number: int, seed: int, room: str) -> list[Mutant]:
    """Draw from one room, a kind first, so that rare kinds are tried too; no line twice."""
    chance = random.Random(f"{seed} {room}")
    by_kind: dict[str, list[Mutant]] = defaultdict(list)
    for mutant in mutants:
        by_kind[mutant.kind].append(mutant)
    drawn: list[Mutant] = []
    while len(drawn) < number and by_kind:
        kind = chance.choice(sorted(by_kind))
        mutant = by_kind[kind].pop(chance.randrange(len(by_kind[kind])))
        if not by_kind[kind]:
            del by_kind[kind]
        there = (mutant.file, mutant.line) in {(m.file, m.line) for m in drawn}
        if not there and _is_other_code(mutant):
            drawn.append(mutant)
    return drawn


def mutants_of(path: Path) -> Iterator[Mutant]:
    """Give all mutants of a file; few of them do not parse, or are the same code."""
    source = path.read_text(encoding="utf-8")
    lines = source.split("\n")
    name = path.relative_to(ROOT).as_posix()
    tree = ast.parse(source)
    names = {n.id for n in ast.walk(tree) if isinstance(n, ast.Name)}
    names |= {n.attr for n in ast.walk(tree) if isinstance(n, ast.Attribute)}
    for node, parent in _numeric(tree):
        if node.lineno != node.end_lineno:
            continue
        line = lines[node.lineno - 1]
        code = line.encode()
        for kind, begin, end, new in _edits(node, parent, code, names):
            changed = (code[:begin] + new.encode() + code[end:]).decode()
            yield Mutant(name, node.lineno, kind, line.strip(), changed.strip())


def _is_other_code(mutant: Mutant) -> bool:
    """Whether the changed file parses, and as other code than before."""
    source = (ROOT / mutant.file).read_text(encoding="utf-8")
    lines = source.split("\n")
    lines[mutant.line - 1] = lines[mutant.line - 1].replace(mutant.before, mutant.after)
    try:
        return ast.dump(ast.parse("\n".join(lines))) != ast.dump(ast.parse(source))
    except SyntaxError:
        return False


def _numeric(tree: ast.Module) -> Iterator[tuple[ast.expr | ast.stmt, ast.AST]]:
    """Nodes of functions' bodies with their parents; messages, texts and annotations left out."""
    waiting: list[tuple[ast.AST, ast.AST, bool]] = [(tree, tree, False)]
    while waiting:
        node, parent, inside = waiting.pop()
        if isinstance(
            node, ast.Raise | ast.JoinedStr | ast.Assert | ast.Import | ast.ImportFrom
        ):
            continue
        if isinstance(node, ast.Call):
            called = node.func.attr if isinstance(node.func, ast.Attribute) else ""
            called = node.func.id if isinstance(node.func, ast.Name) else called
            if called.endswith(("Error", "Warning")) or WORDS.match(called.strip("_")):
                continue
        if inside and isinstance(node, ast.expr | ast.AugAssign):
            yield node, parent
        if isinstance(node, ast.FunctionDef):
            if not WORDS.match(node.name.strip("_")):
                waiting += [(child, node, True) for child in node.body]
            continue
        if isinstance(node, ast.AnnAssign):
            waiting += [(node.value, node, inside)] if node.value else []
            continue
        waiting += [(child, node, inside) for child in ast.iter_child_nodes(node)]


def _edits(
    node: ast.expr | ast.stmt, parent: ast.AST, code: bytes, names: set[str]
) -> Iterator[tuple[str, int, int, str]]:
    """Changes of one node: kind, first byte, last byte and what is put there."""
    begin, end = node.col_offset, node.end_col_offset or 0

    def text(part: ast.expr) -> str:
        return code[part.col_offset : part.end_col_offset].decode()

    def between(
        first: ast.expr, second: ast.expr, old: str, new: str
    ) -> tuple[int, int, str]:
        at = code.index(old.encode(), first.end_col_offset, second.col_offset)
        return at, at + len(old), new

    if isinstance(node, ast.BinOp) and type(node.op) in OPERATORS:
        if any(map(_is_text, (node.left, node.right))):
            return
        sign = OPERATORS[type(node.op)]
        if sign != "*":
            yield "sign", *between(node.left, node.right, sign, "-" if sign == "+" else "+")
        yield "term", begin, end, f"({text(node.left)})"
        if sign != "-":
            yield "term", begin, end, f"({text(node.right)})"
    elif isinstance(node, ast.AugAssign) and isinstance(node.op, ast.Add | ast.Sub):
        if any(map(_is_text, ast.walk(node.value))):
            return
        old, new = ("+=", "-=") if isinstance(node.op, ast.Add) else ("-=", "+=")
        yield "sign", *between(node.target, node.value, old, new)
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
        if not isinstance(node.operand, ast.Constant):
            yield "sign", begin, end, f"({text(node.operand)})"
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
        yield "not", begin, end, f"({text(node.operand)})"
    elif isinstance(node, ast.Compare) and len(node.ops) == 1:
        if type(node.ops[0]) in COMPARISONS:
            old, *others = COMPARISONS[type(node.ops[0])]
            for new in others:
                yield "comparison", *between(node.left, node.comparators[0], old, new)
    elif isinstance(node, ast.Call):
        yield from _edits_of_call(node, code, text)
    elif isinstance(node, ast.Constant) and type(node.value) in (int, float):
        yield from _edits_of_number(node, parent)
    elif isinstance(node, ast.Constant) and node.value in ("x", "y"):
        yield "axis", begin, end, '"y"' if node.value == "x" else '"x"'
    elif isinstance(node, ast.Name | ast.Attribute) and isinstance(node.ctx, ast.Load):
        own = node.id if isinstance(node, ast.Name) else node.attr
        found = AXES.fullmatch(own)
        if found:
            other = "y" if found["axis"] == "x" else "x"
            other = f"{found['before']}{other}{found['after']}"
            if other in names:
                yield "axis", end - len(own), end, other


def _edits_of_call(node, code, text):  # type: ignore[no-untyped-def]
    """Changes of a call: its axis, a minimum that becomes a maximum, a root that is not taken."""
    for keyword in node.keywords:
        value = keyword.value
        if keyword.arg == "axis" and text(value) in ("0", "1", "-1", "-2"):
            new = {"0": "1", "1": "0", "-1": "-2", "-2": "-1"}[text(value)]
            yield "axis", value.col_offset, value.end_col_offset, new
    name = node.func
    own = name.attr if isinstance(name, ast.Attribute) else getattr(name, "id", "")
    if own in EXTREMES:
        yield "extreme", name.end_col_offset - len(own), name.end_col_offset, EXTREMES[own]
    if own in ("sqrt", "hypot") and len(node.args) == 1:
        yield "root", node.col_offset, node.end_col_offset, f"({text(node.args[0])})"


def _edits_of_number(
    node: ast.Constant, parent: ast.AST
) -> Iterator[tuple[str, int, int, str]]:
    """Changes of a number: a factor twice as large, an index one further, the other side of a shape."""
    begin, end = node.col_offset, node.end_col_offset or 0
    if isinstance(parent, ast.BinOp) and isinstance(parent.op, ast.Mult | ast.Div):
        new = repr(type(node.value)(1) if node.value in (2, 0.5) else 2 * node.value)
        yield "factor", begin, end, new
    elif isinstance(parent, ast.Subscript) and isinstance(parent.value, ast.Attribute):
        if parent.value.attr == "shape" and node.value in (0, 1):
            yield "axis", begin, end, str(1 - node.value)
    elif type(node.value) is int and _counts(parent):
        yield "index", begin, end, str(node.value + 1)


def _counts(parent: ast.AST) -> bool:
    """Whether a whole number below this node is an index, or is added to one."""
    if isinstance(parent, ast.BinOp):
        return isinstance(parent.op, ast.Add | ast.Sub)
    if isinstance(parent, ast.Call):
        return getattr(parent.func, "id", "") == "range"
    return isinstance(parent, ast.Subscript | ast.Slice)


def _is_text(node: ast.AST) -> bool:
    """Whether an operand is a text or a list, which a sum joins."""
    return isinstance(node, ast.JoinedStr | ast.List | ast.Tuple) or (
        isinstance(node, ast.Constant) and isinstance(node.value, str)
    )
