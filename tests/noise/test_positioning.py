"""The path of the drift: where places lie on it, and how its spread grows."""

from __future__ import annotations

import pytest
import torch

from crowdmap_torch.noise.positioning import (
    DriftPathConfig,
    PositioningNoise,
    drift_terms,
    knot_count,
    places_on_path,
)
from crowdmap_torch.optim.problem import Problem, Variable, euclidean
from crowdmap_torch.optim.solvers.dense import DenseBackend

F64 = torch.float64
NOISE = PositioningNoise(
    drift_sigma_m=1.4, drift_length_m=400.0, rotation_sigma_deg=0.8, rotation_length_m=400.0
)
CONFIG = DriftPathConfig()


def test_places_lie_between_their_knots():
    station = torch.tensor([0.0, 1.0, 4.0, 6.5, 12.0], dtype=F64)
    places = places_on_path(station, CONFIG)
    knots = knot_count(station, CONFIG)
    assert int(places.before.max()) + 1 < knots
    at_knots = (torch.arange(knots) * CONFIG.knot_m)[:, None].expand(-1, 8).to(F64)
    torch.testing.assert_close(places.drift(at_knots)[:, 0], station)


@pytest.mark.parametrize("scale", [0.5, 1.0])
def test_the_drift_grows_with_the_root_of_the_way_and_has_an_end(scale):
    knots = 200
    terms = drift_terms(knots, scale, torch.zeros(1, dtype=F64), NOISE, CONFIG)
    problem = Problem({"drift": Variable(8, euclidean)}, terms)
    normal = DenseBackend().assemble(problem, {"drift": torch.zeros(knots, 8, dtype=F64)})
    covariance = torch.linalg.inv(normal.hessian[0])

    def spread(knot: int, other: int, part: int) -> float:
        a, b = 8 * knot + part, 8 * other + part
        change = covariance[a, a] + covariance[b, b] - 2 * covariance[a, b]
        return float(change.sqrt())

    for part, sigma in ((0, NOISE.walk_m), (4, NOISE.walk_rad)):
        # Over a short way it is a walk; of what it was nothing is left in the end.
        walk = scale * sigma * CONFIG.knot_m**0.5
        assert spread(50, 51, part) == pytest.approx(walk, rel=0.01)
        assert spread(50, 54, part) == pytest.approx(2 * walk, rel=0.02)
        far = scale * sigma * (NOISE.drift_length_m / 2) ** 0.5
        for knot in (0, 100, 199):
            own = covariance[8 * knot + part, 8 * knot + part].sqrt()
            assert float(own) == pytest.approx(far, rel=1e-3)
    # How the camera stands in the car does not drift with the poses.
    assert float(covariance[6, 6].sqrt()) == pytest.approx(CONFIG.slip_sigma_rad, rel=1e-3)
    assert spread(0, 199, 6) < 0.05 * CONFIG.slip_sigma_rad
