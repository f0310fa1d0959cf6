"""A drive frame by frame: association equals the batch, memory stays bounded, a drive can be interrupted."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from crowdmap_torch.config import MapperConfig
from crowdmap_torch.io.datasets import load_journey
from crowdmap_torch.noise.positioning import PositioningNoise
from crowdmap_torch.road.estimate import estimate_road
from crowdmap_torch.signs.triangulate import triangulate_signs
from crowdmap_torch.simulate.dataset import SimulationConfig, write_dataset
from crowdmap_torch.simulate.worlds import WORLD_PRESETS
from crowdmap_torch.single_journey import (
    LANE_STRETCH_FRAMES,
    MAPPING_FRAMES,
    SIGN_STRETCH_FRAMES,
    SingleJourneyMapper,
    frame_of,
    joined,
)
from crowdmap_torch.tables import concatenate
from crowdmap_torch.tracking.lanes import associate_lanes
from crowdmap_torch.tracking.signs import associate_signs

FRAMES = 220


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    """The first frames of a simulated street."""
    out = tmp_path_factory.mktemp("drive") / "street"
    config = SimulationConfig(world=WORLD_PRESETS["street"], journeys=1, seed=3)
    write_dataset(config, out)
    (folder,) = (out / "journeys").iterdir()
    journey, _ = load_journey(folder)
    return joined([frame_of(journey, i) for i in range(min(FRAMES, journey.frame_count))])


@pytest.fixture(scope="module")
def stepped(drive):
    mapper = SingleJourneyMapper(drive.rig)
    held, results = [], []
    for index in range(drive.frame_count):
        results.append(mapper.step(frame_of(drive, index)))
        held.append(mapper.frames_held)
    return results, mapper.finish(), held


def test_association_equals_the_batch(drive, stepped):
    results, _, _ = stepped
    config = MapperConfig()
    signs = associate_signs(drive, config.positioning, config.sign_association)
    order = torch.argsort(drive.signs.frame, stable=True)
    assert torch.equal(torch.cat([r.sign_tracklet for r in results]), signs.label[order])
    lanes = associate_lanes(drive, config.lane_association)
    order = torch.argsort(drive.lanes.frame, stable=True)
    assert torch.equal(torch.cat([r.lane_tracklet for r in results]), lanes.label[order])


def test_the_road_equals_the_causal_batch(drive, stepped):
    results, _, _ = stepped
    config = replace(MapperConfig().road, method="causal")
    batch = estimate_road(drive, PositioningNoise(), config)
    stepwise = concatenate([r.road for r in results])
    torch.testing.assert_close(stepwise.normal_camera, batch.normal_camera, rtol=0, atol=1e-9)


def test_every_sign_of_the_batch_comes_out_once(drive, stepped):
    results, (last, _), _ = stepped
    config = MapperConfig()
    batch, _ = triangulate_signs(
        drive,
        associate_signs(drive, config.positioning, config.sign_association),
        config.positioning,
        config.sign_triangulation,
    )
    found = [r.signs for r in results if r.signs is not None]
    found = concatenate(found + ([last] if last is not None else []))
    assert len(found) >= len(batch)
    assert len(found.tracklet.unique()) == len(found)
    distance, row = torch.cdist(batch.center_world, found.center_world).min(1)
    assert len(row.unique()) == len(batch)
    # The batch knows more of the drift, from signs to come: it may differ by what the causal signs are unsure.
    unsure = torch.linalg.eigvalsh(found.covariance[row])[:, -1].sqrt()
    assert float((distance / unsure).max()) < 3.0


def test_a_drive_that_ends_early_is_the_batch(drive):
    """Before anything went out of sight there is nothing to come that the batch could know."""
    mapper, frames = SingleJourneyMapper(drive.rig), [frame_of(drive, i) for i in range(50)]
    results = [mapper.step(frame) for frame in frames]
    assert all(result.signs is None for result in results)
    found, _ = mapper.finish()
    part, config = joined(frames), MapperConfig()
    batch, _ = triangulate_signs(
        part,
        associate_signs(part, config.positioning, config.sign_association),
        config.positioning,
        config.sign_triangulation,
    )
    assert found is not None and len(found) == len(batch) > 0
    torch.testing.assert_close(found.T_world_sign, batch.T_world_sign, rtol=0, atol=1e-6)


def test_memory_holds_what_is_in_sight(stepped):
    _, _, held = stepped
    assert max(held) < FRAMES
    assert len(set(held)) > 1


def test_lanes_come_out_along_the_way(stepped):
    results, (_, last), _ = stepped
    assert any(r.lanes is not None and len(r.lanes) for r in results)
    assert last is not None


@pytest.mark.parametrize("stop", [30, SIGN_STRETCH_FRAMES + 5, LANE_STRETCH_FRAMES + 1])
def test_an_interrupted_drive_goes_on(drive, stop):
    """At any frame: also while signs or lanes that went out of sight are being mapped."""
    whole, first, second = (SingleJourneyMapper(drive.rig) for _ in range(3))
    frames = [frame_of(drive, i) for i in range(stop + MAPPING_FRAMES + 10)]
    expected = [whole.step(frame) for frame in frames]
    for frame in frames[:stop]:
        first.step(frame)
    second.load_state_dict(first.state_dict())
    for frame, result in zip(frames[stop:], expected[stop:], strict=True):
        again = second.step(frame)
        assert torch.equal(again.sign_tracklet, result.sign_tracklet)
        assert torch.equal(again.lane_tracklet, result.lane_tracklet)
        torch.testing.assert_close(again.road.normal_camera, result.road.normal_camera)
        assert (again.signs is None) == (result.signs is None)
        assert (again.lanes is None) == (result.lanes is None)
        if result.signs is not None and again.signs is not None:
            assert torch.equal(again.signs.T_world_sign, result.signs.T_world_sign)
        if result.lanes is not None and again.lanes is not None:
            assert torch.equal(again.lanes.control.point_world, result.lanes.control.point_world)
    (signs, lanes), (signs_again, lanes_again) = whole.finish(), second.finish()
    assert signs is not None and signs_again is not None
    assert torch.equal(signs.T_world_sign, signs_again.T_world_sign)
    assert lanes is not None and lanes_again is not None
    assert torch.equal(lanes.control.point_world, lanes_again.control.point_world)


def test_two_frames_at_once_are_refused(drive):
    with pytest.raises(ValueError, match="one frame"):
        SingleJourneyMapper(drive.rig).step(drive)
