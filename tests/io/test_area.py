"""A data set cut to an area: what is left is what was seen from inside, row for row, and the rest is counted."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from worlds.small_world import Builder

from crowdmap_torch.io.area import MARGIN_M, Area, area_of, cut_dataset, cut_truth, read_area
from crowdmap_torch.io.datasets import row_count
from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.truth import Truth
from crowdmap_torch.tables import Dataset, Journey

AREA = Area(200, -10, 300, 10)


def there_and_back(build: Builder, name: str = "a") -> Journey:
    """A drive along 500 m of road, from 100 m past the area back through it; a sign and a lane in every tenth frame."""
    rows = [(frame, 0) for frame in range(0, 1000, 10)]
    points = [[(5.0, 1.0), (9.0, 1.0)] for _ in rows]
    drive = build.drive(name, frames=1000, sign_rows=rows, lane_rows=rows, lane_points=points)
    there = torch.arange(1000, dtype=torch.float64)
    T = drive.journey.T_world_camera.clone()
    T[:, 0, 3] = torch.minimum(there, 900 - there)
    return replace(drive.journey, T_world_camera=T)


def dataset_of(build: Builder, *journeys: Journey) -> Dataset:
    return Dataset(build.survey(build.signs([[0.0, 0, 2]])).origin, journeys, (), ())


def test_what_is_left_was_seen_from_inside_or_near(build: Builder):
    whole = there_and_back(build)
    cut, left = cut_dataset(dataset_of(build, whole), AREA)
    (journey,) = cut.journeys
    x = journey.T_world_camera[:, 0, 3]
    for frame in (journey.signs.frame, journey.lanes.frame):
        assert ((x[frame] >= 200 - MARGIN_M) & (x[frame] <= 300 + MARGIN_M)).all()
        assert len(frame) == left.sign_detections == 42
    # In the first and last frame the drive is inside; in between it goes 100 m past the area, its poses stay.
    assert x[0] == x[-1] == 150 and x.max() == 450 and journey.frame_count == 601
    assert left.frames == 402 and left.frames_outside == 598
    assert cut.bbox == AREA.sides


def test_rows_that_are_left_are_what_they_were(build: Builder):
    whole = there_and_back(build)
    (journey,) = cut_dataset(dataset_of(build, whole), AREA)[0].journeys
    for now, before in ((journey.signs, whole.signs), (journey.lanes, whole.lanes)):
        assert torch.equal(
            journey.frame_number[now.frame], whole.frame_number[before.frame[now.row]]
        )
    owner = journey.lanes.row[journey.lane_points.detection]
    assert torch.equal(
        owner, torch.arange(len(whole.lanes))[journey.lanes.row].repeat_interleave(2)
    )
    # Those of the file are all accounted for.
    for kind in ("sign", "lane"):
        assert row_count(journey, kind) == row_count(whole, kind) == 100
    assert journey.dropped == {
        "sign: in a frame outside the area": 58,
        "lane: in a frame outside the area": 58,
    }


def test_drives_that_never_come_are_left_out_and_counted(build: Builder):
    away = there_and_back(build, "b")
    away = replace(away, T_world_camera=away.T_world_camera.clone())
    away.T_world_camera[:, 1, 3] += 500
    cut, left = cut_dataset(dataset_of(build, there_and_back(build), away), AREA)
    assert [j.journey_id for j in cut.journeys] == ["a"]
    assert (left.journeys, left.journeys_outside) == (1, 1)
    assert str(left).startswith(
        "area 200,-10,300,10 and 50 m around it: 1 of 2 journeys, 402 of 2,"
    )
    with pytest.raises(InputError, match="no drive comes there; they are in -99,500,450,500"):
        cut_dataset(dataset_of(build, away), AREA)


def test_the_truth_of_what_is_left_is_that_of_the_drive_that_is_left(build: Builder):
    rows = [(frame, 0) for frame in range(0, 400, 10)]
    points = [[(5.0, 1.0), (9.0, 1.0)] for _ in rows]
    drive = build.drive("a", frames=400, sign_rows=rows, lane_rows=rows, lane_points=points)
    whole = dataset_of(build, drive.journey)
    (truth,) = cut_truth(Truth((drive,)), AREA).journeys
    (journey,) = cut_dataset(whole, AREA)[0].journeys
    assert torch.equal(truth.T_world_camera[:, 0, 3], journey.T_world_camera[:, 0, 3])
    assert len(truth.road_normal_camera) == len(truth.camera_height) == journey.frame_count == 201
    # Rows outside show nothing, so that they are neither seen nor lost; of the others the frame is known.
    assert torch.equal(torch.nonzero(truth.sign >= 0)[:, 0], journey.signs.row)
    assert torch.equal(truth.sign_frame[journey.signs.row], journey.signs.frame)
    assert torch.equal(torch.nonzero(truth.lane >= 0)[:, 0], journey.lanes.row)


@pytest.mark.parametrize(
    "text", ["", "1,2,3", "1,2,3,4,5", "a,b,c,d", "0,0,0,10", "0,10,10,0", "0,0,inf,1", "nan,0,1,1"]
)
def test_what_has_no_inside_is_no_area(text: str):
    with pytest.raises(ValueError, match="expected"):
        read_area(text)


def test_an_area_is_read_as_it_is_written():
    area = read_area("-50.5,0,100,1e3")
    assert area.sides == (-50.5, 0, 100, 1000)
    assert read_area(str(area)) == area
    assert area_of({"bbox": [*area.sides]}) == area
    for odd in (
        {},
        {"bbox": None},
        {"bbox": [1, 2, 3]},
        {"bbox": [1, 1, 0, 2]},
        {"bbox": ["a"] * 4},
    ):
        assert area_of(odd) is None
