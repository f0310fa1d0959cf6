from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from crowdmap_torch.plausibility.finding import Finding

Look = Callable[[Path], dict[str, Finding]]


def test_nothing_is_found_in_a_good_data_set(good: Path, look: Look) -> None:
    assert look(good) == {}


def test_what_real_fleets_get_wrong_is_no_mistake(fleet: Path, look: Look) -> None:
    assert look(fleet) == {}


@pytest.mark.parametrize("name", ["kitti-00", "kitti-05", "kitti-06", "kitti-08"])
def test_nothing_is_found_in_real_drives(
    real_data: Callable[[str], Path], look: Look, name: str
) -> None:
    assert look(real_data(f"kitti-signs/{name}")) == {}


def test_what_is_found_is_said_in_one_line_with_cause_and_cure(spoil, look: Look) -> None:
    found = look(spoil("normal-up"))
    assert list(found) == ["road-normal"]
    line = found["road-normal"].line(4)
    assert "\n" not in line
    assert found["road-normal"].cause in line and found["road-normal"].cure in line


def test_a_mistake_of_one_drive_is_named_with_it(good: Path, spoil, look: Look) -> None:
    folder = spoil("w-x-y-z")
    at = Path("journeys") / "journey-000" / "poses.parquet"
    (folder / at).write_bytes((good / at).read_bytes())
    found = look(folder)
    assert found["quaternion-order"].journeys == ("journey-001",)
