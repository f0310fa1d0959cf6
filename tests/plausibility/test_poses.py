from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from worlds.drives import make_journey

from crowdmap_torch.geometry import se3
from crowdmap_torch.geometry.camera import Camera
from crowdmap_torch.plausibility.poses import pose_findings
from crowdmap_torch.tables import Journey, Origin, Rig

ORIGIN = Origin(48.0, 11.5, 520.0)
CAMERA = Camera(
    "brown_conrady", 640, 480, torch.tensor([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]]).double(),
    torch.zeros(0).double(),
)  # fmt: skip
RIG = Rig("rig", CAMERA, torch.eye(4).double(), torch.tensor([0.0, 1, 0]).double(), 1.4)


def drive(heading: torch.Tensor, *, step_m: float = 1.0) -> Journey:
    """A drive along headings [rad from east], a frame each 0.1 s, the camera ahead and upright."""
    ahead = torch.stack((heading.cos(), heading.sin(), torch.zeros_like(heading)), dim=-1)
    down = torch.tensor([0.0, 0.0, -1.0]).double().expand_as(ahead)
    R = torch.stack((torch.linalg.cross(down, ahead), down, ahead), dim=-1)
    return make_journey(RIG, se3.make(R, (step_m * ahead).cumsum(0)))


def kinds(journey: Journey) -> list[str]:
    return [finding.kind for finding in pose_findings(journey, ORIGIN)]


@pytest.mark.parametrize("heading_deg", range(-180, 180, 30))
def test_a_camera_that_looks_ahead_is_sound_whatever_the_heading(heading_deg: int) -> None:
    heading = torch.linspace(0, 0.5, 60).double() + math.radians(heading_deg)
    assert kinds(drive(heading)) == []


def test_a_car_that_stands_tells_nothing() -> None:
    assert kinds(drive(torch.zeros(60).double(), step_m=0.0)) == []


def test_a_camera_that_looks_aside_is_named_without_a_cause() -> None:
    journey = drive(torch.zeros(60).double())
    aside = se3.exp(torch.tensor([0, 0, 0, 0, 1.2, 0]).double())
    turned = replace(journey, T_world_camera=journey.T_world_camera @ aside)
    assert kinds(turned) == ["axes"]


@pytest.mark.parametrize("heading_deg", range(-180, 180, 30))
def test_a_rear_camera_is_not_taken_for_two_mistakes_at_once(heading_deg: int) -> None:
    """Another world and another camera's axes together would look back as well: `--fix` would turn all poses over."""
    journey = drive(torch.linspace(0, 0.5, 60).double() + math.radians(heading_deg))
    back = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0]).double())
    turned = replace(journey, T_world_camera=journey.T_world_camera @ back)
    (found,) = pose_findings(turned, ORIGIN)
    assert found.kind == "axes" and found.repair is None


def test_a_car_that_waits_longer_than_it_drives_looks_ahead(generator: torch.Generator) -> None:
    """Positions that tremble by 2 cm at a standstill go on for metres, in no direction."""
    moving = drive(torch.zeros(60).double()).T_world_camera
    trembling = moving[-1:].repeat(600, 1, 1)
    trembling[:, :3, 3] += 0.02 * torch.randn(600, 3, dtype=torch.float64, generator=generator)
    assert kinds(make_journey(RIG, torch.cat((moving, trembling)))) == []
    assert kinds(make_journey(RIG, trembling)) == []


def test_a_leap_is_named_with_its_frames() -> None:
    journey = drive(torch.zeros(60).double())
    T = journey.T_world_camera.clone()
    T[30:, 0, 3] += 400
    T[30:, 2, 3] += 0.1
    (found,) = pose_findings(replace(journey, T_world_camera=T), ORIGIN)
    assert found.kind == "leap"
    assert "frames 29 and 30" in found.evidence


@pytest.mark.parametrize("mounted", [False, True])
def test_one_height_in_all_frames_is_named_where_the_road_is_long(mounted: bool) -> None:
    journey = drive(torch.zeros(400).double())
    if mounted:
        T_link_camera = journey.rig.T_link_camera.clone()
        T_link_camera[:3, 3] = torch.tensor([0.7, -0.2, 1.9])
        rig = replace(journey.rig, T_link_camera=T_link_camera)
        journey = replace(journey, rig=rig, T_world_camera=journey.T_world_camera @ T_link_camera)
    (found,) = pose_findings(journey, ORIGIN)
    assert (found.kind, found.repair) == ("one-height", None)
    T = journey.T_world_camera.clone()
    T[:, 2, 3] += torch.linspace(0, 0.01, 400).double()
    assert pose_findings(replace(journey, T_world_camera=T), ORIGIN) == []
    short = journey.with_frames(torch.arange(100))
    assert pose_findings(short, ORIGIN) == []


def test_leaps_that_a_map_does_without_are_told() -> None:
    journey = drive(torch.zeros(60).double())
    (found,) = pose_findings(replace(journey, leaps_m=(1.2, 2.4)), ORIGIN)
    assert (found.kind, found.repair) == ("leaps-taken-out", None)
    assert "2 times" in found.evidence and "2.4 m" in found.evidence


def test_bursts_of_noise_that_a_map_does_without_are_told() -> None:
    journey = drive(torch.zeros(60).double())
    (found,) = pose_findings(replace(journey, noisy_frames=40), ORIGIN)
    assert (found.kind, found.repair) == ("noise-smoothed", None)
    assert f"40 of {journey.frame_count} frames" in found.evidence


def test_times_in_another_unit_are_named() -> None:
    journey = drive(torch.zeros(60).double())
    assert kinds(replace(journey, t_ns=journey.t_ns // 1000)) == ["frame-times"]


def test_a_drive_at_the_height_of_its_origin_alone_is_not_enough() -> None:
    low = Origin(ORIGIN.lat_deg, ORIGIN.lon_deg, 0.4)
    assert pose_findings(drive(torch.zeros(60).double()), low) == []


@pytest.mark.parametrize("heading_deg", range(-180, 180, 30))
def test_axes_of_opengl_are_named(heading_deg: int) -> None:
    journey = drive(torch.linspace(0, 0.5, 60).double() + math.radians(heading_deg))
    over = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]).double())
    turned = replace(journey, T_world_camera=journey.T_world_camera @ over)
    assert kinds(turned) == ["camera-axes"]


def test_a_drive_to_the_east_shows_another_order_of_quaternions_only_a_little() -> None:
    journey = drive(0.25 * torch.sin(torch.arange(80).double() / 10))
    T = journey.T_world_camera
    x, y, z, w = se3.to_quaternion(T[:, :3, :3]).unbind(-1)
    mixed = se3.make(se3.from_quaternion(torch.stack((w, x, y, z), dim=-1)), T[:, :3, 3])
    (found,) = pose_findings(replace(journey, T_world_camera=mixed), ORIGIN)
    assert found.kind == "quaternion-order"
    # A camera that looks as far aside for good is none.
    aside = se3.exp(torch.tensor([0, 0, 0, 0.1, 0.25, 0]).double())
    assert kinds(replace(journey, T_world_camera=T @ aside)) == []


def test_rotations_with_two_digits_are_named_and_those_with_three_or_of_one_heading_are_not() -> (
    None
):
    journey = drive(torch.linspace(0.3, 1.2, 80).double())
    q = se3.to_quaternion(journey.T_world_camera[:, :3, :3])
    place = journey.T_world_camera[:, :3, 3]
    for digits, expected in ((2, ["rounded-rotations"]), (3, []), (15, [])):
        rounded = torch.nn.functional.normalize(q.round(decimals=digits), dim=-1)
        T = se3.make(se3.from_quaternion(rounded), place)
        assert kinds(replace(journey, T_world_camera=T)) == expected
    assert kinds(drive(torch.zeros(80).double())) == []
