from __future__ import annotations

import pytest
import torch
from torch import Tensor
from worlds.road_drives import angle_deg, blind_journey, poses_on_plane

from crowdmap_torch.geometry import se3
from crowdmap_torch.road.coplanarity import (
    COSTS,
    CoplanarityConfig,
    NormalUpdates,
    coplanar_normals,
    pick_nodes,
)
from crowdmap_torch.road.ego_motion import motion_of_poses

F64 = torch.float64
PITCH, ROLL = 0.02, -0.015


def bends(frames: int = 500) -> Tensor:
    return 0.8 * torch.sin(torch.arange(frames, dtype=F64) * 0.8 / 20)


def normals(poses: Tensor, config: CoplanarityConfig, *, every: int = 100) -> NormalUpdates:
    """Updates at every some frames of a drive with these poses."""
    journey = blind_journey(poses)
    motion = motion_of_poses(poses, journey.t_ns, torch.eye(3, dtype=F64))
    station = torch.cat((motion.station[:1], motion.station)).cummax(0)[0]
    frame = torch.arange(every, len(poses), every)
    nodes = pick_nodes(motion, station, config)
    return coplanar_normals(
        nodes, frame, station[1:][frame], 1.5, torch.zeros(2, dtype=F64), config
    )


@pytest.mark.parametrize("cost", sorted(COSTS))
def test_pitch_and_roll_of_exact_poses_in_bends(cost: str) -> None:
    found = normals(poses_on_plane(bends(), 0.8, pitch=PITCH, roll=ROLL), CoplanarityConfig(cost))
    normal = torch.stack((found.beta, torch.ones_like(found.beta), found.alpha), dim=-1)
    true = torch.nn.functional.normalize(torch.tensor([ROLL, 1.0, PITCH], dtype=F64), dim=-1)
    off = angle_deg(torch.nn.functional.normalize(normal, dim=-1), true[None])
    assert len(found.frame) == 4
    assert float(off.max()) < 0.02


def test_a_straight_road_does_not_decide_the_roll() -> None:
    poses = poses_on_plane(0 * bends(), 0.8, pitch=PITCH)
    generator = torch.Generator().manual_seed(0)
    noise = torch.randn(len(poses), 6, dtype=F64, generator=generator)
    noise = noise * torch.tensor([0.02] * 3 + [1e-4] * 3, dtype=F64)
    straight = normals(se3.retract(poses, noise), CoplanarityConfig())
    bending = normals(
        se3.retract(poses_on_plane(bends(), 0.8, pitch=PITCH), noise), CoplanarityConfig()
    )
    assert float(straight.sigma[-1]) > 2 * float(bending.sigma[-1])


def test_too_few_segments_start_no_update() -> None:
    poses = poses_on_plane(bends(60), 0.8, pitch=PITCH)
    assert len(normals(poses, CoplanarityConfig(min_segments=3), every=20).frame) == 0
    assert len(normals(poses, CoplanarityConfig(min_segments=2), every=20).frame) == 0
    assert len(normals(poses, CoplanarityConfig(min_segments=1), every=20).frame) == 1


def test_nodes_are_the_first_poses_of_their_cells() -> None:
    poses = poses_on_plane(torch.zeros(60, dtype=F64), 0.3)
    motion = motion_of_poses(poses, torch.arange(60), torch.eye(3, dtype=F64))
    station = torch.cat((motion.station[:1], motion.station))
    config = CoplanarityConfig(segment_m=10.0, poses=10)
    nodes = pick_nodes(motion, station, config)
    assert nodes.cell.tolist() == list(range(1, 18))
    place = nodes.position[:, 0] - poses[0, 0, 3]
    assert ((place - nodes.cell >= -1e-9) & (place - nodes.cell < 0.3)).all()


def test_unknown_cost_is_refused() -> None:
    with pytest.raises(ValueError, match="cost: expected one of"):
        CoplanarityConfig(cost="guess")
