from __future__ import annotations

import pytest
import torch

from crowdmap_torch.evaluation.lanes import survey_samples
from crowdmap_torch.evaluation.visibility import (
    frames_of_signs,
    nearest_detections,
    observable_signs,
    oracle_figures,
    seen_by_journeys,
)
from crowdmap_torch.io.truth import Truth


def rows(sign: int, frames: range) -> list[tuple[int, int]]:
    return [(frame, sign) for frame in frames]


def test_observable_needs_five_frames_of_three_journeys(build):
    survey = build.survey_signs(build.signs([[60.0, 4, 2], [90, 4, 2], [95, 4, 2]]))
    many, few = rows(0, range(5)), rows(1, range(4))
    journeys = (
        build.drive("a", sign_rows=many + rows(1, range(9)) + rows(2, range(5))),
        build.drive("b", sign_rows=many + rows(1, range(9)) + rows(2, range(5))),
        build.drive("c", sign_rows=many + few),
    )
    assert observable_signs(Truth(journeys), survey).tolist() == [True, False, False]
    assert not observable_signs(Truth(journeys).select(["a", "b"]), survey).any()


def test_a_sign_detected_twice_in_a_frame_is_seen_in_one_frame(build):
    drive = build.drive("a", sign_rows=[(3, 0), (3, 0), (4, 0), (3, -1)])
    assert frames_of_signs(drive, 2).tolist() == [2, 0]


def test_the_nearest_detection_is_the_nearest_frame_with_a_detection(build):
    survey = build.survey_signs(build.signs([[60.0, 4, 2], [90, 4, 2]]))
    drive = build.drive("a", sign_rows=[(20, 1), (45, 0), (40, 0), (50, -1), (30, 1)])
    sign, frame = nearest_detections(drive, survey)
    assert sign.tolist() == [0, 1]
    assert frame.tolist() == [45, 30]


def test_the_oracle_is_the_length_of_the_mean_pose_error(build):
    survey = build.survey_signs(build.signs([[60.0, 4, 2], [90, 4, 2]]))
    seen = rows(0, range(20, 40))
    truth = Truth(
        (
            build.drive("a", bias=(0.3, 0.0, 0.1), sign_rows=seen),
            build.drive("b", bias=(0.3, 0.8, 0.1), sign_rows=seen),
        )
    )
    corner, centre = oracle_figures(truth, survey, torch.tensor([True, True]))
    # The second sign is seen by nobody: it has no oracle.
    assert corner.total.count == centre.total.count == 1
    assert corner.horizontal.mean == pytest.approx(0.5)
    assert corner.vertical.mean == pytest.approx(0.1)
    assert centre.total.mean == pytest.approx(0.26**0.5)


def test_the_oracle_of_signs_surveyed_by_centre_is_of_centres(build):
    survey = build.centers_only(build.survey_signs(build.signs([[60.0, 4, 2]])))
    truth = Truth((build.drive("a", bias=(0.3, 0, 0), sign_rows=rows(0, range(20, 40))),))
    corner, centre = oracle_figures(truth, survey, torch.tensor([True]))
    assert corner.total.count == 0
    assert centre.total.mean == pytest.approx(0.3)


def test_a_lane_is_seen_from_the_nearest_to_the_farthest_point_of_a_detection(build):
    lines = [build.straight(2.0), build.straight(-2.0)]
    survey = build.survey(build.signs([]), lines)
    samples = survey_samples(survey, 0.5)
    drive = build.drive(
        "a",
        bias=(0.4, 0.4, 0.0),
        # The false detection (-1) and the outlier 5 m beside the marker show nothing.
        lane_rows=[(10, 0), (10, 1), (40, -1), (60, 0)],
        lane_points=[
            [(20, 2), (5, 2), (11, 2)],
            [(6, -2), (12, -2)],
            [(5, 2), (20, 2)],
            [(5, 7), (20, 7)],
        ],
    )
    seen = seen_by_journeys(Truth((drive, drive)), samples)
    assert set(seen.tolist()) == {0, 2}
    left = samples.point_world[(samples.line == 0) & (seen > 0), 0]
    right = samples.point_world[(samples.line == 1) & (seen > 0), 0]
    assert (left.min(), left.max()) == (15, 30)
    assert (right.min(), right.max()) == (16, 22)


def test_a_journey_without_lanes_has_seen_none(build):
    survey = build.survey(build.signs([]), [build.straight(2.0)])
    samples = survey_samples(survey, 0.5)
    assert not seen_by_journeys(Truth((build.drive("a"),)), samples).any()
