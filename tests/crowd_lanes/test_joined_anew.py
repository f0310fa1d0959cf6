from __future__ import annotations

import numpy as np
import pytest
import torch
from worlds import lane_world

from crowdmap_torch.crowd_lanes.join import JoinedLanes, LaneJoinConfig, join_lanes
from crowdmap_torch.crowd_lanes.joined_anew import joined_anew, share_twice
from crowdmap_torch.noise.positioning import PositioningNoise
from crowdmap_torch.tables import LANE_TYPES, Lanes, concatenate_lanes

NOISE, CONFIG = PositioningNoise(), LaneJoinConfig()
APART = 1.5
"""How far beside where they were half of the drives are taken to be [m]: nearer, their pieces are of one marker at once."""
FRAMES = 100


def straight(offset: float, first: float = 0.0, last: float = 200.0) -> np.ndarray:
    """Control points 10 m apart, `offset` left of the x axis."""
    x = np.arange(first, last + 1, 10.0)
    return np.stack((x, np.full_like(x, offset), np.zeros_like(x)), axis=1)


def pieces_of(journey: int, offsets: list[float], seed: int = 0) -> Lanes:
    """What one drive made of markers that lie at these offsets, one piece each."""
    rng = np.random.default_rng((seed, journey))
    n = len(offsets)
    control = [straight(o) + 0.02 * rng.normal(size=(21, 3)) for o in offsets]
    kind, number = [LANE_TYPES.index("solid")] * n, list(range(n))
    return lane_world.pieces(
        control, type=kind, journey=[journey] * n, tracklet=number, frame=[50] * n
    )


def moved_by(across: float) -> torch.Tensor:
    """Tangents of all frames that move a drive across the road."""
    drift = torch.zeros(FRAMES, 6, dtype=torch.float64)
    drift[:, 1] = across
    return drift


def anew(
    adjusted: Lanes, made: list[Lanes], across: list[float], config: LaneJoinConfig = CONFIG
) -> JoinedLanes | None:
    sound = [torch.ones(FRAMES, dtype=torch.bool)] * len(made)
    return joined_anew(adjusted, made, [moved_by(a) for a in across], sound, NOISE, config)


@pytest.mark.parametrize("seed", [0, 1])
def test_markers_of_drives_that_were_beside_themselves_are_made_one(seed: int) -> None:
    at = [0.0, 0.0, 0.0, APART, APART, APART]
    made = [pieces_of(k, [a, a + 3.5], seed) for k, a in enumerate(at)]
    before = join_lanes(concatenate_lanes(made), NOISE, CONFIG).lanes
    assert len(before) == 4 and share_twice(before, CONFIG.twice_within_m) == 0
    # As the adjustment has them: in one place.
    adjusted = concatenate_lanes([pieces_of(k, [0.0, 3.5], seed) for k in range(2)])
    assert share_twice(adjusted, CONFIG.twice_within_m) == pytest.approx(1.0, abs=0.01)

    found = anew(adjusted, made, [-a for a in at])
    assert found is not None and len(found.lanes) == 2
    assert int(found.lanes.n_journeys.min()) == 6
    across = found.lanes.control.point_world[:, 1]
    assert float(torch.minimum(across.abs(), (across - 3.5).abs()).max()) < 0.05
    # The support is of the new markers.
    assert set(found.support.lane.unique().tolist()) <= {-1, 0, 1}


def test_markers_that_are_once_stay_as_they_are() -> None:
    made = [pieces_of(k, [0.0, 3.5]) for k in range(4)]
    assert anew(made[0], made, [0.0] * 4) is None


def test_two_markers_side_by_side_stay_two() -> None:
    # Half a metre apart as drives see them, and drawn nearer to each other by the adjustment.
    made = [pieces_of(k, [0.0, 0.5]) for k in range(5)]
    adjusted = pieces_of(0, [0.0, 0.4])
    assert share_twice(adjusted, CONFIG.twice_within_m) == pytest.approx(1.0, abs=0.01)
    found = anew(adjusted, made, [0.0] * 5)
    # Joined anew they are two, further apart: nothing is lost by it.
    assert found is None or len(found.lanes) == 2
    # As near as that in all pieces they stay twice: as good as before.
    near = [pieces_of(k, [0.0, 0.44]) for k in range(5)]
    assert anew(adjusted, near, [0.0] * 5) is None


def test_what_bad_drives_saw_is_not_joined() -> None:
    made = [pieces_of(k, [0.0]) for k in range(4)]
    adjusted = concatenate_lanes(made[:2])
    sound = [torch.full((FRAMES,), k < 3) for k in range(4)]
    found = joined_anew(adjusted, made, [moved_by(0.0)] * 4, sound, NOISE, CONFIG)
    assert found is not None
    assert found.support.journey.unique().tolist() == [0, 1, 2]


def test_a_share_is_of_both_lanes() -> None:
    whole = pieces_of(0, [0.0, 3.5, 7.0])
    assert share_twice(whole, 0.45) == 0
    short = lane_world.pieces(
        [straight(0.2, 50.0, 100.0)], type=[0], journey=[1], tracklet=[0], frame=[50]
    )
    both = concatenate_lanes([whole, short])
    # 50 m twice, of 650.
    assert share_twice(both, 0.45) == pytest.approx(100 / 650, abs=0.01)
    none = whole.select(torch.zeros(0, dtype=torch.int64))
    assert share_twice(none, 0.45) == 0
