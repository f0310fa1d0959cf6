"""Control points: found among the map's signs, and pinning the map."""

from __future__ import annotations

from dataclasses import replace

import torch

from crowdmap_torch.adjustment import adjust
from crowdmap_torch.config import MapperConfig
from crowdmap_torch.mapper import MapResult, build_bundle, finish_map
from crowdmap_torch.survey.control import ControlConfig, find_control_signs
from crowdmap_torch.tables import Dataset, Signs, Survey


def shifted(survey: Survey, shift: list[float]) -> Survey:
    """The survey moved as a whole, corners and centres."""
    by = torch.tensor(shift, dtype=torch.float64)
    signs = replace(
        survey.signs,
        corners_world=survey.signs.corners_world + by,
        center_world=survey.signs.center_world + by,
    )
    return replace(survey, signs=signs)


def pinned(tiny: Dataset, result: MapResult, survey: Survey) -> MapResult:
    config = MapperConfig()
    maps, first = result.journey_maps, result.first
    bundle = build_bundle(tiny.journeys, maps, first, config, control=survey.signs)
    state = adjust.adjust(bundle)
    return finish_map(tiny, maps, first, bundle, state, config)


def errors(signs: Signs, survey: Survey) -> torch.Tensor:
    """Distance of every map sign from the surveyed sign that is nearest."""
    return torch.cdist(signs.center_world, survey.signs.center_world).min(dim=1).values


def test_control_points_are_found_whatever_shift_all_share(
    tiny_result: MapResult, tiny_survey: Survey
):
    signs = tiny_result.first.signs
    here = find_control_signs(signs, tiny_survey.signs, ControlConfig())
    there = find_control_signs(signs, shifted(tiny_survey, [0.4, -0.3, 0.2]).signs, ControlConfig())
    assert len(here) >= 3
    assert torch.equal(here.sign, there.sign)


def test_a_control_point_that_contradicts_the_others_is_none(
    tiny_result: MapResult, tiny_survey: Survey
):
    signs = tiny_result.first.signs
    all_of_them = find_control_signs(signs, tiny_survey.signs, ControlConfig())
    moved = tiny_survey.signs.center_world.clone()
    nearest = torch.cdist(all_of_them.center_world[:1], moved).argmin()
    moved[nearest, 2] += 2.0
    rest = find_control_signs(
        signs, replace(tiny_survey.signs, center_world=moved), ControlConfig()
    )
    assert len(rest) == len(all_of_them) - 1


def test_control_points_pull_the_whole_map(
    tiny: Dataset, tiny_result: MapResult, tiny_survey: Survey
):
    one = find_control_signs(tiny_result.first.signs, tiny_survey.signs, ControlConfig())
    # All but one sign are given; how the one that is left follows is the test.
    left = torch.cdist(one.center_world[-1:], tiny_survey.signs.center_world).argmin()
    given = torch.arange(len(tiny_survey.signs)) != left
    control = replace(tiny_survey, signs=tiny_survey.signs[given])
    result = pinned(tiny, tiny_result, control)
    assert result.control_points == len(one) - 1
    row = one.sign[-1]
    before = errors(tiny_result.hd_map.signs, tiny_survey)[row]
    after = errors(result.hd_map.signs, tiny_survey)[row]
    # Three journeys' mean error is about 0.25 m; what is left with control is the sign's own.
    assert after < before / 2 or after < 0.08
    known = errors(result.hd_map.signs, tiny_survey)[one.sign[:-1]]
    assert float(known.max()) < 0.06
    # The map knows that it is pinned.
    assert float(result.hd_map.shared_covariance.trace()) < 0.25 * float(
        tiny_result.hd_map.shared_covariance.trace()
    )
