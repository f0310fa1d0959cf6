from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch
from worlds.marked_roads import bend, line, marked_map, two_way_road

from crowdmap_torch.geometry.camera import project
from crowdmap_torch.io.datasets import load_dataset
from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.formats.composing.map_files import map_of_file
from crowdmap_torch.io.formats.exporters.carriageways import carriageways
from crowdmap_torch.io.formats.exporters.features import lane_points
from crowdmap_torch.io.surveys import read_survey
from crowdmap_torch.simulate.dataset import (
    SimulationConfig,
    make_fleet,
    make_journey,
    write_dataset,
)
from crowdmap_torch.simulate.fleet import FleetConfig
from crowdmap_torch.simulate.lane_perception import LaneDetectionConfig
from crowdmap_torch.simulate.lane_ways import longest_way
from crowdmap_torch.simulate.map_worlds import map_world
from crowdmap_torch.simulate.recordings import recordings
from crowdmap_torch.simulate.signposts import SignConfig

EXACT = LaneDetectionConfig(
    lane_noise_px=0.0, lane_point_outliers=0.0, merged_lanes=0.0, false_lanes=0.0, missed_lanes=0.0
)


def world_of(hd_map, **more):
    return map_world(hd_map, SignConfig(), np.random.default_rng(0), **more)


def test_ways_follow_lanes_over_crossings():
    # Two lanes of 60 m with 20 m of crossing between them, the second half a lane to the side.
    markers = [
        line((0, 3.5), (60, 3.5)),
        line((0, 0), (60, 0)),
        line((80, 4), (140, 4)),
        line((80, 0.5), (140, 0.5)),
    ]
    way = longest_way(carriageways(markers))
    assert way[0] == pytest.approx([0, 1.75, 0]) and way[-1] == pytest.approx([140, 2.25, 1.4])
    steps = np.diff(way, axis=0)
    assert np.linalg.norm(steps, axis=1).max() < 1.6 and (steps[:, 0] >= 0).all()


def test_ways_run_with_the_traffic():
    way = longest_way(carriageways(lane_points(two_way_road().lanes)))
    # Of two lanes to the east and one back: whichever, in its own direction.
    assert (way[-1, 0] - way[0, 0] > 0) == (way[0, 1] < 3.5)


def test_roads_lean_as_the_markers_beside_them():
    world = world_of(marked_map([("solid", bend(60, 100, a)) for a in (0, -3.5)]))
    inside = slice(200, -200)
    # The bend falls by 3 % to the left.
    np.testing.assert_allclose(world.road.left[inside, 2], -0.03, atol=4e-3)
    np.testing.assert_allclose(world.road.forward[inside, 2], 0.03, atol=4e-3)


def test_exact_detections_lie_on_the_maps_markers():
    world = world_of(two_way_road())
    config = SimulationConfig(world=world.config, lanes=EXACT)
    fleet = make_fleet(config, world)
    journey = make_journey(config, world, fleet, 0)
    rows, markers = journey.lanes, world.markers
    assert len(rows) > 200 and set(rows.marker.tolist()) >= {1, 2, 3, 4}
    start = np.cumsum(rows.count) - rows.count
    for row in range(0, len(rows), 401):
        points = torch.from_numpy(markers.points_of(int(rows.marker[row])))
        R = torch.from_numpy(journey.drive.R_world_camera[rows.frame[row]])
        p = torch.from_numpy(journey.drive.p_world_camera[rows.frame[row]])
        seen, visible = project(journey.vehicle.rig.camera, (points - p) @ R)
        line_px = seen[visible].numpy()
        for px in rows.px[start[row] : start[row] + rows.count[row]]:
            # A point lies on the marker's image, whose own points are 0.25 m apart.
            to = line_px - px
            near = np.argsort(np.linalg.norm(to, axis=1))[:2]
            a, b = line_px[near]
            (du, dv), (pu, pv) = b - a, px - a
            assert abs(du * pv - dv * pu) / max(np.hypot(du, dv), 1e-9) < 0.5


def test_lane_points_are_off_to_the_left_of_the_driver():
    world = world_of(two_way_road())
    off = FleetConfig(lane_error_m=0.5)
    config = SimulationConfig(world=world.config, lanes=EXACT, fleet=off)
    fleet = make_fleet(config, world)
    moved = make_journey(config, world, fleet, 0)
    left_m = moved.vehicle.errors.lane_left_m
    exact = replace(config, fleet=FleetConfig())
    still = make_journey(exact, world, make_fleet(exact, world), 0)
    assert abs(left_m) > 0.05
    if len(moved.lanes) == len(still.lanes) and (moved.lanes.count == still.lanes.count).all():
        shift = (moved.lanes.px - still.lanes.px)[:, 0]
        assert np.mean(np.sign(shift) == -np.sign(left_m)) > 0.95


def test_a_dataset_of_a_map_has_the_map_for_its_survey(tmp_path: Path):
    hd_map = two_way_road()
    world = world_of(hd_map)
    write_dataset(SimulationConfig(world=world.config, journeys=2), tmp_path / "DATA", world=world)
    dataset = load_dataset(tmp_path / "DATA")
    survey = read_survey(tmp_path / "DATA" / "survey")
    assert dataset.origin == survey.origin == hd_map.origin
    assert sorted(survey.sign_id) == sorted(hd_map.sign_id)
    rows = [survey.sign_id.index(name) for name in hd_map.sign_id]
    torch.testing.assert_close(
        survey.signs.corners_world[rows], hd_map.signs.corners_world, rtol=0, atol=1e-9
    )
    assert sorted(survey.lane_id) == sorted(hd_map.lane_id)
    assert all(len(journey.lanes) > 100 for journey in dataset.journeys)


def test_recorded_drives_keep_their_poses_and_camera(tmp_path: Path):
    world = world_of(two_way_road())
    config = SimulationConfig(world=world.config, journeys=1)
    write_dataset(config, tmp_path / "DATA", world=world)
    # What was simulated there stands for a real log.
    (log,) = load_dataset(tmp_path / "DATA").journeys
    again = world_of(two_way_road(), recordings=recordings([log]))
    other = replace(config, world=again.config, seed=5)
    journey = make_journey(other, again, make_fleet(other, again), 0)
    assert journey.vehicle.rig.rig_id == log.rig.rig_id
    assert torch.equal(journey.vehicle.rig.camera.K, log.rig.camera.K)
    own = log.T_world_camera[:, :3, 3].numpy()
    apart = np.linalg.norm(journey.drive.p_world_camera[:, None] - own[None], axis=-1)
    assert apart.min(axis=1).max() == 0.0
    # What the positioning says of them is off, and what is seen is seen from where they are.
    assert np.linalg.norm(journey.T_reported[:, :3, 3] - journey.T_world_link[:, :3, 3]) > 0.1
    assert len(journey.lanes) > 100


def test_signs_are_put_up_where_a_map_has_none():
    bare = marked_map([("solid", bend(60, 100, a)) for a in (0, -3.5)])
    world = world_of(bare)
    assert len(world.signs) > 0
    near = np.linalg.norm(world.signs.center[:, None] - world.road.centre[None, ::50], axis=-1)
    assert near.min(axis=1).max() < 15


def test_maps_without_a_way_are_refused():
    with pytest.raises(InputError, match="no lane markers"):
        world_of(marked_map([]))
    with pytest.raises(InputError, match="the longest way along the map's lanes is 0 m"):
        world_of(marked_map([("solid", line((0, 0), (90, 0)))]))


def test_the_command_takes_files_folders_and_datasets(tmp_path: Path, capsys):
    from crowdmap_torch.cli import main
    from crowdmap_torch.io.formats.exporters import lanelet2
    from crowdmap_torch.io.maps import write_map

    write_map(two_way_road(), tmp_path / "MAP")
    lanelet2.write(two_way_road(), tmp_path / "map.osm")
    for source, out in (("MAP", "A"), ("map.osm", "B"), ("A", "C")):
        code = main(
            ["simulate", str(tmp_path / out), "--map", str(tmp_path / source), "--journeys", "1"]
        )
        assert code == 0, capsys.readouterr()
        head = json.loads((tmp_path / out / "dataset.json").read_text())
        assert head["origin"]["lat_deg"] == pytest.approx(32.9)
        assert "4 signs, " in capsys.readouterr().out


def test_a_real_log_is_driven_again(real_data, tmp_path: Path):
    from crowdmap_torch.cli import main

    log = real_data("argoverse2/7fab2350-7eaf-3b7e-a39d-6937a4c1bede")
    data, out = tmp_path / "LOG", tmp_path / "DRIVES"
    assert main(["convert", "--from", "argoverse2", str(log), "--out", str(data)]) == 0
    assert main(["simulate", str(out), "--map", str(data), "--journeys", "1"]) == 0
    (real,), (drive,) = (load_dataset(folder).journeys for folder in (data, out))
    assert torch.equal(drive.rig.camera.K, real.rig.camera.K)
    # True poses are those of the log.
    true = pq.read_table(out / "survey/truth" / drive.journey_id / "poses.parquet")
    place = np.stack([true.column(axis).to_numpy() for axis in "xyz"], axis=1)
    own = real.T_world_camera[:, :3, 3].numpy()
    assert np.linalg.norm(place[:, None] - own[None], axis=-1).min(axis=1).max() < 1e-9
    assert len(drive.lanes) > 300
    survey = read_survey(out / "survey")
    assert len(survey.lane_id) == 58 and len(survey.sign_id) > 0


def test_a_real_intersection_is_driven_through(real_data):
    hd_map = map_of_file(real_data("lanelet2/intersection.osm"))
    world = world_of(hd_map)
    assert world.road.length > 100
    config = SimulationConfig(world=world.config)
    journey = make_journey(config, world, make_fleet(config, world), 0)
    assert len(journey.lanes) > 300
