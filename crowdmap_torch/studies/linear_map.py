"""The best that can be done, by plain dense algebra: least squares linearised at the truth, and its covariance.

The estimator knows what each detection shows, which ones are outliers, and all noise levels; the poses' error and the
tremble of detectors are the exact Gaussian processes of the simulation. What cars have wrong it has to find (`linear_cars`).
Its covariance is the Cramer-Rao bound. Nothing here is shared with the solver but the residuals: one dense matrix per
journey, so it is for roads of a few hundred metres.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.adjustment import adjust
from crowdmap_torch.adjustment.bundle import Bundle
from crowdmap_torch.adjustment.calibration import CalibrationConfig
from crowdmap_torch.adjustment.config import AdjustConfig
from crowdmap_torch.evaluation.visibility import observable_signs
from crowdmap_torch.geometry import camera, polygon, se3, spline_basis
from crowdmap_torch.io.truth import JourneyTruth, Truth
from crowdmap_torch.noise.positioning import PositioningNoise
from crowdmap_torch.optim.linearize import linearize, rows, sum_of_products
from crowdmap_torch.optim.problem import CostTerm
from crowdmap_torch.optim.robust import Quadratic
from crowdmap_torch.simulate.dataset import SimulationConfig
from crowdmap_torch.simulate.positioning import PositioningConfig
from crowdmap_torch.simulate.sign_detections import SignDetectionConfig
from crowdmap_torch.studies.linear_cars import calibration_of, prior_of_cars, true_cars
from crowdmap_torch.tables import Association, ControlPoints, Lanes, RoadEstimate, Signs, Survey

CONTROL_SPACING_M = 8.0
"""Distance between the control points of the true lanes."""
_OUTLIER_SIGMAS = 4.5
"""A lane point this far from its marker is one of the outliers, which the truth does not name."""


@dataclass(frozen=True)
class LinearMap:
    """Signs as the linear estimator has them."""

    signs: Signs
    """With the bound as covariance of the centres."""
    row: Int[Tensor, " n"]
    """The survey's sign of each."""
    shared: Float[Tensor, "3 3"]
    """Mean covariance between any two centres of observable signs [m^2]."""


@torch.no_grad()
def linear_map(
    truth: Truth,
    survey: Survey,
    true_signs: Signs,
    simulation: SimulationConfig,
    vehicles: Mapping[str, Any] | None = None,
) -> LinearMap:
    """The estimate from all detections of a simulated dataset, and the Cramer-Rao bound of it.

    `true_signs` are the rows of `survey`; `vehicles`, the truth of cars, is where the search for what they have wrong
    begins: None where they have nothing wrong.
    """
    shown = torch.cat([_shown(t) for t in truth.journeys])
    row = torch.unique(shown[shown >= 0])
    cars = vehicles, calibration_of(simulation.fleet)
    bundle = _bundle_at_truth(truth, survey, true_signs, row, *cars)
    seen = bundle.corners.sign.unique()
    if len(seen) < len(row):
        # Frames at a standstill are thinned: some signs may have no detection left.
        row = row[seen]
        bundle = _bundle_at_truth(truth, survey, true_signs, row, *cars)
    signs = true_signs[row]
    # What holds the landmarks where observations do not, as in our adjustment.
    information, force = _normal_equations(
        bundle, list(bundle.fixed.values()), poses=0, first_pose=0
    )
    held, place = _held_along(bundle), _columns(bundle)
    information[: len(held), : len(held)] += held
    for name, own, push in prior_of_cars(bundle.values(), bundle.fleet, simulation.fleet):
        at = slice(place[name], place[name] + len(push))
        information[at, at] += own
        force[at] += push
    for number, journey in enumerate(truth.journeys):
        own, push = _of_journey(bundle, truth, number, journey, simulation)
        information += own
        force += push
    covariance = torch.cholesky_inverse(torch.linalg.cholesky(information))
    delta = -(covariance @ force)
    n = len(signs)
    pose, size = delta[: 6 * n].view(n, 6), delta[6 * n : 8 * n].view(n, 2)
    at = 6 * torch.arange(n)[:, None] + torch.arange(3)
    # A sign seen once or twice is metres off: it has no part in what all share.
    often = at[observable_signs(truth, survey.signs)[row]]
    often = (often if len(often) else at).T
    shared = covariance[often[:, None, :, None], often[None, :, None, :]].mean((-1, -2))
    moved = replace(
        signs,
        T_world_sign=se3.retract(signs.T_world_sign, pose),
        size=signs.size * torch.exp(size),
        covariance=covariance[at[:, :, None], at[:, None]],
    )
    return LinearMap(moved, row, shared)


def _shown(truth: JourneyTruth) -> Int[Tensor, " d"]:
    """The survey's sign that each detection in use shows; -1 for false ones and outliers."""
    row = truth.journey.signs.row
    return torch.where(truth.sign_outlier[row], -1, truth.sign[row])


def _bundle_at_truth(
    truth: Truth,
    survey: Survey,
    true_signs: Signs,
    row: Int[Tensor, " n"],
    vehicles: Mapping[str, Any] | None = None,
    unknown: CalibrationConfig | None = None,
) -> Bundle:
    """All observations of the signs `row` and of lanes with their true landmarks, started at the truth.

    So are the cars of the `vehicles`, whose calibrations are `unknown`.
    """
    of_survey = torch.full((len(true_signs),), -1)
    of_survey[row] = torch.arange(len(row))
    signs = true_signs[row]
    journeys = [t.journey for t in truth.journeys]
    roads = [
        RoadEstimate(
            t.road_normal_camera,
            t.camera_height,
            torch.full_like(t.camera_height, math.radians(0.1)),
        )
        for t in truth.journeys
    ]
    drifts = [se3.local(t.journey.T_world_camera, t.T_world_camera) for t in truth.journeys]
    config = AdjustConfig(keyframe_spacing_m=0.25, points_per_detection=24)
    associations = [_association(t, signs, of_survey) for t in truth.journeys]
    lanes = _true_lanes(survey)
    noise = PositioningNoise()
    told = journeys, roads, signs, lanes, associations, drifts, noise, config
    bundle = adjust.build(*told, calibration=None if vehicles is None else unknown)
    bundle.fold(true_cars(bundle.values(), bundle.fleet, vehicles or {}))
    bundle.relinearise()
    for _ in range(_REFRESHES):
        bundle.refresh()
    return bundle


def _association(truth: JourneyTruth, signs: Signs, of_survey: Tensor) -> Association:
    journey = truth.journey
    shown = _shown(truth)
    row = torch.where(shown >= 0, of_survey[shown], -1)
    row = torch.where((row >= 0) & (signs.shape[row] == journey.signs.shape), row, -1)
    seen = torch.nonzero(row >= 0)[:, 0]
    of = signs[row[seen]]
    T_camera_world = se3.inverse(truth.T_world_camera[journey.signs.frame[seen]])
    px, _ = camera.project(
        journey.rig.camera, se3.transform(T_camera_world[:, None], of.corners_world)
    )
    shift = torch.zeros_like(row)
    shift[seen], _ = polygon.best_shift(
        px, journey.signs.corners_px[seen], polygon.corner_count(of.shape)
    )
    return Association(row, shift, torch.full_like(journey.lanes.row, -1))


def _true_lanes(survey: Survey) -> Lanes:
    """Splines through points of the surveyed markers, equally spaced."""
    points = []
    for number in range(len(survey.lane_id)):
        line = survey.lane_points.point_world[survey.lane_points.lane == number]
        way = torch.cat((line.new_zeros(1), (line[1:] - line[:-1]).norm(dim=1).cumsum(0)))
        count = max(int(way[-1] / CONTROL_SPACING_M), 1) + 1
        at = torch.linspace(0, float(way[-1]), count, dtype=way.dtype)
        after = torch.searchsorted(way, at).clamp(1, len(way) - 1)
        share = (at - way[after - 1]) / (way[after] - way[after - 1])
        points.append(torch.lerp(line[after - 1], line[after], share[:, None]))
    count = torch.tensor([len(p) for p in points])
    unknown = torch.full_like(count, -1)
    point = torch.cat(points)
    return Lanes(
        type=survey.lane_type,
        control_start=count.cumsum(0) - count,
        control_count=count,
        journey=unknown,
        tracklet=unknown,
        frame=unknown,
        n_journeys=unknown,
        n_observations=unknown,
        first_seen_ns=unknown,
        last_seen_ns=unknown,
        confidence=count.to(point),
        control=ControlPoints(point, torch.full_like(point[:, 0], math.nan)),
    )


_REFRESHES = 3
"""Until lane points rest at the splines' nearest places: they begin up to a control point away."""
_AFTER = "after"
"""What `_columns` calls the first column behind all."""


def _columns(bundle: Bundle) -> dict[str, int]:
    """First column of each kind of landmark, and of what cars have wrong."""
    values = bundle.values()
    n = len(values["sign"])
    found, first = {"sign": 0, "size": 6 * n, "lane": 8 * n}, 8 * n + values["lane"].numel()
    for name in bundle.fleet.variables:
        found[name] = first
        first += values[name].numel()
    return {**found, _AFTER: first}


def _held_along(bundle: Bundle) -> Float[Tensor, "c c"]:
    """Information that holds each marker along itself to the signs, to a metre: nothing else tells where it is along itself.

    By hundreds of metres it would slide, and draw the map along by the little that holds it to its place.
    """
    count, n = bundle.lane_count, len(bundle.values()["sign"])
    lane, _ = spline_basis.rows(count)
    share = bundle.lane_axes[:, :, 0] / count[lane, None]
    columns = _columns(bundle)["lane"] + torch.arange(share.numel()).view(share.shape)
    tells = share.new_zeros(len(count), int(columns.max()) + 1 if len(lane) else 8 * n)
    tells[lane[:, None], columns] = share
    of_signs = -share.new_zeros(len(count), 3).index_add_(0, lane, share) / max(n, 1)
    tells[:, : 6 * n].view(len(count), n, 6)[..., :3] = of_signs[:, None]
    return tells.mT @ tells


def _of_journey(
    bundle: Bundle, truth: Truth, number: int, journey: JourneyTruth, simulation: SimulationConfig
) -> tuple[Tensor, Tensor]:
    """Information and force on the landmarks by one journey, its poses marginalised."""
    first = sum(t.journey.frame_count for t in truth.journeys[:number])
    mine = (bundle.frame >= first) & (bundle.frame < first + journey.journey.frame_count)
    pose = torch.nonzero(mine)[:, 0]
    frame = bundle.frame[pose] - first
    p = 6 * len(pose)
    corner, lane = _true_terms(bundle, simulation, pose)
    here = {"poses": len(pose), "first_pose": int(pose[0])}
    t_s = journey.journey.t_ns[frame].double() * 1e-9
    whole, force = _normal_equations(bundle, [lane], **here)
    own, push = _of_tracks(bundle, corner, t_s, simulation.signs, **here)
    whole, force = whole + own, force + push
    T = journey.T_world_camera
    way = (T[1:, :3, 3] - T[:-1, :3, 3]).norm(dim=1).cumsum(0)
    way = torch.cat((way.new_zeros(1), way))[frame]
    axes = _pose_covariances(way, simulation.positioning)
    prior = _joint([torch.linalg.inv(axis) for axis in axes])
    error = se3.local(journey.journey.T_world_camera, T)[frame].flatten()
    by = error.new_zeros(p, len(whole) - p)
    if "mount" in bundle.fleet.variables:
        # What is known of errors is so of what mount and clock leave of them.
        car, mount = int(bundle.fleet.of_journey[number]), bundle.values()["mount"]
        moved = bundle.fleet.by_mount(bundle.values()["pose"])[pose].flatten(0, 1)
        first = _columns(bundle)["mount"] + car * mount.shape[1]
        by[:, first : first + mount.shape[1]] = -moved
        error = error - moved @ mount[car]
    weighed = prior @ by
    A, B, C = whole[:p, :p] + prior, whole[:p, p:] + weighed, whole[p:, p:] + by.mT @ weighed
    gx, gy = force[:p] + prior @ error, force[p:] + weighed.mT @ error
    solved = torch.cholesky_solve(torch.cat((B, gx[:, None]), dim=1), torch.linalg.cholesky(A))
    return C - B.mT @ solved[:, :-1], gy - B.mT @ solved[:, -1]


def _true_terms(
    bundle: Bundle, simulation: SimulationConfig, pose: Int[Tensor, " f"]
) -> tuple[CostTerm, CostTerm]:
    """The journey's observations with their true sigmas, outliers left out."""
    terms = bundle.problem().terms
    low, high = int(pose[0]), int(pose[-1])

    def of_journey(term: CostTerm, weight: Tensor, kept: Tensor) -> CostTerm:
        at = term.slots[0][1]
        own = torch.nonzero(kept & (at >= low) & (at <= high))[:, 0]
        # What detections err by together is known here, not estimated.
        return rows(replace(term, weight=weight, loss=Quadratic(), shared=None), own)

    corner, lane = terms["sign_reprojection"], terms["lane_reprojection"]
    # By the size of the box, which noise hardly changes.
    signs, box_px = simulation.signs, bundle.corners.box_px
    sigma = signs.pixel_noise_px * (1 + (signs.small_box_px / box_px).square()).sqrt()
    every = torch.ones_like(sigma, dtype=torch.bool)
    valid = bundle.matches.valid
    kinds, values = dict(bundle.variables), bundle.values()
    exact = torch.full_like(bundle.matches.t, 1 / simulation.lanes.lane_noise_px)
    error = linearize(replace(lane, weight=exact), kinds, values).residual[0].abs()
    return (
        of_journey(corner, 1 / sigma, every),
        of_journey(lane, exact, valid & (error < _OUTLIER_SIGMAS)),
    )


def _normal_equations(
    bundle: Bundle, terms: Sequence[CostTerm], *, poses: int, first_pose: int
) -> tuple[Float[Tensor, "c c"], Float[Tensor, " c"]]:
    """Hessian and gradient of some terms at the bundle's values: `poses` from the first one on, then the landmarks."""
    total = 6 * poses + _columns(bundle)[_AFTER]
    hessian, gradient = torch.zeros(total, total, dtype=torch.float64), torch.zeros(total).double()
    for term in terms:
        column, J, residual = _linear(bundle, term, poses=poses, first_pose=first_pose)
        pulled = sum_of_products(J, residual[:, None])
        gradient.index_add_(0, column.flatten(), pulled.flatten())
        place = column[:, None] * total + column
        hessian.view(-1).index_add_(0, place.flatten(), sum_of_products(J, J).flatten())
    return hessian, gradient


def _linear(
    bundle: Bundle, term: CostTerm, *, poses: int, first_pose: int
) -> tuple[Int[Tensor, "k m"], Float[Tensor, "d k m"], Float[Tensor, "d m"]]:
    """A term's rows: the columns that each reads, its derivatives by them, and its residual."""
    columns = _columns(bundle)
    linear = linearize(term, dict(bundle.variables), bundle.values())
    at = []
    for (name, index), block in zip(term.slots, linear.jacobians, strict=True):
        k = block.shape[1]
        start = (index - first_pose) * k
        if name != "pose":
            start = 6 * poses + columns[name] + index * k
        at.append(start + torch.arange(k)[:, None])
    return torch.cat(at), torch.cat(linear.jacobians, dim=1), linear.residual


def _of_tracks(
    bundle: Bundle,
    term: CostTerm,
    t_s: Float[Tensor, " f"],
    signs: SignDetectionConfig,
    *,
    poses: int,
    first_pose: int,
) -> tuple[Float[Tensor, "c c"], Float[Tensor, " c"]]:
    """`_normal_equations` of the corners that one drive saw, sign by sign: boxes tremble, all corners of each alike.

    `t_s` is when the drive's poses were.
    """
    column, J, residual = _linear(bundle, term, poses=poses, first_pose=first_pose)
    sign, t = term.slots[1][1], t_s[term.slots[0][1] - first_pose]
    assert isinstance(term.weight, Tensor)
    total = 6 * poses + _columns(bundle)[_AFTER]
    hessian, gradient = torch.zeros(total, total, dtype=torch.float64), torch.zeros(total).double()
    for number in sign.unique():
        own = torch.nonzero(sign == number)[:, 0]
        tremble = torch.exp(-(t[own, None] - t[own]).abs() / signs.jitter_s)
        weight = term.weight[own]
        covariance = (signs.jitter_px * weight[:, None]) * (signs.jitter_px * weight) * tremble
        factor = torch.linalg.cholesky(covariance + torch.eye(len(own)).to(covariance))
        used, place = column[:, own].unique(return_inverse=True)
        rows_of = torch.arange(len(own)).expand(place.shape)
        for of_axis, left in zip(J[:, :, own], residual[:, own], strict=True):
            dense = of_axis.new_zeros(len(own), len(used) + 1)
            dense[rows_of, place] = of_axis
            dense[:, -1] = left
            white = torch.linalg.solve_triangular(factor, dense, upper=False)
            hessian[used[:, None], used] += white[:, :-1].mT @ white[:, :-1]
            gradient[used] += white[:, :-1].mT @ white[:, -1]
    return hessian, gradient


def _pose_covariances(
    way: Float[Tensor, " f"], config: PositioningConfig
) -> list[Float[Tensor, "f f"]]:
    """Covariances of the errors of poses as the simulation draws them, axis by axis: they err apart."""
    apart = (way[:, None] - way).abs()
    eye = torch.eye(len(way), dtype=way.dtype)
    drift = config.drift_m**2 * torch.exp(-apart / config.drift_length_m)
    turn = math.radians(config.drift_rot_deg) ** 2 * torch.exp(-apart / config.drift_rot_length_m)
    turn = turn + math.radians(config.white_rot_deg) ** 2 * eye
    bias = (config.bias_e_m, config.bias_n_m, config.bias_u_m)
    white = (config.white_e_m, config.white_n_m, config.white_u_m)
    if config.bias_wander_m:
        wander = torch.exp(-apart / config.bias_wander_length_m)
        drift = drift + config.bias_wander_m**2 * wander
    return [b**2 + drift + w**2 * eye for b, w in zip(bias, white, strict=True)] + [turn] * 3


def _joint(axes: Sequence[Float[Tensor, "f f"]]) -> Float[Tensor, "p p"]:
    """What is between all numbers of poses, pose by pose, of what is between those of each axis."""
    count = len(axes[0])
    joint = axes[0].new_zeros(count, len(axes), count, len(axes))
    for k, axis in enumerate(axes):
        joint[:, k, :, k] = axis
    return joint.reshape(count * len(axes), count * len(axes))
