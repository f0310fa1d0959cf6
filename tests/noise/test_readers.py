"""What positioning gets wrong is said once: every reader follows the fields that it reads, and no other."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, is_dataclass, replace

import pytest
import torch
from worlds import lane_world
from worlds.crowd_world import make_world
from worlds.drives import make_journey
from worlds.sign_drive import F64, RIG, drive_past, signs_at, straight_poses

from crowdmap_torch.config import MapperConfig
from crowdmap_torch.crowd_lanes.lateral_offsets import LateralOffsetConfig, journey_offsets
from crowdmap_torch.crowd_lanes.samples import sample_lanes
from crowdmap_torch.crowd_lanes.splines import curves_of, match
from crowdmap_torch.crowd_signs.align import AlignConfig, align_journeys, no_bias
from crowdmap_torch.noise.drift_nodes import drift_nodes
from crowdmap_torch.noise.pose_prior import PosePriorConfig, pose_prior
from crowdmap_torch.noise.positioning import DriftPathConfig, PositioningNoise, drift_terms
from crowdmap_torch.road.estimate import RoadConfig, estimate_road
from crowdmap_torch.road.nonholonomic import NonholonomicConfig, drive_path
from crowdmap_torch.signs.pruning import SignTriangulationConfig
from crowdmap_torch.signs.triangulate import triangulate_signs
from crowdmap_torch.tracking.sign_features import SignAssociationConfig
from crowdmap_torch.tracking.signs import SignAssociator, associate_signs

POSITION = {"drift_sigma_m", "drift_length_m"}
ROTATION = {"rotation_sigma_deg", "rotation_length_m"}
WHITE = {"white_sigma_m", "white_sigma_deg"}
BIAS = {"bias_sigma_m", "bias_sigma_deg"}


def prior(noise: PositioningNoise) -> torch.Tensor:
    journey = make_journey(RIG, straight_poses(5))
    way = torch.arange(5, dtype=F64)
    nodes = drift_nodes(torch.zeros(5, dtype=torch.long), way, 1.0)
    made = pose_prior([journey], journey.T_world_camera, nodes, noise, PosePriorConfig())
    return torch.stack(
        (made.bias_sigma[0], made.drift_sigma[0], made.length_m[0], made.white_sigma)
    )


def association(noise: PositioningNoise) -> torch.Tensor:
    journey = drive_past(straight_poses(4), signs_at([(3.5, 30.0, 2.5)])).journey
    associator = SignAssociator(noise, SignAssociationConfig())
    for frame, pose in enumerate(journey.T_world_camera):
        associator.step(frame, pose, journey.signs[journey.signs.frame == frame])
    return torch.from_numpy(associator.active.covariance)


def path(noise: PositioningNoise) -> torch.Tensor:
    terms = drift_terms(3, 1.0, torch.zeros(1, dtype=F64), noise, DriftPathConfig())
    weights = [term.weight for term in terms.values() if term.weight is not None]
    return torch.cat([weight.flatten() for weight in weights])


def constraint(noise: PositioningNoise) -> torch.Tensor:
    journey = make_journey(RIG, straight_poses(30))
    weight = drive_path(journey, noise, NonholonomicConfig(), DriftPathConfig()).nonholonomic.weight
    assert weight is not None
    return weight


def triangulation(noise: PositioningNoise) -> torch.Tensor:
    drive = drive_past(straight_poses(40), signs_at([(3.5, 40.0, 2.5)]), noise_px=0.3)
    tracklets = associate_signs(drive.journey, PositioningNoise(), SignAssociationConfig())
    signs, _ = triangulate_signs(drive.journey, tracklets, noise, SignTriangulationConfig())
    return signs.covariance


def road(noise: PositioningNoise) -> torch.Tensor:
    journey = make_journey(RIG, straight_poses(40))
    return estimate_road(journey, noise, RoadConfig(method="causal")).sigma


def alignment(noise: PositioningNoise) -> torch.Tensor:
    world = make_world(0, journeys=3, posts=4, length_m=150.0)
    crowd, config = world.crowd, AlignConfig(sweeps=1)
    start = no_bias(crowd.signs, crowd.station, noise, config, journeys=3)
    found = align_journeys(crowd.signs, world.sign, crowd.station, noise, config, start=start)
    return torch.cat((found.translation, found.node_drift))


def lateral_offsets(noise: PositioningNoise) -> torch.Tensor:
    world = lane_world.build(0, 2, length=120.0, markers=lane_world.SUBURB[:2])
    lanes = world.lanes
    packed = lanes.select(torch.arange(len(lanes)))
    curves = curves_of(packed.control.point_world, packed.control_count, packed.type)
    samples = sample_lanes(lanes, 4.0, PositioningNoise(), few_observations=10.0)
    matched = match(samples.line, curves, gate=1.2)
    return journey_offsets(samples, matched, noise, LateralOffsetConfig())


def lane_weights(noise: PositioningNoise) -> torch.Tensor:
    lanes = lane_world.build(0, 2, length=60.0, markers=lane_world.SUBURB[:1]).lanes
    return sample_lanes(lanes, 4.0, noise, few_observations=10.0).line.weight


READERS: dict[Callable[[PositioningNoise], torch.Tensor], set[str]] = {
    prior: BIAS | POSITION | ROTATION | WHITE,
    association: POSITION | ROTATION | WHITE,
    path: POSITION | ROTATION,
    constraint: {"white_sigma_m"},
    triangulation: POSITION | ROTATION | WHITE,
    road: ROTATION | {"white_sigma_deg"},
    alignment: BIAS | POSITION,
    lateral_offsets: POSITION,
    lane_weights: {"drift_sigma_m"},
}


@pytest.mark.parametrize("reader", READERS, ids=lambda reader: reader.__name__)
def test_readers_follow_what_they_read_and_nothing_else(reader):
    noise = PositioningNoise()
    usual = reader(noise)
    for field in fields(noise):
        value = getattr(noise, field.name)
        twice = tuple(2 * v for v in value) if isinstance(value, tuple) else 2 * value
        other = reader(replace(noise, **{field.name: twice}))
        is_read = field.name in READERS[reader]
        assert torch.equal(other, usual) != is_read, field.name


def test_no_stage_has_a_setting_of_its_own_of_what_positioning_gets_wrong():
    own = {field.name for field in fields(PositioningNoise)}

    def settings(config: object) -> list[str]:
        found = []
        for field in fields(config):  # type: ignore[arg-type]
            inner = getattr(config, field.name)
            found += [field.name, *(settings(inner) if is_dataclass(inner) else [])]
        return found

    every = settings(MapperConfig())
    assert [name for name in every if name in own] == [f.name for f in fields(PositioningNoise)]
