"""V-B: bundle adjustment of camera poses, signs and lanes of all journeys (eq:ba).

`build` makes a `Bundle` from journeys, a first map and the associations. `start` matches its lanes and finds its scales, the
loop over `steps` adjusts it, and `adjust` is both for those who watch nothing on the way. Between two steps `standing` is
all that the next ones follow from; a bundle that is built alike goes on from there by `go_on`. `read_map` and
`read_poses` give the result.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from functools import partial
from typing import TypeVar

import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree
from torch import Tensor

from crowdmap_torch.adjustment.bundle import Bundle
from crowdmap_torch.adjustment.calibration import CalibrationConfig, fleet_of
from crowdmap_torch.adjustment.config import AdjustConfig
from crowdmap_torch.adjustment.convoys import Convoys
from crowdmap_torch.adjustment.course import course_of, states_at_cuts
from crowdmap_torch.adjustment.covariance import MapUncertainty
from crowdmap_torch.adjustment.cuts import cut_drives
from crowdmap_torch.adjustment.footing import Footing, stand_on
from crowdmap_torch.adjustment.landmark_priors import fixed_terms, up_of_road
from crowdmap_torch.adjustment.lane_matching import (
    LaneMatches,
    follow,
    nearest_lanes,
    supported_lanes,
)
from crowdmap_torch.adjustment.lenses import lenses_of
from crowdmap_torch.adjustment.observations import (
    LanePointObservations,
    corner_observations,
    frame_offsets,
    lane_point_observations,
    spaced_frames,
)
from crowdmap_torch.adjustment.parts import Observations, Priors, Unknowns
from crowdmap_torch.adjustment.residual_summary import TermSummary, residual_summary
from crowdmap_torch.adjustment.steps import adjust_step, start
from crowdmap_torch.crowd_lanes.table import LaneSupport
from crowdmap_torch.fleet.engine import Engine
from crowdmap_torch.geometry import plane, se3, spline_basis
from crowdmap_torch.geometry.trajectory import station
from crowdmap_torch.noise.calibration import KnownCalibration
from crowdmap_torch.noise.drift_nodes import DriftNodes, drift_nodes
from crowdmap_torch.noise.pose_prior import MOST_NUMBERS, pose_prior
from crowdmap_torch.noise.positioning import PositioningNoise
from crowdmap_torch.optim import levenberg_marquardt as lm
from crowdmap_torch.processes.at_rest import leave
from crowdmap_torch.processes.memory import give_back
from crowdmap_torch.processes.progress import silent
from crowdmap_torch.survey.control import ControlSigns
from crowdmap_torch.tables import Association, Journey, Lanes, RoadEstimate, Signs, Tracklets

Asked = TypeVar("Asked", bound=tuple[object, ...])
AskCall = Callable[[bool], Asked]
"""Is asked which landmarks there are, by an adjustment that has ended or not; says first what to begin with, or None."""
Seen = Callable[[], dict[str, TermSummary]]
"""Tells the residuals where a step has come to."""
ToldCall = Callable[[int, lm.LmState, Seen], object]
"""Is handed the number of a step, the state after it, and what tells the residuals there."""
_SUPPORT_M = 3.0
"""How far along a lane tracklet a sample of it, which tells its lane, may be away: samples are 2 m apart."""
_MARGIN = 1.3
"""Lane points that meet the road further ahead than they are to be used, by this factor, lie on markers that far ahead."""
_OWN_GATE_M = 1.0
"""How much further than others a lane point may at first be from the lane that clustering found it to be of [m]."""


def build(
    journeys: Sequence[Journey],
    roads: Sequence[RoadEstimate],
    signs: Signs,
    lanes: Lanes,
    associations: Sequence[Association],
    drifts: Sequence[Float[Tensor, "_ 6"]],
    positioning: PositioningNoise,
    config: AdjustConfig,
    *,
    lane_tracklets: Sequence[Tracklets] = (),
    lane_support: LaneSupport | None = None,
    trusted: Sequence[Bool[Tensor, " _"]] | None = None,
    control: ControlSigns | None = None,
    calibration: CalibrationConfig | None = None,
    known_cars: Mapping[str, KnownCalibration] | None = None,
    footing: Footing | None = None,
) -> Bundle:
    """The bundle of all journeys, started at cluster heads and at poses moved by the estimated `drifts` (V-B).

    `drifts` are tangents per frame, from the positioning module's pose to the start pose. Frames that are not
    `trusted`, by journey, have no say. Signs that are `control` points are held where they were surveyed. Lane points
    keep the lane that `lane_support` has for the journeys' `lane_tracklets` there, where it has one; others go to the
    nearest lane. What cars may have wrong `calibration` says, None: nothing; and what is known of some of them
    `known_cars`.
    """
    given = torch.cat([journey.T_world_camera for journey in journeys])
    drift = torch.cat(list(drifts))
    start = se3.retract(given, drift)
    corners = corner_observations(journeys, associations, signs, box_sigma=config.box_sigma)
    points, ground = _points_on_ground(journeys, roads, start, config)
    known = None
    if lane_support is not None:
        known = supported_lanes(ground, points, lane_tracklets, lane_support, reach=_SUPPORT_M)
    points, matches = _matched(points, ground, lanes, known, config)
    lane = spline_basis.to_coefficients_flat(lanes.control.point_world, lanes.control_count)
    near = _in_reach(points, matches, start, lane, lanes.control_count, config)
    points, matches = points[near], matches[near]
    observed = Observations(corners, points, matches, lenses_of(journeys)[0])
    every = torch.arange(len(given), device=given.device)
    if trusted is not None:
        observed = observed.renumbered(torch.where(torch.cat(list(trusted)), every, -1))
    kept = _kept_frames(journeys, observed, config)
    observed = observed.renumbered(torch.where(kept, kept.cumsum(0) - 1, -1))
    frame = torch.nonzero(kept)[:, 0]
    nodes = _nodes(journeys, frame, config)
    at_nodes = drift[frame][nodes.first]
    place, unknowns = given[frame][nodes.first][:, :2, 3], 8 * len(signs) + lane.numel()
    cut = cut_drives(place, nodes.journey, unknowns, config.cut_unknowns, at_cut=MOST_NUMBERS)
    poses = pose_prior(
        *(journeys, given[frame], nodes, positioning, config.prior, cut), error=at_nodes[:, :3]
    )
    at_start = poses.with_wander(at_nodes)
    is_bound = config.method != "paper2017" and config.course.reach_m > 0
    course = course_of(journeys, frame, nodes, poses.cut, config.course) if is_bound else None
    stance = at_nodes.new_zeros(len(journeys) if is_bound else 0, 2)
    values = {
        "pose": start[frame],
        "drift": at_start,
        "cut": states_at_cuts(poses, course, at_start, stance),
        "bias": nodes.mean(at_nodes, len(journeys)),
        "stance": stance,
        "sign": signs.T_world_sign,
        "size": signs.size,
        "lane": lane,
    }
    unknown = calibration or CalibrationConfig.off()
    fleet = fleet_of(journeys, frame, nodes.journey_of_pose, unknown, known_cars or {})
    values |= fleet.start
    up = up_of_road(observed, values["pose"], lane, lanes.control_count)
    fixed = fixed_terms(values, signs, lanes, up, observed.corners, control, config)
    priors = Priors(poses, fixed, _nearest_poses(values["pose"], values["lane"]), fleet, course)
    bundle = Bundle(Unknowns(values, frame, lanes.control_count), observed, priors, config)
    if footing is not None:
        stand_on(bundle, footing)
    return bundle


def _kept_frames(
    journeys: Sequence[Journey], observed: Observations, config: AdjustConfig
) -> Bool[Tensor, " f"]:
    """The frames with observations, thinned where a car stands."""
    offsets = frame_offsets(journeys)
    used = torch.zeros(offsets[-1], dtype=torch.bool, device=observed.corners.frame.device)
    used[observed.corners.frame] = True
    used[observed.lane_points.frame] = True
    return torch.cat(
        [
            spaced_frames(journey, used[a:b], config.frame_spacing_m)
            for journey, a, b in zip(journeys, offsets, offsets[1:], strict=False)
        ]
    )


def _nodes(
    journeys: Sequence[Journey], frame: Int[Tensor, " p"], config: AdjustConfig
) -> DriftNodes:
    """The stretches of road of the frames, over which the drift stands still."""
    ends = torch.tensor(frame_offsets(journeys)[1:], device=frame.device)
    way = torch.cat([station(journey.T_world_camera) for journey in journeys])[frame]
    return drift_nodes(torch.searchsorted(ends, frame, right=True), way, config.drift_spacing_m)


def _nearest_poses(pose: Float[Tensor, "p 4 4"], point: Float[Tensor, "c 3"]) -> Int[Tensor, " c"]:
    """The pose nearest to each point; -1 where there is no pose at all."""
    if not len(pose):
        return torch.full_like(point[:, 0], -1, dtype=torch.long)
    _, nearest = KDTree(pose[:, :3, 3].cpu().numpy()).query(point.cpu().numpy())
    return torch.as_tensor(nearest, dtype=torch.long, device=pose.device)


def adjust(bundle: Bundle) -> lm.LmState:
    """The state at the end of the adjustment; the bundle holds its values."""
    state = begun = start(bundle)
    for _, after, _ in steps(bundle, begun):
        state = after
    return state


def steps(
    bundle: Bundle, state: lm.LmState, *, first: int = 0, engine: Engine | None = None
) -> Generator[tuple[int, lm.LmState, Seen], None, None]:
    """Every step's number, from `first` on, and the state after it, until the adjustment is finished or out of steps.

    With each goes what tells the residuals there. Many drives are shared out to the hosts of an engine, in `convoys`, which
    end with these steps; None: all are in this process. The lenses of a bundle that is shared out follow at the end.
    """
    numbers = range(first, bundle.config.lm.max_iterations)
    # What was read and matched has left room between what is kept, and drives are not read before the map is made.
    give_back()
    leave()
    with ExitStack() as ends:
        shared = len(bundle.convoys) > 1
        convoys = ends.enter_context(Convoys(bundle, state, engine)) if shared else None
        seen = partial(residual_summary, bundle) if convoys is None else convoys.residuals
        for number in numbers:
            # What goes on with more to do was set running again: a state that is done was the last one.
            if number and state.done:
                break
            if convoys is None:
                state, _ = adjust_step(bundle, state, bundle.backend())
                give_back()
            else:
                state, _ = convoys.step()
            yield number, state, seen


def adjust_until(
    bundle: Bundle,
    state: lm.LmState,
    ask: AskCall[Asked],
    *,
    told: ToldCall = silent,
    first: int = 0,
    engine: Engine | None = None,
) -> tuple[lm.LmState, Asked]:
    """The state at the end of `steps`, or where landmarks turn out to be others, and what `ask` then said.

    It is asked at the end, with True, and, unless the adjustment began where another one stood, one step after
    detections were first judged: what is left to do moves landmarks by little, and is done once if they are others, of which
    the first thing said is not None. `told` is handed what `steps` gives, step by step.
    """
    pauses = first > 0 and _pauses(bundle, state)
    while True:
        with closing(steps(bundle, state, first=first, engine=engine)) as taken:
            while not pauses and (step := next(taken, None)):
                told(*step)
                first, state = step[0] + 1, step[1]
                pauses = _pauses(bundle, state)
        # Its equations have served: covariances begin where the adjustment stands.
        state = replace(state, normal=None)
        said = ask(not pauses)
        if said[0] is not None or not pauses:
            return state, said
        pauses = False


def _pauses(bundle: Bundle, state: lm.LmState) -> bool:
    return not state.done and int(bundle.steps_judged) == 1


@dataclass(frozen=True)
class Standing:
    """Where an adjustment stands between two steps: all that the next ones follow from, beside what `build` makes."""

    steps: int
    """How many were taken."""
    state: lm.LmState
    """Without its normal equations, which follow from its values."""
    bundle: Mapping[str, Tensor]
    """What changes of a bundle, by name, but for its unknowns: those are the values of the state."""


def standing(bundle: Bundle, state: lm.LmState, steps: int) -> Standing:
    """Where the adjustment stands after `steps` steps; the tensors are the bundle's own, which the next step changes."""
    beside = {k: v for k, v in bundle.state_dict().items() if k not in bundle.unknown_names}
    return Standing(steps, replace(state, normal=None), beside)


@torch.no_grad()
def go_on(bundle: Bundle, standing: Standing) -> lm.LmState:
    """Puts a bundle that was built alike where another one stood: the steps from there are the same to the last bit.

    ValueError if it was another one's.
    """
    own, values = bundle.state_dict(), bundle.values()
    beside = {k: v for k, v in own.items() if k not in bundle.unknown_names}
    for here, there in ((beside, standing.bundle), (values, standing.state.values)):
        for name in {*here, *there}:
            if _kind(here.get(name)) != _kind(there.get(name)):
                raise ValueError(
                    f"{name!r} is {_kind(there.get(name))}; expected {_kind(here.get(name))}, as the bundle has it"
                )
    bundle.load_state_dict({**own, **standing.bundle})
    bundle.fold(dict(standing.state.values))
    bundle.relinearise()
    return standing.state


def _kind(tensor: Tensor | None) -> str:
    return "missing" if tensor is None else f"{tensor.dtype} {list(tensor.shape)}"


def _points_on_ground(
    journeys: Sequence[Journey],
    roads: Sequence[RoadEstimate],
    T_world_camera: Float[Tensor, "f 4 4"],
    config: AdjustConfig,
) -> tuple[LanePointObservations, Float[Tensor, "m 3"]]:
    """Lane points that may be near enough, by where they meet the road, and where in the world they do."""
    points = lane_point_observations(
        journeys,
        roads,
        keyframe_spacing=config.keyframe_spacing_m,
        points_per_detection=config.points_per_detection,
        height_sigma=config.lane_height_sigma_m,
    )
    ray = torch.nn.functional.pad(points.ideal, (0, 1), value=1.0)
    h = points.normal_camera * points.camera_height[:, None]
    distance = h.square().sum(-1) / (h * ray).sum(-1)
    near = (distance > 0) & (distance < _MARGIN * config.max_ground_distance_m)
    points, ray, h = points[near], ray[near], h[near]
    return points, plane.ground_points(ray, h, T_world_camera[points.frame])


def _in_reach(
    points: LanePointObservations,
    matches: LaneMatches,
    T_world_camera: Float[Tensor, "f 4 4"],
    coefficient: Float[Tensor, "c 3"],
    count: Int[Tensor, " n"],
    config: AdjustConfig,
) -> Bool[Tensor, " m"]:
    """Which points show splines no further ahead than they are to be used.

    By where the nearest place of the spline is, not the point itself: of points at the border those would stay whose noise
    is downwards, towards the car, and all markers would be drawn in there.
    """
    T = T_world_camera[points.frame]
    point = follow(matches, points, T, coefficient, count).points(coefficient, count)
    ahead = (T[:, :3, 2] * (point - T[:, :3, 3])).sum(-1)
    return ahead < config.max_ground_distance_m


def _matched(
    points: LanePointObservations,
    ground: Float[Tensor, "m 3"],
    lanes: Lanes,
    known: Int[Tensor, " m"] | None,
    config: AdjustConfig,
) -> tuple[LanePointObservations, LaneMatches]:
    """The points that lie near a lane of the map, with the lane and parameter each starts at."""
    lane, t = nearest_lanes(ground, lanes, gate=config.lane_gate_m)
    if known is not None:
        # What was told apart in all frames together is not mixed up again by where one frame's pose puts it.
        gate = config.lane_gate_m + _OWN_GATE_M
        of_known, at_known = nearest_lanes(ground, lanes, gate=gate, of=known)
        is_known = known >= 0
        lane, t = torch.where(is_known, of_known, lane), torch.where(is_known, at_known, t)
    found = lane >= 0
    points = points[found]
    return points, LaneMatches(lane[found], t[found], points.ideal, found[found])


@torch.no_grad()
def read_poses(bundle: Bundle, journeys: Sequence[Journey]) -> tuple[Float[Tensor, "_ 4 4"], ...]:
    """Refined camera poses of every frame; frames without observations take the drift of those around them."""
    values = bundle.values()
    offsets = frame_offsets(journeys)
    poses = []
    nodes = bundle.prior.nodes
    for number, (journey, a, b) in enumerate(zip(journeys, offsets, offsets[1:], strict=False)):
        mine = torch.nonzero((bundle.frame >= a) & (bundle.frame < b))[:, 0]
        if not len(mine):
            poses.append(journey.T_world_camera)
            continue
        of_journey = torch.nonzero(nodes.journey == number)[:, 0]
        known, drift = nodes.way[of_journey], values["drift"][of_journey, :6]
        way = station(journey.T_world_camera)
        after = torch.searchsorted(known, way).clamp(1, max(len(known) - 1, 1))
        after = after.clamp_max(len(known) - 1)
        before = (after - 1).clamp_min(0)
        span = (known[after] - known[before]).clamp_min(1e-9)
        share = ((way - known[before]) / span).clamp(0, 1)[:, None]
        between = drift[before] + share * (drift[after] - drift[before])
        refined = se3.retract(journey.T_world_camera, between)
        refined[bundle.frame[mine] - a] = values["pose"][mine]
        poses.append(refined)
    return tuple(poses)


@torch.no_grad()
def read_map(
    bundle: Bundle, signs: Signs, lanes: Lanes, uncertainty: MapUncertainty | None = None
) -> tuple[Signs, Lanes]:
    """Adjusted signs and lanes, with the covariances of `uncertainty` where it is given."""
    values = bundle.values()
    point = spline_basis.from_coefficients_flat(values["lane"], lanes.control_count)
    signs = replace(signs, T_world_sign=values["sign"], size=values["size"])
    control = replace(lanes.control, point_world=point)
    if uncertainty is not None:
        signs = replace(signs, covariance=uncertainty.center)
        control = replace(control, sigma=uncertainty.lane_sigma)
    return signs, replace(lanes, control=control)
