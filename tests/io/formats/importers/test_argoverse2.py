from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import feather

from crowdmap_torch.io.datasets import load_dataset
from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.formats.composing.compose import compose, write_new
from crowdmap_torch.io.formats.composing.parts import Asked
from crowdmap_torch.io.formats.importers import argoverse2
from crowdmap_torch.io.surveys import read_survey

LOG = "7fab2350-7eaf-3b7e-a39d-6937a4c1bede"
NORTH = 0.5**0.5


def points(x: float, *, z: float = 99.7) -> list[dict[str, float]]:
    return [{"x": x, "y": float(y), "z": z} for y in (0, 20, 40)]


def segment(left: float, right: float, marks: tuple[str, str]) -> dict:
    return {
        "left_lane_boundary": points(left),
        "right_lane_boundary": points(right),
        "left_lane_mark_type": marks[0],
        "right_lane_mark_type": marks[1],
    }


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """A car that drives along the city's y between two lanes; its rear axle is 0.3 m above the road."""
    folder = tmp_path / "log"
    (folder / "map").mkdir(parents=True)
    (folder / "calibration").mkdir()
    pose = {"qw": NORTH, "qx": 0.0, "qy": 0.0, "qz": NORTH}
    rows = [
        {"timestamp_ns": k * 10**8, **pose, "tx_m": 1.5, "ty_m": float(k), "tz_m": 100.0}
        for k in range(30)
    ]
    feather.write_feather(pa.Table.from_pylist(rows), folder / "city_SE3_egovehicle.feather")
    # A camera that looks ahead, a metre above the axle.
    camera = {"qw": 0.5, "qx": -0.5, "qy": 0.5, "qz": -0.5, "tx_m": 2.0, "ty_m": 0.0, "tz_m": 1.0}
    sensors = [{"sensor_name": name, **camera} for name in ("up_lidar", "ring_front_center")]
    feather.write_feather(
        pa.Table.from_pylist(sensors), folder / "calibration" / "egovehicle_SE3_sensor.feather"
    )
    lens = {"fx_px": 900.0, "fy_px": 900.0, "cx_px": 400.0, "cy_px": 300.0}
    lens |= {"k1": -0.1, "k2": 0.01, "k3": 0.001, "height_px": 600, "width_px": 800}
    lenses = pa.Table.from_pylist([{"sensor_name": "ring_front_center", **lens}])
    feather.write_feather(lenses, folder / "calibration" / "intrinsics.feather")
    lanes = {
        "1": segment(0.0, 3.0, ("SOLID_YELLOW", "DASHED_WHITE")),
        "2": segment(3.0, 6.0, ("DASHED_WHITE", "NONE")),
        "3": segment(-4.0, 0.0, ("DASH_SOLID_WHITE", "SOLID_YELLOW")),
    }
    content = {"lane_segments": lanes, "pedestrian_crossings": {}}
    path = folder / "map" / "log_map_archive_log____PIT_city_1.json"
    path.write_text(json.dumps(content))
    return folder


def test_a_log_is_turned_to_true_north(log: Path, tmp_path: Path):
    asked = Asked()
    parts = argoverse2.read((log,), asked)
    write_new(tmp_path / "DATA", compose([parts], asked))
    dataset = load_dataset(tmp_path / "DATA")
    (journey,) = dataset.journeys
    # The city's origin; a metre and a half east of it the drive begins.
    assert dataset.origin.lat_deg == pytest.approx(40.44177902989321, abs=1e-6)
    assert dataset.origin.height_m == 100
    # East of the zone's middle grid north lies east of true north, here by 0.64 degrees.
    forward = journey.T_world_camera[0, :3, 2].numpy()
    assert np.degrees(np.arctan2(forward[0], forward[1])) == pytest.approx(0.6403, abs=1e-3)
    way = journey.T_world_camera[-1, :3, 3] - journey.T_world_camera[0, :3, 3]
    assert float(way.norm()) == pytest.approx(29.0)
    assert journey.rig.camera_height == pytest.approx(1.3)
    assert journey.rig.camera.distortion.tolist() == [-0.1, 0.01, 0, 0, 0.001]
    np.testing.assert_allclose(journey.rig.road_normal_camera, (0, 1, 0), atol=1e-12)
    survey = read_survey(tmp_path / "DATA" / "survey")
    # A boundary that two lanes share comes once.
    assert survey.lane_id == ("1-left", "1-right", "3-left")
    assert survey.lane_type.tolist() == [0, 1, 2]
    assert float(survey.lane_points.point_world[:, 2].max()) == pytest.approx(-0.3)


def test_a_real_log_is_a_data_set_with_a_survey(real_data: Callable[[str], Path], tmp_path: Path):
    asked = Asked()
    parts = argoverse2.read((real_data(f"argoverse2/{LOG}"),), asked)
    write_new(tmp_path / "DATA", compose([parts], asked))
    (journey,) = load_dataset(tmp_path / "DATA", strict=True).journeys
    assert journey.frame_count == 2706
    # Rear axles of these cars are a third of a metre above the road.
    assert journey.rig.camera_height == pytest.approx(1.398 + 0.33, abs=0.05)
    survey = read_survey(tmp_path / "DATA" / "survey")
    assert len(survey.lane_id) == 58
    # The car drives on the map's road: its camera is as high above the nearest marker as above the road.
    camera, marker = (
        journey.T_world_camera[::50, :3, 3].numpy(),
        survey.lane_points.point_world.numpy(),
    )
    away = np.linalg.norm(camera[:, None, :2] - marker[None, :, :2], axis=-1)
    near = away.min(1) < 3
    assert near.sum() > 10
    above = camera[near, 2] - marker[away[near].argmin(1), 2]
    assert np.abs(above - journey.rig.camera_height).max() < 0.25
    # The camera looks along the drive.
    way = np.gradient(journey.T_world_camera[:, :3, 3].numpy()[::100], axis=0)
    speed = np.linalg.norm(way, axis=1)
    ahead = (journey.T_world_camera[::100, :3, 2].numpy() * way).sum(-1)[speed > 1] / speed[
        speed > 1
    ]
    assert ahead.min() > 0.95


def test_a_log_with_a_mistake_is_refused(log: Path):
    with pytest.raises(InputError, match=r"sensor_name 'rear' is not there; expected one of ring"):
        argoverse2.read((log,), Asked(camera="rear"))
    archive = next((log / "map").iterdir())
    nowhere = archive.rename(archive.with_name("log_map_archive_log____XYZ_city_1.json"))
    with pytest.raises(InputError, match="its name has no city"):
        argoverse2.read((log,), Asked())
    nowhere.rename(archive)
    content = json.loads(archive.read_text())
    content["lane_segments"]["1"]["left_lane_boundary"] = []
    archive.write_text(json.dumps(content))
    with pytest.raises(
        InputError, match=r"lane_segments\.1\.left_lane_boundary: expected a list of two"
    ):
        argoverse2.read((log,), Asked())
    archive.unlink()
    with pytest.raises(InputError, match="0 files log_map_archive"):
        argoverse2.read((log,), Asked())
    poses = log / "city_SE3_egovehicle.feather"
    poses.write_bytes(b"nothing")
    with pytest.raises(
        InputError, match=r"city_SE3_egovehicle\.feather: cannot be read as Feather"
    ):
        argoverse2.read((log,), Asked())
    feather.write_feather(pa.table({"timestamp_ns": [1]}), poses)
    with pytest.raises(InputError, match="column 'qx' is missing"):
        argoverse2.read((log,), Asked())
