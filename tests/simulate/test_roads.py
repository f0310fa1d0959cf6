from __future__ import annotations

import numpy as np
import pytest

from crowdmap_torch.simulate.roads import Road, RoadShape, block_road, open_road


def _rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


@pytest.fixture(params=["open", "block"])
def road(request) -> Road:
    shape = RoadShape(heading_deg=28, heading_wavelength_m=350, grade=0.06, bank_deg=4)
    build = open_road if request.param == "open" else block_road
    return build(shape, 600.0, _rng())


def test_leftwards_is_where_offsets_grow(road: Road):
    station = np.linspace(0, road.length, 20)
    left = road.leftwards(station)
    step = road.surface(station, np.ones(20)) - road.surface(station, np.zeros(20))
    assert np.abs(left - step).max() < 1e-12
    # Between samples of the centre line it is the mean of two of them: 0.1 m of a 15 m curve.
    assert np.abs(np.linalg.norm(left, axis=-1) - 1).max() < 1e-4


def test_tangent_frame_agrees_with_the_surface(road: Road):
    rng = _rng(1)
    station, offset = rng.uniform(20, road.length - 20, 200), rng.uniform(-8, 8, 200)
    R = road.tangent_frame(station, offset)
    # Central differences over 0.4 m, four samples of the centre line, see its chords: 2e-3 rad.
    step = 0.2
    along = road.surface(station + step, offset) - road.surface(station - step, offset)
    along /= np.linalg.norm(along, axis=-1, keepdims=True)
    assert np.abs(along - R[:, :, 0]).max() < 2e-3
    aside = road.surface(station, offset + step) - road.surface(station, offset - step)
    assert np.abs((aside * R[:, :, 2]).sum(-1)).max() < 1e-9
    np.testing.assert_allclose(
        R @ R.transpose(0, 2, 1), np.tile(np.eye(3), (200, 1, 1)), atol=1e-12
    )
    assert (np.linalg.det(R) > 0).all()


@pytest.mark.parametrize("seed", range(5))
def test_block_closes(seed: int):
    road = block_road(RoadShape(grade=0.02, bank_deg=2), 600.0, _rng(seed))
    ends = np.array([0.0, road.length - 1e-9])
    for offset in (-4.0, 4.0):
        gap = np.diff(road.surface(ends, np.full(2, offset)), axis=0)
        assert np.linalg.norm(gap) < 1e-6
    # The last step is as long as any other: what was left open is spread over the whole round.
    steps = np.linalg.norm(np.diff(road.centre, axis=0), axis=-1)
    assert np.ptp(steps) < 2e-3 * steps.mean()
    assert np.ptp(road.centre[:, 0]) > 50 and np.ptp(road.centre[:, 1]) > 50


def test_hills_are_as_steep_as_asked_for():
    road = open_road(RoadShape(grade=0.06, bank_deg=4.0), 5000.0, _rng())
    slope = np.tan(np.arcsin(road.forward[:, 2]))
    bank = np.degrees(np.arcsin(road.left[:, 2] / np.hypot(road.forward[:, 0], road.forward[:, 1])))
    assert 0.05 < np.abs(slope).max() <= 0.06 + 1e-9
    assert 3.2 < np.abs(bank).max() <= 4.05
