"""Signs that are alike leave it open where some drives are: lanes tell, and signs are told apart anew."""

from __future__ import annotations

from dataclasses import dataclass

import pytest
import torch
from torch import Tensor
from worlds.gantry import BESIDE_M, gantry
from worlds.small_world import Builder

from crowdmap_torch.crowd_lanes.placed_drives import PlacedDrives, place_drives
from crowdmap_torch.crowd_lanes.tie_groups import GroupTieConfig
from crowdmap_torch.crowd_signs.register import Crowd, CrowdConfig, register_crowd
from crowdmap_torch.noise.positioning import PositioningNoise

SEEN = [[0, 1, 2]] * 5 + [[2]] * 3
NOISE, CONFIG = PositioningNoise(), CrowdConfig()


def biases(seed: int, *, last: float) -> Tensor:
    """Of all drives, those of the last three `last` to the left, so that their sign is where the middle one is."""
    generator = torch.Generator().manual_seed(seed)
    bias = 0.2 * torch.randn(len(SEEN), 3, generator=generator, dtype=torch.float64)
    bias[5:, 1] += last
    return bias


@dataclass(frozen=True)
class Placed:
    """The signs of a gantry told apart, once or twice, and drives placed."""

    crowd: Crowd
    drives: PlacedDrives
    again: bool

    @classmethod
    def of(cls, build: Builder, bias: Tensor, *, with_lanes: bool = True) -> Placed:
        drives, signs, made = gantry(build, SEEN, bias)
        if not with_lanes:
            made = [lanes.select(torch.arange(0)) for lanes in made]
        how = signs.bias_sigma, NOISE, CONFIG.match, GroupTieConfig()
        crowd = register_crowd(signs, NOISE, CONFIG)
        placed = place_drives(drives, made, crowd, *how)
        start = placed.better
        if start is not None:
            crowd = register_crowd(signs, NOISE, CONFIG, start=start)
            placed = place_drives(drives, made, crowd, *how, doubt=False)
        return cls(crowd.moved(placed.ties.move), placed, start is not None)


def aside(crowd: Crowd, bias: Tensor) -> Tensor:
    """How far to the left of the others the last three drives are, beside where they ought to be [m]."""
    left = bias[:, 1] - crowd.bias.translation[:, 1]
    return left[5:] - left[:5].mean()


@pytest.mark.parametrize("seed", range(3))
def test_lanes_tell_which_of_three_signs_a_drive_has_seen(build: Builder, seed: int):
    bias = biases(seed, last=-1.3)
    _, signs, _ = gantry(build, SEEN, bias)
    wrong = aside(register_crowd(signs, NOISE, CONFIG), bias)
    torch.testing.assert_close(wrong, torch.full_like(wrong, -BESIDE_M), rtol=0, atol=0.5)
    found = Placed.of(build, bias)
    assert found.again and float(aside(found.crowd, bias).abs().max()) < 0.4
    crowd = found.crowd
    assert len(crowd.heads) == 3
    # The signs of the last drives are in the cluster that is farthest to the left.
    last = crowd.members.journey >= 5
    assert crowd.label[last].unique().tolist() == [int(crowd.heads.center_world[:, 1].argmax())]
    away = crowd.members.center_world[:, 1] - signs.signs.center_world[:, 1]
    pose = found.drives.poses[6][0, 1, 3] - bias[6, 1]
    torch.testing.assert_close(pose, away[crowd.members.journey == 6][0], rtol=0, atol=0.3)


@pytest.mark.parametrize("seed", range(3))
def test_drives_that_are_right_stay(build: Builder, seed: int):
    bias = biases(seed, last=0.0)
    found = Placed.of(build, bias)
    assert not found.again and float(aside(found.crowd, bias).abs().max()) < 0.4
    ties = found.drives.ties
    assert not bool(ties.move.any()) and not bool(ties.is_shifted.any())


def test_without_lanes_drives_stay_where_signs_put_them(build: Builder):
    bias = biases(0, last=-1.3)
    found = Placed.of(build, bias, with_lanes=False)
    assert not found.again
    _, signs, _ = gantry(build, SEEN, bias)
    by_signs = register_crowd(signs, NOISE, CONFIG)
    assert torch.equal(found.crowd.bias.translation, by_signs.bias.translation)
    assert torch.equal(found.crowd.label, by_signs.label)
