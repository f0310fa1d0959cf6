"""Drives that do not fit the crowd are named with their reason, others are not."""

from __future__ import annotations

import math
from dataclasses import fields, replace

import pytest
import torch
from torch import Tensor
from worlds.crowd_world import signs_at

from crowdmap_torch.crowd_signs.outlier_journeys import (
    JourneyStatistics,
    OutlierJourneyConfig,
    find_outlier_journeys,
    journey_statistics,
)
from crowdmap_torch.geometry import se3

CONFIG = OutlierJourneyConfig()
JOURNEYS = 6


def calm() -> JourneyStatistics:
    """Six journeys that fit each other, none of them exactly."""
    small = 0.01 * torch.arange(JOURNEYS).double()
    return JourneyStatistics(
        signs=torch.full((JOURNEYS,), 20),
        checked=torch.full((JOURNEYS,), 15),
        matched=0.9 + small,
        bias=0.5 + small,
        scatter=0.1 + small,
        turn=0.1 * small,
        roll=0.1 * small,
        stretch=0.1 * small,
        drift=0.2 + small,
        leap=0 * small,
        turn_error=0 * small,
        roll_error=0 * small,
        stretch_error=0 * small,
    )


def with_journey(column: str, journey: int, value: float) -> JourneyStatistics:
    figures = getattr(calm(), column).clone()
    figures[journey] = value
    return replace(calm(), **{column: figures})


def test_journeys_that_fit_are_not_named():
    assert find_outlier_journeys(calm(), CONFIG) == ()


@pytest.mark.parametrize(
    ("column", "value", "reason"),
    [
        ("matched", 0.2, "only 20% of its signs were seen by others too"),
        ("bias", 9.0, "its position is off by 9.0 m"),
        ("scatter", 1.5, "its signs miss the others' by 1.50 m"),
        ("turn", math.radians(-5), "its signs are turned by -5.0 degrees"),
        ("roll", math.radians(4), "its signs are rolled by 4.0 degrees"),
        ("stretch", math.log(1.2), "its signs are 1.20 times the size"),
        ("drift", 3.0, "its position drifts by 3.0 m along the way"),
        ("leap", 7.0, "its position leaps by 7.0 m"),
    ],
)
def test_each_figure_names_the_journey_that_it_does_not_fit(column: str, value: float, reason: str):
    (found,) = find_outlier_journeys(with_journey(column, 3, value), CONFIG)
    assert found.journey == 3 and reason in found.reason


def test_a_journey_is_named_once_with_all_its_reasons():
    drift = with_journey("drift", 4, 3.0).drift
    (found,) = find_outlier_journeys(replace(with_journey("bias", 4, 9.0), drift=drift), CONFIG)
    assert found.journey == 4 and len(found.reason.split("; ")) == 2


def test_a_crowd_that_agrees_closely_makes_no_outlier_of_a_little_more():
    # Far beyond six robust standard deviations, yet below what is ever suspicious.
    assert find_outlier_journeys(with_journey("bias", 3, 3.9), CONFIG) == ()


def test_journeys_with_few_signs_are_not_judged_by_them():
    few = replace(with_journey("bias", 3, 9.0), signs=torch.tensor([20, 20, 20, 3, 20, 20]))
    assert find_outlier_journeys(few, CONFIG) == ()


@pytest.mark.parametrize("journeys", [0, 1, 2])
def test_of_few_journeys_only_a_leap_tells(journeys: int):
    both = replace(with_journey("bias", 0, 9.0), leap=with_journey("leap", 0, 7.0).leap)
    few = JourneyStatistics(*(getattr(both, f.name)[:journeys] for f in fields(both)))
    found = find_outlier_journeys(few, CONFIG)
    assert [f.reason for f in found] == [
        "its position leaps by 7.0 m between two frames" for _ in range(min(journeys, 1))
    ]


def test_naming_does_not_depend_on_the_order_of_journeys():
    order = torch.tensor([5, 3, 0, 1, 4, 2])
    figures = with_journey("scatter", 3, 1.5)
    turned = JourneyStatistics(*(getattr(figures, f.name)[order] for f in fields(figures)))
    (found,) = find_outlier_journeys(turned, CONFIG)
    assert int(order[found.journey]) == 3


PLACES = [(0.0, 0.0, 3.0), (50.0, 0.0, 3.0), (80.0, 0.0, 3.0)]


def statistics_of(
    company: Tensor | None = None, label: tuple[int, ...] = (0, 1, 2, 0, 1, 2), **changes: Tensor
) -> JourneyStatistics:
    """Of two journeys with three signs each, on the heads; those of journey 1 changed."""
    signs = signs_at(PLACES * 2, [0, 0, 0, 1, 1, 1])
    return journey_statistics(
        replace(signs, **changes),
        torch.tensor(label),
        signs_at([*PLACES, PLACES[-1]], [-1] * 4),
        torch.ones(6, dtype=torch.bool) if company is None else company,
        torch.tensor([[0.0, 0.0, 0.0], [3.0, 4.0, 0.0]]).double(),
        torch.zeros(2).double(),
        torch.zeros(2).double(),
    )


def test_signs_on_their_heads_have_figures_of_zero():
    found = statistics_of()
    assert found.signs.tolist() == [3, 3] and found.matched.tolist() == [1, 1]
    for column in ("scatter", "turn", "roll", "stretch"):
        assert getattr(found, column).tolist() == [0, 0], column
    # Of two, the median is the first.
    assert found.bias.tolist() == [0, 5]


@pytest.mark.parametrize(("axis", "column"), [((0.0, 1.0, 0.0), "turn"), ((0.0, 0.0, 1.0), "roll")])
def test_turns_of_signs_are_told_apart(axis: tuple[float, float, float], column: str):
    angle = math.radians(3)
    T = signs_at(PLACES * 2, [0, 0, 0, 1, 1, 1]).T_world_sign.clone()
    T[3:, :3, :3] = T[3:, :3, :3] @ se3.so3_exp(angle * torch.tensor(axis).double())
    found = statistics_of(T_world_sign=T)
    assert getattr(found, column).tolist() == pytest.approx([0, angle], abs=1e-9)
    other = {"turn": "roll", "roll": "turn"}[column]
    assert getattr(found, other).tolist() == pytest.approx([0, 0], abs=1e-9)


NOBODY = torch.zeros(6, dtype=torch.bool)


def test_what_nobody_else_passed_by_does_not_count_as_unmatched():
    found = statistics_of(NOBODY, label=(-1, -1, -1, 0, 1, -1))
    assert found.checked.tolist() == [0, 0] and found.matched.isnan().all()
    found = statistics_of(torch.arange(6) == 2, label=(-1, -1, -1, 0, 1, -1))
    assert found.checked.tolist() == [1, 0] and found.matched[0] == 0


def test_who_saw_a_sign_too_has_passed_by_it():
    # Where one other drive came by nobody misses it, but where that one saw the sign it fits.
    found = statistics_of(NOBODY, label=(0, 1, -1, 0, 1, -1))
    assert found.checked.tolist() == [2, 2] and found.matched.tolist() == [1, 1]
    found = statistics_of(torch.arange(6) == 5, label=(0, 1, -1, 0, 1, -1))
    assert found.checked.tolist() == [2, 3]
    assert found.matched.tolist() == pytest.approx([1, 2 / 3])


def test_nobody_is_judged_by_few_signs_where_others_passed_by():
    # As a drive through a city that meets others at crossings alone.
    unseen = with_journey("matched", 4, 0.0)
    assert [found.journey for found in find_outlier_journeys(unseen, CONFIG)] == [4]
    checked = unseen.checked.clone()
    checked[4] = CONFIG.min_signs - 1
    assert find_outlier_journeys(replace(unseen, checked=checked), CONFIG) == ()


def test_what_few_signs_say_that_others_saw_too_is_not_judged():
    # The third sign of each is its own head.
    found = statistics_of(label=(0, 1, 2, 0, 1, 3))
    for column in ("scatter", "turn", "roll", "stretch"):
        assert getattr(found, column).isnan().all(), column


def test_of_two_figures_none_is_an_outlier():
    roll = torch.full((JOURNEYS,), torch.nan).double()
    roll[:2] = torch.tensor([0.0, math.radians(9)])
    assert find_outlier_journeys(replace(calm(), roll=roll), CONFIG) == ()
    roll[2] = 0.0
    (found,) = find_outlier_journeys(replace(calm(), roll=roll), CONFIG)
    assert found.journey == 1


@pytest.mark.parametrize(("signs", "accused"), [(5, False), (60, True)])
def test_a_figure_of_few_signs_that_scatter_accuses_nobody(signs: int, accused: bool):
    generator = torch.Generator().manual_seed(4)
    n = 4 * signs
    places = [(5.0 * k, 0.0, 3.0) for k in range(signs)]
    rolled = 2.5 * torch.randn(n, generator=generator, dtype=torch.float64)
    # The last of four drives has its camera rolled.
    rolled[3 * signs :] += 4.0 - rolled[3 * signs :].median()
    turn = torch.zeros(n, 3, dtype=torch.float64)
    turn[:, 2] = torch.deg2rad(rolled)
    all_signs = signs_at(places * 4, [j for j in range(4) for _ in range(signs)])
    T = all_signs.T_world_sign.clone()
    T[:, :3, :3] = T[:, :3, :3] @ se3.so3_exp(turn)
    nothing = torch.zeros(4, dtype=torch.float64)
    found = journey_statistics(
        replace(all_signs, T_world_sign=T),
        torch.arange(signs).repeat(4),
        signs_at(places, [-1] * signs),
        torch.ones(n, dtype=torch.bool),
        torch.zeros(4, 3, dtype=torch.float64),
        nothing,
        nothing,
    )
    named = [o.journey for o in find_outlier_journeys(found, CONFIG) if "rolled" in o.reason]
    assert named == ([3] if accused else [])
