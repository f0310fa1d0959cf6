from __future__ import annotations

import torch
from worlds.road_drives import blind_journey, poses_on_plane

from crowdmap_torch.geometry import se3
from crowdmap_torch.road.dead_reckoning import Slip, dead_reckon, direction, fit_slip, headings
from crowdmap_torch.road.ego_motion import motion_of

F64 = torch.float64


def test_headings_are_continuous_through_a_full_turn() -> None:
    heading = torch.linspace(0, 7, 90, dtype=F64)
    motion = motion_of(blind_journey(poses_on_plane(heading, 0.8)))
    torch.testing.assert_close(headings(motion), heading)


def test_reckoning_gives_the_drive_where_poses_are_exact() -> None:
    heading = 0.8 * torch.sin(torch.arange(200, dtype=F64) * 0.8 / 25)
    poses = poses_on_plane(heading, 0.8)
    motion = motion_of(blind_journey(poses))
    still = heading[0] * 0
    across, up = dead_reckon(motion, 0 * motion.alpha, Slip(still, still))
    driven = poses[:, :2, 3] - poses[0, :2, 3]
    # The chord of an arc of 0.8 m is taken for the arc: a bend of 1 / 25 m, over 160 m.
    torch.testing.assert_close(across - across[0], driven, atol=0.02, rtol=0)
    assert float(up.abs().max()) == 0.0


def test_a_slope_shortens_the_way_and_lifts_it() -> None:
    motion = motion_of(blind_journey(poses_on_plane(torch.zeros(50, dtype=F64), 0.8)))
    slope = torch.full((50,), 0.1, dtype=F64)
    still = slope[0] * 0
    across, up = dead_reckon(motion, slope, Slip(still, still))
    flat = 0.8 * 49 / (1 + 0.1**2) ** 0.5
    torch.testing.assert_close((across[-1] - across[0]).norm().item(), flat)
    torch.testing.assert_close(up[-1].item(), 0.1 * flat)


def test_directions_are_unit_vectors_from_east_to_north() -> None:
    found = direction(torch.tensor([0.0, torch.pi / 2], dtype=F64))
    torch.testing.assert_close(found, torch.eye(2, dtype=F64))


def test_slip_and_lever_of_a_camera_ahead_of_the_axle() -> None:
    heading = 0.8 * torch.sin(torch.arange(800, dtype=F64) * 0.8 / 25)
    poses = poses_on_plane(heading, 0.8)
    # The camera sits 1.3 m ahead of what rolls along its heading, and squints by one degree.
    mount = torch.tensor([0.0, 0.0, 1.3], dtype=F64)
    ahead = se3.make(torch.eye(3, dtype=F64), mount)
    squint = se3.make(se3.so3_exp(torch.tensor([0.0, 0.0175, 0.0], dtype=F64)), mount * 0)
    motion = motion_of(blind_journey(poses @ ahead @ squint))
    slip = fit_slip(motion, motion.alpha * 0)
    # The prior (0.03 rad, 2 m) and the drift that is expected of positions pull a little.
    assert abs(slip.angle - 0.0175) < 1e-3
    assert abs(slip.lever - 1.3) < 0.15


def test_a_drive_too_short_to_compare_has_no_slip() -> None:
    motion = motion_of(blind_journey(poses_on_plane(torch.zeros(10, dtype=F64), 0.8)))
    slip = fit_slip(motion, 0 * motion.alpha)
    assert float(slip.angle) == float(slip.lever) == 0.0
