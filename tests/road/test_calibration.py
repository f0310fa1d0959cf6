from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from crowdmap_torch.geometry import se3
from crowdmap_torch.geometry.camera import Camera, project
from crowdmap_torch.road.calibration import (
    Annotations,
    CalibrationConfig,
    SurveyedPoints,
    calibrate_road,
)

F64 = torch.float64
CONFIG = CalibrationConfig()
HEIGHT = 1.4
NORMAL = torch.nn.functional.normalize(torch.tensor([0.02, 1.0, 0.05], dtype=F64), dim=0)


def camera() -> Camera:
    K = torch.tensor([[900.0, 0, 640], [0, 900, 400], [0, 0, 1]], dtype=F64)
    return Camera("brown_conrady", 1281, 801, K, torch.tensor([-0.2, 0.05, 0, 0], dtype=F64))


def room() -> SurveyedPoints:
    """A wall 6 m ahead of where cars stop, and the floor before it; z is up."""
    wall = [(x, 6.0, z) for x in (-2.0, 0.0, 2.0) for z in (0.3, 1.2, 2.1)]
    floor = [(x, y, 0.0) for x in (-1.0, 0.5) for y in (3.5, 4.5, 5.5)]
    name = tuple(f"p{k}" for k in range(len(wall) + len(floor)))
    position = torch.tensor(wall + floor, dtype=F64)
    return SurveyedPoints(name, position, (False,) * len(wall) + (True,) * len(floor))


def pose(place: tuple[float, float], turn: float) -> Tensor:
    """T_camera_room of a car that stands at a place, turned from the wall's direction."""
    # Columns: right, down and ahead of the level car in the camera frame.
    ahead = torch.nn.functional.normalize(
        torch.tensor([0.0, 0.0, 1.0], dtype=F64) - NORMAL[2] * NORMAL, dim=0
    )
    R_camera_car = torch.stack((torch.linalg.cross(NORMAL, ahead), NORMAL, ahead), dim=-1)
    t = torch.tensor(turn, dtype=F64)
    c, s, zero, one = t.cos(), t.sin(), t * 0, t * 0 + 1
    R_room_car = torch.stack(
        (torch.stack((c, zero, -s)), torch.stack((s, zero, c)), torch.stack((zero, -one, zero)))
    )
    T_room_camera = se3.make(R_room_car @ R_camera_car.T, torch.tensor([*place, HEIGHT], dtype=F64))
    return se3.inverse(T_room_camera)


def pictures(*poses: Tensor, noise_px: float = 0.0, seed: int = 0) -> Annotations:
    g = torch.Generator().manual_seed(seed)
    points = room().position
    px = torch.cat([project(camera(), se3.transform(T, points))[0] for T in poses])
    px = px + noise_px * torch.randn(px.shape, dtype=F64, generator=g)
    n = len(points)
    return Annotations(
        tuple(f"picture {k}" for k in range(len(poses))),
        torch.arange(len(poses)).repeat_interleave(n),
        torch.arange(n).repeat(len(poses)),
        px,
    )


def test_exact_pictures_give_the_normal_and_the_height() -> None:
    seen = pictures(pose((0.0, 0.0), 0.0), pose((0.4, -1.0), 0.1))
    found = calibrate_road(camera(), room(), seen, CONFIG)
    # The lens is inverted by iterations to about 1e-9, OpenCV stops at steps of about 1e-7.
    torch.testing.assert_close(found.normal_camera, NORMAL, atol=1e-5, rtol=0)
    assert found.height == pytest.approx(HEIGHT, abs=1e-4)
    assert max(found.rms_px) < 1e-2 and found.sigma_deg < 1e-3


def test_sigma_is_about_the_error_and_one_picture_has_none() -> None:
    poses = [pose((0.2 * k, -0.3 * k), 0.03 * k) for k in range(4)]
    found = calibrate_road(camera(), room(), pictures(*poses, noise_px=0.5), CONFIG)
    off = torch.rad2deg(torch.linalg.cross(found.normal_camera, NORMAL).norm())
    assert 0.0 < found.sigma_deg < 0.3
    assert float(off) < 4 * found.sigma_deg
    alone = calibrate_road(camera(), room(), pictures(poses[0]), CONFIG)
    assert alone.sigma_deg != alone.sigma_deg and alone.sigma_height != alone.sigma_height


def test_the_frame_of_the_room_does_not_matter() -> None:
    T = se3.exp(torch.tensor([5.0, -2.0, 1.0, 0.3, 0.2, 2.0], dtype=F64))
    points = room()
    moved = replace(points, position=se3.transform(T, points.position))
    seen = pictures(pose((0.0, 0.0), 0.0), noise_px=0.2)
    here = calibrate_road(camera(), points, seen, CONFIG)
    there = calibrate_road(camera(), moved, seen, CONFIG)
    # Where OpenCV's last step ends.
    torch.testing.assert_close(there.normal_camera, here.normal_camera, atol=1e-5, rtol=0)
    assert there.height == pytest.approx(here.height, abs=1e-4)


def spoilt(
    points: SurveyedPoints, seen: Annotations, what: str
) -> tuple[SurveyedPoints, Annotations]:
    if what == "swapped names":
        px = seen.px.clone()
        px[[0, 8]] = px[[8, 0]]
        return points, replace(seen, px=px)
    if what == "few points":
        return points, replace(
            seen, of_picture=seen.of_picture[:5], point=seen.point[:5], px=seen.px[:5]
        )
    if what == "no wall":
        return replace(points, is_floor=(True,) * len(points.name)), seen
    if what == "no floor":
        return replace(points, is_floor=(False,) * len(points.name)), seen
    if what == "bump":
        bump = torch.zeros_like(points.position)
        bump[-1, 2] = 0.2
        return replace(points, position=points.position + bump), seen
    return points, Annotations((), seen.of_picture[:0], seen.point[:0], seen.px[:0])


@pytest.mark.parametrize(
    ("what", "message"),
    [
        ("swapped names", "miss by|no camera pose|behind the camera"),
        ("few points", "5 points; expected 6 or more"),
        ("no wall", "no wall point"),
        ("no floor", "0 floor points; expected three or more"),
        ("bump", "off the plane of the floor points"),
        ("no picture", "there is no picture"),
    ],
)
def test_what_is_wrong_is_said(what: str, message: str) -> None:
    points, seen = spoilt(room(), pictures(pose((0.0, 0.0), 0.0)), what)
    with pytest.raises(ValueError, match=message):
        calibrate_road(camera(), points, seen, CONFIG)


def test_a_picture_that_disagrees_is_refused() -> None:
    seen = pictures(*(pose((0.3 * k, 0.0), 0.0) for k in range(3)), noise_px=0.3)
    with pytest.raises(ValueError, match="degrees off the mean"):
        calibrate_road(camera(), room(), seen, replace(CONFIG, max_spread_deg=1e-6))
