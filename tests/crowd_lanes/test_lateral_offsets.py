"""Offsets of journeys against common curves."""

from __future__ import annotations

import numpy as np
import torch
from worlds import lane_world

from crowdmap_torch.crowd_lanes.lateral_offsets import LateralOffsetConfig, journey_offsets
from crowdmap_torch.crowd_lanes.samples import sample_lanes
from crowdmap_torch.crowd_lanes.splines import curves_of, match
from crowdmap_torch.noise.positioning import PositioningNoise
from crowdmap_torch.tables import LANE_TYPES

NOISE = PositioningNoise()


def test_offsets_are_the_journeys_drifts() -> None:
    world = lane_world.build(0, 6, length=810.0, drift=0.2)
    # Against the true markers, the part across the road.
    reference = lane_world.pieces(
        [t[::16] for t in world.truth],
        type=[LANE_TYPES.index(m.type) for m in world.markers],
        journey=[-1] * len(world.truth),
        tracklet=[-1] * len(world.truth),
        frame=[-1] * len(world.truth),
    )
    packed = reference.select(torch.arange(len(reference)))
    curves = curves_of(packed.control.point_world, packed.control_count, packed.type)
    samples = sample_lanes(world.lanes, 2.0, NOISE, few_observations=10.0)
    found = journey_offsets(
        samples, match(samples.line, curves, gate=1.2), NOISE, LateralOffsetConfig()
    ).numpy()
    frame = world.lanes.frame[samples.piece]
    errors, sizes = [], []
    for j, drift in world.drift.items():
        mine = (samples.line.owner == j).numpy()
        at = (2 * frame[mine]).clamp(0, len(drift) - 1).numpy()
        true = (drift[at, :2] * world.left[at]).sum(1)
        errors.append((found[mine, :2] * world.left[at]).sum(1) - true)
        sizes.append(true)
    error, size = np.concatenate(errors), np.concatenate(sizes)
    assert np.sqrt(np.mean(error**2)) < 0.35 * np.sqrt(np.mean(size**2))
