"""What is known of a car put right: drives with a wrong calibration become those without."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from crowdmap_torch.geometry import camera, polygon, se3
from crowdmap_torch.geometry.trajectory import motion
from crowdmap_torch.noise.calibration import KnownCalibration, corrected_journey, corrected_rig
from crowdmap_torch.single_journey import SingleJourneyMapper, frame_of
from crowdmap_torch.tables import Dataset, Journey

F64 = torch.float64
WRONG = {
    "mount_deg": (0.8, -0.6, 1.0),
    "mount_m": (0.05, -0.02, 0.1),
    "clock_s": (0.03,),
    "focal": (0.02,),
    "principal_px": (6.0, -9.0),
    "box": (0.05,),
    "corner_px": (0.5, -0.3),
    "height_m": (0.06,),
}
KNOWN: KnownCalibration = {name: (value, value) for name, value in WRONG.items()}


def number(name: str) -> Tensor:
    return torch.tensor(WRONG[name], dtype=F64)


def spoilt(journey: Journey) -> Journey:
    """The drive as its files would tell it, were the calibration in them wrong by these numbers."""
    T = se3.make(se3.so3_exp(torch.deg2rad(number("mount_deg"))), number("mount_m"))
    rig, K = journey.rig, journey.rig.camera.K.clone()
    K[:2, 2] -= number("principal_px")
    K[[0, 1], [0, 1]] /= 1 + number("focal")
    moved = torch.cat(motion(journey.T_world_camera, journey.t_ns), dim=-1) * number("clock_s")
    given = se3.retract(journey.T_world_camera @ se3.inverse(T), -moved)
    lens = replace(rig.camera, K=K)
    signs, points = journey.signs, journey.lane_points
    mask = polygon.corner_mask(signs.shape)[..., None].to(F64)
    mean = (signs.corners_px * mask).sum(1, keepdim=True) / mask.sum(1, keepdim=True)
    px = mean + (signs.corners_px - mean) * (1 + number("box")) + number("corner_px")
    return replace(
        journey,
        rig=replace(
            rig,
            camera=lens,
            T_link_camera=rig.T_link_camera @ se3.inverse(T),
            road_normal_camera=T[:3, :3] @ rig.road_normal_camera,
            camera_height=rig.camera_height - float(number("height_m")),
        ),
        T_world_camera=given,
        signs=replace(signs, corners_px=px, corners_ideal=camera.unproject(lens, px)[0]),
        lane_points=replace(points, ideal=camera.unproject(lens, points.px)[0]),
    )


def test_rigs_and_drives_are_put_right(tiny: Dataset) -> None:
    for journey in tiny.journeys[:2]:
        wrong = spoilt(journey)
        rig, right = corrected_rig(wrong.rig, KNOWN), corrected_journey(wrong, KNOWN)
        for found, true in ((rig, journey.rig), (right.rig, journey.rig)):
            torch.testing.assert_close(found.camera.K, true.camera.K)
            torch.testing.assert_close(found.T_link_camera, true.T_link_camera)
            torch.testing.assert_close(found.road_normal_camera, true.road_normal_camera)
            assert found.camera_height == pytest.approx(true.camera_height)
        off = se3.local(journey.T_world_camera, right.T_world_camera)
        # What a car does is told by poses that are themselves wrong by the clock: second order.
        assert float(off[:, :3].norm(dim=-1).max()) < 0.02
        assert float(off[:, 3:].norm(dim=-1).max()) < 1e-3
        torch.testing.assert_close(right.signs.corners_px, journey.signs.corners_px)
        torch.testing.assert_close(right.signs.corners_ideal, journey.signs.corners_ideal)
        torch.testing.assert_close(right.lane_points.ideal, journey.lane_points.ideal)


def test_nothing_known_changes_nothing(tiny: Dataset) -> None:
    journey = tiny.journeys[0]
    same = corrected_journey(journey, {})
    torch.testing.assert_close(same.T_world_camera, journey.T_world_camera)
    torch.testing.assert_close(same.signs.corners_px, journey.signs.corners_px)


def test_a_drive_that_is_known_is_mapped_as_if_its_rig_were_right(tiny: Dataset) -> None:
    journey = tiny.journeys[0]

    def mapped(drive: Journey, known: KnownCalibration | None) -> tuple[list[int], Tensor]:
        one, labels, signs = SingleJourneyMapper(drive.rig, None, known), [], []
        for index in range(drive.frame_count):
            result = one.step(frame_of(drive, index))
            labels += result.sign_tracklet.tolist()
            signs += [] if result.signs is None else [result.signs.center_world]
        last = one.finish()[0]
        return labels, torch.cat(signs + ([] if last is None else [last.center_world]))

    labels, true = mapped(journey, None)
    same, right = mapped(spoilt(journey), KNOWN)
    _, wrong = mapped(spoilt(journey), None)
    agree = sum(a == b for a, b in zip(labels, same, strict=True))
    assert agree > 0.95 * len(labels) and len(right) == len(true)
    away = [torch.cdist(true, found).amin(1).median() for found in (right, wrong)]
    assert float(away[0]) < 0.1 and float(away[1]) > 3 * float(away[0])
