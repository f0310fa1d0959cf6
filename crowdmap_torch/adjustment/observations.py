"""Rows of bundle adjustment: every sign corner and lane point of all journeys, with its frame and landmark."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from crowdmap_torch.adjustment.lenses import SeenPoints, lenses_of, seen_points
from crowdmap_torch.geometry import camera, polygon
from crowdmap_torch.geometry.trajectory import station
from crowdmap_torch.noise.pixels import longer_side
from crowdmap_torch.road.ground_projection import ground_points_camera
from crowdmap_torch.tables import Association, Journey, RoadEstimate, Signs, concatenate

_CURVATURE = 1e-3
"""Vertical curvature of roads [1/m] that the plane under the car leaves out: a crest of 1 km radius."""


@dataclass(frozen=True)
class CornerObservations(SeenPoints):
    """Sign corners seen in frames; those of a detection are adjacent."""

    detection: Int[Tensor, " m"]
    """Sign detection, counted over all journeys, twice: the centre of a box is one of its own."""
    journey: Int[Tensor, " m"]
    sign: Int[Tensor, " m"]
    template: Float[Tensor, "m 2"]
    """The corner for width and height one, on the sign's plane."""
    box_px: Float[Tensor, " m"]
    """Larger side of the detection's box in the image."""
    loose_px: Float[Tensor, " m"]
    """What the detection's kind adds to the noise of a corner: the sides of a box are not those of the sign."""


@dataclass(frozen=True)
class LanePointObservations(SeenPoints):
    """Lane points seen in frames."""

    journey: Int[Tensor, " m"]
    detection: Int[Tensor, " m"]
    """Lane detection of the journey."""
    normal_camera: Float[Tensor, "m 3"]
    """The road's normal in that frame."""
    camera_height: Float[Tensor, " m"]
    height_sigma: Float[Tensor, " m"]
    """How well the road tells the height of this point [m]."""


def frame_offsets(journeys: Sequence[Journey]) -> list[int]:
    """Number of frames before each journey, and in the end of all."""
    offsets = [0]
    for journey in journeys:
        offsets.append(offsets[-1] + journey.frame_count)
    return offsets


def corner_observations(
    journeys: Sequence[Journey],
    associations: Sequence[Association],
    signs: Signs,
    *,
    box_sigma: float,
) -> CornerObservations:
    """Corners of the detections that show a sign of the map, where the shapes agree.

    Detections that are axis-aligned boxes, or have their shape drawn into one, were drawn around a sign, with sides wrong by
    the share `box_sigma`: their centres are rows of their own, and their corners know no more than that. With 0 they are
    outlines like others.
    """
    offsets, (_, lenses) = frame_offsets(journeys), lenses_of(journeys)
    begins = accumulate((len(journey.signs) for journey in journeys), initial=0)
    return concatenate(
        [
            _corners(journey, number, lens, association, signs, offset, detections, box_sigma)
            for number, (journey, lens, association, offset, detections) in enumerate(
                zip(journeys, lenses, associations, offsets, begins, strict=False)
            )
        ]
    )


def _corners(
    journey: Journey,
    number: int,
    lens: int,
    association: Association,
    signs: Signs,
    offset: int,
    before: int,
    box_sigma: float,
) -> CornerObservations:
    """The rows of one journey, the `number`-th, with `offset` frames and `before` detections before it."""
    detections = journey.signs
    used = torch.nonzero(association.sign >= 0)[:, 0]
    used = used[detections.shape[used] == signs.shape[association.sign[used]]]
    sign, shape = association.sign[used], detections.shape[used]
    count = polygon.corner_count(shape)
    slot = torch.arange(polygon.MAX_CORNERS, device=shape.device)
    shifted = (slot + association.sign_shift[used][:, None]) % count[:, None]
    at = shifted[..., None].expand(-1, -1, 2)
    px, ideal = (
        corners[used].gather(1, at) for corners in (detections.corners_px, detections.corners_ideal)
    )
    # Slots past the shape's number of corners repeat one of them.
    box = longer_side(px)
    mask, template = polygon.corner_mask(shape), polygon.template(shape)
    row, corner = torch.nonzero(mask, as_tuple=True)
    boxed = polygon.is_box(px, shape) & (box_sigma > 0)
    centre = torch.nonzero(boxed)[:, 0]

    def mean(at_corners: Float[Tensor, "d 8 2"]) -> Float[Tensor, "c 2"]:
        among = mask[centre, :, None].to(at_corners)
        return (at_corners[centre] * among).sum(1) / among.sum(1)

    of = torch.cat((row, centre))
    # What the centre of a box shows is the middle of undistorted corners, in the pixel where the lens has it.
    middle = mean(ideal)
    px = torch.cat((px[row, corner], camera.distort(journey.rig.camera, middle)))
    ideal = torch.cat((ideal[row, corner], middle))
    template = torch.cat((template[row, corner], mean(template)))
    loose = torch.zeros_like(box[of])
    loose[: len(row)] = box_sigma / 2 * box[row] * boxed[row]
    frame = detections.frame[used][of]
    return CornerObservations(
        **seen_points(journey.rig.camera, lens, px, ideal),
        frame=frame + offset,
        journey=torch.full_like(frame, number),
        detection=2 * (used[of] + before) + (torch.arange(len(of), device=of.device) >= len(row)),
        sign=sign[of],
        template=template,
        box_px=box[of],
        loose_px=loose,
    )


def lane_point_observations(
    journeys: Sequence[Journey],
    roads: Sequence[RoadEstimate],
    *,
    keyframe_spacing: float,
    points_per_detection: int,
    height_sigma: float,
) -> LanePointObservations:
    """Points of lane detections in frames at least `keyframe_spacing` [m] apart, evenly thinned.

    The height that the road gives a point is trusted to `height_sigma` [m] under the car, and less further ahead, where
    the normal's own error and the road's curvature tell.
    """
    offsets, (_, lenses) = frame_offsets(journeys), lenses_of(journeys)
    tables = []
    for number, (journey, road, offset) in enumerate(zip(journeys, roads, offsets, strict=False)):
        cell = (station(journey.T_world_camera) / keyframe_spacing).floor()
        key = torch.ones_like(cell, dtype=torch.bool)
        key[1:] = cell[1:] != cell[:-1]
        points = journey.lane_points
        rank = rank_within(points.detection)
        count = torch.bincount(points.detection, minlength=len(journey.lanes))[points.detection]
        # Evenly spread ranks: kept where the scaled rank passes an integer.
        wanted = count.clamp_max(points_per_detection)
        thin = (rank * wanted) // count != ((rank - 1) * wanted).div(count, rounding_mode="floor")
        use = thin & key[journey.lanes.frame[points.detection]]
        points = points[use]
        frame = journey.lanes.frame[points.detection]
        normal = road.normal_camera[frame]
        # The plane is put through the road where the car drove it later: beside the car a road that
        # leans ever more would be off by decimetres at the next bend.
        on_road, is_met = ground_points_camera(journey, road, points)
        ray = torch.nn.functional.pad(points.ideal, (0, 1), value=1.0)
        height = torch.where(is_met, (normal * on_road).sum(-1), road.height[frame])
        distance = height / (normal * ray).sum(-1).clamp_min(1e-3)
        slope = road.sigma[frame] + distance * _CURVATURE
        tables.append(
            LanePointObservations(
                **seen_points(journey.rig.camera, lenses[number], points.px, points.ideal),
                frame=frame + offset,
                journey=torch.full_like(points.detection, number),
                detection=points.detection,
                normal_camera=normal,
                camera_height=height,
                height_sigma=(height_sigma**2 + (slope * distance).square()).sqrt(),
            )
        )
    return concatenate(tables)


def spaced_frames(journey: Journey, used: Bool[Tensor, " f"], spacing: float) -> Bool[Tensor, " f"]:
    """The used frames, thinned to one per `spacing` metres of travel: a car at a light sees one picture."""
    index = torch.nonzero(used)[:, 0]
    cell = (station(journey.T_world_camera)[index] / spacing).floor()
    first = torch.ones_like(cell, dtype=torch.bool)
    first[1:] = cell[1:] != cell[:-1]
    kept = torch.zeros_like(used)
    kept[index[first]] = True
    return kept


def rank_within(group: Int[Tensor, " m"]) -> Int[Tensor, " m"]:
    """Position of each row among the adjacent rows of its group."""
    index = torch.arange(len(group), device=group.device)
    first = torch.ones_like(group, dtype=torch.bool)
    first[1:] = group[1:] != group[:-1]
    return index - index[first][first.cumsum(0) - 1]
