from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from worlds import foreign

from crowdmap_torch.io.datasets import load_dataset
from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.formats.composing.compose import compose, write_new
from crowdmap_torch.io.formats.composing.parts import Asked
from crowdmap_torch.io.formats.importers import nuscenes

START_US = 1_532_402_927_612_460
Tables = dict[str, list[dict[str, Any]]]


@pytest.fixture
def tables() -> Tables:
    """Two scenes; of the first three images ahead and one to the rear, in no order."""
    images = [
        {
            "token": f"image{k}",
            "sample_token": "sample1" if k < 3 else "sample2",
            "ego_pose_token": f"pose{k}",
            "calibrated_sensor_token": "rear1" if k == 1 else "front1",
            "timestamp": START_US + 50_000 * (5 - k),
            "filename": f"sweeps/CAM_FRONT/n015__CAM_FRONT__{START_US + 50_000 * (5 - k)}.jpg",
            "width": 1600,
            "height": 900,
        }
        for k in range(6)
    ]
    poses = [
        # Heading north: a quarter turn of a body that looked east.
        {
            "token": f"pose{k}",
            "translation": [400.0, 1000.0 - k, 0.0],
            "rotation": [0.5**0.5, 0, 0, 0.5**0.5],
        }
        for k in range(6)
    ]
    ahead = {"translation": [1.7, 0.0, 1.5], "rotation": [0.5, -0.5, 0.5, -0.5]}
    K = [[1266.4, 0, 816.3], [0, 1266.4, 491.5], [0, 0, 1]]
    return {
        "scene": [
            {"token": "1", "name": "scene-0061", "log_token": "log"},
            {"token": "2", "name": "scene-0103", "log_token": "log"},
        ],
        "log": [{"token": "log", "location": "singapore-onenorth"}],
        "sample": [
            {"token": "sample1", "scene_token": "1"},
            {"token": "sample2", "scene_token": "1"},
        ],
        "sensor": [{"token": "f", "channel": "CAM_FRONT"}, {"token": "r", "channel": "CAM_BACK"}],
        "calibrated_sensor": [
            {"token": "front1", "sensor_token": "f", "camera_intrinsic": K, **ahead},
            {"token": "rear1", "sensor_token": "r", "camera_intrinsic": K, **ahead},
        ],
        "sample_data": images,
        "ego_pose": poses,
    }


@pytest.fixture
def write(tmp_path: Path) -> Callable[[Tables], Path]:
    def to_folder(tables: Tables) -> Path:
        folder = tmp_path / "v1.0-mini"
        folder.mkdir(exist_ok=True)
        for name, rows in tables.items():
            foreign.write_json(folder / f"{name}.json", rows)
        return folder

    return to_folder


def test_a_scene_is_a_journey_of_its_cameras_images(tables: Tables, write, tmp_path: Path):
    asked = Asked(drive="scene-0061", images="us")
    parts = nuscenes.read((write(tables),), asked)
    write_new(tmp_path / "DATA", compose([parts], asked))
    dataset = load_dataset(tmp_path / "DATA")
    (journey,) = dataset.journeys
    assert journey.journey_id == "scene-0061"
    assert dataset.origin.lat_deg == pytest.approx(1.2882100868743724)
    # In order of time: all but the one to the rear.
    expected = [(START_US + 50_000 * k) * 1000 for k in (0, 1, 2, 3, 5)]
    assert journey.t_ns.tolist() == expected
    north = [1000 - k + 1.7 for k in (5, 4, 3, 2, 0)]
    np.testing.assert_allclose(journey.T_world_camera[:, 1, 3], north, atol=1e-9)
    np.testing.assert_allclose(journey.T_world_camera[0, :3, 2], (0, 1, 0), atol=1e-9)
    assert journey.rig.camera_height == 1.5
    np.testing.assert_allclose(journey.rig.road_normal_camera, (0, 1, 0), atol=1e-9)
    assert (journey.rig.camera.width, journey.rig.camera.height) == (1600, 900)


def test_scenes_and_cameras_must_be_named(tables: Tables, write):
    folder = write(tables)
    with pytest.raises(InputError, match="give --drive SCENE, one of scene-0061, scene-0103"):
        nuscenes.read((folder,), Asked())
    with pytest.raises(InputError, match="'scene-1' is not there; give --drive"):
        nuscenes.read((folder,), Asked(drive="scene-1"))
    with pytest.raises(InputError, match="--camera CAM: expected one of CAM_BACK, CAM_FRONT"):
        nuscenes.read((folder,), Asked(drive="scene-0061", camera="CAM"))
    with pytest.raises(InputError, match="has no images of CAM_FRONT"):
        nuscenes.read((folder,), Asked(drive="scene-0103"))


@pytest.mark.parametrize(
    ("table", "row", "change", "expected"),
    [
        ("log", 0, {"location": "moon"}, r"log\.json: \[0\].location: 'moon' is unknown"),
        (
            "sample_data",
            0,
            {"ego_pose_token": "x"},
            r"sample_data\.json: \[0\].ego_pose_token: no row",
        ),
        (
            "sample_data",
            3,
            {"timestamp": START_US + 250_000},
            r"timestamp: its time is that of another",
        ),
        ("sample_data", 3, {"width": 800}, "images of 2 sizes"),
        (
            "ego_pose",
            0,
            {"rotation": [2, 0, 0, 0]},
            r"ego_pose\.json: \[0\].rotation: expected a unit",
        ),
        ("calibrated_sensor", 0, {"camera_intrinsic": []}, "expected a matrix of 3 x 3"),
        ("calibrated_sensor", 0, {"sensor_token": "r"}, "has no images of CAM_FRONT"),
    ],
)
def test_a_table_with_a_mistake_is_refused(
    tables: Tables, write, table: str, row: int, change: dict[str, Any], expected: str
):
    tables[table][row] |= change
    with pytest.raises(InputError, match=expected):
        nuscenes.read((write(tables),), Asked(drive="scene-0061"))


def test_a_table_that_is_no_list_is_refused(tables: Tables, write):
    folder = write(tables)
    foreign.write_json(folder / "scene.json", {})
    with pytest.raises(InputError, match=r"scene\.json: expected a list of rows"):
        nuscenes.read((folder,), Asked())
    (folder / "scene.json").unlink()
    with pytest.raises(InputError, match=r"scene\.json: the file is missing"):
        nuscenes.read((folder,), Asked())
