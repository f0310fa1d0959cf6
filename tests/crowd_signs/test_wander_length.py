"""V-B: whether biases wander, and over which way, as the signs of a crowd tell."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from worlds.crowd_world import World, make_world, pair_scores, wandering_world

from crowdmap_torch.crowd_signs.align import AlignConfig, no_bias
from crowdmap_torch.crowd_signs.gather import unexplained_covariance
from crowdmap_torch.crowd_signs.journey_bias import BiasEquations, JourneyBias
from crowdmap_torch.crowd_signs.register import CrowdConfig, register_crowd
from crowdmap_torch.crowd_signs.wander_length import likely_wander
from crowdmap_torch.noise.positioning import PositioningNoise

NOISE = PositioningNoise()


def told(world: World, positioning: PositioningNoise = NOISE) -> PositioningNoise:
    """What the true clusters say."""
    crowd, config = world.crowd, AlignConfig()
    start = no_bias(crowd.signs, crowd.station, positioning, config, journeys=crowd.journeys)
    least = unexplained_covariance(crowd, crowd.bias_sigma.new_tensor([0.25, 0.12, 0.06]))
    return likely_wander(crowd, least, world.sign, positioning, config, start=start)


@pytest.mark.parametrize("seed", range(4))
def test_biases_that_wander_within_a_drive_are_said_to(seed: int):
    found = told(wandering_world(seed, wander_m=1.0, length_m=1000.0, bias_sigma_m=0.7))
    assert found.wander_length_m <= NOISE.wander_length_m / 2
    assert found.wander_sigma_m > NOISE.wander_sigma_m
    assert replace(found, wander_length_m=3000.0, wander_sigma_m=0.2) == NOISE


@pytest.mark.parametrize("seed", range(4))
def test_constant_biases_are_not(seed: int):
    assert told(make_world(seed, journeys=6)) == NOISE


def test_of_no_wander_there_is_no_way():
    at_rest = PositioningNoise(wander_sigma_m=0.0)
    assert (
        told(wandering_world(0, wander_m=1.0, length_m=1000.0, bias_sigma_m=0.7), at_rest)
        == at_rest
    )


def test_nothing_is_told_by_signs_of_one_drive_each():
    world = make_world(0, journeys=3)
    assert told(replace(world, sign=torch.full_like(world.sign, -1))) == NOISE


@pytest.mark.parametrize("seed", range(3))
def test_one_drive_with_an_outage_does_not_speak_for_all(seed: int):
    world = make_world(seed, journeys=8)
    crowd = world.crowd
    T = crowd.signs.T_world_sign.clone()
    off = (crowd.signs.journey == 3) & (crowd.station > 400) & (crowd.station < 600)
    T[off, 1, 3] += 3.0
    crowd = replace(crowd, signs=replace(crowd.signs, T_world_sign=T))
    assert told(replace(world, crowd=crowd)) == NOISE


@pytest.mark.parametrize("seed", [4, 5, 7])
def test_signs_are_told_apart_where_nobody_said_that_biases_wander(seed: int):
    world = wandering_world(seed, wander_m=1.3, length_m=1000.0, bias_sigma_m=0.7, ghosts=0.0)
    found = register_crowd(world.crowd, NOISE, CrowdConfig())
    precision, recall = pair_scores(world, found.label)
    # With biases that stand still and are as large as expected 49, 72 and 52 % of the pairs were found.
    assert precision > 0.97 and recall > 0.93
    assert not found.report.outages and not found.report.outlier_journeys
    assert found.positioning.wander_length_m < NOISE.wander_length_m


def test_evidence_is_that_of_the_joint_normal_density():
    """Between two priors, of a drive whose errors are written out: bias, heading, drift and noise of all signs."""
    world = make_world(5, journeys=2, length_m=200.0, posts=5, ghosts=0.0)
    crowd, signs = world.crowd, world.crowd.signs
    config = AlignConfig(node_spacing_m=30.0)
    place = world.center[world.sign]
    information = torch.linalg.inv(signs.covariance)
    tried = (
        PositioningNoise(wander_length_m=100.0, drift_sigma_m=0.4, bias_sigma_deg=1.0),
        PositioningNoise(wander_sigma_m=0.0, drift_length_m=60.0),
    )
    start = no_bias(signs, crowd.station, NOISE, config, journeys=2)
    found, written = [], []
    for noise in tried:
        given = signs, crowd.station, place, information, crowd.bias_sigma, noise
        found.append(BiasEquations.of(start, *given).log_evidence())
        written.append(_density(world, start, noise))
    assert torch.allclose(found[0] - found[1], written[0] - written[1], atol=1e-7)


def _density(world: World, start: JourneyBias, noise: PositioningNoise) -> torch.Tensor:
    signs, station = world.crowd.signs, world.crowd.station
    of_journey = []
    for journey in range(2):
        rows = torch.nonzero(signs.journey == journey)[:, 0]
        n, count = len(rows), int(start.node_count[journey])
        node = start.node_origin[journey] + start.node_spacing[journey] * torch.arange(count)
        at = (station[rows] - start.node_origin[journey]) / start.node_spacing[journey]
        hat = (1 - (at[:, None] - torch.arange(count)).abs()).clamp_min(0)
        apart = (node[:, None] - node).abs()
        bias = world.crowd.bias_sigma[journey]
        drift = noise.drift_sigma_m**2 * torch.exp(-apart / noise.drift_length_m)
        each = drift.expand(3, count, count).clone()
        length = start.length[journey]
        if noise.wander_sigma_m and length >= 0.5 * noise.wander_length_m:
            slow = torch.exp(-apart / noise.wander_length_m)
            each += 0.5 * bias.square()[:, None, None] * slow
        total = torch.zeros(n, 3, n, 3, dtype=torch.float64)
        for axis in range(3):
            total[:, axis, :, axis] = hat @ each[axis] @ hat.T + bias[axis].square()
        arm = signs.center_world[rows] - start.centroid[journey]
        lever = torch.stack((-arm[:, 1], arm[:, 0], 0 * arm[:, 0]), dim=1)
        turn = noise.bias_sigma_rad * min(0.5 * noise.wander_length_m / float(length), 1)
        total += turn**2 * torch.einsum("ia,jb->iajb", lever, lever)
        for row in range(n):
            total[row, :, row] += signs.covariance[rows[row]]
        miss = (signs.center_world[rows] - world.center[world.sign[rows]]).flatten()
        normal = torch.distributions.MultivariateNormal(
            torch.zeros_like(miss), total.reshape(3 * n, 3 * n)
        )
        of_journey.append(normal.log_prob(miss))
    return torch.stack(of_journey)
