from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from worlds.mistakes import MISTAKES

from crowdmap_torch.plausibility.finding import Finding

Look = Callable[[Path], dict[str, Finding]]
NOT_FOUND = {"lever-arm": "what four drives show of it is mostly the drift of their poses"}
"""Mistakes that a look at so few short drives does not name, and why."""


def test_nothing_is_found_in_a_good_data_set(good: Path, look: Look) -> None:
    assert look(good) == {}


def test_what_real_fleets_get_wrong_is_no_mistake(fleet: Path, look: Look) -> None:
    assert look(fleet) == {}


@pytest.mark.parametrize("name", ["kitti-00", "kitti-05", "kitti-06", "kitti-08"])
def test_nothing_is_found_in_real_drives(
    real_data: Callable[[str], Path], look: Look, name: str
) -> None:
    assert look(real_data(f"kitti-signs/{name}")) == {}


@pytest.mark.parametrize("mistake", sorted(MISTAKES.keys() - NOT_FOUND.keys()))
def test_a_mistake_is_named_by_its_cause_and_by_no_other(
    spoil: Callable[[str], Path], look: Look, mistake: str
) -> None:
    found = look(spoil(mistake))
    assert list(found) == [mistake]
    line = found[mistake].line(4)
    assert "\n" not in line
    assert found[mistake].cause in line and found[mistake].cure in line


@pytest.mark.parametrize("mistake", sorted(NOT_FOUND))
def test_a_mistake_that_does_not_show_is_not_taken_for_another(
    spoil: Callable[[str], Path], look: Look, mistake: str
) -> None:
    assert not look(spoil(mistake)).keys() - {mistake}


def test_a_mistake_of_one_drive_is_named_with_it(good: Path, spoil, look: Look) -> None:
    folder = spoil("quaternion-order")
    for name in ("journey-000", "journey-001", "journey-003"):
        at = Path("journeys") / name / "poses.parquet"
        (folder / at).write_bytes((good / at).read_bytes())
    found = look(folder)
    assert found["quaternion-order"].journeys == ("journey-002",)
