"""Scales of what cars have wrong: what evidence says of them, and what it does not."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from crowdmap_torch.adjustment.calibration import CalibrationConfig, Fleet, fleet_of
from crowdmap_torch.adjustment.calibration_priors import (
    CalibrationScales,
    prior_sigmas,
    priors,
    variances,
)
from crowdmap_torch.adjustment.calibration_scales import prior_information, rescaled, scale_of
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


def scales_of(fleet: Fleet, *of_kind: float) -> CalibrationScales:
    """Scales by kind, ones for none, and no car beyond them."""
    kinds = torch.tensor(of_kind or (1.0,) * len(fleet.kinds), dtype=F64)
    numbers = sum(start.shape[1] for start in fleet.expected.values())
    return CalibrationScales(kinds, torch.ones(len(fleet.vehicles), numbers, dtype=F64))


def prior_hessian(fleet: Fleet, scales: CalibrationScales) -> Tensor:
    """Information of the fleet's own rows on all numbers, mounts before optics."""
    terms = priors(fleet, scales).values()

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


def rescaled_by(
    fleet: Fleet, seen: dict[str, Tensor], sigma: dict[str, Tensor]
) -> CalibrationScales:
    """Scales where images show all numbers of cars directly, with these sigmas, beside a bias that is nobody's."""
    scales = scales_of(fleet)
    flat = torch.cat([seen[name].flatten() for name in fleet.start])
    weight = torch.cat([sigma[name].flatten() for name in fleet.start]) ** -2
    count = len(flat)
    matrix = torch.eye(count + 2, dtype=F64)
    matrix[2:, 2:] = torch.diag(weight) + prior_hessian(fleet, scales)
    value = torch.linalg.solve(matrix[2:, 2:], weight * flat)
    entries, values, first = {}, {}, 0
    for name, start in fleet.start.items():
        at = torch.arange(first, first + start.numel()).view(start.shape)
        entries[name], values[name] = at + 2, value[at]
        first += start.numel()
    return rescaled(fleet, values, BorderInformation(matrix, entries), scales)


def test_that_cars_are_alike_says_nothing_of_how_far_off_they_are_together(tiny: Dataset) -> None:
    fleet = fleet_of_cars(tiny, "abcdef")
    seen = {"mount": normal(18).view(6, 3), "optics": torch.zeros(6, 2, dtype=F64)}
    # Boxes of all cars are as much too large, and lane points nobody sees.
    seen["optics"][:, 0] = 1.0
    sigma = {name: torch.full_like(part, 0.05) for name, part in seen.items()}
    sigma["optics"][:, 1] = 1e6
    mount, box, lane = rescaled_by(fleet, seen, sigma).of_kind
    assert 0.7 < float(mount) <= 1
    assert float(box) < 0.15
    assert float(lane) == pytest.approx(1.0, abs=0.02)
    # The mean of six boxes is held by what is configured: 0.42 of a variance of one.
    sigmas = prior_sigmas(fleet, scales_of(fleet, float(mount), float(box), float(lane)))
    assert 0.41 < float(sigmas[0, 3]) ** 2 < 0.44


def test_rows_and_sigmas_of_a_scaled_prior_are_the_same(tiny: Dataset) -> None:
    fleet = fleet_of_cars(tiny, "abcd", {"b": {"box": ((0.001,), (0.002,))}})
    scales = scales_of(fleet, 0.5, 0.4, 0.9)
    scales.far[2, 1], scales.far[3, 3], scales.far[1, 3] = 5.0, 3.0, 7.0
    covariance = torch.linalg.inv(prior_hessian(fleet, scales))
    found = prior_sigmas(fleet, scales)
    stated = torch.cat([part.flatten() for part in found.split([3, 2], dim=1)])
    torch.testing.assert_close(covariance.diagonal().sqrt(), stated)
    # What was found before is as sure as it was then.
    assert float(found[1, 3]) == pytest.approx(0.2)
    # The mount of the third car has a sigma of its own.
    assert float(found[2, 1]) ** 2 == pytest.approx(float(found[1, 1]) ** 2 + 5**2 - 1)
    information = prior_information(variances(fleet, scales))
    torch.testing.assert_close(torch.linalg.inv(information).diagonal().sqrt(), found.flatten())


@pytest.mark.parametrize("cars", ["abc", "abcdefgh"])
def test_a_car_that_is_far_off_is_not_held_back(tiny: Dataset, cars: str) -> None:
    fleet = fleet_of_cars(tiny, cars)
    seen = {
        "mount": 0.3 * normal(3 * len(cars)).view(len(cars), 3),
        "optics": 0.3 * normal(2 * len(cars), 1).view(len(cars), 2),
    }
    # A mount of 2 degrees where sigmas are 0.2, and a box that is 8 % too large where they are 1 %.
    seen["mount"][0, 1], seen["optics"][0, 0] = 10.0, 8.0
    sigma = {name: torch.full_like(part, 0.4) for name, part in seen.items()}
    scales = rescaled_by(fleet, seen, sigma)
    information = prior_hessian(fleet, scales)
    weight = torch.full_like(information.diagonal(), 0.4**-2)
    flat = torch.cat([seen[name].flatten() for name in fleet.start])
    covariance = torch.linalg.inv(torch.diag(weight) + information)
    missed = (covariance @ (weight * flat) - flat) / covariance.diagonal().sqrt()
    # As configured it would be held back by 1.4 degrees' worth: three sigmas and a half.
    far = torch.tensor([1, 3 * len(cars)])
    assert float(missed[far].abs().max()) < 0.6
    assert float(scales.far[0, 1]) > 3 and float(scales.far[0, 3]) > 3
    assert float(scales.far[1:].max()) < 1.5


def test_what_all_cars_are_off_alike_is_no_cars_own(tiny: Dataset) -> None:
    for cars in ("a", "abcd"):
        fleet = fleet_of_cars(tiny, cars)
        seen = {name: torch.zeros_like(part) for name, part in fleet.start.items()}
        seen["mount"][:, 1] = 10.0
        sigma = {name: torch.full_like(part, 0.1) for name, part in seen.items()}
        assert float(rescaled_by(fleet, seen, sigma).far.max()) < 1.01


def test_cars_that_err_as_configured_have_no_tails(tiny: Dataset) -> None:
    fleet = fleet_of_cars(tiny, "abcdefgh")
    seen = {"mount": normal(24).view(8, 3), "optics": normal(16, 1).view(8, 2)}
    sigma = {name: torch.full_like(part, 0.3) for name, part in seen.items()}
    far = rescaled_by(fleet, seen, sigma).far
    assert float(far.max()) < 1.5
    # Of normal numbers the mean is 0.07.
    assert float(far.log().mean()) < 0.1


def test_a_fleet_that_errs_less_than_configured_has_no_tails(tiny: Dataset) -> None:
    fleet = fleet_of_cars(tiny, "abcdefgh")
    seen = {"mount": 0.2 * normal(24).view(8, 3), "optics": 0.2 * normal(16, 1).view(8, 2)}
    sigma = {name: torch.full_like(part, 0.1) for name, part in seen.items()}
    found = rescaled_by(fleet, seen, sigma)
    assert float(found.of_kind.max()) < 0.5
    assert bool((found.far == 1).all())


def test_one_car_has_no_scale(tiny: Dataset) -> None:
    known: dict[str, KnownCalibration] = {"b": {"mount_deg": ((0.8,) * 3, (0.01,) * 3)}}
    for cars in ("a", "ab"):
        fleet = fleet_of_cars(tiny, cars, known)
        seen = {name: torch.zeros_like(part) for name, part in fleet.start.items()}
        sigma = {name: torch.full_like(part, 0.05) for name, part in seen.items()}
        # What was found of the other one before says nothing of how far cars are apart.
        assert float(rescaled_by(fleet, seen, sigma).of_kind[0]) == 1.0
