"""Each journey's signs against the cluster heads: what must, what may and what must never be one."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor
from worlds.crowd_world import signs_at, turned_round

from crowdmap_torch.crowd_signs.cluster import sign_heads
from crowdmap_torch.crowd_signs.match import (
    HeadMatchConfig,
    join_leftovers,
    match_heads,
    split_by_conflicts,
    without_small,
)
from crowdmap_torch.geometry import polygon
from crowdmap_torch.tables import Signs

CONFIG = HeadMatchConfig()
SIGMA = torch.full((3,), 0.2, dtype=torch.float64)
NONE = torch.zeros(0, 2, dtype=torch.int64)


def match(signs: Signs, heads: Signs, together: Tensor = NONE) -> list[int]:
    return match_heads(signs, heads, together, CONFIG, shift_sigma=SIGMA).label.tolist()


def test_signs_back_to_back_are_never_one():
    heads = signs_at([(0.0, 0.0, 2.0)], [-1])
    other = replace(turned_round(heads), journey=torch.tensor([0]))
    assert match(other, heads) == [-1]
    assert join_leftovers(other, torch.tensor([-1]), heads, NONE, CONFIG).tolist() == [-1]


POST = [(0.0, 0.0, 2.0), (0.0, 0.0, 2.7)]


def test_a_common_shift_does_not_swap_the_signs_of_a_post():
    heads = signs_at(POST, [-1, -1])
    shifted = signs_at([(0.0, 0.0, 2.45), (0.0, 0.0, 3.15)], [0, 0])
    assert match(shifted, heads, torch.tensor([[0, 1]])) == [0, 1]


def test_a_sign_between_two_is_uncertain():
    heads = signs_at(POST, [-1, -1])
    between = signs_at([(0.0, 0.0, 2.33), (0.0, 0.0, 2.0)], [0, 1])
    found = match_heads(between, heads, NONE, CONFIG, shift_sigma=SIGMA)
    assert found.label.tolist() == [0, 0]
    assert found.certainty[0] < 0.2 < 0.8 < found.certainty[1]


def test_signs_seen_in_one_frame_are_never_one():
    heads = signs_at([(0.0, 0.0, 2.0)], [-1])
    twice = signs_at([(0.05, 0.0, 2.0), (0.0, 0.1, 2.0)], [0, 0])
    assert match(twice, heads, torch.tensor([[0, 1]])) == [0, -1]


def test_fragments_of_one_sign_are_one():
    heads = signs_at([(0.0, 0.0, 2.0)], [-1])
    twice = signs_at([(0.05, 0.0, 2.0), (0.0, 0.1, 2.0)], [0, 0])
    assert match(twice, heads) == [0, 0]


def test_of_two_fragments_that_contradict_only_the_better_joins():
    heads = signs_at([(0.0, 0.0, 2.0)], [-1])
    three = signs_at([(0.0, 0.0, 2.0), (0.05, 0.0, 2.0), (0.1, 0.1, 2.0)], [0, 0, 0])
    assert match(three, heads, torch.tensor([[1, 2]])) == [0, 0, -1]


def test_a_wrong_shape_alone_does_not_keep_a_sign_out():
    heads = signs_at([(0.0, 0.0, 2.0)], [-1])
    sign = replace(heads, shape=torch.tensor([polygon.RECTANGLE]), journey=torch.tensor([0]))
    assert match(sign, heads) == [0]


def test_a_cluster_with_conflicts_falls_apart_into_what_one_journey_saw():
    label = torch.tensor([0, 0, 0, 0, 0, 1, 1])
    journey = torch.tensor([0, 0, 1, 2, 2, 0, 1])
    together = torch.tensor([[3, 4], [0, 5]])
    split = split_by_conflicts(journey, label, together)
    assert split.tolist() == [-1, -1, -1, 0, 1, 2, 2] or split[3] != split[4]
    assert split[:3].tolist() == [-1] * 3
    assert split[5] == split[6] >= 0


def test_small_clusters_are_dropped_and_those_without_say_do_not_count():
    journey = torch.tensor([0, 1, 0, 0, 2])
    label = torch.tensor([0, 0, 1, 1, 0])
    assert without_small(journey, label, min_journeys=2).tolist() == [0, 0, -1, -1, 0]
    counts = torch.tensor([True, False, True, True, False])
    assert without_small(journey, label, min_journeys=2, counts=counts).tolist() == [-1] * 5


def test_what_was_left_over_is_brought_back_unless_a_frame_forbids():
    place = [(0.0, 0.0, 2.0)] * 5 + [(0.8, 0.3, 2.1), (0.8, 0.3, 2.1)]
    signs = signs_at(place, [0, 1, 2, 3, 4, 4, 5])
    label = torch.tensor([0] * 5 + [-1, -1])
    heads = sign_heads(signs, label)
    together = torch.tensor([[4, 5]])
    assert join_leftovers(signs, label, heads, together, CONFIG).tolist() == [0] * 5 + [-1, 0]
