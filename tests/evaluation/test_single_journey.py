from __future__ import annotations

import pytest
import torch

from crowdmap_torch.evaluation.single_journey import (
    JourneyLandmarks,
    evaluate_single_journeys,
    nearest_seeing_frame,
)


def test_the_pose_error_is_taken_off(build):
    true = build.signs([[40.0, 4, 2], [60, -4, 2], [80, 4, 2]])
    bias = (0.8, -0.6, 1.0)
    drive = build.drive("a", bias=bias, sign_rows=[(f, s) for s in range(3) for f in range(12)])
    lines = [build.straight(2.0)]
    survey = build.survey(true, lines)
    # What a perfect triangulation makes of biased poses, and 5 cm of its own error.
    signs = build.moved(build.moved(true, bias), (0.0, 0.0, 0.05))
    lanes = build.lanes([build.straight(2.0 - 0.6 + 0.04, start=10.8, end=60.8, z=1.0)])
    figures = evaluate_single_journeys([JourneyLandmarks("a", signs, lanes)], [drive], survey)
    assert figures.corner.total.mean == pytest.approx(0.05)
    assert figures.center.total.count == 3
    assert figures.recall == 1
    assert figures.ghosts == figures.duplicates == 0
    assert figures.lane_lateral.mean == pytest.approx(0.04)
    assert figures.lane_vertical.p95 < 1e-9
    assert figures.lane_precision == 1


def test_the_width_between_markers_is_that_of_the_journey_alone(build):
    bias = (0.8, -0.6, 1.0)
    drive = build.drive("a", bias=bias)
    survey = build.survey(build.signs([]), [build.straight(2.0), build.straight(5.5)])
    right = build.straight(2.0 - 0.6 + 0.02, start=10.8, end=60.8, z=1.0)
    left = build.straight(5.5 - 0.6 + 0.05, start=10.8, end=60.8, z=1.0)
    landmarks = JourneyLandmarks("a", build.signs([]), build.lanes([right, left]))
    figures = evaluate_single_journeys([landmarks], [drive], survey)
    assert figures.lane_width.count >= 15
    assert figures.lane_width.mean == pytest.approx(0.03, abs=1e-6)


def test_recall_expects_signs_of_ten_frames_only(build):
    true = build.signs([[40.0, 4, 2], [60, -4, 2], [80, 4, 2]])
    rows = [(f, 0) for f in range(10)] + [(f, 1) for f in range(9)] + [(f, 2) for f in range(20)]
    drive = build.drive("a", sign_rows=rows)
    ghost = build.signs([[30.0, -20, 2]])
    signs = build.signs(torch.cat((true.center_world[:1], ghost.center_world)))
    landmarks = JourneyLandmarks("a", signs, build.lanes([]))
    figures = evaluate_single_journeys([landmarks], [drive], build.survey(true))
    assert figures.recall == 0.5
    assert figures.ghosts == 0.5


def test_nearest_seeing_frame_is_the_nearest_frame_that_has_the_point_in_its_image(build):
    drive = build.drive("a")
    points = torch.tensor([[50.0, 4.0, 1.5], [50.0, 0.0, 0.0], [200.0, 0.0, 1.5]]).double()
    frame = nearest_seeing_frame(drive, points, 120.0)
    # 640 px to the left at f = 1000: 4 m aside is in the image from 6.25 m on; the ground 1.5 m
    # below from 3.75 m on.
    assert frame.tolist() == [43, 46, 99]


def test_without_journeys_there_is_nothing_to_say(build):
    with pytest.raises(ValueError, match="no journey"):
        evaluate_single_journeys([], [], build.survey(build.signs([])))
