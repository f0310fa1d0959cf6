"""Lanes of a map against those of a survey (METRICS.md, Lanes)."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.evaluation.polyline import (
    Crossings,
    Samples,
    crossings,
    lane_samples,
    nearest,
    sample_polylines,
)
from crowdmap_torch.evaluation.statistics import ErrorFigures, error_figures, share
from crowdmap_torch.ranges import Count, Length, Settings, Spacing, Span
from crowdmap_torch.tables import Lanes, Survey


@dataclass(frozen=True)
class LaneEvaluationConfig(Settings):
    """How true markers are sampled and when a sample counts as found."""

    step_m: Spacing = 0.5
    """Distance of the samples along a marker."""
    lateral_gate_m: Length = 0.5
    vertical_gate_m: Length = 2.0
    min_journeys: Count = 3
    """Recall is over the length seen by this many journeys."""
    width_m: Span = (2.0, 5.0)
    """The neighbouring marker is this far away."""
    width_step_m: Spacing = 2.5
    """Distance of the places where the lane width is taken."""


@dataclass(frozen=True)
class LaneFigures:
    """METRICS.md's figures of lanes, in metres."""

    true_length_m: float
    """Of all true markers."""
    seen_length_m: float
    """Of what three or more journeys have seen."""
    map_length_m: float
    recall: float
    precision: float
    duplicates: float
    """Share of the found true points that two or more map lines cover."""
    lateral: ErrorFigures
    vertical: ErrorFigures
    lateral_without_shift: ErrorFigures
    """After the shift that the matched signs show was taken off the map."""
    vertical_without_shift: ErrorFigures
    width: ErrorFigures
    """Absolute difference of the lane width to the true one, both to the neighbour on the left."""
    sigma_coverage: float
    """Share of found points whose lateral error without the shift is inside the map's 95 %
    interval, the part that all journeys share taken out of it."""


def survey_samples(survey: Survey, step_m: float) -> Samples:
    """Points along the surveyed markers, `line` being the survey's lane."""
    return sample_polylines(survey.lane_points.lane, survey.lane_points.point_world, step_m)


def evaluate_lanes(
    lanes: Lanes,
    survey: Survey,
    *,
    seen_by: Int[Tensor, " p"] | None = None,
    shift: Float[Tensor, " 3"] | None = None,
    shared_covariance: Float[Tensor, "3 3"] | None = None,
    config: LaneEvaluationConfig | None = None,
) -> LaneFigures:
    """Figures of lane pieces against surveyed markers.

    `seen_by` says of every sample of `survey_samples` how many journeys have seen it (None: all
    count); `shift` is what the matched signs show, map minus truth.
    """
    config = config or LaneEvaluationConfig()
    true = survey_samples(survey, config.step_m)
    mapped = lane_samples(lanes, config.step_m)
    seen = torch.ones_like(true.line, dtype=torch.bool)
    if seen_by is not None:
        seen = seen_by >= config.min_journeys
    by_line = within_gate(true, mapped, config)
    found = nearest(by_line)
    covered = torch.bincount(by_line.point, minlength=len(true))
    back = within_gate(mapped, true, config)
    right = torch.zeros_like(mapped.line, dtype=torch.bool).index_fill(0, back.point, True)
    weight_true, weight_map = length_of_samples(true), length_of_samples(mapped)
    seen_length = weight_true[seen]
    unshifted = (
        replace(mapped, point_world=mapped.point_world - shift) if shift is not None else mapped
    )
    clean = nearest(within_gate(true, unshifted, config)) if shift is not None else found
    return LaneFigures(
        true_length_m=float(weight_true.sum()),
        seen_length_m=float(seen_length.sum()),
        map_length_m=float(weight_map.sum()),
        recall=_share_of(weight_true, seen & (covered > 0), seen),
        precision=_share_of(weight_map, right, torch.ones_like(right)),
        duplicates=share(int((covered > 1).sum()), int((covered > 0).sum())),
        lateral=error_figures(found.lateral.abs()),
        vertical=error_figures(found.vertical.abs()),
        lateral_without_shift=error_figures(clean.lateral.abs()),
        vertical_without_shift=error_figures(clean.vertical.abs()),
        width=error_figures(width_errors(true, mapped, found, config)),
        sigma_coverage=_coverage(true, clean, shared_covariance),
    )


def length_of_samples(samples: Samples) -> Float[Tensor, " p"]:
    """The length of line that each sample stands for [m]."""
    half = (samples.point_world[1:] - samples.point_world[:-1]).norm(dim=-1) / 2
    half = torch.where(samples.line[1:] == samples.line[:-1], half, 0.0)
    edge = samples.point_world.new_zeros(min(len(samples), 1))
    return torch.cat((edge, half)) + torch.cat((half, edge))


def within_gate(at: Samples, lines: Samples, config: LaneEvaluationConfig) -> Crossings:
    """Where `lines` cross beside the samples `at`, near enough to be the same marker."""
    return crossings(at, lines, lateral_m=config.lateral_gate_m, vertical_m=config.vertical_gate_m)


def _share_of(weight: Tensor, part: Tensor, whole: Tensor) -> float:
    total = float(weight[whole].sum())
    return float(weight[part].sum()) / total if total > 0 else math.nan


def width_errors(
    true: Samples, mapped: Samples, found: Crossings, config: LaneEvaluationConfig
) -> Float[Tensor, " w"]:
    """Absolute errors of the distance to the left neighbour, at found points a few metres apart.

    `found` are the places where the nearest line of the map crosses beside the true points.
    """
    every = max(round(config.width_step_m / config.step_m), 1)
    own = found[(found.point % every) == 0]
    at = true[own.point]
    low, high = config.width_m
    middle, reach = (low + high) / 2, (high - low) / 2
    offset = torch.full_like(own.lateral, middle)
    beside = crossings(
        at, true, lateral_m=reach, vertical_m=config.vertical_gate_m, offset_m=offset
    )
    beside = beside[beside.line != at.line[beside.point]]
    neighbour = nearest(beside)
    offset = offset.index_put((neighbour.point,), neighbour.lateral)
    has = torch.zeros_like(own.point, dtype=torch.bool).index_fill(0, neighbour.point, True)
    there = crossings(
        at,
        mapped,
        lateral_m=config.lateral_gate_m,
        vertical_m=config.vertical_gate_m,
        offset_m=offset,
    )
    there = nearest(there, offset)
    there = there[has[there.point]]
    return ((there.lateral - own.lateral[there.point]) - offset[there.point]).abs()


def _coverage(
    true: Samples, clean: Crossings, shared_covariance: Float[Tensor, "3 3"] | None
) -> float:
    """Share of lateral errors inside 1.96 sigma, the shared part taken out of the sigma."""
    variance = clean.sigma.square()
    if shared_covariance is not None:
        along = true.along[clean.point]
        left = torch.stack((-along[:, 1], along[:, 0]), dim=-1)
        shared = torch.einsum("pi,ij,pj->p", left, shared_covariance[:2, :2].to(left), left)
        variance = (variance - shared).clamp_min(0)
    known = variance.isfinite() & (clean.sigma > 0)
    inside = clean.lateral.abs() <= 1.959964 * variance.sqrt()
    return share(int((inside & known).sum()), int(known.sum()))
