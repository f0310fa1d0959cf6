"""What poses' errors take of image noise, which draws signs near where they are small, and that it is undone."""

from __future__ import annotations

from dataclasses import dataclass, replace
from statistics import fmean
from typing import TYPE_CHECKING

import pytest
import torch
from torch import Tensor
from torch.func import jacrev

from crowdmap_torch.adjustment import adjust
from crowdmap_torch.adjustment.config import AdjustConfig
from crowdmap_torch.adjustment.convoys import convoy
from crowdmap_torch.adjustment.noise_pull import (
    held_off,
    nearness,
    nearness_jacobian,
    noise_pull_term,
)
from crowdmap_torch.adjustment.parts import VARIABLES
from crowdmap_torch.adjustment.shared_corner_errors import CornerDetections
from crowdmap_torch.geometry import se3
from crowdmap_torch.optim.levenberg_marquardt import LmConfig
from crowdmap_torch.optim.linearize import dense, first_blocks, residuals, row_blocks
from crowdmap_torch.optim.problem import CostTerm
from crowdmap_torch.residuals.reprojection import sign_reprojection, sign_reprojection_jacobian

if TYPE_CHECKING:
    from worlds.adjusted_street import Adjusted, Street

F64 = torch.float64
FRAMES, SIGNS, JOURNEYS = 600, 4, 2
FOCAL = 1000.0
CORNERS = torch.tensor([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]], dtype=F64)
PIXEL = 2.0
SIGMA = torch.tensor([0.05, 0.05, 0.05, 1e-3, 1e-3, 1e-3], dtype=F64)
"""What poses' noise from frame to frame is taken to be."""


@dataclass(frozen=True)
class Views:
    """Signs beside frames whose poses were estimated with the signs known."""

    term: CostTerm
    detections: CornerDetections
    values: dict[str, Tensor]
    covariance: Tensor
    given: Tensor
    true: Tensor

    def strength(self, true_share: float = 0.0) -> Tensor:
        """At that share of the poses' errors."""
        by_prior = self.covariance @ torch.diag(SIGMA**-2) @ self.covariance
        runs = self.detections.run, len(self.detections.count)
        _, _, tells = first_blocks(self.term, VARIABLES, self.values, *runs)
        seen = self.term, self.detections, self.values, tells, by_prior
        found = held_off(*seen, self.term.slots[0][1] * JOURNEYS // FRAMES, JOURNEYS)
        return (1 - true_share**2) ** 0.5 * found

    def cost(self, scale: float, *terms: CostTerm) -> float:
        """Of some terms in a world of that scale, in which every given position is as far from the true one as in this."""
        values = {name: value.clone() for name, value in self.values.items()}
        values["pose"][:, :3, 3] += (scale - 1) * self.true[:, :3, 3]
        values["sign"][:, :3, 3] *= scale
        values["size"] *= scale
        return sum(float(residuals(term, values).square().sum() / 2) for term in terms)

    def slope(self, *terms: CostTerm) -> float:
        """Of the cost by the logarithm of the scale."""
        return (self.cost(1 + 1e-5, *terms) - self.cost(1 - 1e-5, *terms)) / 2e-5


def _deviation(given: Tensor, pose: Tensor) -> Tensor:
    turn = se3.log(se3.inverse(given) @ pose)[:, 3:]
    return torch.cat((pose[:, :3, 3] - given[:, :3, 3], turn), dim=1)


def views(true_share: float, seed: int = 0) -> Views:
    """`true_share` of the noise that poses are taken to have they have."""
    g = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=g, dtype=F64)

    frame = torch.arange(FRAMES)
    true = torch.eye(4, dtype=F64).repeat(FRAMES, 1, 1)
    true[:, 2, 3] = 0.02 * frame
    given = se3.retract(true, true_share * SIGMA * normal(FRAMES, 6))
    sign = torch.eye(4, dtype=F64).repeat(SIGNS, 1, 1)
    sign[:, :3, 3] = torch.tensor(
        [[-4.0, -1, 30], [3, -2, 35], [5, 0, 45], [-2, -1, 60]], dtype=F64
    )
    size = torch.full((SIGNS, 2), 0.7, dtype=F64)
    # A sign in two of three frames.
    seen = torch.nonzero(torch.rand(FRAMES, SIGNS, generator=g) < 2 / 3)
    of_frame, of_sign = (x.repeat_interleave(4) for x in seen.unbind(1))
    template = CORNERS.repeat(len(seen), 1)
    point = se3.transform(sign[of_sign], torch.nn.functional.pad(template * 0.7, (0, 1)))
    ray = se3.transform(se3.inverse(true)[of_frame], point)
    px = FOCAL * ray[:, :2] / ray[:, 2:] + PIXEL * normal(len(ray), 2)
    matrix = torch.diag(torch.tensor([FOCAL, FOCAL, 1], dtype=F64)).repeat(len(px), 1, 1)
    matrix[:, :2, 2] = -px
    term = CostTerm(
        sign_reprojection,
        (("pose", of_frame), ("sign", of_sign), ("size", of_sign)),
        (template, matrix),
        torch.full((len(px),), 1 / PIXEL, dtype=F64),
        jacobian=sign_reprojection_jacobian,
    )
    count = len(seen)
    detections = CornerDetections(
        run=torch.arange(count).repeat_interleave(4),
        rank=torch.arange(4).repeat(count),
        most=4,
        count=torch.full((count,), 4.0, dtype=F64),
        first=4 * torch.arange(count),
        frame=seen[:, 0],
        order=torch.arange(count),
        track=torch.arange(count),
        follower=torch.full((count,), -1),
    )
    values = {"pose": given.clone(), "sign": sign, "size": size}
    covariance = torch.eye(6, dtype=F64)
    for _ in range(6):
        blocks = row_blocks(term, VARIABLES, values).added_up(of_frame, FRAMES)
        information = blocks.hessian[0, 0].movedim(-1, 0) + torch.diag(SIGMA**-2)
        gradient = blocks.gradient[0].mT + _deviation(given, values["pose"]) / SIGMA**2
        covariance = torch.linalg.inv(information)
        step = -(covariance @ gradient[..., None])[..., 0]
        values["pose"] = se3.retract(values["pose"], step)
    return Views(term, detections, values, covariance, given, true)


def hold_off(seen: Views, strength: Tensor) -> CostTerm:
    first = seen.detections.first
    (_, frame), (_, sign), *_ = seen.term.slots
    return noise_pull_term(frame[first], sign[first], strength)


@pytest.mark.parametrize("true_share", [0.0, 0.3, 0.7, 1.0])
def test_noise_draws_signs_near_and_they_are_held_off_by_as_much(true_share: float):
    """In the mean of some draws; as much as errors are smaller than they are taken to be, and not at all where they are."""
    every = [views(true_share, seed) for seed in range(8)]
    pull = fmean(seen.slope(seen.term) for seen in every)
    whole = -fmean(seen.slope(hold_off(seen, seen.strength())) for seen in every)
    left = fmean(seen.slope(seen.term, hold_off(seen, seen.strength(true_share))) for seen in every)
    assert whole > 100.0
    assert pull == pytest.approx((1 - true_share**2) * whole, abs=0.1 * whole)
    assert abs(left) < 0.1 * whole


def test_detections_that_are_given_up_hold_nothing_off():
    seen = views(0.0)
    weight = seen.term.weight
    assert weight is not None
    gone = seen.detections.run < 100
    without = replace(seen, term=replace(seen.term, weight=torch.where(gone, 0.0, weight)))
    assert not without.strength()[:100].any()
    assert (without.strength()[100:] > 0).any()


def test_its_derivatives_are_those_of_the_residual():
    g = torch.Generator().manual_seed(1)
    camera, sign = (
        se3.retract(torch.eye(4, dtype=F64)[None], torch.randn(1, 6, generator=g, dtype=F64))
        for _ in range(2)
    )
    strength = torch.tensor([3.0], dtype=F64)

    def moved(by_camera: Tensor, by_sign: Tensor) -> Tensor:
        one, other = se3.retract(camera, by_camera[None]), se3.retract(sign, by_sign[None])
        return nearness(one.movedim(0, -1), other.movedim(0, -1), strength)[:, 0]

    zero = torch.zeros(6, dtype=F64)
    found = nearness_jacobian(camera.movedim(0, -1), sign.movedim(0, -1), strength)
    for J, expected in zip(dense(found[1]), jacrev(moved, (0, 1))(zero, zero), strict=True):
        torch.testing.assert_close(J[..., 0], expected)


def test_an_adjustment_ends_with_it(adjusted: Adjusted):
    bundle = adjusted.bundle
    assert "noise_pull" in bundle.problem().terms
    assert len(bundle.held_off) == len(bundle.detections.count)
    assert (bundle.held_off >= 0).all() and bundle.held_off.isfinite().all()
    assert (bundle.held_off > 0).any()
    # As much of it as errors of poses are smaller than they are taken to be.
    strength = bundle.problem().terms["noise_pull"].constants[0]
    share = (1 - bundle.share_there).clamp_min(0)
    torch.testing.assert_close(strength, share.sqrt() * bundle.held_off)
    # What is known of the map does not come from it.
    assert "noise_pull" not in bundle.information(bundle.prior_scale).terms


def test_the_method_of_the_paper_has_none_of_it(street: Street):
    config = replace(AdjustConfig(), method="paper2017", lm=LmConfig(max_iterations=1))
    bundle = street.bundle(config=config)
    adjust.adjust(bundle)
    assert "noise_pull" not in bundle.problem().terms
    assert not bundle.held_off.any()


def test_every_convoy_has_that_of_its_own_detections(adjusted: Adjusted):
    bundle = adjusted.bundle
    count = len(bundle.prior_scale)
    for name in ("held_off", "innovation"):
        each = [convoy(bundle, None, n, n + 1).kept[name] for n in range(count)]
        assert all(len(own) for own in each)
        assert torch.equal(torch.cat(each), getattr(bundle, name))
