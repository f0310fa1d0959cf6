"""The house as its imports draw it: `python docs/architecture.py` prints it, `--write` puts it into ARCHITECTURE.md.

Everything is read from the source with `ast`; nothing is imported. The floors stand here and nowhere else: the test of
the layers reads them too.
"""

from __future__ import annotations

import argparse
import ast
import re
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "ARCHITECTURE.md"
PACKAGE = "crowdmap_torch"
FLOORS = (
    ("ranges", "processes", "notebook"),
    ("fleet", "geometry", "optim", "clustering"),
    ("tables",),
    ("residuals",),
    ("noise",),
    ("tracking", "road", "signs", "lanes", "crowd_signs", "crowd_lanes", "survey"),
    ("io",),
    ("evaluation", "simulate"),
    ("adjustment", "viewer"),
    ("config", "plausibility"),
    ("mapper", "single_journey", "checking"),
    ("report",),
    ("runs",),
    ("benchmark",),
    ("studies",),
    ("commands",),
    ("cli",),
    ("soak",),
    ("__main__", "__init__"),
)
"""Every room of the house, from the ground up; the modules of the root are rooms of their own."""
NEIGHBOURS = {"signs": {"road"}, "lanes": {"road"}, "crowd_lanes": {"crowd_signs"}}
"""What rooms of one floor may import of each other."""
FLOOR = {room: number for number, rooms in enumerate(FLOORS) for room in rooms}
SIGN_TABLES = {
    *("tables.SignDetections", "tables.Tracklets", "tables.Signs", "tables.Association"),
    *("signs.views.SignViews", "signs.views.SignStart", "signs.views.SignFit"),
    "adjustment.observations.CornerObservations",
}
"""Tables with a row for each sign, or for each detection or view of one."""
WAY_STARTS = ("io.datasets.load_dataset", "mapper.build_map", "io.maps.write_map")
BEGIN, END = "<!-- drawn by docs/architecture.py -->", "<!-- end of the drawing -->"


# ---- the source ----


@cache
def modules() -> dict[str, Path]:
    """The file of every module by its name inside the package; that of a room's `__init__` is the room's."""
    found = {}
    for path in sorted((ROOT / PACKAGE).rglob("*.py")):
        parts = path.relative_to(ROOT / PACKAGE).with_suffix("").parts
        in_room = len(parts) > 1 and parts[-1] == "__init__"
        found[".".join(parts[:-1] if in_room else parts)] = path
    return found


@cache
def tree(path: Path) -> ast.Module:
    """The source of a file."""
    return ast.parse(path.read_text(encoding="utf-8"), filename=str(path))


def room(name: str) -> str:
    """The room that a module is in."""
    return name.split(".")[0]


def imports(path: Path) -> Iterator[str]:
    """Full names of what a file imports, wherever in it that stands."""
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            if node.level:
                raise ValueError(f"{path}:{node.lineno}: relative import; write it in full")
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


@cache
def own_imports(name: str) -> frozenset[str]:
    """Modules of the package that a module imports."""
    found = set()
    for full in imports(modules()[name]):
        if not full.startswith(f"{PACKAGE}.") or full == f"{PACKAGE}.__version__":
            # The version is a constant of the package's `__init__`, which loads nothing.
            continue
        inside = full.removeprefix(f"{PACKAGE}.")
        # The last part may be something inside the module.
        found.add(inside if inside in modules() else inside.rpartition(".")[0] or "__init__")
    return frozenset(found - {name})


def arrows() -> set[tuple[str, str]]:
    """Which room imports which other."""
    return {
        (room(name), room(other))
        for name in modules()
        for other in own_imports(name)
        if room(name) != room(other)
    }


def functions(path: Path) -> Iterator[tuple[str, int]]:
    """Every function and method of a file, and how many lines it has."""
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.FunctionDef):
            yield node.name, (node.end_lineno or node.lineno) - node.lineno + 1


# ---- a sign's way ----


@cache
def _definitions(name: str) -> dict[str, ast.FunctionDef | ast.ClassDef]:
    body = tree(modules()[name]).body
    return {n.name: n for n in body if isinstance(n, ast.FunctionDef | ast.ClassDef)}


@cache
def _names(name: str) -> dict[str, str]:
    """What the names of a module stand for, of those that are the package's."""
    found = {own: f"{name}.{own}" for own in _definitions(name)}
    for node in ast.walk(tree(modules()[name])):
        if isinstance(node, ast.ImportFrom) and str(node.module).startswith(PACKAGE):
            inside = str(node.module).removeprefix(PACKAGE).removeprefix(".")
            for alias in node.names:
                found[alias.asname or alias.name] = f"{inside}.{alias.name}".removeprefix(".")
    return found


def _mentions(name: str, node: ast.AST | None) -> list[str]:
    """Full names of the package's functions and classes that a piece of a module mentions, as they stand in it."""
    known, found = _names(name), []
    for part in ast.walk(node) if node is not None else ():
        if isinstance(part, ast.Name) and part.id in known:
            found.append((part.lineno, part.col_offset, known[part.id]))
        elif isinstance(part, ast.Attribute) and isinstance(part.value, ast.Name):
            of_module = known.get(part.value.id)
            if of_module in modules():
                found.append((part.lineno, part.col_offset, f"{of_module}.{part.attr}"))
    return [full for _, _, full in sorted(found)]


@cache
def _sign_tables() -> frozenset[str]:
    """SIGN_TABLES and every class with a field that holds one of them."""
    tables, before = set(SIGN_TABLES), -1
    while before < len(tables):
        before = len(tables)
        for name in modules():
            for own, definition in _definitions(name).items():
                fields = (n for n in definition.body if isinstance(n, ast.AnnAssign))
                if isinstance(definition, ast.ClassDef) and any(
                    tables.intersection(_mentions(name, field.annotation)) for field in fields
                ):
                    tables.add(f"{name}.{own}")
    return frozenset(tables)


def _hands_on(name: str, function: ast.FunctionDef) -> bool:
    """Whether signs go in and come out, be it from or to a file."""
    inputs = [a.annotation for a in (*function.args.args, *function.args.kwonlyargs)]
    takes = any(_sign_tables().intersection(_mentions(name, one)) for one in inputs)
    gives = bool(_sign_tables().intersection(_mentions(name, function.returns)))
    of_file = any(one is not None and re.search(r"\bPath\b", ast.unparse(one)) for one in inputs)
    return (takes and gives) or (of_file and (takes or gives))


def sign_way() -> tuple[str, ...]:
    """Modules that a sign passes from file to map, in order of the calls.

    Those with a function that takes a table of signs (or of their detections) and hands one on, the first and the last from
    and to a file; of the functions that it calls, those that do the same. What is asked for numbers alone, such as a
    distance or a covariance, is a tool beside the way, and what is about lanes is another way.
    """
    passed: dict[str, None] = {}
    seen: set[str] = set()

    def follow(full: str, start: bool = False) -> None:
        name, _, own = full.rpartition(".")
        if full in seen or name not in modules() or name.endswith("lanes"):
            return
        definition = _definitions(name).get(own)
        if not isinstance(definition, ast.FunctionDef):
            return
        hands_on = _hands_on(name, definition)
        if not (hands_on or start or own.startswith("_")):
            return
        seen.add(full)
        if hands_on:
            passed[name] = None
        for other in _mentions(name, definition):
            follow(other)

    for full in WAY_STARTS:
        follow(full, start=True)
    return tuple(passed)


# ---- the drawing ----


def _summary(name: str) -> str:
    text = ast.get_docstring(tree(modules()[name])) or ""
    return text.partition("\n")[0].rstrip(".")


def drawing() -> str:
    """The house, top floor first."""
    lines = []
    for number, rooms in reversed([*enumerate(FLOORS)]):
        for one in sorted(rooms):
            inside = sum(room(name) == one for name in modules())
            size = f"{inside - 1} modules" if inside > 1 else "module"
            lines.append(f"{number:>5}  {one:<15} {size:<11} {_summary(one)}")
    drawn, edges = sorted(room(name) for name in modules() if "." not in name), arrows()
    loose = [one for one in drawn if modules()[one].parent == ROOT / PACKAGE]
    beside = sorted(f"{one} -> {other}" for one, other in edges if FLOOR[one] == FLOOR[other])
    up = sorted(f"{one} -> {other}" for one, other in edges if FLOOR[one] < FLOOR[other])
    way = sign_way()
    return "\n".join(
        (
            "```",
            "floor  room",
            *lines,
            "",
            f"{len(FLOOR)} rooms on {len(FLOORS)} floors, {len(edges)} arrows between rooms, "
            f"{'none' if not up else ', '.join(up)} upwards",
            f"arrows between rooms of one floor: {', '.join(beside)}",
            f"modules of the root: {', '.join(loose)}",
            f"a sign passes {len(way)} modules from file to map:",
            *(f"    {name:<28} {_summary(name)}" for name in way),
            "```",
        )
    )


def page_drawing() -> str:
    """The drawing that the page has."""
    return PAGE.read_text(encoding="utf-8").partition(BEGIN)[2].partition(END)[0].strip("\n")


def main() -> int:
    """Prints the drawing and what is longest, or writes the drawing into the page."""
    parser = argparse.ArgumentParser(description="Draws the house from its imports.")
    parser.add_argument("--write", action="store_true", help="into docs/ARCHITECTURE.md")
    if parser.parse_args().write:
        before, _, rest = PAGE.read_text(encoding="utf-8").partition(BEGIN)
        after = rest.partition(END)[2]
        PAGE.write_text(f"{before}{BEGIN}\n{drawing()}\n{END}{after}", encoding="utf-8")
        return 0
    print(drawing())
    files = modules().values()
    lines, path = max((len(p.read_text(encoding="utf-8").splitlines()), p) for p in files)
    print(f"longest file: {path.relative_to(ROOT)}, {lines} lines")
    lines, path, name = max((n, p, name) for p in files for name, n in functions(p))
    print(f"longest function: {name} of {path.relative_to(ROOT)}, {lines} lines")
    return 0


if __name__ == "__main__":
    sys.exit(main())
