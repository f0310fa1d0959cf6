"""The straight line from detections to a map, in the order of the paper: read this file first.

One journey (section IV): detections -> tracklets -> signs; road normal; lane tracklets -> splines. Many journeys
(section V): signs -> clusters and biases, lanes -> markers; then everything at once in bundle adjustment. `build_map`
does it all; `commands/optimize.py` spells out the same calls with logging between them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from crowdmap_torch.adjustment import adjust
from crowdmap_torch.adjustment.bundle import Bundle
from crowdmap_torch.adjustment.covariance import MapUncertainty, map_uncertainty
from crowdmap_torch.adjustment.detection_lanes import with_lanes
from crowdmap_torch.adjustment.first_map import FirstMap
from crowdmap_torch.adjustment.footing import footing_of
from crowdmap_torch.adjustment.signs_alone import joined_by_signs
from crowdmap_torch.adjustment.witnesses import witnesses
from crowdmap_torch.config import MapperConfig, config_hash
from crowdmap_torch.crowd_lanes.cluster import cluster_lanes
from crowdmap_torch.crowd_lanes.joined_anew import joined_anew
from crowdmap_torch.crowd_lanes.placed_drives import place_drives
from crowdmap_torch.crowd_lanes.table import support_of_pieces
from crowdmap_torch.crowd_signs.complete_tracks import (
    associate_detections,
    associated_once,
    completed_signs,
    merged_signs,
    with_company,
    without_strayed,
)
from crowdmap_torch.crowd_signs.completion import AssociatedSigns
from crowdmap_torch.crowd_signs.duplicates import may_be_one, none_of_the_map, same_sign
from crowdmap_torch.crowd_signs.gather import gather_signs, signs_of_crowd
from crowdmap_torch.crowd_signs.journey_bias import without_bias
from crowdmap_torch.crowd_signs.register import register_crowd
from crowdmap_torch.fleet.choice import engine_of
from crowdmap_torch.fleet.engine import Engine
from crowdmap_torch.fleet.here import InProcess
from crowdmap_torch.geometry import se3
from crowdmap_torch.io.maps import as_map
from crowdmap_torch.io.stored_drives import StoredDrive
from crowdmap_torch.lanes.reconstruct import LaneReport, reconstruct_lanes
from crowdmap_torch.noise.calibration import KnownCalibration
from crowdmap_torch.optim.levenberg_marquardt import LmState
from crowdmap_torch.processes.memory import large_tensors_again
from crowdmap_torch.processes.progress import ProgressCall, silent
from crowdmap_torch.processes.threads import one_core_each
from crowdmap_torch.road.estimate import estimate_road
from crowdmap_torch.signs.triangulate import SignReport, triangulate_signs
from crowdmap_torch.survey.control import find_control_signs
from crowdmap_torch.tables import (
    Association,
    Dataset,
    HdMap,
    Journey,
    Lanes,
    RoadEstimate,
    Signs,
    SurveySigns,
    Tracklets,
    concatenate_lanes,
)
from crowdmap_torch.tracking.lanes import associate_lanes
from crowdmap_torch.tracking.signs import associate_signs

KeepCall = Callable[[int, "JourneyMap"], object]


@dataclass(frozen=True)
class JourneyMap:
    """What one journey shows by itself (section IV)."""

    sign_tracklets: Tracklets
    signs: Signs
    """O1; `signs.tracklet` is a label of `sign_tracklets`."""
    sign_report: SignReport
    road: RoadEstimate
    lane_tracklets: Tracklets
    lanes: Lanes
    lane_report: LaneReport


@dataclass(frozen=True)
class MapResult:
    """A finished map, and what it was made of."""

    hd_map: HdMap
    map_clusters: HdMap
    journey_maps: tuple[JourneyMap, ...]
    first: FirstMap
    associations: tuple[Association, ...]
    poses: tuple[Float[Tensor, "_ 4 4"], ...]
    """Refined camera poses."""
    uncertainty: MapUncertainty
    """Of the signs and lanes of the map, tentative signs left out, and of the journeys' errors."""
    prior_scale: Float[Tensor, "j _"]
    """By journey, how far the sigmas of its bias, drift and rotation were from those given."""
    white_scale: Float[Tensor, "j 6"]
    """The same of the noise from frame to frame, by number of a pose."""
    state: LmState
    control_points: int = 0
    """Surveyed signs that pin the map."""

    def __repr__(self) -> str:
        return f"MapResult({self.hd_map!r} of {len(self.poses)} journeys: {self.state.reasons[0]})"


@one_core_each()
def build_map(
    dataset: Dataset,
    config: MapperConfig,
    *,
    workers: int = 1,
    progress: ProgressCall = silent,
    control: SurveySigns | None = None,
) -> MapResult:
    """The map of all journeys, pinned by signs in `control`; `progress` is told the stage, what is done and of how much."""
    with engine_of(None, workers=workers) as engine:
        maps = map_journeys(dataset.journeys, config, engine=engine, progress=progress)
    first = first_map(dataset.journeys, maps, config)
    how = {"control": control, "progress": progress}
    with engine_of(None, workers=workers) as engine:
        return adjusted_map(dataset, maps, first, config, engine=engine, **how)


def map_journeys(
    journeys: Sequence[Journey],
    config: MapperConfig,
    *,
    engine: Engine | None = None,
    stored: Sequence[StoredDrive] | None = None,
    progress: ProgressCall = silent,
    known: Mapping[int, JourneyMap] | None = None,
    tracklets: Mapping[int, Tracklets] | None = None,
    keep: KeepCall = silent,
) -> tuple[JourneyMap, ...]:
    """Section IV for every journey, by the workers of an engine (None: in this process), each on one core.

    Any engine with any number of workers makes the same, and they read journeys that are `stored` themselves; drives on a
    GPU stay in this process. Those `known`, by number, are taken as they are, and so are `tracklets` of sign detections.
    `keep` is handed each that was mapped. ChildProcessError, with its name, if the worker of one is killed again and again.
    """
    stage, total, maps = "single journeys", len(journeys), dict(known or {})
    progress(stage, len(maps), total)
    left = [number for number in range(total) if number not in maps]
    if engine is None or any(journeys[number].t_ns.is_cuda for number in left[:1]):
        engine = InProcess()
    tracked = tracklets or {}
    drives = journeys if stored is None or engine.shares_memory else stored
    calls = [
        (journeys[n].journey_id, map_journey, (drives[n], n, config, tracked.get(n))) for n in left
    ]
    for place, made in engine.each(calls):
        maps[number := left[place]] = made
        keep(number, made)
        progress(stage, len(maps), total)
    return tuple(maps[number] for number in range(total))


@large_tensors_again()
@one_core_each()
@torch.no_grad()
def map_journey(
    drive: Journey | StoredDrive,
    number: int,
    config: MapperConfig,
    tracklets: Tracklets | None = None,
) -> JourneyMap:
    """Section IV: the signs and lanes of one journey, the `number`-th of the dataset; one that is stored is read here.

    `tracklets` are what `associate_signs` gives, where that is known already.
    """
    journey, config = drive.read() if isinstance(drive, StoredDrive) else drive, config.resolved()
    if tracklets is None:
        tracklets = associate_signs(journey, config.positioning, config.sign_association)
    signs, sign_report = triangulate_signs(
        journey, tracklets, config.positioning, config.sign_triangulation
    )
    road = estimate_road(journey, config.positioning, config.road)
    lane_tracklets = associate_lanes(journey, config.lane_association)
    lanes, lane_report = reconstruct_lanes(journey, lane_tracklets, road, config.lane)
    return JourneyMap(
        sign_tracklets=sign_report.tracklets,
        signs=replace(signs, journey=torch.full_like(signs.journey, number)),
        sign_report=sign_report,
        road=road,
        lane_tracklets=lane_tracklets,
        lanes=replace(lanes, journey=torch.full_like(lanes.journey, number)),
        lane_report=lane_report,
    )


@one_core_each()
@torch.no_grad()
def first_map(
    journeys: Sequence[Journey], maps: Sequence[JourneyMap], config: MapperConfig
) -> FirstMap:
    """Section V-A: landmarks of many journeys in clusters, the journeys' biases, and the cluster heads.

    Lane pieces are joined where biases, or signs alone, place the journeys (`joined_by_signs`).
    """
    config = config.resolved()
    tracklets, sure = [m.sign_tracklets for m in maps], [m.signs for m in maps]
    doubtful, sigma = [m.sign_report.doubtful for m in maps], config.positioning.bias_sigma_m
    signs = signs_of_crowd(sure, doubtful, config.crowd.min_journeys)
    gathered = gather_signs(journeys, tracklets, signs, bias_sigma_m=sigma)
    generator = torch.Generator().manual_seed(config.seed)
    made, known = [m.lanes for m in maps], (config.positioning, config.crowd)
    crowd, ties = register_crowd(gathered, *known, generator=generator), None
    if config.crowd.method != "paper2017":
        tie = config.crowd.match, config.lane_join.tie_groups
        how = gathered.bias_sigma, config.positioning, *tie
        placed = place_drives(journeys, made, crowd, *how)
        if (start := placed.better) is not None:
            crowd = register_crowd(gathered, *known, generator=generator, start=start)
            placed = place_drives(journeys, made, crowd, *how, doubt=False)
        poses, drifts, ties = placed.poses, placed.drifts, placed.ties
        crowd = crowd.moved(ties.move)
    else:
        poses, drifts = without_bias([j.T_world_camera for j in journeys], crowd.bias)
    rules = config.crowd, config.complete_tracks
    found = associate_detections(journeys, poses, tracklets, crowd, *rules)
    if ties is not None:
        told = journeys, [m.road for m in maps], made, crowd, found, drifts, ties.group
        rules = config.lane_join, config.adjust, config.calibration
        drifts, joined = joined_by_signs(*told, *rules)
        lanes, support, rounds = joined.lanes, joined.support, ()
    else:
        pieces = concatenate_lanes(made)
        clusters = cluster_lanes(pieces, config.lane_cluster, generator=generator)
        lanes, rounds = clusters.heads, clusters.rounds
        support = support_of_pieces(pieces, clusters.label, config.lane_join.sample_spacing_m)
    return FirstMap(
        signs=found.heads,
        lanes=lanes,
        lane_support=support,
        tentative=found.tentative,
        lane_rounds=rounds,
        crowd=crowd,
        associations=found.associations,
        drifts=drifts,
        completed=found.completed,
        ties=ties,
    )


@one_core_each()
def build_bundle(
    journeys: Sequence[Journey],
    maps: Sequence[JourneyMap],
    first: FirstMap,
    config: MapperConfig,
    *,
    control: SurveySigns | None = None,
    known_cars: Mapping[str, KnownCalibration] | None = None,
) -> Bundle:
    """Section V-B: unknowns and observations; signs in `control` pin the map, of `known_cars` calibrations are known."""
    config = config.resolved()
    pins = None if control is None else find_control_signs(first.signs, control, config.control)
    return adjust.build(
        *(journeys, [m.road for m in maps], first.signs, first.lanes),
        *(first.associations, first.drifts, first.crowd.positioning, config.adjust),
        lane_tracklets=[m.lane_tracklets for m in maps],
        lane_support=first.lane_support,
        trusted=first.crowd.trusted_frames(journeys),
        calibration=config.calibration,
        known_cars=known_cars,
        footing=first.footing,
        control=pins,
    )


@one_core_each()
def adjusted_map(
    dataset: Dataset,
    maps: Sequence[JourneyMap],
    first: FirstMap,
    config: MapperConfig,
    *,
    control: SurveySigns | None = None,
    engine: Engine | None = None,
    progress: ProgressCall = silent,
) -> MapResult:
    """Section V-B: the `first` map adjusted, and once more where signs turned out to be one."""

    def told(number: int, *_: object) -> None:
        progress("bundle adjustment", number + 1, config.adjust.lm.max_iterations)

    while True:
        bundle = build_bundle(dataset.journeys, maps, first, config, control=control)
        ask = partial(made_anew, dataset.journeys, maps, first, bundle, config, engine)
        begun = adjust.start(bundle)
        state, (again, known) = adjust.adjust_until(bundle, begun, ask, told=told, engine=engine)
        if again is None:
            return finish_map(dataset, maps, first, bundle, state, config, engine, known)
        first = again
        del ask, bundle, begun, state


@one_core_each()
@torch.no_grad()
def made_anew(
    journeys: Sequence[Journey],
    maps: Sequence[JourneyMap],
    first: FirstMap,
    bundle: Bundle,
    config: MapperConfig,
    engine: Engine | None = None,
    ended: bool = True,
) -> tuple[FirstMap | None, MapUncertainty | None]:
    """What the adjustment begins again with: where it was, without signs that turned out to be one or none; None: nothing.

    It does so for those once; later on `finish_map` joins them and lets them go. Markers that are there twice are joined
    anew, signs of single drives that are one come in while a round can tell whether they fit. With it the covariances, if
    they had to be known: that can wait until it has `ended`.
    """
    rules = config.duplicate_signs
    if first.completed is None or first.anew >= rules.rounds:
        return None, None
    (signs, lanes), crowd = adjust.read_map(bundle, first.signs, first.lanes), first.crowd
    poses = adjust.read_poses(bundle, journeys)
    drifts = tuple(map(se3.local, (j.T_world_camera for j in journeys), poses))
    markers = lanes, [m.lanes for m in maps], drifts, crowd.trusted_frames(journeys)
    joined, known = joined_anew(*markers, crowd.positioning, config.lane_join), None
    found = AssociatedSigns(signs, first.tentative, first.associations, first.completed)
    given = journeys, poses, [m.sign_tracklets for m in maps]
    how, once = (rules, config.complete_tracks, crowd.journey_weight > 0), None
    goes = None if first.anew else _strayed(journeys, poses, signs, first, bundle, config)
    if goes is not None and bool(goes.any()):
        once = without_strayed(*given, found, goes, *how[1:])
    elif goes is not None and ended and len(may_be_one(signs, journeys, first.associations, rules)):
        known = map_uncertainty(bundle, first.signs, first.lanes, engine)
        found = replace(found, heads=replace(signs, covariance=known.of_their_own))
        once = associated_once(*given, found, *how)
    left, more = once or found, None
    if first.anew + 1 < rules.rounds:
        made = [m.signs for m in maps], [m.sign_report.from_afar for m in maps]
        more = with_company(*given, left, first.associations, *made, crowd, config.crowd, *how)
    if joined is None and once is None and more is None:
        return None, known
    found = more or left
    return replace(
        first,
        signs=found.heads,
        lanes=joined.lanes if joined else lanes,
        lane_support=joined.support if joined else first.lane_support,
        tentative=found.tentative,
        associations=found.associations,
        drifts=drifts,
        completed=found.completed,
        anew=first.anew + 1,
        joined=first.joined + len(signs) - len(left.heads),
        found_later=first.found_later + len(found.heads) - len(left.heads),
        before=first.before or first,
        footing=footing_of(bundle),
    ), known


def _strayed(
    journeys: Sequence[Journey],
    poses: Sequence[Float[Tensor, "_ 4 4"]],
    signs: Signs,
    first: FirstMap,
    bundle: Bundle,
    config: MapperConfig,
) -> Bool[Tensor, " n"]:
    """The adjusted `signs` that went astray, are other ones from afar or fit too few drives to be of the map."""
    fits = witnesses(bundle, first.crowd.journey_weight > 0)
    unseen = fits < min(config.crowd.min_journeys, len(journeys))
    begun = first.associations, first.signs, first.drifts, unseen
    rules = config.duplicate_signs, config.complete_tracks
    return none_of_the_map(journeys, poses, signs, *begun, *rules)


@one_core_each()
@torch.no_grad()
def finish_map(
    dataset: Dataset,
    maps: Sequence[JourneyMap],
    first: FirstMap,
    bundle: Bundle,
    state: LmState,
    config: MapperConfig,
    engine: Engine | None = None,
    uncertainty: MapUncertainty | None = None,
) -> MapResult:
    """The adjusted map with its covariances, the refined poses, and which landmark each detection shows.

    Where it was begun again already, signs that are one by now are joined, and those that are none go. Covariances that are
    not known are found by an engine's hosts, of many drives.
    """
    poses = adjust.read_poses(bundle, journeys := dataset.journeys)
    uncertainty = uncertainty or map_uncertainty(bundle, first.signs, first.lanes, engine)
    bundle.forget_factors()  # As large as all that follows.
    signs, lanes = adjust.read_map(bundle, first.signs, first.lanes, uncertainty)
    associations = first.associations
    if first.anew:
        own = replace(signs, covariance=uncertainty.of_their_own)
        goes = _strayed(journeys, poses, signs, first, bundle, config)
        into = same_sign(own, journeys, associations, config.duplicate_signs, goes)
        signs, associations = merged_signs(signs, associations, into)
        uncertainty = uncertainty.of_signs(into)
    if first.completed is not None:
        # Once more with the adjusted poses: what the first projections were too far off for.
        given = journeys, poses, [m.sign_tracklets for m in maps]
        rules, trusted = config.complete_tracks, first.crowd.journey_weight > 0
        signs, again = completed_signs(*given, signs, associations, rules, trusted=trusted)
        associations = again.associations
    roads, gate = [m.road for m in maps], config.adjust.lane_gate_m
    associations = with_lanes(associations, journeys, roads, poses, lanes, gate=gate)
    provenance = {"config": config_hash(config), "journeys": [j.journey_id for j in journeys]}
    provenance |= {} if dataset.bbox is None else {"bbox": [*dataset.bbox]}
    shared = uncertainty.shared
    hd_map = as_map(dataset, signs, lanes, first.tentative, associations, shared, provenance)
    heads = first.before or replace(first, associations=associations)
    return MapResult(
        hd_map=hd_map,
        map_clusters=clusters_map(dataset, heads, provenance),
        journey_maps=tuple(maps),
        first=first,
        associations=associations,
        poses=poses,
        uncertainty=uncertainty,
        prior_scale=bundle.prior_scale.clone(),
        white_scale=bundle.white_scale.clone(),
        state=replace(state, normal=None),
        control_points=len(bundle.fixed["control"]) if "control" in bundle.fixed else 0,
    )


def clusters_map(dataset: Dataset, first: FirstMap, provenance: dict | None = None) -> HdMap:
    """The map of the cluster heads, before bundle adjustment."""
    shared = first.crowd.bias.shared_covariance
    signs = replace(first.signs, covariance=first.signs.covariance + shared)
    others = first.lanes, first.tentative, first.associations
    return as_map(dataset, signs, *others, shared, provenance or {})
