"""Simulated drives with their truth, and drives over a plane, for the tests of road and lanes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from crowdmap_torch.geometry import se3
from crowdmap_torch.geometry.camera import Camera
from crowdmap_torch.io.datasets import load_dataset
from crowdmap_torch.io.surveys import read_survey
from crowdmap_torch.io.truth import JourneyTruth, read_truth
from crowdmap_torch.simulate.dataset import SimulationConfig, write_dataset
from crowdmap_torch.simulate.positioning import PositioningConfig
from crowdmap_torch.simulate.vehicle import VehicleConfig
from crowdmap_torch.simulate.worlds import WORLD_PRESETS
from crowdmap_torch.tables import (
    Journey,
    LaneDetections,
    LanePoints,
    Rig,
    RoadEstimate,
    SignDetections,
    Survey,
    Tracklets,
)

EXACT = PositioningConfig(
    bias_e_m=0.0,
    bias_n_m=0.0,
    bias_u_m=0.0,
    drift_m=0.0,
    drift_rot_deg=0.0,
    white_e_m=0.0,
    white_n_m=0.0,
    white_u_m=0.0,
    white_rot_deg=0.0,
)
"""Poses without any error."""


@dataclass(frozen=True)
class SimulatedDrives:
    """Journeys of one world, what they truly were, and where its markers are."""

    truths: tuple[JourneyTruth, ...]
    survey: Survey


def simulate(
    folder: Path,
    world: str,
    *,
    length_m: float,
    journeys: int = 1,
    seed: int = 0,
    positioning: PositioningConfig | None = None,
    vehicle: VehicleConfig | None = None,
) -> SimulatedDrives:
    """Drives of loaded cars through a short version of a preset world."""
    config = SimulationConfig(
        world=replace(WORLD_PRESETS[world], length_m=length_m),
        vehicle=vehicle or VehicleConfig(load_deg=1.5),
        positioning=positioning or PositioningConfig(),
        journeys=journeys,
        seed=seed,
    )
    write_dataset(config, folder)
    survey = read_survey(folder / "survey")
    truth = read_truth(folder / "survey", survey, load_dataset(folder).journeys)
    return SimulatedDrives(truth.journeys, survey)


def lane_tracklets(truth: JourneyTruth, *, silence: int = 25) -> Tracklets:
    """Tracklets of a perfect association: of one marker, a new one after some silent frames."""
    lane = truth.lane[truth.journey.lanes.row]
    frame = truth.journey.lanes.frame
    label, count = torch.full_like(lane, -1), 0
    for marker in lane[lane >= 0].unique():
        rows = (lane == marker).nonzero()[:, 0]
        rows = rows[frame[rows].argsort()]
        begins = torch.ones_like(rows, dtype=torch.bool)
        begins[1:] = frame[rows][1:] - frame[rows][:-1] > silence
        label[rows] = count + begins.cumsum(0) - 1
        count += int(begins.sum())
    return Tracklets(label, count)


def true_road(truth: JourneyTruth) -> RoadEstimate:
    """The road as it truly was."""
    height = truth.camera_height
    return RoadEstimate(truth.road_normal_camera, height, torch.full_like(height, 1e-4))


def angle_deg(a: Float[Tensor, "f 3"], b: Float[Tensor, "f 3"]) -> Float[Tensor, " f"]:
    """Angles between unit vectors."""
    return torch.rad2deg(torch.linalg.cross(a, b.expand_as(a)).norm(dim=-1))


def frames_of(journey: Journey, first: int, last: int) -> Journey:
    """Frames `first` to before `last` with their detections: what a stream hands over."""
    signs = (journey.signs.frame >= first) & (journey.signs.frame < last)
    lanes = (journey.lanes.frame >= first) & (journey.lanes.frame < last)
    number = lanes.cumsum(0) - 1
    sign_rows, lane_rows = journey.signs[signs], journey.lanes[lanes]
    points = journey.lane_points[lanes[journey.lane_points.detection]]
    return replace(
        journey,
        frame_number=journey.frame_number[first:last],
        t_ns=journey.t_ns[first:last],
        T_world_camera=journey.T_world_camera[first:last],
        # The road does not ask how sure positions are.
        sigma_position=None,
        sigma_rotation=None,
        signs=replace(sign_rows, frame=sign_rows.frame - first),
        lanes=replace(lane_rows, frame=lane_rows.frame - first),
        lane_points=replace(points, detection=number[points.detection]),
    )


def in_other_order(journey: Journey, order: Tensor) -> Journey:
    """The journey with its lane detections in another order."""
    place = torch.empty_like(order)
    place[order] = torch.arange(len(order))
    detection = place[journey.lane_points.detection]
    rows = detection.argsort(stable=True)
    points = replace(journey.lane_points[rows], detection=detection[rows])
    return replace(journey, lanes=journey.lanes[order], lane_points=points)


def blind_journey(
    T_world_camera: Float[Tensor, "f 4 4"], *, normal: tuple[float, float, float] = (0.0, 1.0, 0.0)
) -> Journey:
    """A journey with poses and no detections at all; 15 frames a second, the camera 1.5 m high."""
    frames = len(T_world_camera)
    K = torch.tensor([[1000.0, 0, 640], [0, 1000, 400], [0, 0, 1]], dtype=torch.float64)
    camera = Camera("brown_conrady", 1281, 801, K, torch.zeros(0, dtype=torch.float64))
    down = torch.nn.functional.normalize(torch.tensor(normal, dtype=torch.float64), dim=-1)
    none, real = torch.zeros(0, dtype=torch.int64), torch.zeros(0, dtype=torch.float64)
    corners, pixels = real.reshape(0, 8, 2), real.reshape(0, 2)
    return Journey(
        journey_id="blind",
        rig=Rig("rig", camera, torch.eye(4, dtype=torch.float64), down, 1.5),
        frame_number=torch.arange(frames),
        t_ns=torch.arange(frames) * 66_666_667,
        T_world_camera=T_world_camera,
        sigma_position=None,
        sigma_rotation=None,
        signs=SignDetections(none, none, none, corners, corners, none, real, none),
        lanes=LaneDetections(none, none, none, real),
        lane_points=LanePoints(none, pixels, pixels),
        dropped={},
    )


def poses_on_plane(
    heading: Float[Tensor, " f"],
    step_m: float | Float[Tensor, " f"],
    *,
    pitch: float = 0.0,
    roll: float = 0.0,
) -> Float[Tensor, "f 4 4"]:
    """Cameras driven 1.5 m over the plane z = 0, whose normal they see as `(roll, 1, pitch)`."""
    down = torch.nn.functional.normalize(heading.new_tensor([roll, 1.0, pitch]), dim=-1)
    z = heading.new_tensor([0.0, 0.0, 1.0])
    ahead = torch.nn.functional.normalize(z - (z @ down) * down, dim=-1)
    # Columns: the car's right, down and ahead in the camera frame.
    R_camera_car = torch.stack((torch.linalg.cross(down, ahead), down, ahead), dim=-1)
    c, s, zero = heading.cos(), heading.sin(), torch.zeros_like(heading)
    R_world_car = torch.stack((s, zero, c, -c, zero, s, zero, zero - 1, zero), dim=-1)
    middle = torch.cat((heading[:1], 0.5 * (heading[1:] + heading[:-1])))
    move = torch.stack((middle.cos(), middle.sin(), zero), dim=-1)
    position = (torch.as_tensor(step_m) * torch.ones_like(heading))[:, None] * move
    position = position.cumsum(0) + heading.new_tensor([0.0, 0.0, 1.5])
    return se3.make(R_world_car.reshape(-1, 3, 3) @ R_camera_car.T, position)
