"""Scales of what cars have wrong: what evidence says of them, and what it does not."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from crowdmap_torch.adjustment.calibration import CalibrationConfig, Fleet, fleet_of
from crowdmap_torch.adjustment.calibration_scales import prior_sigmas, rescaled, scale_of
from crowdmap_torch.noise.calibration import KnownCalibration
from crowdmap_torch.optim.linearize import residuals
from crowdmap_torch.optim.solvers.normal_equations import BorderInformation
from crowdmap_torch.tables import Dataset

F64 = torch.float64
ONLY = replace(CalibrationConfig.off(), mount_deg=0.2, box=0.01, lane_m=0.03, in_common=0.3)


def found_with(seen: Tensor, sigma: float, scale: float) -> tuple[Tensor, Tensor]:
    """What is found of numbers that were `seen` with a sigma, those of their prior multiplied by `scale`."""
    variance = 1 / (1 / sigma**2 + 1 / scale**2)
    return seen * variance / sigma**2, variance * torch.eye(len(seen), dtype=F64)


def scale_found(seen: Tensor, sigma: float) -> float:
    """The scale at which it finds itself again."""
    scale = torch.ones((), dtype=F64)
    for _ in range(100):
        scale = scale_of(*found_with(seen, sigma, float(scale)), scale)
    return float(scale)


def normal(count: int, seed: int = 0) -> Tensor:
    drawn = torch.randn(count, generator=torch.Generator().manual_seed(seed), dtype=F64)
    # Of just the variance that is asked for.
    return drawn / drawn.square().mean().sqrt()


def test_what_nothing_tells_stays_as_configured() -> None:
    for count in (1, 3, 50):
        assert scale_found(1e4 * normal(count), 1e6) == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize("true", [0.1, 0.4, 1.0, 2.0])
def test_the_scale_of_many_numbers_is_their_own(true: float) -> None:
    # Of 400 numbers the root mean square is known to 1 / sqrt(800).
    seen = (true**2 + 0.1**2) ** 0.5 * normal(400)
    assert scale_found(seen, 0.1) == pytest.approx(true, rel=0.12)


def test_few_numbers_that_are_not_there_are_found_so() -> None:
    found = [scale_found(0.1 * normal(count), 0.1) for count in (3, 12, 48)]
    # Never nothing, but the less the more numbers agree that it is.
    assert 0.1 > found[2] > 0.02
    assert found[0] > found[1] > found[2]
    assert found[0] < 0.3


def test_a_scale_that_is_right_is_found_from_any_other() -> None:
    seen = normal(12)
    right = scale_found(seen, 0.3)
    for start in (0.1, 5.0):
        scale = torch.tensor(start, dtype=F64)
        found = scale_of(*found_with(seen, 0.3, start), scale)
        # One look is enough where likelihoods are known: what was found is taken apart into what is seen and the prior.
        assert float(found) == pytest.approx(right, rel=1e-6)


def fleet_of_cars(
    dataset: Dataset, cars: str, known: dict[str, KnownCalibration] | None = None
) -> Fleet:
    journey = dataset.journeys[0]
    each = [replace(journey, vehicle_id=name) for name in cars]
    first = torch.arange(len(cars)) * len(journey.t_ns)
    return fleet_of(each, first, torch.arange(len(cars)), ONLY, known or {})


def prior_hessian(fleet: Fleet, scale: Tensor) -> Tensor:
    """Information of the fleet's own rows on all numbers, mounts before optics."""
    terms = fleet.priors(scale).values()

    def cost(flat: Tensor) -> Tensor:
        values, first = {}, 0
        for name, start in fleet.start.items():
            values[name] = flat[first : first + start.numel()].view(start.shape)
            first += start.numel()
        return torch.stack([residuals(t, values).square().sum() / 2 for t in terms]).sum()

    count = sum(start.numel() for start in fleet.start.values())
    hessian = torch.autograd.functional.hessian(cost, torch.zeros(count, dtype=F64))
    assert isinstance(hessian, Tensor)
    return hessian


def rescaled_by(fleet: Fleet, seen: dict[str, Tensor], sigma: dict[str, Tensor]) -> Tensor:
    """Scales where images show all numbers of cars directly, with these sigmas, beside a bias that is nobody's."""
    scale = torch.ones(len(fleet.kinds), dtype=F64)
    flat = torch.cat([seen[name].flatten() for name in fleet.start])
    weight = torch.cat([sigma[name].flatten() for name in fleet.start]) ** -2
    count = len(flat)
    matrix = torch.eye(count + 2, dtype=F64)
    matrix[2:, 2:] = torch.diag(weight) + prior_hessian(fleet, scale)
    value = torch.linalg.solve(matrix[2:, 2:], weight * flat)
    entries, values, first = {}, {}, 0
    for name, start in fleet.start.items():
        at = torch.arange(first, first + start.numel()).view(start.shape)
        entries[name], values[name] = at + 2, value[at]
        first += start.numel()
    return rescaled(fleet, values, BorderInformation(matrix, entries), scale)


def test_that_cars_are_alike_says_nothing_of_how_far_off_they_are_together(tiny: Dataset) -> None:
    fleet = fleet_of_cars(tiny, "abcdef")
    seen = {"mount": normal(18).view(6, 3), "optics": torch.zeros(6, 2, dtype=F64)}
    # Boxes of all cars are as much too large, and lane points nobody sees.
    seen["optics"][:, 0] = 1.0
    sigma = {name: torch.full_like(part, 0.05) for name, part in seen.items()}
    sigma["optics"][:, 1] = 1e6
    mount, box, lane = rescaled_by(fleet, seen, sigma)
    assert 0.7 < float(mount) <= 1
    assert float(box) < 0.15
    assert float(lane) == pytest.approx(1.0, abs=0.02)
    # The mean of six boxes is held by what is configured: 0.42 of a variance of one.
    sigmas = prior_sigmas(fleet, torch.stack((mount, box, lane)))
    assert 0.41 < float(sigmas["optics"][0, 0]) ** 2 < 0.44


def test_rows_and_sigmas_of_a_scaled_prior_are_the_same(tiny: Dataset) -> None:
    fleet = fleet_of_cars(tiny, "abcd", {"b": {"box": ((0.001,), (0.002,))}})
    scale = torch.tensor([0.5, 0.4, 0.9], dtype=F64)
    covariance = torch.linalg.inv(prior_hessian(fleet, scale))
    found = prior_sigmas(fleet, scale)
    stated = torch.cat([found[name].flatten() for name in fleet.start])
    torch.testing.assert_close(covariance.diagonal().sqrt(), stated)
    # What was found before is as sure as it was then.
    assert float(found["optics"][1, 0]) == pytest.approx(0.2)


def test_one_car_has_no_scale(tiny: Dataset) -> None:
    known: dict[str, KnownCalibration] = {"b": {"mount_deg": ((0.8,) * 3, (0.01,) * 3)}}
    for cars in ("a", "ab"):
        fleet = fleet_of_cars(tiny, cars, known)
        seen = {name: torch.zeros_like(part) for name, part in fleet.start.items()}
        sigma = {name: torch.full_like(part, 0.05) for name, part in seen.items()}
        # What was found of the other one before says nothing of how far cars are apart.
        assert float(rescaled_by(fleet, seen, sigma)[0]) == 1.0
