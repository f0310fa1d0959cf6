"""Shifts of detections, told apart from the errors of poses that move all corners of a view as well."""

from __future__ import annotations

from copy import deepcopy
from typing import TYPE_CHECKING

import pytest
import torch
from torch import Tensor

from crowdmap_torch.adjustment.bundle import Evidence
from crowdmap_torch.adjustment.detection_shifts import told_apart
from crowdmap_torch.adjustment.noise_pull import left_by_prior
from crowdmap_torch.optim import levenberg_marquardt as lm

if TYPE_CHECKING:
    from worlds.adjusted_street import Adjusted

F64 = torch.float64
COUNT = 4000


def innovations(shift: float, share: float, seed: int) -> tuple[Tensor, Tensor]:
    """Of detections near and far, and the noise of the means of their corners."""
    g = torch.Generator().manual_seed(seed)
    poses = 10 ** (2 * torch.rand(COUNT, generator=g, dtype=F64) - 1.3)
    others = 0.3 * torch.rand(COUNT, generator=g, dtype=F64)
    noise = torch.full((COUNT,), 0.06, dtype=F64)
    sigma = (shift**2 + share * poses + others + noise).sqrt()
    foreseen = sigma[:, None] * torch.randn(COUNT, 2, generator=g, dtype=F64)
    return torch.stack((foreseen.square().mean(1), poses, others), dim=1), noise


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("share", [0.0, 0.3, 1.0, 3.0])
@pytest.mark.parametrize("shift", [0.0, 0.5, 2.0])
def test_shifts_and_errors_of_poses_are_told_apart(shift: float, share: float, seed: int):
    innovation, noise = innovations(shift, share, seed)
    every = torch.ones(COUNT, dtype=torch.bool)
    variance, there = told_apart(innovation, noise, every)
    assert abs(float(variance) - shift**2) < 0.1 * shift**2 + 0.03
    assert abs(float(there) - share) < 0.15 * share + 0.06 * (1 + shift**2)


def test_what_is_not_counted_or_wild_does_not_matter():
    innovation, noise = innovations(1.0, 1.0, 0)
    every = torch.ones(COUNT, dtype=torch.bool)
    wild = torch.arange(COUNT) % 50 == 0
    spoiled = innovation.clone()
    spoiled[wild, 0] = 1e4
    expected = told_apart(innovation[~wild], noise[~wild], every[~wild])
    left_out = told_apart(spoiled, noise, ~wild)
    torch.testing.assert_close(torch.stack(left_out), torch.stack(expected))
    # Clipped, two in a hundred of nine times the variance add to it by a fifth at most.
    clipped = told_apart(spoiled, noise, every)
    assert 0.9 < float(clipped[0]) < 1.4
    silent = innovation * (torch.arange(3) == 0)
    for nothing in (told_apart(silent, noise, every), told_apart(innovation, noise, ~every)):
        assert [float(x) for x in nothing] == [0.0, 1.0]


@pytest.mark.parametrize("count", [1, 7, 495])
@pytest.mark.parametrize("poses", [0.0, 1e-6, 0.3])
def test_of_detections_that_are_moved_alike_all_beyond_errors_of_poses_is_shift(
    count: int, poses: float
):
    """Nothing tells the two apart: a difference that is rounding is not divided by."""
    g = torch.Generator().manual_seed(count)
    square = 2 + torch.rand(count, generator=g, dtype=F64)
    alike = torch.full((count,), poses, dtype=F64)
    innovation = torch.stack((square, alike, torch.zeros_like(alike)), dim=1)
    noise, every = torch.full((count,), 0.5, dtype=F64), torch.ones(count, dtype=torch.bool)
    shift, share = told_apart(innovation, noise, every)
    assert share == 1.0
    expected = float(square.mean()) - 0.5 - poses if poses else 0.0
    assert float(shift) == pytest.approx(expected, rel=1e-6)


def test_an_adjustment_foresees_its_detections(adjusted: Adjusted):
    bundle = adjusted.bundle
    square, poses, others = bundle.innovation.unbind(1)
    told = poses > 0
    assert told.double().mean() > 0.9 and bundle.innovation.isfinite().all()
    # Means of squares are what is expected of them, corners' noise of half a pixel beside it.
    expected = poses + others + bundle.scale[0].square() / bundle.detections.count
    assert 0.5 < float(square[told].mean() / expected[told].mean()) < 1.5
    assert 0 <= float(bundle.share_there) < 2


def test_what_the_prior_leaves_is_a_part_of_the_covariance(adjusted: Adjusted):
    bundle = deepcopy(adjusted.bundle)
    problem, values = bundle.problem(), bundle.values()
    equations = bundle.backend().assemble(problem, values)
    lm.step(problem, lm.init(problem, values, bundle.config.lm), bundle.config.lm)
    whole = equations.conditional_covariance("pose")
    prior = left_by_prior(equations, whole)
    # P (P^-1 - H) P: neither it nor the rest is negative, and of a frame that sees nothing it would be all.
    assert torch.linalg.eigvalsh((prior + prior.mT) / 2).min() > -1e-9
    rest = whole - prior
    assert torch.linalg.eigvalsh((rest + rest.mT) / 2).min() > -1e-9
    share = prior.diagonal(dim1=-2, dim2=-1) / whole.diagonal(dim1=-2, dim2=-1)
    assert 0.0 < float(share.min()) and float(share.max()) < 1.0


def test_the_share_that_is_there_follows_what_is_foreseen_half_way_each_time(adjusted: Adjusted):
    bundle = deepcopy(adjusted.bundle)
    found = []
    for begun in (1.0, 0.2, 0.2):
        bundle.share_there.fill_(begun)
        told, innovation = bundle.drift_told.clone(), bundle.innovation.clone()
        evidence = Evidence(told, bundle.poses_left.clone(), bundle.held_off.clone(), innovation)
        bundle.refresh(evidence if len(found) < 2 else None)
        found.append(float(bundle.share_there))
    first, later, still = found
    assert 0.3 < first < 1.0
    assert later == pytest.approx((first + 0.2) / 2)
    # What was not foreseen anew says nothing new.
    assert still == pytest.approx(0.2)
