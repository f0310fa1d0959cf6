from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch

from crowdmap_torch.geometry import polygon
from crowdmap_torch.simulate.worlds import WORLD_PRESETS, build_world


def _signs(name: str, seed: int = 0, **changes):
    return build_world(replace(WORLD_PRESETS[name], **changes), np.random.default_rng(seed)).signs


def test_suburb_has_30_to_60_signs_a_kilometre_of_every_shape():
    worlds = [_signs("suburb", seed) for seed in range(5)]
    assert all(30 <= len(signs) <= 70 for signs in worlds)
    shapes = np.concatenate([signs.shape for signs in worlds])
    assert set(shapes) == set(range(len(polygon.SHAPES)))
    codes = [code for signs in worlds for code in signs.code]
    assert None in codes and "US:R1-1" in codes
    size = np.concatenate([signs.size for signs in worlds])
    assert 0.4 <= size.min() and size.max() <= 0.9


def test_shared_posts_hold_signs_0_7_m_apart_that_do_not_touch():
    signs = _signs("suburb", length_m=3000.0)
    distances = []
    for post in np.unique(signs.post):
        rows = np.flatnonzero(signs.post == post)
        for a, b in pairwise(rows):
            distances.append(np.linalg.norm(signs.center[a] - signs.center[b]))
            assert distances[-1] > 0.5 * (signs.size[a] + signs.size[b]).min()
    # Centres are means of corners, which for a pentagon lie below or above the box's middle.
    assert len(distances) > 10
    np.testing.assert_allclose(distances, 0.7, atol=1e-9)


def test_gantries_carry_wide_panels_and_signals_2_m_apart():
    signs = _signs("highway", length_m=4000.0)
    high = signs.center[:, 2] - np.median(signs.center[:, 2]) > 2.0
    wide = signs.size[:, 0] >= 2.0
    assert wide.any() and signs.size[:, 0].max() <= 4.0
    signals = np.flatnonzero(np.isclose(signs.size[:, 0], 1.2))
    same = signs.post[signals[1:]] == signs.post[signals[:-1]]
    gaps = np.linalg.norm(np.diff(signs.center[signals], axis=0), axis=-1)[same]
    np.testing.assert_allclose(gaps, 2.0, atol=1e-9)
    assert high.any()


def test_wide_boards_hang_above_all_lanes_and_leave_the_other_signs_alone():
    plain = _signs("highway", length_m=2000.0)
    config = replace(WORLD_PRESETS["highway"].signs, wide_boards_per_km=3.0)
    signs = _signs("highway", length_m=2000.0, signs=config)
    is_board = signs.size[:, 0] > 8.0
    assert is_board.sum() == 6
    assert 9.0 <= signs.size[is_board, 0].min() and signs.size[is_board, 0].max() <= 15.0
    low = signs.corners()[is_board][..., 2].min(1)
    road = np.median(plain.center[plain.size[:, 0] < 1.0, 2])
    assert (low > road).all()
    first = set(map(tuple, plain.center.round(6)[: len(plain) // 2]))
    assert first <= set(map(tuple, signs.center.round(6)))


def test_block_has_signs_back_to_back_and_facing_both_ways():
    signs = _signs("block")
    apart = np.linalg.norm(signs.center[:, None] - signs.center[None], axis=-1)
    facing = signs.normal @ signs.normal.T
    back_to_back = (apart < 0.3) & (facing < -0.9)
    assert back_to_back.any()


def test_signs_stand_upright_clockwise_from_the_top_left_and_are_canonical():
    signs = _signs("suburb", length_m=2000.0)
    T = np.tile(np.eye(4), (len(signs), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = signs.R_world_sign, signs.center
    same, size = polygon.canonical(
        torch.from_numpy(T), torch.from_numpy(signs.size), torch.from_numpy(signs.shape)
    )
    np.testing.assert_allclose(same.numpy(), T, atol=1e-12)
    np.testing.assert_allclose(size.numpy(), signs.size)
    corners = signs.corners()
    count = polygon.CORNER_COUNT.numpy()[signs.shape]
    for k in range(len(signs)):
        own = corners[k, : count[k]]
        np.testing.assert_allclose(own.mean(0), signs.center[k], atol=1e-12)
        assert np.abs((own - signs.center[k]) @ signs.normal[k]).max() < 1e-12
        # Clockwise as seen from the side that the normal points to.
        edge, following = own[1] - own[0], own[2] - own[1]
        assert np.cross(edge, following) @ signs.normal[k] < 0
        up = (own - signs.center[k]) @ signs.R_world_sign[k, :, 1]
        assert up[0] == pytest.approx(up.max(), abs=1e-9)
