"""The house of docs/ARCHITECTURE.md: imports go down only, read from the source; the page shows them as they are."""

from __future__ import annotations

import ast
from graphlib import CycleError, TopologicalSorter

import architecture
import pytest
from architecture import FLOOR, NEIGHBOURS, functions, imports, modules, own_imports, room, tree

PACKAGE = architecture.ROOT / architecture.PACKAGE
SPEAKING = ("benchmark", "commands", "soak", "studies")
"""Rooms that print: benchmarks and studies are the inside of a command."""


def test_every_module_has_a_floor() -> None:
    assert {room(name) for name in modules()} == set(FLOOR)


def test_imports_go_down_only() -> None:
    for name in modules():
        for other in own_imports(name):
            above, below = room(name), room(other)
            if below == above or below in NEIGHBOURS.get(above, ()):
                continue
            assert FLOOR[below] < FLOOR[above], (
                f"{name} (floor {FLOOR[above]}) imports {other} (floor {FLOOR[below]}): imports go down"
            )


def test_neighbours_are_those_that_are_needed() -> None:
    level = {edge for edge in architecture.arrows() if FLOOR[edge[0]] == FLOOR[edge[1]]}
    assert level == {(one, other) for one, others in NEIGHBOURS.items() for other in others}


def test_the_page_shows_the_house_as_it_is() -> None:
    assert architecture.page_drawing() == architecture.drawing(), (
        "docs/ARCHITECTURE.md is out of date: run `python docs/architecture.py --write`"
    )


def test_the_root_of_the_package_is_not_a_room() -> None:
    assert len([*PACKAGE.glob("*.py")]) <= 9


def test_files_are_read_in_one_sitting() -> None:
    lines = {n: len(path.read_text("utf-8").splitlines()) for n, path in modules().items()}
    assert not {name: count for name, count in lines.items() if count > 450}


def test_functions_fit_on_a_page() -> None:
    long = {
        f"{name}.{function}": lines
        for name, path in modules().items()
        for function, lines in functions(path)
        if lines > 80
    }
    assert not long


def test_a_sign_passes_few_modules_from_file_to_map() -> None:
    way = architecture.sign_way()
    assert len(way) <= 15
    # From the detections' file, through one journey, many journeys and the adjustment, to the map's file.
    stations = ("io.detections", "tracking.signs", "signs.triangulate", "crowd_signs.register")
    places = [way.index(name) for name in (*stations, "adjustment.adjust", "io.maps")]
    assert places == sorted(places)


def test_modules_do_not_import_in_circles() -> None:
    graph = {name: own_imports(name) for name in modules()}
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(f"import cycle: {' -> '.join(error.args[1])}")


def test_nothing_imports_scripts_or_tests() -> None:
    for path in modules().values():
        roots = {full.split(".")[0] for full in imports(path)}
        assert not roots & {"scripts", "tests"}, path


@pytest.mark.parametrize(
    ("library", "only"),
    [
        ("kornia.geometry.camera", "geometry.camera"),
        ("kornia.geometry.calibration", "geometry.camera"),
        ("pytorch_kinematics", "geometry.rig"),
        ("cv2", "road.calibration"),
    ],
)
def test_a_library_is_imported_in_one_place(library: str, only: str) -> None:
    places = {
        name
        for name, path in modules().items()
        if any(full == library or full.startswith(f"{library}.") for full in imports(path))
    }
    assert places <= {only}


def test_the_library_does_not_print() -> None:
    for path in (p for name, p in modules().items() if room(name) not in SPEAKING):
        calls = (n.func for n in ast.walk(tree(path)) if isinstance(n, ast.Call))
        prints = [f.lineno for f in calls if isinstance(f, ast.Name) and f.id == "print"]
        assert not prints, f"{path}: print in lines {prints}; return numbers, report/ shows them"


def test_no_module_is_a_drawer_for_the_rest() -> None:
    drawers = {"utils", "util", "common", "helpers", "helper", "misc"}
    assert not {name for name in modules() if drawers & set(name.split("."))}


def test_no_exception_is_caught_whatever_it_is() -> None:
    for path in modules().values():
        for node in ast.walk(tree(path)):
            if isinstance(node, ast.ExceptHandler):
                caught = ast.unparse(node.type) if node.type else "everything"
                assert caught not in ("everything", "Exception", "BaseException"), (
                    f"{path}:{node.lineno} catches {caught}; name what can go wrong"
                )
