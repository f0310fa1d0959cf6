"""Small maps, surveys and drives with known answers."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from crowdmap_torch.geometry import polygon, se3
from crowdmap_torch.geometry.camera import Camera
from crowdmap_torch.io.truth import JourneyTruth
from crowdmap_torch.tables import (
    ControlPoints,
    HdMap,
    Journey,
    LaneDetections,
    LanePoints,
    Lanes,
    Origin,
    Rig,
    SignDetections,
    Signs,
    Survey,
    SurveyLanePoints,
    SurveySigns,
)

ORIGIN = Origin(32.9, -117.2, 120.0)


@dataclass(frozen=True)
class Builder:
    """Tables from a few numbers."""

    def signs(self, center, *, shape=None, heading=None, size=(0.6, 0.8), sigma=0.05) -> Signs:
        """Upright signs facing along `heading` [rad from east]: rectangles, west by default."""
        center = torch.as_tensor(center, dtype=torch.float64).reshape(-1, 3)
        n = len(center)
        heading = torch.as_tensor(torch.pi if heading is None else heading, dtype=torch.float64)
        heading = heading.expand(n)
        z = torch.stack((heading.cos(), heading.sin(), torch.zeros(n)), dim=-1).double()
        y = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand(n, 3)
        R = torch.stack((torch.linalg.cross(y, z), y, z), dim=-1)
        codes = torch.full((n,), 2) if shape is None else torch.as_tensor(shape).expand(n)
        none = torch.full((n,), -1)
        return Signs(
            shape=codes,
            type=none,
            T_world_sign=se3.make(R, center),
            size=torch.tensor(size, dtype=torch.float64).expand(n, 2),
            covariance=sigma**2 * torch.eye(3, dtype=torch.float64).expand(n, 3, 3),
            journey=none,
            tracklet=none,
            frame=none,
            n_journeys=torch.full((n,), 5),
            n_observations=torch.full((n,), 50),
            first_seen_ns=torch.zeros(n, dtype=torch.int64),
            last_seen_ns=torch.ones(n, dtype=torch.int64),
            confidence=torch.ones(n, dtype=torch.float64),
        )

    def moved(self, signs: Signs, shift) -> Signs:
        """The signs shifted by a vector, or by one vector each."""
        T = signs.T_world_sign.clone()
        T[:, :3, 3] += torch.as_tensor(shift, dtype=torch.float64)
        return replace(signs, T_world_sign=T)

    def survey_signs(self, signs: Signs) -> SurveySigns:
        return SurveySigns(
            shape=signs.shape,
            corners_world=signs.corners_world,
            center_world=signs.center_world,
            normal_world=signs.normal_world,
            sigma=torch.full((len(signs),), 0.02, dtype=torch.float64),
        )

    def centers_only(self, survey: SurveySigns) -> SurveySigns:
        nan = torch.nan
        return replace(
            survey,
            corners_world=torch.full_like(survey.corners_world, nan),
            normal_world=torch.full_like(survey.normal_world, nan),
        )

    def lanes(self, lines, *, sigma=0.05) -> Lanes:
        """Splines through lists of control points."""
        points = [torch.as_tensor(line, dtype=torch.float64).reshape(-1, 3) for line in lines]
        count = torch.tensor([len(p) for p in points], dtype=torch.int64)
        n = len(points)
        none = torch.full((n,), -1)
        control = torch.cat(points) if points else torch.zeros(0, 3, dtype=torch.float64)
        return Lanes(
            type=none,
            control_start=count.cumsum(0) - count,
            control_count=count,
            journey=none,
            tracklet=none,
            frame=none,
            n_journeys=torch.full((n,), 5),
            n_observations=torch.full((n,), 50),
            first_seen_ns=torch.zeros(n, dtype=torch.int64),
            last_seen_ns=torch.ones(n, dtype=torch.int64),
            confidence=torch.ones(n, dtype=torch.float64),
            control=ControlPoints(control, torch.full_like(control[:, 0], sigma)),
        )

    def straight(self, y: float, *, start=0.0, end=100.0, z=0.0, points=11) -> Tensor:
        """Control points along the x axis."""
        x = torch.linspace(start, end, points, dtype=torch.float64)
        return torch.stack((x, torch.full_like(x, y), torch.full_like(x, z)), dim=-1)

    def survey(self, signs: Signs, lines=()) -> Survey:
        points = [torch.as_tensor(line, dtype=torch.float64).reshape(-1, 3) for line in lines]
        lane = [torch.full((len(p),), k) for k, p in enumerate(points)]
        return Survey(
            origin=ORIGIN,
            sign_id=tuple(f"s{k}" for k in range(len(signs))),
            signs=self.survey_signs(signs),
            lane_id=tuple(f"l{k}" for k in range(len(points))),
            lane_type=torch.full((len(points),), -1),
            lane_points=SurveyLanePoints(
                torch.cat(lane) if lane else torch.zeros(0, dtype=torch.int64),
                torch.cat(points) if points else torch.zeros(0, 3, dtype=torch.float64),
            ),
        )

    def hd_map(self, signs: Signs, lanes: Lanes | None = None, *, shared=0.0) -> HdMap:
        lanes = self.lanes([]) if lanes is None else lanes
        return HdMap(
            origin=ORIGIN,
            signs=signs,
            lanes=lanes,
            sign_id=tuple(f"m{k}" for k in range(len(signs))),
            lane_id=tuple(f"k{k}" for k in range(len(lanes))),
            type_names=(),
            shared_covariance=shared**2 * torch.eye(3, dtype=torch.float64),
            provenance={},
        )

    def drive(
        self,
        journey_id: str,
        *,
        frames=100,
        bias=(0.0, 0.0, 0.0),
        sign_rows=(),
        lane_rows=(),
        lane_points=(),
    ) -> JourneyTruth:
        """A camera 1.5 m above a flat road, 1 m east a frame, every pose off by `bias`.

        `sign_rows` are (frame, true sign), `lane_rows` (frame, true lane) with as many (m
        ahead, m to the left) in `lane_points`.
        """
        # Columns: camera x (right) is south, y (down) is down, z (forward) is east.
        R = torch.tensor([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]], dtype=torch.float64)
        position = torch.zeros(frames, 3, dtype=torch.float64)
        position[:, 0] = torch.arange(frames)
        position[:, 2] = 1.5
        true = se3.make(R.expand(frames, 3, 3), position)
        given = se3.make(R.expand(frames, 3, 3), position + torch.tensor(bias, dtype=torch.float64))
        K = torch.tensor([[1000.0, 0, 640], [0, 1000, 400], [0, 0, 1]], dtype=torch.float64)
        camera = Camera("brown_conrady", 1281, 801, K, torch.zeros(0, dtype=torch.float64))
        down = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
        rig = Rig("rig", camera, torch.eye(4, dtype=torch.float64), down, 1.5)
        d, q = len(sign_rows), len(lane_rows)
        sign = torch.tensor(sign_rows, dtype=torch.int64).reshape(-1, 2)
        lane = torch.tensor(lane_rows, dtype=torch.int64).reshape(-1, 2)
        ideal = [[(-left / ahead, 1.5 / ahead) for ahead, left in row] for row in lane_points]
        flat = torch.tensor([p for row in ideal for p in row], dtype=torch.float64).reshape(-1, 2)
        owner = [k for k, row in enumerate(ideal) for _ in row]
        unknown = torch.full((d,), torch.nan, dtype=torch.float64)
        corners = torch.zeros(d, polygon.MAX_CORNERS, 2, dtype=torch.float64)
        journey = Journey(
            journey_id=journey_id,
            rig=rig,
            frame_number=torch.arange(frames),
            t_ns=torch.arange(frames) * 10**9,
            T_world_camera=given,
            sigma_position=None,
            sigma_rotation=None,
            signs=SignDetections(
                torch.arange(d),
                sign[:, 0],
                torch.full((d,), 2),
                corners,
                corners,
                torch.full((d,), -1),
                unknown,
                torch.full((d,), -1),
            ),
            lanes=LaneDetections(
                torch.arange(q),
                lane[:, 0],
                torch.full((q,), -1),
                torch.full((q,), torch.nan, dtype=torch.float64),
            ),
            lane_points=LanePoints(torch.tensor(owner, dtype=torch.int64), flat, flat),
            dropped={},
        )
        return JourneyTruth(
            journey=journey,
            T_world_camera=true,
            sign=sign[:, 1],
            sign_frame=sign[:, 0],
            sign_outlier=torch.zeros(d, dtype=torch.bool),
            lane=lane[:, 1],
            road_normal_camera=down.expand(frames, 3),
            camera_height=torch.full((frames,), 1.5, dtype=torch.float64),
        )
