"""What observations tell of poses' errors: estimates that follow the prior count for nothing."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from worlds.pose_priors import make_prior

from crowdmap_torch.noise.pose_evidence import sampled_changes, share_told, white_scales
from crowdmap_torch.noise.pose_prior import PosePrior
from crowdmap_torch.optim.solvers.normal_equations import ChainChanges

F64 = torch.float64


def changes_of(prior: PosePrior) -> ChainChanges:
    """Those of the drift that are asked for."""
    return sampled_changes(prior, prior.far, torch.eye(prior.numbers, dtype=F64))


def test_changes_are_told_by_what_is_left_of_their_variance():
    prior = make_prior(3)
    scale = torch.tensor([[1.0, 2.0, 0.5]], dtype=F64).expand(3, 3)
    changes = changes_of(prior)
    journey = prior.nodes.journey[changes.pair]
    assert torch.equal(journey[:, 0], journey[:, 1]) and set(journey.flatten().tolist()) == {
        0,
        1,
        2,
    }
    gap = (prior.nodes.way[changes.pair[:, 1]] - prior.nodes.way[changes.pair[:, 0]])[:, None]
    # Of a Gauss-Markov chain, by its sigma and its length.
    sigma = prior.drift_sigma[journey[:, 0]] * scale[0, 1:].repeat_interleave(3)
    of_prior = 2 * sigma.square() * (1 - torch.exp(-gap / prior.length_m[journey[:, 0]]))
    for left, told in ((1.0, 0.0), (0.25, 0.75), (0.0, 1.0), (1.2, 0.0)):
        found = share_told(prior, changes, left * of_prior, scale)
        torch.testing.assert_close(found, torch.full((3, 6), told, dtype=F64))


def test_no_more_changes_are_asked_for_than_are_solved_at_once():
    short, long = (changes_of(make_prior(2, way_m=way)) for way in (400.0, 9000.0))
    for changes, most in ((short, 3), (long, 16)):
        assert changes.columns == 16 and torch.bincount(changes.column).tolist() == [2] * most
    assert len(changes_of(make_prior(2, way_m=50.0)).pair) == 0
    many = changes_of(make_prior(60, way_m=400.0))
    assert many.columns == 1 and many.whose.tolist() == list(range(60))


def estimated(noise: Tensor, sigma: Tensor, seen: Tensor) -> tuple[Tensor, Tensor]:
    """Means and variances of numbers drawn by `sigma`, each seen with a noise of its own `seen`."""
    generator = torch.Generator().manual_seed(5)
    measured = noise + seen * torch.randn(noise.shape, generator=generator, dtype=F64)
    left = 1 / (1 / seen.square() + 1 / sigma**2)
    return measured * left / seen.square(), left


@pytest.mark.parametrize(
    "by_axis",
    [(0.5,) * 6, (1.0,) * 6, (2.0,) * 6, (4.0,) * 6, (4, 1, 0.5, 1, 3, 1), (1, 2, 6, 5, 1, 2)],
)
@pytest.mark.parametrize("seen", ["all", "few"])
def test_noise_from_frame_to_frame_is_found_whatever_it_was_taken_for(
    by_axis: tuple[float, ...], seen: str
):
    # Short stretches: within long ones the drift moves by more than this noise.
    prior = make_prior(3, way_m=400.0, spacing_m=0.25)
    poses, generator = len(prior.nodes.of_frame), torch.Generator().manual_seed(2)
    ones, scale = torch.ones(3, 3, dtype=F64), torch.ones(3, 6, dtype=F64)
    within = prior.within_stretch(ones)
    factors = torch.tensor(by_axis, dtype=F64)
    spread = ((factors * prior.white_sigma) ** 2 + within).sqrt()
    noise = spread * torch.randn(poses, 6, generator=generator, dtype=F64)
    # Of a few frames much is seen, of the others next to nothing.
    of_frame = torch.full((poses, 1), 0.3, dtype=F64)
    if seen == "few":
        of_frame[torch.arange(poses) % 4 > 0] = 1e4
    owner = prior.nodes.journey_of_pose
    for _ in range(60):
        sigma = ((scale[owner] * prior.white_sigma) ** 2 + within).sqrt()
        mean, left = zip(
            *(
                estimated(noise[:, k], sigma[:, k], of_frame[:, 0] * prior.white_sigma[k])
                for k in range(6)
            ),
            strict=True,
        )
        residual = torch.stack(mean, dim=1) / sigma
        scale = white_scales(prior, residual, torch.stack(left, dim=1), ones, scale)
    # It is never narrowed.
    expected = factors.clamp_min(1).expand(3, 6)
    assert torch.allclose(scale, expected, rtol=0.15, atol=0.1)


def test_noise_that_nothing_tells_of_is_as_it_is_given():
    prior = make_prior(2)
    ones, scale = torch.ones(2, 3, dtype=F64), torch.ones(2, 6, dtype=F64)
    sigma = prior.white_sigma**2 + prior.within_stretch(ones)
    found = white_scales(prior, torch.zeros_like(sigma), sigma, ones, scale)
    torch.testing.assert_close(found, scale)
