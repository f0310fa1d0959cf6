from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch

from crowdmap_torch.geometry import plane, polygon, se3
from crowdmap_torch.geometry.camera import project
from crowdmap_torch.io.datasets import load_dataset
from crowdmap_torch.io.surveys import read_survey
from crowdmap_torch.io.truth import read_truth
from crowdmap_torch.simulate.dataset import SimulationConfig, make_fleet, write_dataset
from crowdmap_torch.simulate.errors import with_errors
from crowdmap_torch.simulate.fleet import FleetConfig
from crowdmap_torch.simulate.rigs import RigConfig
from crowdmap_torch.simulate.sign_detections import DAY, corner_sigma
from crowdmap_torch.simulate.worlds import WORLD_PRESETS

STREET = replace(WORLD_PRESETS["street"], length_m=120.0)
SMALL = SimulationConfig(world=STREET, journeys=3, rig=RigConfig(rigs=3), seed=4)


@pytest.fixture(scope="module")
def small(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("simulated") / "small"
    write_dataset(SMALL, out)
    return out


def _bytes(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def test_same_seed_gives_same_bytes_and_another_seed_another_world(small: Path, tmp_path: Path):
    write_dataset(SMALL, tmp_path / "again")
    assert _bytes(tmp_path / "again") == _bytes(small)
    write_dataset(replace(SMALL, seed=5), tmp_path / "other")
    assert (
        _bytes(tmp_path / "other")["survey/signs.parquet"] != _bytes(small)["survey/signs.parquet"]
    )


def test_a_journey_does_not_depend_on_how_many_there_are(small: Path, tmp_path: Path):
    write_dataset(replace(SMALL, journeys=2), tmp_path / "fewer")
    name = "journeys/journey-001/"
    for file in ("poses.parquet", "signs.parquet", "lanes.parquet"):
        assert (tmp_path / "fewer" / name / file).read_bytes() == (small / name / file).read_bytes()


def test_other_journeys_can_drive_in_the_same_world(small: Path, tmp_path: Path):
    write_dataset(replace(SMALL, seed=9, world_seed=SMALL.seed), tmp_path / "other")
    for file in ("survey/signs.parquet", "survey/lanes.parquet"):
        assert (tmp_path / "other" / file).read_bytes() == (small / file).read_bytes()
    poses = "journeys/journey-000/poses.parquet"
    assert (tmp_path / "other" / poses).read_bytes() != (small / poses).read_bytes()


def test_errors_of_no_size_leave_no_trace(small: Path, tmp_path: Path):
    """Data sets keep their bytes: what is new draws from streams of its own and adds nothing where it is nothing."""
    nothing = replace(
        SMALL,
        journeys=2,
        fleet=FleetConfig(vehicles=3, one_detector=True),
        positioning=replace(SMALL.positioning, outage_m=9.0),
        signs=replace(SMALL.signs, jitter_s=0.1),
    )
    write_dataset(nothing, tmp_path / "nothing")
    made, known = _bytes(tmp_path / "nothing"), _bytes(small)
    told = ("survey/map.json", "survey/truth/drives.json", "survey/truth/bad_drives.json")
    assert len(made) > 20
    assert {name for name, content in made.items() if known[name] != content} <= set(told)


def test_what_is_wrong_with_vehicles_and_drives_is_kept_as_truth(tmp_path: Path):
    config = with_errors(replace(SMALL, journeys=4), ["fleet"])
    config = replace(config, fleet=replace(config.fleet, vehicles=2), seed=7)
    config = replace(config, positioning=replace(config.positioning, outages=0.5))
    write_dataset(config, tmp_path / "data")
    truth = tmp_path / "data" / "survey" / "truth"
    vehicles = json.loads((truth / "vehicles.json").read_text())
    for vehicle in make_fleet(config):
        told = vehicles[vehicle.vehicle_id]
        assert told.pop("rig") == vehicle.rig.rig_id
        assert told == json.loads(json.dumps(asdict(vehicle.errors)))
    drives = json.loads((truth / "drives.json").read_text())
    right = SMALL.positioning
    sigma = np.sqrt(right.bias_e_m**2 + right.drift_m**2 + right.white_e_m**2)
    for name, drive in drives.items():
        folder = tmp_path / "data" / "journeys" / name
        journey = json.loads((folder / "journey.json").read_text())
        assert drive["vehicle_id"] == journey["vehicle_id"]
        assert vehicles.keys() >= {journey["vehicle_id"]}
        poses = pq.read_table(folder / "poses.parquet")
        assert poses["sigma_e"][0].as_py() == pytest.approx(drive["sigma_factor"] * sigma)
    assert len(drives) == 4 and len({d["vehicle_id"] for d in drives.values()}) == 2
    outages = [drive["outage"] for drive in drives.values()]
    assert any(outages) and not all(outages)
    assert not load_dataset(tmp_path / "data", strict=True).rejected


def test_the_reader_takes_every_journey(small: Path):
    dataset = load_dataset(small, strict=True)
    assert len(dataset.journeys) == 3 and not dataset.rejected
    assert len({journey.rig.rig_id for journey in dataset.journeys}) == 3
    # Only gross outliers may be dropped for their geometry.
    for journey in dataset.journeys:
        assert sum(journey.dropped.values()) <= 0.02 * len(journey.signs)


@pytest.mark.parametrize("camera", ["brown", "pinhole", "fisheye"])
def test_survey_corners_reproject_into_detections_within_the_noise(camera: str, tmp_path: Path):
    """Through the files: lens, mount (none, base link, inner link), true poses, survey and labels."""
    config = replace(SMALL, rig=RigConfig(rigs=3, camera=camera))
    write_dataset(config, tmp_path / "data")
    dataset, survey = load_dataset(tmp_path / "data"), read_survey(tmp_path / "data" / "survey")
    truth = read_truth(tmp_path / "data" / "survey", survey, dataset.journeys)
    for known in truth.journeys:
        signs = known.journey.signs
        label = known.sign[signs.row]
        kept = (label >= 0) & ~known.sign_outlier[signs.row]
        signs, label = signs[kept], label[kept]
        T_camera_world = se3.inverse(known.T_world_camera[signs.frame])
        p_camera = se3.transform(T_camera_world[:, None], survey.signs.corners_world[label])
        px, _ = project(known.journey.rig.camera, p_camera)
        count = polygon.corner_count(signs.shape)
        shift, _ = polygon.best_shift(px, signs.corners_px, count)
        error = polygon.roll(signs.corners_px, shift, count) - px
        sigma = torch.from_numpy(corner_sigma((px.amax(1) - px.amin(1)).amax(-1).numpy(), DAY))
        scaled = (error / sigma[:, None, None])[polygon.corner_mask(signs.shape)]
        # The median does not mind the few duplicates, whose noise is 2.5 times as large;
        # of a standard normal variable it is 0.674, known here to about 0.02.
        assert scaled.abs().median() == pytest.approx(0.674, abs=0.06)
        assert scaled.square().mean().sqrt() < 1.15


def test_true_road_meets_the_surveyed_markers(small: Path):
    """Lane points cast on the true road plane land on the survey: at 5 to 12 m within centimetres."""
    dataset, survey = load_dataset(small), read_survey(small / "survey")
    truth = read_truth(small / "survey", survey, dataset.journeys)
    for known in truth.journeys:
        journey = known.journey
        detection = journey.lane_points.detection
        frame = journey.lanes.frame[detection]
        lane = known.lane[journey.lanes.row[detection]]
        ideal = journey.lane_points.ideal
        ray = torch.cat((ideal, torch.ones_like(ideal[:, :1])), dim=-1)
        h = known.road_normal_camera * known.camera_height[:, None]
        below = (h[frame] * ray).sum(-1)
        near = (lane >= 0) & (below > 1.45**2 / 12)
        point = plane.ground_points(
            ray[near], h[frame[near]], known.T_world_camera[frame[near]]
        ).numpy()
        off = []
        for own in lane[near].unique():
            line = survey.lane_points.point_world[survey.lane_points.lane == own].numpy()
            mine = point[(lane[near] == own).numpy()]
            off.append(np.linalg.norm(mine[:, None] - line[None], axis=-1).min(-1))
        # Survey points are half a metre apart, so 0.25 m is as far as one can be along the line.
        assert np.median(np.concatenate(off)) < 0.2
        assert np.quantile(np.concatenate(off), 0.9) < 0.4


def test_survey_is_in_the_form_of_a_map(small: Path):
    signs = pq.read_table(small / "survey" / "signs.parquet").to_pylist()
    lanes = pq.read_table(small / "survey" / "lanes.parquet").to_pylist()
    for sign in signs:
        corners = np.array(sign["corners"])
        np.testing.assert_allclose(corners.mean(0), sign["center"], atol=1e-9)
        assert np.linalg.norm(sign["normal"]) == pytest.approx(1.0)
    for lane in lanes:
        points = np.array(lane["points"])
        assert np.linalg.norm(np.diff(points, axis=0), axis=-1).max() <= 1.0
        assert lane["type"] in ("solid", "dashed", "double", "curb")
    assert len({sign["sign_id"] for sign in signs}) == len(signs)


def test_points_of_surveyed_markers_run_in_the_direction_of_travel(tmp_path: Path):
    block = replace(WORLD_PRESETS["block"], length_m=400.0)
    write_dataset(SimulationConfig(world=block, journeys=2), tmp_path / "block")
    lanes = pq.read_table(tmp_path / "block" / "survey" / "lanes.parquet").to_pylist()
    # The edges of a two-way road run against each other: round the block to the left and to the right.
    turns = []
    for lane in lanes:
        x, y = np.array(lane["points"])[:, :2].T
        turns.append(np.sign((x * np.roll(y, -1) - y * np.roll(x, -1)).sum()))
    kinds = [lane["type"] for lane in lanes]
    assert sorted(t for t, kind in zip(turns, kinds, strict=True) if kind != "double") == [-1, 1]


def test_sigma_columns_can_be_left_out(tmp_path: Path):
    config = replace(SMALL, journeys=1, positioning=replace(SMALL.positioning, sigmas=False))
    write_dataset(config, tmp_path / "data")
    table = pq.read_table(tmp_path / "data" / "journeys" / "journey-000" / "poses.parquet")
    assert not [name for name in table.column_names if name.startswith("sigma")]


def test_an_existing_folder_is_refused_unless_it_may_be_replaced(tmp_path: Path):
    config = replace(SMALL, journeys=1)
    write_dataset(config, tmp_path / "data")
    with pytest.raises(ValueError, match="overwrite"):
        write_dataset(config, tmp_path / "data")
    write_dataset(config, tmp_path / "data", overwrite=True)
    (tmp_path / "precious").mkdir()
    (tmp_path / "precious" / "thesis.txt").write_text("years of work")
    with pytest.raises(ValueError, match="left alone"):
        write_dataset(config, tmp_path / "precious", overwrite=True)
    assert (tmp_path / "precious" / "thesis.txt").exists()


def test_a_configuration_without_journeys_is_refused():
    with pytest.raises(ValueError, match="journeys: expected 1 to"):
        SimulationConfig(journeys=0)
    with pytest.raises(ValueError, match="length"):
        replace(STREET, length_m=-5.0)
