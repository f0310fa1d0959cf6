"""What one journey alone is worth, its pose error taken off (METRICS.md, One journey)."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from crowdmap_torch.clustering.groups import group_argmin
from crowdmap_torch.clustering.neighbours import pairs_between
from crowdmap_torch.evaluation.lanes import (
    LaneEvaluationConfig,
    survey_samples,
    width_errors,
    within_gate,
)
from crowdmap_torch.evaluation.polyline import Samples, lane_samples, nearest
from crowdmap_torch.evaluation.signs import SignEvaluationConfig, compare_signs
from crowdmap_torch.evaluation.statistics import (
    ErrorFigures,
    PositionFigures,
    error_figures,
    position_figures,
    share,
)
from crowdmap_torch.evaluation.visibility import frames_of_signs
from crowdmap_torch.geometry import camera as camera_module
from crowdmap_torch.geometry import se3
from crowdmap_torch.io.truth import JourneyTruth
from crowdmap_torch.processes.threads import in_order
from crowdmap_torch.ranges import Count, Settings
from crowdmap_torch.survey.matching import DUPLICATE, FALSE
from crowdmap_torch.tables import Lanes, Signs, Survey

_SIGN_RANGE_M = 120.0
_LANE_RANGE_M = 40.0
"""Frames further from a landmark are not looked at for the closest approach."""
_NEAR = 3
"""Frames in so small a part of that are looked at first."""
_VIEW_STEP_M = 5.0
"""Distance of the places along a lane whose closest approach is looked up."""


@dataclass(frozen=True)
class SingleJourneyConfig(Settings):
    """Which true signs a journey is expected to map."""

    min_frames: Count = 10
    """Recall is over true signs detected in this many frames of the journey."""
    signs: SignEvaluationConfig = field(default_factory=SignEvaluationConfig)
    lanes: LaneEvaluationConfig = field(default_factory=LaneEvaluationConfig)


@dataclass(frozen=True)
class JourneyLandmarks:
    """What one journey alone made of the world: RUN/journeys/ID/signs.parquet and lanes.parquet."""

    journey_id: str
    signs: Signs
    lanes: Lanes


@dataclass(frozen=True)
class SingleJourneyFigures:
    """Figures [m] over the landmarks of all journeys, the true pose errors taken off."""

    journeys: int
    signs: int
    corner: PositionFigures
    center: PositionFigures
    normal_deg: ErrorFigures
    recall: float
    """Of the true signs detected in ten or more frames, journey by journey."""
    duplicates: float
    """Share of the landmarks that stand beside a true sign that another one has taken."""
    ghosts: float
    """Share of the landmarks further than 3 m from every true sign."""
    lane_lateral: ErrorFigures
    lane_vertical: ErrorFigures
    lane_width: ErrorFigures
    """Of the distance between neighbouring markers."""
    lane_precision: float
    """Share of the lanes' length within the gate of a true marker."""


@dataclass(frozen=True)
class _Part:
    """The raw numbers of one journey, to be put together over all."""

    corner: Float[Tensor, "k 8 3"]
    corner_mask: Bool[Tensor, "k 8"]
    center: Float[Tensor, "k 1 3"]
    normal_deg: Float[Tensor, " k"]
    lateral: Float[Tensor, " p"]
    vertical: Float[Tensor, " p"]
    width: Float[Tensor, " w"]
    expected: int
    found: int
    duplicates: int
    false: int
    signs: int
    lane_samples: int
    lane_right: int


def evaluate_single_journeys(
    landmarks: list[JourneyLandmarks],
    truths: list[JourneyTruth],
    survey: Survey,
    config: SingleJourneyConfig | None = None,
) -> SingleJourneyFigures:
    """Figures over the landmarks of journeys; `truths` in the same order."""
    config = config or SingleJourneyConfig()
    samples = survey_samples(survey, config.lanes.step_m)

    def part(of: tuple[JourneyLandmarks, JourneyTruth]) -> _Part:
        return _evaluate_one(*of, survey, samples, config)

    device = samples.point_world.device
    parts = list(in_order(part, list(zip(landmarks, truths, strict=True)), device))
    if not parts:
        raise ValueError("no journey to evaluate: expected at least one with landmarks and truth")

    def joined(name: str) -> Tensor:
        return torch.cat([getattr(part, name) for part in parts])

    def total(name: str) -> int:
        return sum(getattr(part, name) for part in parts)

    center, mask, signs = joined("center"), joined("corner_mask"), total("signs")
    every = torch.ones_like(center[..., 0], dtype=torch.bool)
    return SingleJourneyFigures(
        journeys=len(parts),
        signs=signs,
        corner=position_figures(joined("corner"), mask, mask.any(-1)),
        center=position_figures(center, every, every[:, 0]),
        normal_deg=error_figures(joined("normal_deg")),
        recall=share(total("found"), total("expected")),
        duplicates=share(total("duplicates"), signs),
        ghosts=share(total("false"), signs),
        lane_lateral=error_figures(joined("lateral").abs()),
        lane_vertical=error_figures(joined("vertical").abs()),
        lane_width=error_figures(joined("width")),
        lane_precision=share(total("lane_right"), total("lane_samples")),
    )


def _evaluate_one(
    landmarks: JourneyLandmarks,
    truth: JourneyTruth,
    survey: Survey,
    true_samples: Samples,
    config: SingleJourneyConfig,
) -> _Part:
    signs = without_pose_error(landmarks.signs, truth)
    c = compare_signs(signs, survey.signs, config=config.signs)
    expected = frames_of_signs(truth, len(survey.signs)) >= config.min_frames
    found = torch.zeros_like(expected).index_fill(0, c.true_row, True)
    mapped = lane_samples(landmarks.lanes, config.lanes.step_m)
    # A pose error changes slowly: samples share the view of one a few metres before them.
    anchor = _anchors(mapped.line, max(round(_VIEW_STEP_M / config.lanes.step_m), 1))
    anchors, of_sample = anchor.unique(return_inverse=True)
    frame = nearest_seeing_frame(truth, mapped.point_world[anchors], _LANE_RANGE_M)[of_sample]
    moved = se3.transform(truth.T_true_given[frame], mapped.point_world)
    mapped = replace(mapped, point_world=moved)
    # From the map's points to the true markers: a journey sees pieces, and nobody expects the rest
    # of it.
    on_marker = nearest(within_gate(mapped, true_samples, config.lanes))
    beside_marker = nearest(within_gate(true_samples, mapped, config.lanes))
    return _Part(
        corner=c.corner_error_world,
        corner_mask=c.corner_mask,
        center=c.center_error_world,
        normal_deg=c.normal_deg,
        lateral=on_marker.lateral,
        vertical=on_marker.vertical,
        width=width_errors(true_samples, mapped, beside_marker, config.lanes),
        expected=int(expected.sum()),
        found=int((expected & found).sum()),
        duplicates=int((c.match.true_of_map == DUPLICATE).sum()),
        false=int((c.match.true_of_map == FALSE).sum()),
        signs=len(signs),
        lane_samples=len(mapped),
        lane_right=len(on_marker),
    )


def _anchors(line: Int[Tensor, " p"], every: int) -> Int[Tensor, " p"]:
    """For each sample the row of the last one on its line whose rank is a multiple of `every`."""
    row = torch.arange(len(line), device=line.device)
    _, count = torch.unique_consecutive(line, return_counts=True)
    first = torch.repeat_interleave(count.cumsum(0) - count, count)
    return row - (row - first) % every


def without_pose_error(signs: Signs, truth: JourneyTruth) -> Signs:
    """The signs as they would be had the pose at closest approach been the true one."""
    frame = nearest_seeing_frame(truth, signs.center_world, _SIGN_RANGE_M)
    return replace(signs, T_world_sign=truth.T_true_given[frame] @ signs.T_world_sign)


def nearest_seeing_frame(
    truth: JourneyTruth, point_world: Float[Tensor, "n 3"], range_m: float
) -> Int[Tensor, " n"]:
    """For each point (world as the given poses have it) the nearest frame that has it in its image.

    A pose drifts on from where a landmark was last seen to where the car passes it, so it is
    the view that counts; the nearest frame of all stands in where no frame within `range_m` has
    the point in its image.
    """
    near = _nearest_frame(truth, point_world, range_m / _NEAR)
    # Most points are seen from near; no frame beyond is nearer, or seen from nearer, than one within.
    left = (~near.visible).nonzero()[:, 0]
    far = _nearest_frame(truth, point_world[left], range_m)
    return near.frame.index_put((left,), far.frame)


@dataclass(frozen=True)
class _Nearest:
    """For each point the nearest frame that sees it; the nearest of all where none does, 0 where none is near."""

    frame: Int[Tensor, " n"]
    visible: Bool[Tensor, " n"]


def _nearest_frame(
    truth: JourneyTruth, point_world: Float[Tensor, "n 3"], range_m: float
) -> _Nearest:
    T_camera_world = se3.inverse(truth.journey.T_world_camera)
    position = truth.journey.T_world_camera[:, :3, 3]
    point, frame, distance = pairs_between(point_world, position, radius=range_m)
    in_camera = se3.transform(T_camera_world[frame], point_world[point])
    _, visible = camera_module.project(truth.journey.rig.camera, in_camera)
    # A frame that does not see the point loses against every frame that does, and the nearest of
    # those is left otherwise.
    cost = torch.where(visible, distance, distance + 10 * range_m)
    points, group = point.unique(return_inverse=True)
    best = group_argmin(cost, group)
    none = torch.zeros(len(point_world), dtype=torch.int64, device=point_world.device)
    return _Nearest(
        frame=none.index_put((points,), frame[best]),
        visible=none.bool().index_put((points,), visible[best]),
    )
