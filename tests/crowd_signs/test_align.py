"""V-B: biases of journeys from clusters."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from worlds.crowd_world import World, make_world

from crowdmap_torch.crowd_signs.align import AlignConfig, align_journeys, no_bias
from crowdmap_torch.crowd_signs.journey_bias import (
    JourneyBias,
    bias_at,
    largest_drift,
    unbiased_poses,
)
from crowdmap_torch.geometry import se3
from crowdmap_torch.noise.positioning import PositioningNoise

NOISE = PositioningNoise()


def align(
    world: World,
    config: AlignConfig,
    label: torch.Tensor | None = None,
    positioning: PositioningNoise = NOISE,
) -> JourneyBias:
    """Biases from the true associations, or others."""
    crowd = world.crowd
    start = no_bias(crowd.signs, crowd.station, positioning, config, journeys=crowd.journeys)
    return align_journeys(
        crowd.signs,
        world.sign if label is None else label,
        crowd.station,
        positioning,
        config,
        start=start,
        bias_sigma=crowd.bias_sigma,
    )


def error_left(world: World, bias: JourneyBias) -> torch.Tensor:
    """Pose error that is left at each sign of the world, up to what all journeys share [m]."""
    crowd = world.crowd
    found = bias_at(bias, crowd.signs.journey, crowd.station, crowd.signs.center_world)
    left = (world.error - found)[world.sign >= 0]
    return left - left.median(0).values


CONSTANT = PositioningNoise(drift_sigma_m=0.001, bias_sigma_deg=1e-4)


def test_constant_biases_are_found():
    world = make_world(0, journeys=5, drift_m=0.0, noise_m=0.01)
    left = error_left(world, align(world, AlignConfig(), positioning=CONSTANT)).norm(dim=1)
    # Lateral errors of the wandering heading, 4 cm, are no bias; the median of what they leave.
    assert left.median() < 0.06
    assert world.error.norm(dim=1).median() > 0.5


def test_mean_of_biases_weighted_by_priors_is_zero():
    world = make_world(0, journeys=5)
    sigma = world.crowd.bias_sigma * torch.tensor([1, 2, 1, 0.5, 3])[:, None]
    world = replace(world, crowd=replace(world.crowd, bias_sigma=sigma))
    weight = sigma.pow(-2)
    mean = (weight * align(world, AlignConfig()).translation).sum(0) / weight.sum(0)
    # Rounding of a sum of five.
    assert mean.abs().max() < 1e-4


def test_drift_along_the_journey_is_found():
    world = make_world(1, journeys=8, drift_m=0.5)
    constant = (
        error_left(world, align(world, AlignConfig(), positioning=CONSTANT)).norm(dim=1).median()
    )
    config = AlignConfig(noise_sigma_m=0.1, sweeps=20)
    wandering = PositioningNoise(drift_sigma_m=0.5)
    drifting = align(world, config, positioning=wandering)
    # Signs are 35 m apart and miss by 0.2 m along the line of sight: part of a drift of 0.5 m in 150 m cannot be seen.
    assert error_left(world, drifting).norm(dim=1).median() < 0.6 * constant
    assert largest_drift(drifting).min() > 0.3


def test_a_turned_journey_is_turned_back():
    world = make_world(2, journeys=5, drift_m=0.0, noise_m=0.01)
    signs, angle = world.crowd.signs, torch.deg2rad(torch.tensor(1.5)).double()
    mine = signs.journey == 3
    centroid = signs.center_world[mine].mean(0)
    arm = signs.center_world - centroid
    lever = torch.stack((-arm[:, 1], arm[:, 0], 0 * arm[:, 0]), dim=1)
    T = signs.T_world_sign.clone()
    T[mine, :3, 3] += angle * lever[mine]
    world = replace(world, crowd=replace(world.crowd, signs=replace(signs, T_world_sign=T)))
    config = AlignConfig(noise_sigma_m=0.5, sweeps=15)
    turned = PositioningNoise(drift_sigma_m=0.001, bias_sigma_deg=2.0)
    bias = align(world, config, positioning=turned)
    # One hundredth of a radian over 500 m is 5 m: the heading is seen to a small part of that.
    assert abs(float(bias.heading[3] - angle)) < 0.1 * float(angle)
    others = torch.tensor([0, 1, 2, 4])
    assert bias.heading[others].abs().max() < 0.25 * float(angle)


def test_outliers_have_no_say():
    world = make_world(3, journeys=6, ghosts=0.0, drift_m=0.1)
    g = torch.Generator().manual_seed(0)
    wrong = torch.rand(len(world.sign), generator=g) < 0.05
    label = torch.where(wrong, world.sign.roll(1), world.sign)
    clean, dirty = align(world, AlignConfig()), align(world, AlignConfig(), label)
    assert (clean.translation - dirty.translation).norm(dim=1).max() < 0.05


def test_a_journey_without_weight_does_not_move_the_others_but_is_aligned():
    world = make_world(4, journeys=6, drift_m=0.05)
    crowd = world.crowd
    rest = crowd.signs.journey > 0
    moved = crowd.signs.T_world_sign.clone()
    moved[~rest, 0, 3] += 3.0
    signs = replace(crowd.signs, T_world_sign=moved)
    config = AlignConfig(sweeps=20)
    start = no_bias(signs, crowd.station, NOISE, config, journeys=6)
    weight = torch.tensor([0.0, 1, 1, 1, 1, 1]).double()
    both = align_journeys(
        signs, world.sign, crowd.station, NOISE, config, start=start, journey_weight=weight
    )
    alone = align_journeys(
        signs[rest],
        world.sign[rest],
        crowd.station[rest],
        NOISE,
        config,
        start=start,
        journey_weight=weight,
    )
    # A thousandth of the weight is left to keep systems regular.
    assert (both.translation[1:] - alone.translation[1:]).abs().max() < 1e-3
    found = both.translation[0] - both.translation[1:].mean(0)
    truth = world.bias[0] - world.bias[1:].mean(0) + torch.tensor([3.0, 0, 0])
    assert (found - truth).norm() < 0.3


def test_paper_bias_is_the_mean_difference():
    world = make_world(5, journeys=4, missed=0.0, ghosts=0.0, fragments=0.0)
    bias = align(world, AlignConfig(method="paper2017"))
    signs = world.crowd.signs
    mean = torch.stack([signs.center_world[signs.journey == j].mean(0) for j in range(4)])
    # All journeys see all signs: the mean difference is that of the means.
    assert torch.allclose(bias.translation, mean - mean.mean(0), atol=1e-6)
    assert not bias.node_drift.any()
    assert not bias.heading.any()


def test_unbiased_poses_move_with_the_bias():
    world = make_world(6, journeys=3)
    bias = align(world, AlignConfig())
    T = torch.eye(4, dtype=torch.float64).repeat(3, 1, 1)
    T[:, 0, 3] = torch.tensor([100.0, 200.0, 300.0])
    station = T[:, 0, 3].clone()
    poses = unbiased_poses(T, bias, 1, station)
    rows = torch.full((3,), 1)
    expected = T[:, :3, 3] - bias_at(bias, rows, station, T[:, :3, 3])
    assert torch.allclose(poses[:, :3, 3], expected)
    turn = se3.so3_log(poses[:, :3, :3])[:, 2]
    assert torch.allclose(turn, -bias.heading[1].expand(3))


def test_drift_is_linear_between_nodes_and_constant_outside():
    world = make_world(6, journeys=2)
    bias = no_bias(world.crowd.signs, world.crowd.station, NOISE, AlignConfig(), journeys=2)
    count = int(bias.node_count[1])
    drift = torch.zeros_like(bias.node_drift)
    start = int(bias.node_start[1])
    drift[start : start + count, 2] = torch.arange(count).double()
    bias = replace(bias, node_drift=drift)
    origin, spacing = float(bias.node_origin[1]), float(bias.node_spacing[1])
    station = origin + spacing * torch.tensor([-3.0, 0.5, 1.25, count + 4.0]).double()
    found = bias_at(bias, torch.ones(4, dtype=torch.int64), station, bias.centroid[1].expand(4, 3))
    # Linear interpolation of whole numbers.
    expected = torch.tensor([0.0, 0.5, 1.25, count - 1.0]).double()
    assert torch.allclose(found[:, 2], expected, atol=1e-9)


def test_unknown_method_is_refused():
    with pytest.raises(ValueError, match="method: expected one of"):
        AlignConfig(method="mean")
