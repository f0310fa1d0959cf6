from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from crowdmap_torch.evaluation.signs import SignEvaluationConfig, evaluate_signs
from crowdmap_torch.geometry import se3
from crowdmap_torch.survey.matching import SurveyMatchConfig

ROUNDING_M = 1e-9
"""Coordinates of some hundred metres lose no more than this."""


def test_a_map_that_is_the_survey_has_no_error(build, row_of_signs):
    signs = build.signs(row_of_signs, shape=torch.arange(12) % 6)
    figures = evaluate_signs(signs, build.survey_signs(signs))
    assert figures.recall == figures.precision == figures.shape_accuracy == 1
    assert figures.duplicates == figures.false == 0
    for errors in (figures.absolute.total, figures.relative.total, figures.width, figures.height):
        assert errors.count == 12
        assert errors.p95 < ROUNDING_M
    # acos is flat at 1: rounding of 1e-16 shows as 1e-6 degrees.
    assert figures.normal_deg.p95 < 1e-5


def test_a_common_shift_is_absolute_but_not_relative(build, row_of_signs):
    signs = build.signs(row_of_signs)
    figures = evaluate_signs(build.moved(signs, (0.3, 0.4, -1.2)), build.survey_signs(signs))
    assert figures.absolute.total.mean == pytest.approx(1.3, abs=ROUNDING_M)
    assert figures.absolute.horizontal.mean == pytest.approx(0.5, abs=ROUNDING_M)
    assert figures.absolute.vertical.mean == pytest.approx(1.2, abs=ROUNDING_M)
    assert figures.relative.total.p95 < ROUNDING_M
    assert figures.median_shift == pytest.approx((0.3, 0.4, -1.2), abs=ROUNDING_M)


def test_a_turn_of_the_whole_map_is_not_relative(build, row_of_signs):
    signs = build.signs(row_of_signs)
    turn = se3.exp(torch.tensor([0.1, 0.0, 0.2, 0.0, 0.0, 0.004], dtype=torch.float64))
    turned = replace(signs, T_world_sign=turn @ signs.T_world_sign)
    figures = evaluate_signs(turned, build.survey_signs(signs))
    assert figures.absolute.total.mean > 0.1
    assert figures.relative.total.p95 < ROUNDING_M


def test_relative_error_of_one_displaced_sign_is_what_least_squares_leaves(build):
    center = torch.tensor([[0.0, 0, 2], [50, 0, 2], [100, 0, 2], [50, 50, 2]])
    signs = build.signs(center)
    up = torch.zeros(4, 3, dtype=torch.float64)
    up[3, 2] = 0.4
    figures = evaluate_signs(build.moved(signs, up), build.survey_signs(signs))
    # Height is not turned by a yaw: the mean of 0.1 is taken off everywhere.
    assert figures.relative.total.mean == pytest.approx((3 * 0.1 + 0.3) / 4, abs=ROUNDING_M)


def test_relative_error_needs_three_signs_within_150_m(build):
    signs = build.signs(torch.tensor([[0.0, 0, 2], [100, 0, 2], [249, 0, 2], [260, 0, 2.0]]))
    figures = evaluate_signs(build.moved(signs, (1, 1, 1)), build.survey_signs(signs))
    # The first sign has one neighbour (100 m); the second two (100 and 149), the third two, the
    # last one.
    assert figures.relative.total.count == 2


def test_duplicates_are_near_a_true_sign_and_false_ones_are_not(build, row_of_signs):
    survey = build.survey_signs(build.signs(row_of_signs))
    extra = torch.stack((row_of_signs[0] + 1.0, row_of_signs[0] + torch.tensor([0, 8, 0])))
    signs = build.signs(torch.cat((row_of_signs, extra)))
    figures = evaluate_signs(signs, survey)
    assert (figures.duplicates, figures.false) == (1, 1)
    assert figures.precision == pytest.approx(12 / 14)


def test_the_gate_is_on_the_distance(build, row_of_signs):
    survey = build.survey_signs(build.signs(row_of_signs))
    shift = torch.zeros(12, 3, dtype=torch.float64)
    shift[4, 1] = 2.5
    signs = build.moved(build.signs(row_of_signs), shift)
    assert evaluate_signs(signs, survey).matched == 12
    near = SignEvaluationConfig(match=SurveyMatchConfig(gate_m=2.0))
    assert evaluate_signs(signs, survey, config=near).matched == 11


def test_signs_that_are_not_observable_count_neither_way(build, row_of_signs):
    survey = build.survey_signs(build.signs(row_of_signs))
    observable = torch.arange(12) < 6
    signs = build.signs(row_of_signs[:9])
    shift = torch.zeros(9, 3, dtype=torch.float64)
    shift[6:] = 1.0
    figures = evaluate_signs(build.moved(signs, shift), survey, observable=observable)
    assert figures.recall == figures.precision == 1
    assert figures.absolute.total.count == 6
    assert figures.absolute.total.p95 < ROUNDING_M


def test_control_signs_are_left_out(build, row_of_signs):
    signs = build.signs(row_of_signs)
    survey = build.survey_signs(signs)
    control = torch.arange(12) >= 10
    shift = torch.zeros(12, 3, dtype=torch.float64)
    shift[:10, 0] = 0.1
    figures = evaluate_signs(build.moved(signs, shift), survey, control=control)
    assert (figures.map_signs, figures.true_signs, figures.matched) == (10, 10, 10)
    assert figures.absolute.total.median == pytest.approx(0.1, abs=ROUNDING_M)


def test_corners_are_compared_in_the_best_cyclic_order(build, row_of_signs):
    signs = build.signs(row_of_signs, shape=torch.arange(12) % 6)
    survey = build.survey_signs(signs)
    rolled = survey.corners_world.clone()
    for row, count in enumerate((3, 3, 4, 4, 5, 8) * 2):
        rolled[row, :count] = survey.corners_world[row, :count].roll(1, dims=0)
        rolled[row, count:] = rolled[row, count - 1]
    figures = evaluate_signs(signs, replace(survey, corners_world=rolled))
    assert figures.absolute.total.p95 < ROUNDING_M
    assert figures.width.p95 < ROUNDING_M


def test_size_errors_are_along_the_sign_s_own_axes(build, row_of_signs):
    shape = torch.arange(12) % 6
    survey = build.survey_signs(build.signs(row_of_signs, shape=shape, size=(0.6, 0.9)))
    figures = evaluate_signs(build.signs(row_of_signs, shape=shape, size=(0.65, 0.8)), survey)
    assert figures.width.mean == pytest.approx(0.05, abs=ROUNDING_M)
    assert figures.height.mean == pytest.approx(0.10, abs=ROUNDING_M)


def test_different_numbers_of_corners_have_no_corner_error(build, row_of_signs):
    survey = build.survey_signs(build.signs(row_of_signs, shape=2))
    shape = torch.full((12,), 2)
    shape[0] = 0
    figures = evaluate_signs(build.signs(row_of_signs, shape=shape), survey)
    assert figures.matched == figures.absolute_center.total.count == 12
    assert figures.absolute.total.count == 11
    assert figures.shape_accuracy == pytest.approx(11 / 12)


def test_signs_surveyed_by_centre_count_in_all_but_corner_figures(build, row_of_signs):
    signs = build.signs(row_of_signs)
    survey = build.centers_only(build.survey_signs(signs))
    figures = evaluate_signs(build.moved(signs, (0.2, 0, 0)), survey)
    assert figures.recall == 1
    assert figures.absolute.total.count == figures.width.count == figures.normal_deg.count == 0
    assert math.isnan(figures.absolute.total.mean)
    assert figures.absolute_center.total.mean == pytest.approx(0.2, abs=ROUNDING_M)
    assert figures.relative_center.total.p95 < ROUNDING_M


@pytest.mark.parametrize("empty", ["map", "survey", "both"])
def test_empty_tables_have_figures(build, row_of_signs, empty):
    signs = build.signs(row_of_signs)
    nothing = signs[torch.zeros(0, dtype=torch.int64)]
    figures = evaluate_signs(
        signs if empty == "survey" else nothing,
        build.survey_signs(signs if empty == "map" else nothing),
    )
    assert figures.matched == 0
    assert figures.false == (12 if empty == "survey" else 0)
    assert figures.absolute.total.count == 0


def test_figures_do_not_depend_on_row_order(build, row_of_signs):
    generator = torch.Generator().manual_seed(1)
    signs = build.signs(row_of_signs, shape=torch.arange(12) % 6)
    noisy = build.moved(signs, 0.2 * torch.randn(12, 3, generator=generator, dtype=torch.float64))
    survey = build.survey_signs(signs)
    order = torch.randperm(12, generator=generator)
    one = evaluate_signs(noisy, survey)
    other = evaluate_signs(noisy[order], survey[order.flip(0)])
    assert one.relative.total.mean == pytest.approx(other.relative.total.mean, abs=ROUNDING_M)
    assert one.absolute.total.p95 == pytest.approx(other.absolute.total.p95, abs=ROUNDING_M)


def test_signs_on_one_post_are_told_apart_if_both_are_matched(build):
    post = torch.tensor([[0.0, 0, 2.0], [0, 0, 2.7], [40, 0, 2.0], [40, 0, 2.7], [90, 0, 2]])
    survey = build.survey_signs(build.signs(post))
    figures = evaluate_signs(build.signs(post[[0, 1, 2, 4]]), survey)
    assert figures.close_pairs == 2
    assert figures.close_pairs_told_apart == 0.5
