"""A small simulated dataset, and its journeys cut, reordered and moved."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import torch
from torch import Tensor

from crowdmap_torch.geometry import se3
from crowdmap_torch.io.truth import JourneyTruth
from crowdmap_torch.simulate.dataset import SimulationConfig, write_dataset
from crowdmap_torch.simulate.rigs import RigConfig
from crowdmap_torch.simulate.vehicle import VehicleConfig
from crowdmap_torch.simulate.worlds import WORLD_PRESETS
from crowdmap_torch.tables import Journey, LaneDetections, LanePoints, Rig, SignDetections


def write_tiny(
    out: Path, *, journeys: int = 3, frame_rate_hz: float = 8.0, length_m: float = 120.0
) -> Path:
    """A dataset of a short street with a few signs; returns `out`."""
    street = WORLD_PRESETS["street"]
    config = SimulationConfig(
        world=replace(
            street,
            length_m=length_m,
            lights_per_km=0.0,
            signs=replace(street.signs, posts_per_km=60.0),
        ),
        vehicle=VehicleConfig(frame_rate_hz=frame_rate_hz),
        rig=RigConfig(camera="pinhole"),
        journeys=journeys,
    )
    write_dataset(config, out)
    return out


def make_journey(
    rig: Rig,
    T_world_camera: Tensor,
    *,
    signs: SignDetections | None = None,
    lanes: LaneDetections | None = None,
    lane_points: LanePoints | None = None,
) -> Journey:
    """A journey with these poses, ten frames a second."""
    frames = torch.arange(len(T_world_camera))
    none, empty = frames[:0], torch.zeros(0, 2, dtype=torch.float64)
    corners = empty.new_zeros(0, 8, 2)
    return Journey(
        journey_id="drive",
        rig=rig,
        frame_number=frames,
        t_ns=frames * 10**8,
        T_world_camera=T_world_camera,
        sigma_position=None,
        sigma_rotation=None,
        signs=signs or SignDetections(none, none, none, corners, corners, none, empty[:, 0], none),
        lanes=lanes or LaneDetections(none, none, none, empty[:, 0]),
        lane_points=lane_points or LanePoints(none, empty, empty),
        dropped={},
    )


def with_frames(journey: Journey, frames: Tensor) -> Journey:
    """The journey with these of its frames, numbered and timed anew."""
    return replace(
        journey.with_frames(frames),
        frame_number=torch.arange(len(frames)),
        t_ns=journey.t_ns[0] + torch.arange(len(frames)) * 125_000_000,
    )


def without_detections(journey: Journey, frames: Tensor) -> Journey:
    """These frames of the journey as they were, and nothing detected in them."""
    none = torch.zeros(0, dtype=torch.int64)
    sigmas = (journey.sigma_position, journey.sigma_rotation)
    sigma_position, sigma_rotation = (None if s is None else s[frames] for s in sigmas)
    return replace(
        journey,
        frame_number=journey.frame_number[frames],
        t_ns=journey.t_ns[frames],
        T_world_camera=journey.T_world_camera[frames],
        sigma_position=sigma_position,
        sigma_rotation=sigma_rotation,
        signs=journey.signs[none],
        lanes=journey.lanes[none],
        lane_points=journey.lane_points[none],
    )


def with_order(journey: Journey, sign_order: Tensor, lane_order: Tensor) -> Journey:
    """The journey with its detections in another order; `row` says where they were."""
    detection, point = torch.nonzero(
        journey.lane_points.detection == lane_order[:, None], as_tuple=True
    )
    return replace(
        journey,
        signs=journey.signs[sign_order],
        lanes=journey.lanes[lane_order],
        lane_points=replace(journey.lane_points[point], detection=detection),
    )


def shuffled(journey: Journey, generator: torch.Generator) -> Journey:
    """The journey with its detections in a random order."""
    return with_order(
        journey,
        torch.randperm(len(journey.signs), generator=generator),
        torch.randperm(len(journey.lanes), generator=generator),
    )


def with_shuffled_rows(dataset: Path, out: Path, *, seed: int) -> Path:
    """A copy of a dataset's files with the rows of detections and of the survey in a random order."""
    shutil.copytree(dataset, out)
    random = np.random.default_rng(seed)
    files = [*out.glob("journeys/*/*.parquet"), *out.glob("survey/*.parquet")]
    for path in sorted(files):
        # Poses are sorted by frame, as FORMAT.md asks for.
        if path.name != "poses.parquet":
            table = pq.read_table(path)
            pq.write_table(table.take(random.permutation(len(table))), path)
    return out


def with_poses(journey: Journey, T_world_camera: Tensor) -> Journey:
    """The journey, driven along other poses."""
    return replace(journey, T_world_camera=T_world_camera)


def turn_about_up(angle: float, shift: tuple[float, float, float]) -> Tensor:
    """A rigid motion of the world: a turn about the vertical, then a shift."""
    tangent = torch.tensor([*shift, 0.0, 0.0, angle], dtype=torch.float64)
    return se3.retract(torch.eye(4, dtype=torch.float64), tangent)


def lanes_by_detection(truth: JourneyTruth) -> Tensor:
    """The true lane of each lane detection; -1 for false ones."""
    return truth.lane[truth.journey.lanes.row]


def signs_by_detection(truth: JourneyTruth) -> Tensor:
    """The true sign of each sign detection; -1 for false ones."""
    return truth.sign[truth.journey.signs.row]
