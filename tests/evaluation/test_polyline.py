from __future__ import annotations

import torch

from crowdmap_torch.evaluation.polyline import crossings, lane_samples, nearest, sample_polylines

ROUNDING_M = 1e-9


def test_samples_are_equally_spaced_and_include_both_ends(build):
    line = torch.tensor([0, 0, 0, 2, 2])
    point = torch.tensor(
        [[0.0, 0, 0], [3, 0, 0], [3, 1.2, 0], [9, 0, 0], [9, 0, 2]], dtype=torch.float64
    )
    samples = sample_polylines(line, point, 0.5)
    first, second = samples[samples.line == 0], samples[samples.line == 2]
    assert len(first) == 10
    assert len(second) == 5
    assert torch.equal(first.point_world[-1], point[2])
    assert first.point_world[6].tolist() == [3, 0, 0]
    # Straight up has no horizontal direction.
    assert second.along.abs().max() == 0


def test_repeated_points_and_single_points_do_no_harm():
    line = torch.tensor([0, 0, 0, 1])
    point = torch.tensor([[0.0, 0, 0], [0, 0, 0], [1, 0, 0], [5, 5, 5]], dtype=torch.float64)
    samples = sample_polylines(line, point, 0.5)
    assert samples.line.tolist() == [0, 0, 0]
    assert samples.point_world.isfinite().all()


def test_lanes_are_sampled_whatever_the_order_of_their_control_points(build):
    one, other = build.straight(0), build.straight(3.5, points=4)
    lanes = build.lanes([one, other])
    samples = lane_samples(lanes.select(torch.tensor([1, 0])), 0.5)
    assert samples.line.bincount().tolist() == [201, 201]
    assert (samples.point_world[samples.line == 0, 1] - 3.5).abs().max() < ROUNDING_M


def test_a_line_crosses_at_its_distance_to_the_left_and_its_height(build):
    at = lane_samples(build.lanes([build.straight(0.0)]), 1.0)
    beside = build.straight(0.4)
    beside[:, 2] += 0.3
    found = crossings(at, lane_samples(build.lanes([beside]), 1.0), lateral_m=0.5, vertical_m=1.0)
    assert found.point.tolist() == list(range(len(at)))
    # The lines run east: north of them is left.
    assert (found.lateral - 0.4).abs().max() < ROUNDING_M
    assert (found.vertical - 0.3).abs().max() < ROUNDING_M


def test_the_nearest_crossing_is_that_beside_the_offset(build):
    at = lane_samples(build.lanes([build.straight(0.0)]), 5.0)
    lines = lane_samples(build.lanes([build.straight(0.2), build.straight(3.4)]), 5.0)
    found = crossings(at, lines, lateral_m=5.0, vertical_m=1.0)
    assert (nearest(found).lateral - 0.2).abs().max() < ROUNDING_M
    aside = torch.full((len(at),), 3.0, dtype=torch.float64)
    assert (nearest(found, aside).lateral - 3.4).abs().max() < ROUNDING_M
