"""What journeys have seen of the truth, and what their pose errors make of it (the oracle)."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree
from torch import Tensor

from crowdmap_torch.clustering.groups import group_argmin
from crowdmap_torch.clustering.neighbours import layered
from crowdmap_torch.evaluation.polyline import Samples
from crowdmap_torch.evaluation.statistics import PositionFigures, position_figures
from crowdmap_torch.geometry import polygon, se3
from crowdmap_torch.io.truth import JourneyTruth, Truth
from crowdmap_torch.tables import SurveySigns

MIN_JOURNEYS = 3
"""A true sign is observable if this many journeys detect it ..."""
MIN_FRAMES = 5
"""... in this many frames each."""
_BESIDE_M = 1.5
"""A lane point on the road further from its own marker than this is an outlier and says nothing of
what was seen."""


def observable_signs(truth: Truth, survey: SurveySigns) -> Bool[Tensor, " n"]:
    """True for the signs that three or more journeys detect in five or more frames each."""
    journeys = torch.zeros(len(survey), dtype=torch.int64, device=survey.shape.device)
    for journey in truth.journeys:
        journeys += frames_of_signs(journey, len(survey)) >= MIN_FRAMES
    return journeys >= MIN_JOURNEYS


def frames_of_signs(truth: JourneyTruth, count: int) -> Int[Tensor, " n"]:
    """In how many frames of a journey each of `count` true signs is detected."""
    shown = (truth.sign >= 0) & (truth.sign_frame >= 0)
    frames = max(truth.journey.frame_count, 1)
    # A sign that is detected twice in a frame is seen in one frame.
    key = (truth.sign[shown] * frames + truth.sign_frame[shown]).unique()
    return torch.bincount(key.div(frames, rounding_mode="floor"), minlength=count)


def oracle_figures(
    truth: Truth, survey: SurveySigns, counted: Bool[Tensor, " n"]
) -> tuple[PositionFigures, PositionFigures]:
    """The oracle's errors of corners and of centres.

    Each true sign is moved by the mean true pose error, position and rotation, of the journeys that
    see it, at closest approach.
    """
    corner_sum = torch.zeros_like(survey.corners_world)
    center_sum = torch.zeros_like(survey.center_world)
    seen = torch.zeros_like(survey.center_world[:, 0])
    for journey in truth.journeys:
        sign, frame = nearest_detections(journey, survey)
        T_given_true = se3.inverse(journey.T_true_given)[frame]
        corner = survey.corners_world[sign]
        center = survey.center_world[sign]
        corner_sum.index_add_(0, sign, se3.transform(T_given_true[:, None], corner) - corner)
        center_sum.index_add_(0, sign, se3.transform(T_given_true, center) - center)
        seen.index_add_(0, sign, torch.ones_like(seen[sign]))
    counted = counted & (seen > 0)
    mean = 1 / seen.clamp_min(1)
    corner_error = torch.where(
        survey.has_corners[:, None, None], corner_sum * mean[:, None, None], 0.0
    )
    centre = torch.ones_like(seen, dtype=torch.bool)[:, None]
    return (
        position_figures(
            corner_error, polygon.corner_mask(survey.shape), counted & survey.has_corners
        ),
        position_figures((center_sum * mean[:, None])[:, None], centre, counted),
    )


def nearest_detections(
    truth: JourneyTruth, survey: SurveySigns
) -> tuple[Int[Tensor, " k"], Int[Tensor, " k"]]:
    """The signs that a journey detects, and the nearest frame in which each is detected."""
    shown = (truth.sign >= 0) & (truth.sign_frame >= 0)
    sign, frame = truth.sign[shown], truth.sign_frame[shown]
    distance = (truth.T_world_camera[frame, :3, 3] - survey.center_world[sign]).norm(dim=-1)
    detected, group = sign.unique(return_inverse=True)
    return detected, frame[group_argmin(distance, group)]


def seen_by_journeys(truth: Truth, samples: Samples) -> Int[Tensor, " p"]:
    """How many journeys have seen each sample of the true markers.

    A detection shows its marker from its nearest to its farthest point, put on the true road by
    the true pose.
    """
    journeys = torch.zeros_like(samples.line)
    if not len(samples):
        return journeys
    markers = KDTree(_on_markers(samples.point_world, samples.line))
    for journey in truth.journeys:
        journeys += _seen_by(journey, samples, markers)
    return journeys


def _seen_by(truth: JourneyTruth, samples: Samples, markers: KDTree) -> Bool[Tensor, " p"]:
    detections, points = truth.journey.lanes, truth.journey.lane_points
    nothing = torch.zeros_like(samples.line, dtype=torch.bool)
    if len(points) == 0:
        return nothing
    lane = truth.lane[detections.row]
    frame = detections.frame[points.detection]
    ray = torch.cat((points.ideal, torch.ones_like(points.ideal[:, :1])), dim=-1)
    below = (truth.road_normal_camera[frame] * ray).sum(-1)
    usable = (below > 1e-6) & (lane[points.detection] >= 0)
    depth = truth.camera_height[frame] / torch.where(usable, below, 1.0)
    # The nearest and the farthest point of each detection bound what it shows.
    ends = [
        _row_of_extreme(sign * depth, points.detection, usable, len(detections))
        for sign in (1.0, -1.0)
    ]
    both = (ends[0] >= 0) & (ends[1] >= 0)
    place = []
    for row in ends:
        row = row[both]
        point = se3.transform(truth.T_world_camera[frame[row]], ray[row] * depth[row][:, None])
        place.append(_nearest_sample(point, lane[both], markers))
    known = (place[0] >= 0) & (place[1] >= 0)
    low = torch.minimum(place[0], place[1])[known]
    high = torch.maximum(place[0], place[1])[known]
    change = torch.zeros(len(samples) + 1, dtype=torch.int64, device=low.device)
    change = change.index_add(0, low, torch.ones_like(low))
    change = change.index_add(0, high + 1, -torch.ones_like(high))
    return change.cumsum(0)[:-1] > 0


def _row_of_extreme(
    value: Float[Tensor, " p"], group: Int[Tensor, " p"], usable: Bool[Tensor, " p"], count: int
) -> Int[Tensor, " g"]:
    """The row of the smallest usable value of each group; -1 for a group without one."""
    rows = usable.nonzero()[:, 0]
    groups, dense = group[rows].unique(return_inverse=True)
    none = torch.full((count,), -1, dtype=torch.int64, device=value.device)
    return none.index_put((groups,), rows[group_argmin(value[rows], dense)])


def _nearest_sample(
    point_world: Float[Tensor, "n 3"], lane: Int[Tensor, " n"], markers: KDTree
) -> Int[Tensor, " n"]:
    """The horizontally nearest sample of its own marker to each point; -1 if none is near."""
    of_own = _on_markers(point_world, lane)
    distance, index = markers.query(of_own, distance_upper_bound=_BESIDE_M)
    found = torch.as_tensor(index).to(lane)
    return torch.where(torch.as_tensor(distance).to(point_world).isfinite(), found, -1)


def _on_markers(
    point_world: Float[Tensor, "n 3"], lane: Int[Tensor, " n"]
) -> Float[np.ndarray, "n 3"]:
    """East and north, the markers out of each other's reach: a tree answers for each point's own one."""
    return layered(point_world[:, :2], lane, _BESIDE_M).cpu().numpy()
