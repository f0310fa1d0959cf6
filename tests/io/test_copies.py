"""Which journeys are one drive uploaded again, and which are not."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from worlds.drives import shuffled, turn_about_up, with_frames, without_detections

from crowdmap_torch.io.copies import Overlap, copies, overlaps
from crowdmap_torch.io.datasets import load_dataset
from crowdmap_torch.io.errors import InputError
from crowdmap_torch.tables import Dataset, Journey


def with_pixels(journey: Journey, change) -> Journey:
    return replace(
        journey,
        signs=replace(journey.signs, corners_px=change(journey.signs.corners_px)),
        lane_points=replace(journey.lane_points, px=change(journey.lane_points.px)),
    )


CHANGES = {
    "nothing": lambda journey, generator: journey,
    "times": lambda journey, generator: replace(journey, t_ns=journey.t_ns + 86_400 * 10**9),
    "frame numbers": lambda journey, generator: replace(
        journey, frame_number=journey.frame_number + 7000
    ),
    "poses": lambda journey, generator: replace(
        journey, T_world_camera=turn_about_up(0.01, (1.0, -2.0, 0.5)) @ journey.T_world_camera
    ),
    "single precision": lambda journey, generator: with_pixels(
        journey, lambda px: px.float().double()
    ),
    "a decimal": lambda journey, generator: with_pixels(journey, lambda px: px.round(decimals=1)),
    "the order of rows": shuffled,
}


@pytest.mark.parametrize("change", CHANGES)
def test_a_drive_with_something_changed_is_still_a_copy(
    tiny: Dataset, generator: torch.Generator, change: str
) -> None:
    first, second, third = tiny.journeys
    again = CHANGES[change](second, generator)
    (found,) = copies((first, second, again, third))
    # Rounded coordinates may make two boxes one: then the copy is the one with fewer.
    assert {found.journey, found.other} == {1, 2} and found.share > 0.99


def test_drives_over_the_same_road_have_nothing_in_common(tiny: Dataset) -> None:
    assert overlaps(tiny.journeys) == ()


def test_a_drive_back_over_the_same_road_is_no_copy(tiny: Dataset) -> None:
    drive = tiny.journeys[0]
    middle = drive.rig.camera.width - 1
    # What a camera sees that drives the other way: here at least mirrored.
    back = with_pixels(drive, lambda px: torch.stack((middle - px[..., 0], px[..., 1]), dim=-1))
    assert overlaps((drive, back)) == ()


def test_a_piece_that_was_cut_out_is_a_copy_of_the_whole(tiny: Dataset) -> None:
    drive = tiny.journeys[0]
    piece = with_frames(drive, torch.arange(drive.frame_count // 3, drive.frame_count // 2))
    assert copies((piece, *tiny.journeys)) == (Overlap(0, 1, 1.0),)


def test_pieces_that_overlap_a_little_both_stay_and_are_told(tiny: Dataset) -> None:
    drive = tiny.journeys[0]
    n = drive.frame_count
    halves = [with_frames(drive, torch.arange(a, b)) for a, b in ((0, 5 * n // 8), (n // 2, n))]
    (found,) = overlaps(halves)
    assert 0.1 < found.share < 0.5
    assert copies(halves) == ()


def test_of_many_copies_one_stays(tiny: Dataset) -> None:
    first, second, third = tiny.journeys
    found = copies((second, first, third, second, second))
    assert [(copy.journey, copy.other) for copy in found] == [(3, 0), (4, 0)]


def test_journeys_without_detections_are_no_copies(tiny: Dataset) -> None:
    journey = tiny.journeys[0]
    empty = without_detections(journey, torch.arange(journey.frame_count))
    assert overlaps((empty, empty)) == ()
    assert overlaps((empty, journey)) == ()


@pytest.fixture
def twice(tiny_folder: Path, tmp_path: Path) -> Path:
    """The dataset with its first journey once more under another name."""
    folder = Path(shutil.copytree(tiny_folder, tmp_path / "dataset"))
    again = Path(shutil.copytree(folder / "journeys" / "journey-000", folder / "journeys" / "b"))
    head = json.loads((again / "journey.json").read_text())
    (again / "journey.json").write_text(json.dumps(head | {"journey_id": "b"}))
    return folder


def test_a_copy_is_set_aside_at_the_door_with_the_journey_that_it_repeats(
    twice: Path, tiny: Dataset
) -> None:
    dataset = load_dataset(twice)
    # `b` comes first by its name, so it is the drive and the other its copy.
    names = [journey.journey_id for journey in dataset.journeys]
    assert names == ["b", *(j.journey_id for j in tiny.journeys[1:])]
    (rejected,) = dataset.rejected
    assert rejected.journey_id == "journey-000"
    assert rejected.reason.startswith("copy of journey 'b': 100% of its detections")


def test_a_copy_is_an_error_where_nothing_may_be_set_aside(twice: Path) -> None:
    with pytest.raises(InputError, match="journey 'journey-000': copy of journey 'b'"):
        load_dataset(twice, strict=True)
