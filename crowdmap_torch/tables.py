"""The nouns: flat tables of tensors with integer key columns.

A detection row says its frame, a landmark row its journey, a control point its lane. Association and clustering are
label columns (-1 = none). World: local East-North-Up [m]. Camera: x right, y down, z forward. Sign: x right and y up
as the driver sees it, z the normal that points at the driver; its origin is the mean of its corners.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, TypeVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from crowdmap_torch.geometry import polygon, se3, spline_basis
from crowdmap_torch.geometry.camera import Camera
from crowdmap_torch.geometry.extent import extent
from crowdmap_torch.notebook import HasFrame, HasLayers, HasPicture
from crowdmap_torch.processes.records import with_tensors

LANE_TYPES = ("solid", "dashed", "double", "curb")
"""Lane types by code; -1 is unknown."""

Table = TypeVar("Table", bound="Rows")


@dataclass(frozen=True)
class Rows(HasFrame):
    """A table whose every tensor has the rows as its leading axis; None where an optional column is missing."""

    def __len__(self) -> int:
        return len(getattr(self, fields(self)[0].name))

    def __getitem__(self: Table, index: Tensor | slice) -> Table:
        """The rows at `index` (a mask, row numbers or a slice), in that order."""
        return self._map(lambda column: column[index])

    def __init_subclass__(cls) -> None:
        # Before the dataclass is made, which would otherwise show every number.
        cls.__repr__ = Rows.__repr__

    def __repr__(self) -> str:
        return f"{type(self).__name__}({len(self):,} rows)"

    def to(self: Table, device: torch.device | str) -> Table:
        """The same table on another device."""
        return self._map(lambda column: column.to(device))

    def _map(self: Table, function) -> Table:
        columns = {f.name: getattr(self, f.name) for f in fields(self)}
        changed = {k: function(v) for k, v in columns.items() if isinstance(v, Tensor)}
        return replace(self, **changed)


def to_device(value: Any, device: torch.device | str) -> Any:
    """The same on another device, down to the last tensor in records, tuples and mappings."""
    return with_tensors(value, lambda tensor: tensor.to(device))


def concatenate(tables: Sequence[Table]) -> Table:
    """One table with the rows of all, in order; at least one table is needed."""
    first = tables[0]
    columns = {
        f.name: torch.cat([getattr(t, f.name) for t in tables])
        for f in fields(first)
        if isinstance(getattr(first, f.name), Tensor)
    }
    return replace(first, **columns)


@dataclass(frozen=True)
class Rig:
    """A camera, where it sits on the vehicle, and where the road is in its frame."""

    rig_id: str
    camera: Camera
    T_link_camera: Float[Tensor, "4 4"]
    """Camera in the link whose pose poses.parquet gives; the identity without a mount."""
    road_normal_camera: Float[Tensor, " 3"]
    """Calibrated unit normal from the camera towards the road."""
    camera_height: float
    """Distance from the camera centre to the road plane along the normal [m]."""


@dataclass(frozen=True)
class SignDetections(Rows):
    """Signs detected in the frames of one journey."""

    row: Int[Tensor, " d"]
    """Row of signs.parquet."""
    frame: Int[Tensor, " d"]
    """Index into the journey's frames (0 .. f - 1; not the frame number)."""
    shape: Int[Tensor, " d"]
    """Index into `polygon.SHAPES`."""
    corners_px: Float[Tensor, "d 8 2"]
    """Raw, distorted pixels, clockwise; slots past the shape's number of corners repeat the last corner."""
    corners_ideal: Float[Tensor, "d 8 2"]
    """The same, undistorted, on the plane z = 1."""
    type: Int[Tensor, " d"]
    """Index into the dataset's `type_names`; -1 unknown."""
    score: Float[Tensor, " d"]
    """0 to 1; NaN unknown."""
    track: Int[Tensor, " d"]
    """The perception module's own track number, a hint that may be wrong; -1 none."""


@dataclass(frozen=True)
class LaneDetections(Rows):
    """Lane markers detected in the frames of one journey; their points are in `LanePoints`."""

    row: Int[Tensor, " d"]
    frame: Int[Tensor, " d"]
    type: Int[Tensor, " d"]
    """Index into `LANE_TYPES`; -1 unknown."""
    score: Float[Tensor, " d"]


@dataclass(frozen=True)
class LanePoints(Rows):
    """The points of all lane detections of one journey, those of one detection adjacent, from the image's bottom up."""

    detection: Int[Tensor, " p"]
    """Index into the journey's lane detections, not decreasing."""
    px: Float[Tensor, "p 2"]
    ideal: Float[Tensor, "p 2"]


@dataclass(frozen=True)
class Journey:
    """One drive: frames with camera poses, and what was detected in them."""

    journey_id: str
    rig: Rig
    frame_number: Int[Tensor, " f"]
    t_ns: Int[Tensor, " f"]
    T_world_camera: Float[Tensor, "f 4 4"]
    """The positioning module's poses, through the mount: biased by up to a metre, drifting slowly, put right."""
    sigma_position: Float[Tensor, "f 3"] | None
    """The positioning module's own 1-sigma, east north up [m]."""
    sigma_rotation: Float[Tensor, " f"] | None
    """1-sigma about each axis [rad]."""
    signs: SignDetections
    lanes: LaneDetections
    lane_points: LanePoints
    dropped: dict[str, int]
    """Detections dropped at the door for a fault of their geometry, by reason."""
    vehicle_id: str = ""
    """Whose drives share a calibration; empty: those of the rig do."""
    leaps_m: tuple[float, ...] = ()
    """How far positions leapt between two frames where the drive was put together again at the door [m]."""
    noisy_frames: int = 0
    """Frames whose positions were noisy for a while, and were smoothed at the door."""

    def __repr__(self) -> str:
        return f"Journey({self.journey_id!r}: {_driven((self,))})"

    @property
    def vehicle(self) -> str:
        """The name of what its calibration is of."""
        return self.vehicle_id or self.rig.rig_id

    @property
    def frame_count(self) -> int:
        """How many frames the journey has."""
        return len(self.frame_number)

    def with_frames(self, frames: Int[Tensor, " k"]) -> Journey:
        """The journey with these of its frames, by row, each with all that was detected in it; one may come again."""
        sign_frame, sign_row = torch.nonzero(frames[:, None] == self.signs.frame, as_tuple=True)
        lane_frame, lane_row = torch.nonzero(frames[:, None] == self.lanes.frame, as_tuple=True)
        owner, point = torch.nonzero(lane_row[:, None] == self.lane_points.detection, as_tuple=True)
        sigmas = (self.sigma_position, self.sigma_rotation)
        sigma_position, sigma_rotation = (None if s is None else s[frames] for s in sigmas)
        return replace(
            self,
            frame_number=self.frame_number[frames],
            t_ns=self.t_ns[frames],
            T_world_camera=self.T_world_camera[frames],
            sigma_position=sigma_position,
            sigma_rotation=sigma_rotation,
            signs=replace(self.signs[sign_row], frame=sign_frame, row=torch.arange(len(sign_row))),
            lanes=replace(self.lanes[lane_row], frame=lane_frame, row=torch.arange(len(lane_row))),
            lane_points=replace(self.lane_points[point], detection=owner),
            dropped={},
        )

    def to(self, device: torch.device | str) -> Journey:
        """The same journey on another device."""
        return to_device(self, device)


@dataclass(frozen=True)
class Tracklets:
    """Which detections of one journey show the same physical object (IV-A)."""

    label: Int[Tensor, " d"]
    """Tracklet of each detection, 0 .. count - 1; -1 for none."""
    count: int
    shift: Int[Tensor, " d"] | None = None
    """Signs only: corner k of the tracklet is corner `(k + shift) % C` of the detection."""


@dataclass(frozen=True)
class Signs(Rows):
    """Traffic signs in the world: of one journey (O1), of many journeys, or of the map."""

    shape: Int[Tensor, " n"]
    type: Int[Tensor, " n"]
    T_world_sign: Float[Tensor, "n 4 4"]
    size: Float[Tensor, "n 2"]
    """Width and height along the sign's own axes [m]."""
    covariance: Float[Tensor, "n 3 3"]
    """Of the centre [m^2]. Of one journey: from triangulation alone, the pose error left out. Of the map: absolute."""
    journey: Int[Tensor, " n"]
    """Index of the journey; -1 for the map."""
    tracklet: Int[Tensor, " n"]
    """Tracklet of that journey; -1 for the map."""
    frame: Int[Tensor, " n"]
    """Frame index of closest approach in that journey; -1 for the map."""
    n_journeys: Int[Tensor, " n"]
    n_observations: Int[Tensor, " n"]
    first_seen_ns: Int[Tensor, " n"]
    last_seen_ns: Int[Tensor, " n"]
    confidence: Float[Tensor, " n"]

    @property
    def center_world(self) -> Float[Tensor, "n 3"]:
        """Mean of the corners [m]."""
        return self.T_world_sign[:, :3, 3]

    @property
    def normal_world(self) -> Float[Tensor, "n 3"]:
        """Unit normal, pointing at the driver."""
        return self.T_world_sign[:, :3, 2]

    @property
    def corners_world(self) -> Float[Tensor, "n 8 3"]:
        """Corners clockwise from the top-left; slots past the shape's number of corners repeat the last corner."""
        corners_sign = polygon.corners(self.shape, self.size)
        return se3.transform(self.T_world_sign[:, None], corners_sign)

    @property
    def corner_mask(self) -> Bool[Tensor, "n 8"]:
        """True for the slots that hold a corner of the shape."""
        return polygon.corner_mask(self.shape)


@dataclass(frozen=True)
class Lanes(Rows):
    """Pieces of lane markers; their control points are in `control`.

    Each piece is a natural cubic spline through its control points with uniform knots.
    """

    type: Int[Tensor, " n"]
    control_start: Int[Tensor, " n"]
    """First row of `control_points`."""
    control_count: Int[Tensor, " n"]
    """Number of control points, at least two."""
    journey: Int[Tensor, " n"]
    tracklet: Int[Tensor, " n"]
    frame: Int[Tensor, " n"]
    """Frame index of the journey in the middle of what it was made from; -1 for the map."""
    n_journeys: Int[Tensor, " n"]
    n_observations: Int[Tensor, " n"]
    first_seen_ns: Int[Tensor, " n"]
    last_seen_ns: Int[Tensor, " n"]
    confidence: Float[Tensor, " n"]
    control: ControlPoints

    def select(self, index: Tensor) -> Lanes:
        """The pieces at `index` with their control points packed in that order."""
        pieces = self[index]
        piece_of, rank = spline_basis.rows(pieces.control_count)
        control = self.control[pieces.control_start[piece_of] + rank]
        start = spline_basis.starts(pieces.control_count)
        return replace(pieces, control_start=start, control=control)

    @property
    def piece_of_control(self) -> Int[Tensor, " c"]:
        """The piece each control point belongs to; control points must be packed in the order of the pieces."""
        return spline_basis.rows(self.control_count)[0]


@dataclass(frozen=True)
class ControlPoints(Rows):
    """Control points of lane pieces, those of one piece adjacent and in order."""

    point_world: Float[Tensor, "c 3"]
    sigma: Float[Tensor, " c"]
    """1-sigma of the lateral position [m]."""


def concatenate_lanes(tables: Sequence[Lanes]) -> Lanes:
    """One table with the pieces of all, in order, their control points packed; at least one table is needed."""
    control = concatenate([t.control for t in tables])
    merged = concatenate(tables)
    start = merged.control_count.cumsum(0) - merged.control_count
    return replace(merged, control_start=start, control=control)


@dataclass(frozen=True)
class HdMap(HasPicture):
    """Signs and lanes in one local frame."""

    origin: Origin
    signs: Signs
    lanes: Lanes
    sign_id: tuple[str, ...]
    lane_id: tuple[str, ...]
    type_names: tuple[str, ...]
    shared_covariance: Float[Tensor, "3 3"]
    """The part of every position's covariance that all journeys share [m^2]."""
    provenance: dict

    def __repr__(self) -> str:
        place = torch.cat((self.signs.center_world, self.lanes.control.point_world))
        what = f"{len(self.signs):,} signs, {len(self.lanes):,} lane pieces"
        return f"HdMap({what}, {extent(place)} at {self.origin})"


@dataclass(frozen=True)
class Origin:
    """Where the local East-North-Up frame touches the WGS84 ellipsoid."""

    lat_deg: float
    lon_deg: float
    height_m: float

    def is_same(self, other: Origin) -> bool:
        """Whether two frames are one: within 1e-9 degrees and a millimetre."""
        away_deg = max(abs(self.lat_deg - other.lat_deg), abs(self.lon_deg - other.lon_deg))
        return away_deg <= 1e-9 and abs(self.height_m - other.height_m) <= 1e-3

    def __str__(self) -> str:
        return f"({self.lat_deg:.9f}, {self.lon_deg:.9f}, {self.height_m:.3f} m)"


@dataclass(frozen=True)
class RejectedJourney:
    """A journey that was set aside, and why: for people, and the rule that was broken (`io.errors.Code`), if it is one."""

    journey_id: str
    reason: str
    code: str = ""


@dataclass(frozen=True)
class Dataset(HasPicture):
    """What the mapper reads: journeys in use, and those set aside with their reasons."""

    origin: Origin
    journeys: tuple[Journey, ...]
    rejected: tuple[RejectedJourney, ...]
    type_names: tuple[str, ...]
    """Traffic-sign codes that occur, by code of the `type` columns."""
    bbox: tuple[float, float, float, float] | None = None
    """West, south, east and north [m] of the part of the world that it was cut to; None: it is whole."""

    def __repr__(self) -> str:
        what = f"{len(self.journeys):,} journeys, {len(self.rejected):,} set aside"
        return f"Dataset({what}, {_driven(self.journeys)} at {self.origin})"


@dataclass(frozen=True)
class SurveySigns(Rows):
    """Signs whose place is known: of a survey, or given as control points."""

    shape: Int[Tensor, " n"]
    """Index into `polygon.SHAPES`."""
    corners_world: Float[Tensor, "n 8 3"]
    """As in `Signs` (last corner repeated); NaN throughout where only the centre was surveyed."""
    center_world: Float[Tensor, "n 3"]
    normal_world: Float[Tensor, "n 3"]
    """Unit normal, pointing at the driver; NaN where neither corners nor a normal were surveyed."""
    sigma: Float[Tensor, " n"]
    """1-sigma of the position per axis [m]."""

    @property
    def has_corners(self) -> Bool[Tensor, " n"]:
        """True where the corners were surveyed, not the centre alone."""
        return self.corners_world.isfinite().all(-1).all(-1)


@dataclass(frozen=True)
class SurveyLanePoints(Rows):
    """Points of surveyed lane markers, those of one marker adjacent and in order."""

    lane: Int[Tensor, " p"]
    """Index into the survey's lanes, not decreasing."""
    point_world: Float[Tensor, "p 3"]


@dataclass(frozen=True)
class Survey(HasLayers):
    """What a map is measured against: signs and lane markers whose place is known."""

    origin: Origin
    sign_id: tuple[str, ...]
    signs: SurveySigns
    lane_id: tuple[str, ...]
    lane_type: Int[Tensor, " m"]
    """Index into `LANE_TYPES`; -1 unknown."""
    lane_points: SurveyLanePoints

    def __repr__(self) -> str:
        place = torch.cat((self.signs.center_world, self.lane_points.point_world))
        return f"Survey({len(self.signs):,} signs, {len(self.lane_id):,} lane markers, {extent(place)} at {self.origin})"


@dataclass(frozen=True)
class Association:
    """Which landmark of the map every detection of one journey shows; -1 for none."""

    sign: Int[Tensor, " d"]
    sign_shift: Int[Tensor, " d"]
    """Corner k of the map's sign is corner `(k + shift) % C` of the detection."""
    lane: Int[Tensor, " l"]
    """The lane that most points of the detection lie on."""


@dataclass(frozen=True)
class RoadEstimate(Rows):
    """The road under the car in every frame of one journey, in the camera frame (IV-C)."""

    normal_camera: Float[Tensor, "f 3"]
    """Unit normal from the camera towards the road."""
    height: Float[Tensor, " f"]
    """Distance from the camera centre to the road plane along it [m]."""
    sigma: Float[Tensor, " f"]
    """1-sigma of the normal's angle [rad]."""


def _driven(journeys: Sequence[Journey]) -> str:
    frames, signs, lanes = (
        sum(len(getattr(j, name)) for j in journeys) for name in ("t_ns", "signs", "lanes")
    )
    place = torch.cat([j.T_world_camera[:, :3, 3] for j in journeys] or [torch.zeros(0, 3)])
    return f"{frames:,} frames, {signs:,} sign and {lanes:,} lane detections, {extent(place)}"
