"""Each journey's signs against the cluster heads: what must, what may and what must never be one."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from crowdmap_torch.geometry import polygon, se3
from crowdmap_torch.stages.cluster import sign_heads
from crowdmap_torch.stages.match import (
    SignMatchConfig,
    harvest_signs,
    match_signs,
    merge_heads,
    split_by_conflicts,
    without_small,
)
from crowdmap_torch.tables import Signs

CONFIG = SignMatchConfig()
SIGMA = torch.full((3,), 0.2, dtype=torch.float64)
NONE = torch.zeros(0, 2, dtype=torch.int64)


def signs_at(place: list[tuple[float, float, float]], journey: list[int]) -> Signs:
    """Equal octagons that face west."""
    n = len(place)
    one = torch.ones(n, dtype=torch.int64)
    R = torch.tensor([[0.0, 0, -1], [-1, 0, 0], [0, 1, 0]]).double()
    return Signs(
        shape=one * polygon.OCTAGON,
        type=-one,
        T_world_sign=se3.make(R.expand(n, 3, 3), torch.tensor(place, dtype=torch.float64)),
        size=torch.full((n, 2), 0.6, dtype=torch.float64),
        covariance=0.01 * torch.eye(3).double().expand(n, 3, 3),
        journey=torch.tensor(journey),
        tracklet=torch.arange(n),
        frame=0 * one,
        n_journeys=one,
        n_observations=10 * one,
        first_seen_ns=0 * one,
        last_seen_ns=0 * one,
        confidence=one.double(),
    )


def turned_round(signs: Signs) -> Signs:
    half = torch.diag(torch.tensor([-1.0, 1, -1, 1])).double()
    return replace(signs, T_world_sign=signs.T_world_sign @ half)


def match(signs: Signs, heads: Signs, together: Tensor = NONE) -> list[int]:
    return match_signs(signs, heads, together, CONFIG, shift_sigma=SIGMA).label.tolist()


POST = [(0.0, 0.0, 2.0), (0.0, 0.0, 2.7)]


def test_a_common_shift_does_not_swap_the_signs_of_a_post():
    heads = signs_at(POST, [-1, -1])
    shifted = signs_at([(0.0, 0.0, 2.45), (0.0, 0.0, 3.15)], [0, 0])
    assert match(shifted, heads, torch.tensor([[0, 1]])) == [0, 1]


def test_a_sign_between_two_is_uncertain():
    heads = signs_at(POST, [-1, -1])
    between = signs_at([(0.0, 0.0, 2.33), (0.0, 0.0, 2.0)], [0, 1])
    found = match_signs(between, heads, NONE, CONFIG, shift_sigma=SIGMA)
    assert found.label.tolist() == [0, 0]
    assert found.certainty[0] < 0.2 < 0.8 < found.certainty[1]


def test_signs_back_to_back_are_never_one():
    heads = signs_at([(0.0, 0.0, 2.0)], [-1])
    assert match(turned_round(heads), heads) == [-1]
    both = signs_at([(0.0, 0, 2), (0.02, 0, 2)] * 3, [0, 1, 2, 3, 4, 5])
    back = turned_round(both)
    T = both.T_world_sign.clone()
    T[1::2] = back.T_world_sign[1::2]
    both = replace(both, T_world_sign=T)
    label = torch.tensor([0, 1] * 3)
    heads = sign_heads(both, label)
    merged = merge_heads(both, label, heads, NONE, CONFIG, shift_sigma=SIGMA)
    assert merged.tolist() == label.tolist()
    assert harvest_signs(both, label, heads, NONE, CONFIG).tolist() == label.tolist()


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


def test_a_split_cluster_is_merged_and_a_post_is_not():
    same = signs_at([(0.0, 0, 2), (0.1, 0, 2)] * 3, list(range(6)))
    label = torch.tensor([0, 1] * 3)
    heads = sign_heads(same, label)
    merged = merge_heads(same, label, heads, NONE, CONFIG, shift_sigma=SIGMA)
    assert merged.unique().tolist() == [0]

    post = signs_at(POST * 3, [0, 0, 1, 1, 2, 2])
    heads = sign_heads(post, label)
    together = torch.tensor([[0, 1], [2, 3], [4, 5]])
    merged = merge_heads(post, label, heads, together, CONFIG, shift_sigma=4 * SIGMA)
    assert merged.tolist() == label.tolist()


def test_clusters_nobody_saw_both_of_are_one_sign():
    place = [(0.0, 0.0, 2.0)] * 6 + [(0.9, 0.0, 2.2)] * 6
    apart = signs_at(place, list(range(12)))
    label = torch.arange(12) // 6
    heads = sign_heads(apart, label)
    merged = merge_heads(apart, label, heads, NONE, CONFIG, shift_sigma=0.5 * SIGMA)
    assert merged.unique().tolist() == [0]


def test_plates_that_overlap_are_one_sign_detected_twice():
    same = signs_at([(0.0, 0, 2), (0.0, 0.1, 2)] * 3, [0, 0, 1, 1, 2, 2])
    label = torch.tensor([0, 1] * 3)
    together = torch.tensor([[0, 1], [2, 3], [4, 5]])
    heads = sign_heads(same, label)
    merged = merge_heads(same, label, heads, together, CONFIG, shift_sigma=0.1 * SIGMA)
    assert merged.unique().tolist() == [0]


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
    assert harvest_signs(signs, label, heads, together, CONFIG).tolist() == [0] * 5 + [-1, 0]


def test_a_weak_cluster_beside_a_strong_one_is_dissolved():
    place = [(0.0, 0.0, 2.0)] * 8 + [(0.7, 0.2, 2.1)] * 2
    signs = signs_at(place, [*range(8), 0, 1])
    label = torch.tensor([0] * 8 + [1] * 2)
    heads = sign_heads(signs, label)
    assert harvest_signs(signs, label, heads, NONE, CONFIG).unique().tolist() == [0]
