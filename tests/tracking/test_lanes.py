from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor
from worlds.drives import lanes_by_detection, shuffled, with_frames
from worlds.partitions import same_partition

from crowdmap_torch.geometry import se3
from crowdmap_torch.io.truth import Truth
from crowdmap_torch.tables import Dataset, Journey
from crowdmap_torch.tracking.lane_features import METHODS, LaneAssociationConfig
from crowdmap_torch.tracking.lanes import LaneAssociator, associate_lanes


@pytest.fixture(scope="module")
def journey(tiny: Dataset) -> Journey:
    return tiny.journeys[0]


def step_through(journey: Journey, associator: LaneAssociator, frames: range) -> Tensor:
    """Labels of the detections of these frames, one frame after another; -2 elsewhere."""
    label = torch.full_like(journey.lanes.frame, -2)
    for frame in frames:
        row = torch.nonzero(journey.lanes.frame == frame)[:, 0]
        detection, point = torch.nonzero(
            journey.lane_points.detection == row[:, None], as_tuple=True
        )
        points = replace(journey.lane_points[point], detection=detection)
        label[row] = associator.step(
            frame, journey.T_world_camera[frame], journey.lanes[row], points, journey.rig
        )
    return label


@pytest.mark.parametrize("method", METHODS)
def test_the_batch_gives_what_one_frame_after_another_gives(journey: Journey, method: str):
    config = LaneAssociationConfig(method=method)
    batch = associate_lanes(journey, config)
    associator = LaneAssociator(config)
    label = step_through(journey, associator, range(journey.frame_count))
    assert torch.equal(label, batch.label)
    assert associator.count == batch.count == int(label.max()) + 1


def test_an_associator_goes_on_from_its_state(journey: Journey):
    config = LaneAssociationConfig()
    whole = step_through(journey, LaneAssociator(config), range(40))
    first, second = LaneAssociator(config), LaneAssociator(config)
    begun = step_through(journey, first, range(20))
    second.load_state_dict(first.state_dict())
    rest = step_through(journey, second, range(20, 40))
    assert torch.equal(torch.maximum(begun, rest), whole)


@pytest.mark.parametrize("method", METHODS)
def test_the_order_of_rows_changes_nothing_but_numbers(journey: Journey, method: str, generator):
    config = LaneAssociationConfig(method=method)
    other = shuffled(journey, generator)
    label = associate_lanes(other, config).label
    back = torch.empty_like(label)
    # `row` is the place in the file, which tells where each detection stood.
    place = torch.full((int(journey.lanes.row.max()) + 1,), -1)
    place[journey.lanes.row] = torch.arange(len(journey.lanes))
    back[place[other.lanes.row]] = label
    assert same_partition(back, associate_lanes(journey, config).label)


def test_how_many_pairs_are_computed_at_once_changes_nothing(journey: Journey):
    config = LaneAssociationConfig()
    few = associate_lanes(journey, replace(config, chunk_pairs=97))
    assert torch.equal(few.label, associate_lanes(journey, config).label)


def test_a_car_that_stands_sees_the_same_markers_all_the_time(journey: Journey, generator):
    frame = int(torch.bincount(journey.lanes.frame).argmax())
    standing = with_frames(journey, torch.full((30,), frame))
    noise = torch.randn(30, 6, generator=generator, dtype=torch.float64)
    # White noise of positions and rotations: 1.5 cm and 0.02 degrees.
    noise = noise * torch.tensor([0.015] * 3 + [3.5e-4] * 3, dtype=torch.float64)
    T = se3.retract(standing.T_world_camera, noise)
    label = associate_lanes(replace(standing, T_world_camera=T), LaneAssociationConfig()).label
    per_frame = label.reshape(30, -1)
    assert (per_frame == per_frame[0]).all()
    assert len(per_frame[0].unique()) == per_frame.shape[1]


def test_tracklets_are_of_one_marker_and_markers_of_few_tracklets(tiny_truth: Truth):
    right = total = pieces = markers = 0
    for truth in tiny_truth.journeys:
        found = associate_lanes(truth.journey, LaneAssociationConfig())
        lane = lanes_by_detection(truth)
        true = lane >= 0
        table = torch.zeros(found.count, int(lane.max()) + 1, dtype=torch.int64)
        table.index_put_((found.label[true], lane[true]), torch.tensor(1), accumulate=True)
        right += int(table.amax(1).sum())
        total += int(true.sum())
        pieces += int((table.sum(1) >= 10).sum())
        markers += len(lane[true].unique())
    # Of the simulator's day preset 1 % of detections begin on one marker and end on another.
    assert right / total > 0.97
    assert pieces <= 2 * markers


@pytest.mark.parametrize("method", METHODS)
def test_a_journey_without_lanes_has_no_tracklets(journey: Journey, method: str):
    none = torch.zeros(0, dtype=torch.int64)
    blind = replace(journey, lanes=journey.lanes[none], lane_points=journey.lane_points[none])
    found = associate_lanes(blind, LaneAssociationConfig(method=method))
    assert found.count == 0 and len(found.label) == 0


def test_markers_out_of_sight_for_longer_than_the_window_begin_anew(journey: Journey):
    frame = int(torch.bincount(journey.lanes.frame).argmax())
    window = LaneAssociationConfig().window_frames
    for gap, again in ((window, True), (window + 1, False)):
        twice = with_frames(journey, torch.full((gap + 1,), frame))
        keep = (twice.lanes.frame == 0) | (twice.lanes.frame == gap)
        row = torch.nonzero(keep)[:, 0]
        detection, point = torch.nonzero(twice.lane_points.detection == row[:, None], as_tuple=True)
        points = replace(twice.lane_points[point], detection=detection)
        label = associate_lanes(
            replace(twice, lanes=twice.lanes[row], lane_points=points), LaneAssociationConfig()
        ).label.reshape(2, -1)
        assert bool((label[0] == label[1]).all()) == again
