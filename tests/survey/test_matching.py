from __future__ import annotations

import math

import pytest
import torch

from crowdmap_torch.survey.matching import DUPLICATE, FALSE, SurveyMatchConfig, match_to_survey


def test_matching_is_repeated_without_the_shift(build):
    post = torch.tensor([[0.0, 0, 2.0], [0.0, 0, 2.7], [40.0, 0, 2.0], [80, 0, 2], [120, 0, 2]])
    signs = build.signs(post)
    shifted = build.moved(signs, (0.0, 0.0, 0.7))
    match = match_to_survey(shifted, build.survey_signs(signs), SurveyMatchConfig())
    # 0.7 m is the distance of the two signs on the post: without the second round the lower one
    # would be taken for the upper.
    assert match.map_row.tolist() == match.true_row.tolist() == [0, 1, 2, 3, 4]


def test_a_false_sign_does_not_make_neighbours_swap(build):
    survey = build.survey_signs(build.signs([[0, 0, 2], [0, 2.8, 2], [50, 0, 2], [90, 0, 2.0]]))
    signs = build.signs([[0, 0, 2], [0, -2.9, 2], [50, 0, 2], [90, 0, 2.0]])
    match = match_to_survey(signs, survey, SurveyMatchConfig())
    assert match.true_of_map.tolist() == [0, DUPLICATE, 2, 3]


def test_shape_and_facing_decide_between_signs_back_to_back(build):
    center = torch.tensor([[0.0, 0, 2], [0.3, 0, 2], [50, 0, 2], [70, 0, 2]])
    heading = torch.tensor([0.0, math.pi, 0, 0], dtype=torch.float64)
    survey = build.survey_signs(build.signs(center, heading=heading))
    swapped = build.signs(center[[1, 0, 2, 3]], heading=heading)
    match = match_to_survey(swapped, survey, SurveyMatchConfig())
    # 0.3 m of distance each, against 1.5 m each for facing away.
    assert match.map_row.tolist() == match.true_row.tolist() == [0, 1, 2, 3]


def test_an_unmatched_sign_near_a_true_one_is_a_duplicate_and_a_far_one_is_false(
    build, row_of_signs
):
    survey = build.survey_signs(build.signs(row_of_signs))
    extra = torch.stack((row_of_signs[0] + 1.0, row_of_signs[0] + torch.tensor([0, 8, 0])))
    signs = build.signs(torch.cat((row_of_signs, extra)))
    match = match_to_survey(signs, survey, SurveyMatchConfig())
    assert match.true_of_map.tolist() == [*range(12), DUPLICATE, FALSE]


@pytest.mark.parametrize("empty", ["map", "survey"])
def test_nothing_is_matched_to_nothing(build, row_of_signs, empty):
    signs = build.signs(row_of_signs)
    survey = build.survey_signs(signs)
    none = torch.zeros(0, dtype=torch.int64)
    match = match_to_survey(
        signs[none] if empty == "map" else signs,
        survey[none] if empty == "survey" else survey,
        SurveyMatchConfig(),
    )
    assert len(match.map_row) == len(match.true_row) == 0
    assert (match.shift == 0).all()
    assert (match.true_of_map == FALSE).all()
