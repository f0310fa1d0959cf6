"""Clusters that are one sign are joined, by what was seen beside what; signs back to back or on one post are not."""

from __future__ import annotations

from dataclasses import replace

import torch
from worlds.crowd_world import signs_at, turned_round

from crowdmap_torch.crowd_signs.cluster import sign_heads
from crowdmap_torch.crowd_signs.merge import (
    SignMergeConfig,
    dissolve_weak,
    join_passes,
    merge_heads,
)
from crowdmap_torch.geometry import se3

CONFIG = SignMergeConfig()
SIGMA = torch.full((3,), 0.2, dtype=torch.float64)
NONE = torch.zeros(0, 2, dtype=torch.int64)
POST = [(0.0, 0.0, 2.0), (0.0, 0.0, 2.7)]


def test_signs_back_to_back_are_never_one():
    both = signs_at([(0.0, 0, 2), (0.02, 0, 2)] * 3, [0, 1, 2, 3, 4, 5])
    back = turned_round(both)
    T = both.T_world_sign.clone()
    T[1::2] = back.T_world_sign[1::2]
    both = replace(both, T_world_sign=T)
    label = torch.tensor([0, 1] * 3)
    heads = sign_heads(both, label)
    merged = merge_heads(both, label, heads, NONE, CONFIG, shift_sigma=SIGMA)
    assert merged.tolist() == label.tolist()
    assert dissolve_weak(both, label, heads, NONE, CONFIG).tolist() == label.tolist()
    station = torch.zeros(6).double()
    joined = join_passes(both, label, heads, station, NONE, CONFIG)
    assert joined.tolist() == label.tolist()


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


def test_a_weak_cluster_beside_a_strong_one_is_dissolved():
    place = [(0.0, 0.0, 2.0)] * 8 + [(0.7, 0.2, 2.1)] * 2
    signs = signs_at(place, [*range(8), 0, 1])
    label = torch.tensor([0] * 8 + [1] * 2)
    heads = sign_heads(signs, label)
    assert dissolve_weak(signs, label, heads, NONE, CONFIG).tolist() == [0] * 8 + [-1] * 2


def test_a_sign_seen_from_afar_with_another_normal_is_one_if_seen_in_one_pass():
    place = [(0.0, 0.0, 2.0), (0.3, 0.4, 2.0)] * 5
    signs = signs_at(place, [0, 0, 1, 1, 2, 2, 3, 3, 4, 4])
    quarter = se3.so3_exp(torch.tensor([0.0, 1.7, 0.0]).double())
    T = signs.T_world_sign.clone()
    T[1::2, :3, :3] = T[1::2, :3, :3] @ quarter
    signs = replace(signs, T_world_sign=T)
    label = torch.tensor([0, 1] * 5)
    heads = sign_heads(signs, label)
    near = torch.tensor([100.0, 130.0] * 5).double()
    far = torch.tensor([100.0, 400.0] * 5).double()
    beside = torch.tensor([[0, 1], [2, 3], [4, 5], [6, 7], [8, 9]])
    assert join_passes(signs, label, heads, near, NONE, CONFIG).unique().numel() == 1
    assert join_passes(signs, label, heads, far, NONE, CONFIG).tolist() == label.tolist()
    assert join_passes(signs, label, heads, near, beside, CONFIG).tolist() == label.tolist()
