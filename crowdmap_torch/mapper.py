"""The straight line from detections to a map, in the order of the paper: read this file first.

One journey (section IV): detections -> tracklets -> signs; road normal; lane tracklets -> splines. Many journeys
(section V): signs -> clusters and biases, lanes -> markers; then everything at once in bundle adjustment. `build_map`
does it all; `scripts/optimize.py` spells out the same calls with logging between them.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context

import torch
from jaxtyping import Float
from torch import Tensor

from crowdmap_torch.bundle import Bundle
from crowdmap_torch.config import MapperConfig, config_hash
from crowdmap_torch.control import find_control_points
from crowdmap_torch.crowd import Crowd, associate_crowd, unbiased_signs
from crowdmap_torch.crowd_signs import gather_signs
from crowdmap_torch.geometry import polygon, se3
from crowdmap_torch.landmark_ids import lane_ids, sign_ids
from crowdmap_torch.lane_matching import detection_lanes
from crowdmap_torch.map_uncertainty import MapUncertainty, map_uncertainty
from crowdmap_torch.observations import station
from crowdmap_torch.optim.levenberg_marquardt import LmState
from crowdmap_torch.stages import adjust
from crowdmap_torch.stages.align import unbiased_poses
from crowdmap_torch.stages.associate import associate_signs
from crowdmap_torch.stages.associate_lanes import associate_lanes
from crowdmap_torch.stages.cluster_lanes import cluster_lanes
from crowdmap_torch.stages.existence import existence
from crowdmap_torch.stages.harvest import (
    Harvest,
    copies,
    harvest_signs,
    still_alone,
    with_evidence,
    without_signs,
)
from crowdmap_torch.stages.join_lanes import join_lanes
from crowdmap_torch.stages.lanes import LaneReport, reconstruct_lanes
from crowdmap_torch.stages.road import estimate_road
from crowdmap_torch.stages.signs import SignReport, triangulate_signs
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
    concatenate,
    concatenate_lanes,
)

ProgressCall = Callable[[str, int, int], object]


def silent(stage: str, done: int, total: int) -> None:
    """Progress that nobody listens to."""


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
    """O2."""
    lane_report: LaneReport


@dataclass(frozen=True)
class FirstMap:
    """The map of the cluster heads, and all that bundle adjustment starts from (section V)."""

    signs: Signs
    lanes: Lanes
    tentative: Signs
    """Signs that too few journeys saw."""
    crowd: Crowd
    associations: tuple[Association, ...]
    drifts: tuple[Float[Tensor, "f 6"], ...]
    """Per journey the tangents from the given poses to those without bias."""
    harvest: Harvest | None
    """What clustering had set aside and was brought back; None with `paper2017`, which does not."""


@dataclass(frozen=True)
class MapResult:
    """A finished map, and what it was made of."""

    hd_map: HdMap
    map_clusters: HdMap
    journey_maps: tuple[JourneyMap, ...]
    first: FirstMap
    associations: tuple[Association, ...]
    poses: tuple[Float[Tensor, "f 4 4"], ...]
    """Refined camera poses."""
    uncertainty: MapUncertainty
    """Of the signs and lanes of the map, tentative signs left out, and of the journeys' errors."""
    prior_scale: Float[Tensor, "j 3"]
    """By journey, how far the sigmas of its bias, drift and rotation were from those given."""
    state: LmState
    control_points: int = 0
    """Surveyed signs that pin the map."""


def build_map(
    dataset: Dataset,
    config: MapperConfig,
    *,
    workers: int = 1,
    progress: ProgressCall = silent,
    control: SurveySigns | None = None,
) -> MapResult:
    """The map of all journeys; `progress` is told the stage, how much is done and of how much.

    Signs that are in `control` pin the map.
    """
    journeys = dataset.journeys
    maps = map_journeys(journeys, config, workers=workers, progress=progress)
    first = first_map(journeys, maps, config)
    bundle = build_bundle(journeys, maps, first, config, control=control)
    state = adjust.start(bundle)
    backend = bundle.backend()
    most = config.adjust.lm.max_iterations
    for iteration in range(most):
        state, finished = adjust.adjust_step(bundle, state, backend)
        progress("bundle adjustment", iteration + 1, most)
        if finished:
            break
    return finish_map(dataset, maps, first, bundle, state, config)


def map_journeys(
    journeys: Sequence[Journey],
    config: MapperConfig,
    *,
    workers: int = 1,
    progress: ProgressCall = silent,
) -> tuple[JourneyMap, ...]:
    """Section IV for every journey, `workers` at a time, each on one core; the result does not depend on how many."""
    stage, total = "single journeys", len(journeys)
    progress(stage, 0, total)
    maps = []
    if workers <= 1 or total <= 1 or journeys[0].t_ns.is_cuda:
        for number, journey in enumerate(journeys):
            maps.append(map_journey(journey, number, config))
            progress(stage, number + 1, total)
        return tuple(maps)
    # Pickled by hand: torch would hand every tensor over as an open file, and a fleet has thousands.
    tasks = (pickle.dumps((j, number, config)) for number, j in enumerate(journeys))
    with ProcessPoolExecutor(
        min(workers, total), mp_context=get_context("spawn"), initializer=_use_one_core
    ) as pool:
        for number, made in enumerate(pool.map(_map_pickled, tasks)):
            maps.append(pickle.loads(made))
            progress(stage, number + 1, total)
    return tuple(maps)


@torch.no_grad()
def map_journey(journey: Journey, number: int, config: MapperConfig) -> JourneyMap:
    """Section IV: the signs and lanes of one journey, the `number`-th of the dataset."""
    config = config.resolved()
    tracklets = associate_signs(journey, config.sign_association)
    signs, sign_report = triangulate_signs(journey, tracklets, config.sign_triangulation)
    road = estimate_road(journey, config.road)
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


@torch.no_grad()
def first_map(
    journeys: Sequence[Journey], maps: Sequence[JourneyMap], config: MapperConfig
) -> FirstMap:
    """Section V-A: landmarks of many journeys in clusters, the journeys' biases, and the cluster heads."""
    config = config.resolved()
    gathered = gather_signs(
        journeys,
        [m.sign_tracklets for m in maps],
        concatenate([m.signs for m in maps]),
        bias_sigma_m=config.crowd.align.bias_sigma_m,
    )
    generator = torch.Generator().manual_seed(config.seed)
    crowd = associate_crowd(gathered, config.crowd, generator=generator)
    starts = [
        unbiased_poses(journey.T_world_camera, crowd.bias, number, station(journey.T_world_camera))
        for number, journey in enumerate(journeys)
    ]
    drifts = [
        se3.local(journey.T_world_camera, start)
        for journey, start in zip(journeys, starts, strict=True)
    ]
    if config.crowd.method == "paper2017":
        pieces = concatenate_lanes([m.lanes for m in maps])
        lanes = cluster_lanes(pieces, config.lane_cluster, generator=generator).heads
    else:
        moved = [_moved(m.lanes, drift) for m, drift in zip(maps, drifts, strict=True)]
        lanes = join_lanes(concatenate_lanes(moved), config.lane_join).lanes
    members = unbiased_signs(gathered, crowd.bias)
    associations = tuple(
        _sign_association(journey, m, members, crowd, number)
        for number, (journey, m) in enumerate(zip(journeys, maps, strict=True))
    )
    heads, tentative, harvest = crowd.heads, crowd.tentative, None
    if config.crowd.method != "paper2017":
        made = [m.sign_tracklets for m in maps]
        copy = copies(journeys, starts, heads, associations, config.harvest)
        passed, heads = crowd.report.passed[~copy], heads[~copy]
        associations = without_signs(associations, copy)
        harvest = harvest_signs(journeys, starts, made, heads, associations, config.harvest)
        associations = harvest.associations
        trusted = crowd.journey_weight > 0
        heads = with_evidence(heads, journeys, associations, trusted, config.harvest)
        sure = existence(heads.n_journeys, passed, config.crowd.existence)
        heads = replace(heads, confidence=sure.to(heads.size))
        # What a bad drive alone saw is nothing to look for.
        tentative = tentative[trusted[tentative.journey]]
        tentative = tentative[still_alone(tentative, made, associations)]
    return FirstMap(heads, lanes, tentative, crowd, associations, tuple(drifts), harvest)


def build_bundle(
    journeys: Sequence[Journey],
    maps: Sequence[JourneyMap],
    first: FirstMap,
    config: MapperConfig,
    *,
    control: SurveySigns | None = None,
) -> Bundle:
    """Section V-B: the unknowns and observations of bundle adjustment; signs that are in `control` pin the map."""
    config = config.resolved()
    return adjust.build(
        journeys,
        [m.road for m in maps],
        first.signs,
        first.lanes,
        first.associations,
        first.drifts,
        config.adjust,
        left_out=[suspect.journey for suspect in first.crowd.report.suspects],
        control=None
        if control is None
        else find_control_points(first.signs, control, config.control),
    )


@torch.no_grad()
def finish_map(
    dataset: Dataset,
    maps: Sequence[JourneyMap],
    first: FirstMap,
    bundle: Bundle,
    state: LmState,
    config: MapperConfig,
) -> MapResult:
    """The adjusted map with its covariances, the refined poses, and which landmark each detection shows."""
    journeys = dataset.journeys
    poses = adjust.read_poses(bundle, journeys)
    uncertainty = map_uncertainty(bundle, first.signs, first.lanes)
    signs, lanes = adjust.read_map(bundle, first.signs, first.lanes, uncertainty)
    associations = first.associations
    if first.harvest is not None:
        # Once more with the adjusted poses: what the first projections were too far off for.
        made = [m.sign_tracklets for m in maps]
        again = harvest_signs(journeys, poses, made, signs, associations, config.harvest)
        associations = again.associations
        trusted = first.crowd.journey_weight > 0
        signs = with_evidence(signs, journeys, associations, trusted, config.harvest)
    associations = tuple(
        replace(
            association,
            lane=detection_lanes(journey, m.road, pose, lanes, gate=config.adjust.lane_gate_m),
        )
        for journey, m, pose, association in zip(journeys, maps, poses, associations, strict=True)
    )
    provenance = {"config": config_hash(config), "journeys": [j.journey_id for j in journeys]}
    shared = uncertainty.shared
    hd_map = as_map(dataset, signs, lanes, first.tentative, associations, shared, provenance)
    clusters = clusters_map(dataset, replace(first, associations=associations), provenance)
    known = len(bundle.fixed["control"]) if "control" in bundle.fixed else 0
    return MapResult(
        hd_map=hd_map,
        map_clusters=clusters,
        journey_maps=tuple(maps),
        first=first,
        associations=associations,
        poses=poses,
        uncertainty=uncertainty,
        prior_scale=bundle.prior_scale.clone(),
        state=state,
        control_points=known,
    )


def clusters_map(dataset: Dataset, first: FirstMap, provenance: dict | None = None) -> HdMap:
    """The map of the cluster heads, before bundle adjustment."""
    shared = first.crowd.bias.shared_covariance
    signs = replace(first.signs, covariance=first.signs.covariance + shared)
    lanes, associations = first.lanes, first.associations
    provenance = {} if provenance is None else provenance
    return as_map(dataset, signs, lanes, first.tentative, associations, shared, provenance)


def as_map(
    dataset: Dataset,
    signs: Signs,
    lanes: Lanes,
    tentative: Signs,
    associations: Sequence[Association],
    shared: Float[Tensor, "3 3"],
    provenance: dict,
) -> HdMap:
    """Signs and lanes with their identifiers, corners in the order of FORMAT.md, tentative signs behind the others."""
    every = concatenate([signs, tentative])
    journeys = dataset.journeys
    T_world_sign, size = polygon.canonical(every.T_world_sign, every.size, every.shape)
    return HdMap(
        origin=dataset.origin,
        signs=replace(every, T_world_sign=T_world_sign, size=size),
        lanes=lanes,
        sign_id=sign_ids(journeys, associations, every),
        lane_id=lane_ids(journeys, associations, lanes),
        type_names=dataset.type_names,
        shared_covariance=shared,
        provenance=provenance,
    )


def certain_part(hd_map: HdMap, min_confidence: float) -> HdMap:
    """The map without its tentative signs: what readers of signs.parquet see."""
    kept = torch.nonzero(hd_map.signs.confidence >= min_confidence)[:, 0]
    names = tuple(hd_map.sign_id[row] for row in kept.tolist())
    return replace(hd_map, signs=hd_map.signs[kept], sign_id=names)


def _map_pickled(task: bytes) -> bytes:
    return pickle.dumps(map_journey(*pickle.loads(task)))


def _use_one_core() -> None:
    torch.set_num_threads(1)


def _sign_association(
    journey: Journey, journey_map: JourneyMap, members: Signs, crowd: Crowd, number: int
) -> Association:
    """The head that every sign detection shows, and how its corners are turned against the head's."""
    tracklets = journey_map.sign_tracklets
    assert tracklets.shift is not None
    mine = torch.nonzero(members.journey == number)[:, 0]
    row_of_tracklet = torch.full((tracklets.count + 1,), -1, device=mine.device)
    row_of_tracklet[members.tracklet[mine]] = mine
    # Label -1 reads the last slot, which stays -1.
    member = row_of_tracklet[tracklets.label]
    found = torch.nonzero(member >= 0)[:, 0]
    head = torch.full_like(tracklets.label, -1).index_put((found,), crowd.label[member[found]])
    used = torch.nonzero(head >= 0)[:, 0]
    shift = torch.zeros_like(head)
    of_member, of_head = members[member[used]], crowd.heads[head[used]]
    turn, _ = polygon.best_shift(
        of_head.corners_world, of_member.corners_world, polygon.corner_count(of_head.shape)
    )
    count = polygon.corner_count(of_head.shape)
    shift[used] = (turn + tracklets.shift[used]) % count
    return Association(sign=head, sign_shift=shift, lane=torch.full_like(journey.lanes.row, -1))


def _moved(lanes: Lanes, drift: Float[Tensor, "f 6"]) -> Lanes:
    """Lane pieces moved by the translation of their middle frame."""
    if not len(lanes):
        return lanes
    shift = drift[lanes.frame, :3]
    point = lanes.control.point_world + shift[lanes.piece_of_control]
    return replace(lanes, control=replace(lanes.control, point_world=point))
