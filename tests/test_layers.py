"""Imports go down only (ARCHITECTURE.md): read from the source, nothing is imported."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGE = "crowdmap_torch"
LEVELS = {
    "geometry": 0,
    "optim": 0,
    "clustering": 0,
    "tables": 1,
    "io": 2,
    "residuals": 2,
    "simulate": 2,
    "stages": 3,
    "config": 4,
    "control": 4,
    "crowd": 4,
    "evaluate": 4,
    "evaluation": 4,
    "mapper": 4,
    "report": 5,
    "run_folder": 5,
    "single_journey": 4,
    "run_metrics": 5,
    "benchmark": 6,
    "studies": 6,
    "subcommands": 6,
    "": 6,
}
"""The layer of each module or package; the package's own `__init__` ("") may import all of them."""
SHARED_LEVEL = 2
"""The layer of whatever else there is: pieces between the tables and the stages that call them."""

MODULES = sorted((ROOT / PACKAGE).rglob("*.py"))


def name_of(path: Path) -> str:
    """The dotted name of a module inside the package, "" for the package itself."""
    parts = path.relative_to(ROOT / PACKAGE).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


NAMES = {name_of(path) for path in MODULES}


def unit(name: str) -> str:
    return name.split(".")[0]


def level(name: str) -> int:
    return LEVELS.get(unit(name), SHARED_LEVEL)


@cache
def tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"), filename=str(path))


def imports(path: Path) -> Iterator[str]:
    """Full names of what a module imports, wherever in the file that stands."""
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import; write it in full"
            for alias in node.names:
                yield f"{node.module}.{alias.name}"


def own_imports(path: Path) -> set[str]:
    """Modules of the package that a module imports."""
    found = set()
    for full in imports(path):
        if full != PACKAGE and not full.startswith(f"{PACKAGE}."):
            continue
        if full == f"{PACKAGE}.__version__":
            # A constant, the first thing in the package's `__init__`.
            continue
        name = full.removeprefix(PACKAGE).removeprefix(".")
        # The last part may be something inside the module.
        found.add(name if name in NAMES else name.rpartition(".")[0])
    return found - {name_of(path)}


@pytest.mark.parametrize("path", MODULES, ids=name_of)
def test_imports_go_down_only(path: Path) -> None:
    name = name_of(path)
    for other in own_imports(path):
        if unit(other) == unit(name):
            continue
        if level(name) == 0:
            pytest.fail(f"{name} (L0) imports {other}: packages of L0 know nothing but themselves")
        assert level(other) <= level(name), (
            f"{name} (L{level(name)}) imports {other} (L{level(other)}): imports go down only"
        )


def test_modules_do_not_import_in_circles() -> None:
    graph = {name_of(path): own_imports(path) for path in MODULES}
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(f"import cycle: {' -> '.join(error.args[1])}")


def test_stages_never_import_each_other() -> None:
    for path in (p for p in MODULES if p.parent.name == "stages"):
        others = {name for name in own_imports(path) if unit(name) == "stages"}
        assert not others, f"{name_of(path)} imports {sorted(others)}: what two stages need is L2"


def test_nothing_imports_scripts_or_tests() -> None:
    for path in MODULES:
        roots = {full.split(".")[0] for full in imports(path)}
        assert not roots & {"scripts", "tests"}, path


@pytest.mark.parametrize(
    ("library", "only"),
    [
        ("kornia.geometry.camera", "geometry.camera"),
        ("kornia.geometry.calibration", "geometry.camera"),
        ("pytorch_kinematics", "geometry.rig"),
        ("pyproj", "geometry.geodesy"),
    ],
)
def test_a_library_is_imported_in_one_place(library: str, only: str) -> None:
    places = {
        name_of(path)
        for path in MODULES
        if any(full == library or full.startswith(f"{library}.") for full in imports(path))
    }
    assert places <= {only}


def test_the_library_does_not_print() -> None:
    # Benchmarks and studies print tables: they are the inside of a script.
    for path in (p for p in MODULES if unit(name_of(p)) not in ("benchmark", "studies")):
        calls = (n.func for n in ast.walk(tree(path)) if isinstance(n, ast.Call))
        prints = [f.lineno for f in calls if isinstance(f, ast.Name) and f.id == "print"]
        assert not prints, f"{path}: print in lines {prints}; return numbers, report/ shows them"


def test_no_module_is_a_drawer_for_the_rest() -> None:
    drawers = {"utils", "util", "common", "helpers", "helper", "misc"}
    assert not {name for name in NAMES if drawers & set(name.split("."))}


def test_no_exception_is_caught_whatever_it_is() -> None:
    for path in MODULES:
        for node in ast.walk(tree(path)):
            if isinstance(node, ast.ExceptHandler):
                caught = ast.unparse(node.type) if node.type else "everything"
                assert caught not in ("everything", "Exception", "BaseException"), (
                    f"{path}:{node.lineno} catches {caught}; name what can go wrong"
                )
