from __future__ import annotations

import pytest
import torch

from crowdmap_torch.evaluation.lanes import LaneEvaluationConfig, evaluate_lanes, survey_samples

ROUNDING_M = 1e-9


def arc(radius: float, *, points: int = 21, lift: float = 0.0) -> torch.Tensor:
    angle = torch.linspace(0, 1.2, points, dtype=torch.float64)
    return torch.stack((radius * angle.cos(), radius * angle.sin(), 0 * angle + lift), dim=-1)


def test_a_map_that_is_the_survey_has_no_error(build):
    lines = [build.straight(y) for y in (0.0, 3.5, 7.0)]
    figures = evaluate_lanes(build.lanes(lines), build.survey(build.signs([]), lines))
    assert figures.recall == figures.precision == 1
    assert figures.duplicates == 0
    assert figures.true_length_m == pytest.approx(300)
    assert figures.map_length_m == pytest.approx(300)
    assert figures.lateral.p95 < ROUNDING_M
    assert figures.width.p95 < ROUNDING_M
    # The marker on the left end has no neighbour further left.
    assert figures.width.count == pytest.approx(2 * 100 / 2.5, abs=2)


def test_lateral_and_vertical_errors_on_a_curve(build):
    mapped = arc(80.3, lift=-0.7)
    survey = build.survey(build.signs([]), [arc(80.0, points=4001)])
    figures = evaluate_lanes(build.lanes([mapped]), survey)
    assert figures.recall == 1
    # A natural spline straightens out at its ends: 2 cm off the circle there, 1 mm in the mean.
    assert figures.lateral.mean == pytest.approx(0.3, abs=2e-3)
    assert figures.vertical.mean == pytest.approx(0.7, abs=2e-3)


@pytest.mark.parametrize(("aside", "lift", "found"), [(0.49, 0, 1), (0.51, 0, 0), (0, 2.1, 0)])
def test_gates_are_half_a_metre_aside_and_two_metres_up(build, aside, lift, found):
    survey = build.survey(build.signs([]), [build.straight(0.0)])
    figures = evaluate_lanes(build.lanes([build.straight(aside, z=lift)]), survey)
    assert figures.recall == figures.precision == found


def test_recall_is_over_the_length_seen_by_three_journeys(build):
    survey = build.survey(build.signs([]), [build.straight(0.0)])
    x = survey_samples(survey, 0.5).point_world[:, 0]
    seen_by = torch.where(x <= 50, 3, 2)
    figures = evaluate_lanes(build.lanes([build.straight(0, end=25.0)]), survey, seen_by=seen_by)
    # Half a step at the end of what was found.
    assert figures.seen_length_m == pytest.approx(50, abs=0.5)
    assert figures.recall == pytest.approx(0.5, abs=0.01)
    assert figures.precision == 1


def test_precision_is_over_the_map_s_length(build):
    survey = build.survey(build.signs([]), [build.straight(0.0)])
    lanes = build.lanes([build.straight(0.1), build.straight(9.0, end=50)])
    figures = evaluate_lanes(lanes, survey)
    assert figures.precision == pytest.approx(2 / 3, abs=0.01)


def test_duplicates_are_points_under_two_lines(build):
    survey = build.survey(build.signs([]), [build.straight(0.0)])
    lanes = build.lanes([build.straight(0.1), build.straight(-0.2, end=20)])
    figures = evaluate_lanes(lanes, survey)
    assert figures.duplicates == pytest.approx(0.2, abs=0.01)
    assert figures.lateral.mean == pytest.approx(0.1, abs=ROUNDING_M)


def test_pieces_that_meet_leave_no_gap_and_are_no_duplicates(build):
    survey = build.survey(build.signs([]), [build.straight(0.0)])
    pieces = build.lanes([build.straight(0, end=33.3), build.straight(0, start=33.3)])
    figures = evaluate_lanes(pieces, survey)
    assert figures.recall == 1
    assert figures.duplicates == 0


def test_the_shift_of_the_signs_is_taken_off(build):
    survey = build.survey(build.signs([]), [build.straight(0.0)])
    shift = torch.tensor([0.2, 0.3, -0.4], dtype=torch.float64)
    figures = evaluate_lanes(build.lanes([build.straight(0.35, z=-0.5)]), survey, shift=shift)
    assert figures.lateral.mean == pytest.approx(0.35)
    assert figures.lateral_without_shift.mean == pytest.approx(0.05)
    assert figures.vertical_without_shift.mean == pytest.approx(0.1)


def test_lane_width_is_to_the_neighbour_on_the_left(build):
    survey = build.survey(build.signs([]), [build.straight(0.0), build.straight(3.5)])
    figures = evaluate_lanes(build.lanes([build.straight(0.1), build.straight(3.3)]), survey)
    assert figures.width.mean == pytest.approx(0.3)


def test_coverage_takes_the_shared_part_out(build):
    survey = build.survey(build.signs([]), [build.straight(0.0)])
    lanes = build.lanes([build.straight(0.15)], sigma=0.1)
    shared = torch.diag(torch.tensor([0.0, 0.08**2, 0.0], dtype=torch.float64))
    assert evaluate_lanes(lanes, survey).sigma_coverage == 1
    # What is left of 0.10 m is 0.06 m: 0.15 m is 2.5 sigma.
    assert evaluate_lanes(lanes, survey, shared_covariance=shared).sigma_coverage == 0


def test_a_bridge_over_a_road_is_another_marker(build):
    survey = build.survey(build.signs([]), [build.straight(0.0), build.straight(0.0, z=6.0)])
    figures = evaluate_lanes(build.lanes([build.straight(0.1, z=6.0)]), survey)
    assert figures.recall == pytest.approx(0.5)
    assert figures.duplicates == 0


def test_an_empty_map_finds_nothing(build):
    survey = build.survey(build.signs([]), [build.straight(0.0)])
    figures = evaluate_lanes(build.lanes([]), survey, config=LaneEvaluationConfig())
    assert figures.recall == 0
    assert figures.map_length_m == 0
    assert figures.lateral.count == 0
