from __future__ import annotations

import torch
from worlds.road_drives import blind_journey, poses_on_plane

from crowdmap_torch.geometry import se3
from crowdmap_torch.road.ego_motion import (
    motion_of,
    motion_of_poses,
    normal_camera,
    road_frame,
    slopes_of_normal,
)

F64 = torch.float64


def test_slopes_and_normals_are_inverse(generator: torch.Generator) -> None:
    journey = blind_journey(poses_on_plane(torch.zeros(3, dtype=F64), 1.0), normal=(0.1, 1.0, 0.05))
    R = road_frame(journey.rig)
    alpha, beta = 0.05 * torch.randn(2, 20, dtype=F64, generator=generator)
    torch.testing.assert_close(slopes_of_normal(normal_camera(alpha, beta, R), R), (alpha, beta))
    torch.testing.assert_close(R @ R.T, torch.eye(3, dtype=F64))
    torch.testing.assert_close(R[1], journey.rig.road_normal_camera)


def test_alpha_and_beta_are_the_tilt_on_a_level_road() -> None:
    heading = torch.linspace(0, 2, 50, dtype=F64)
    motion = motion_of(blind_journey(poses_on_plane(heading, 0.8, pitch=0.02, roll=-0.01)))
    torch.testing.assert_close(motion.alpha, torch.full_like(heading, 0.02))
    torch.testing.assert_close(motion.beta, torch.full_like(heading, -0.01))
    torch.testing.assert_close(motion.turn[1:], -heading.diff())


def test_ways_add_up_to_the_distance_driven_and_backwards_counts_less() -> None:
    heading = torch.zeros(40, dtype=F64)
    step = torch.where(torch.arange(40) < 30, 0.8, -0.5).to(F64)
    motion = motion_of(blind_journey(poses_on_plane(heading, step)))
    torch.testing.assert_close(motion.station[-1], step[1:].sum())
    torch.testing.assert_close(motion.advance[1:], step[1:])
    assert float(motion.advance[0]) == float(motion.turn[0]) == 0.0


def test_motion_does_not_depend_on_where_the_world_is_or_where_north_lies() -> None:
    heading = torch.linspace(2.5, 4.5, 60, dtype=F64)  # over the jump of atan2
    journey = blind_journey(poses_on_plane(heading, 0.8, pitch=0.03, roll=0.01))
    T_there_world = se3.exp(torch.tensor([500.0, -300.0, 40.0, 0, 0, 2.0], dtype=F64))
    here = motion_of(journey)
    there = motion_of_poses(
        T_there_world @ journey.T_world_camera, journey.t_ns, here.R_road_camera
    )
    for name in ("alpha", "beta", "advance", "turn", "t_s"):
        # Positions are hundreds of metres.
        torch.testing.assert_close(getattr(there, name), getattr(here, name), atol=1e-10, rtol=0)


def test_a_motion_can_be_cut() -> None:
    motion = motion_of(blind_journey(poses_on_plane(torch.linspace(0, 1, 9, dtype=F64), 0.8)))
    part = motion[2:5]
    assert len(part) == 3
    assert torch.equal(part.alpha, motion.alpha[2:5])
    assert torch.equal(part.R_road_camera, motion.R_road_camera)
    assert len(motion_of(blind_journey(poses_on_plane(torch.zeros(0, dtype=F64), 0.8)))) == 0
