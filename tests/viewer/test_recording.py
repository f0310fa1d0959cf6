"""Recordings for the rerun viewer, read back with its own reader; skipped where rerun-sdk is not installed."""

from __future__ import annotations

import importlib
import importlib.util
import math
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from crowdmap_torch.geometry import se3
from crowdmap_torch.io.errors import InputError
from crowdmap_torch.viewer.recording import write_recording
from crowdmap_torch.viewer.scene import Scene
from crowdmap_torch.viewer.sources import read_scene, with_journeys

needs_rerun = pytest.mark.skipif(
    importlib.util.find_spec("rerun") is None,
    reason="rerun-sdk (extra rerun, 170 MB) is not installed",
)


class Recording:
    """Columns of a recording by entity, a list a row."""

    def __init__(self, path: Path) -> None:
        reader = importlib.import_module("rerun.chunk").RrdReader(str(path))
        self.entities = columns_of(reader.stream())
        (blueprint,) = reader.blueprints()
        self.layout = columns_of(reader.stream(store=blueprint))

    def one(self, entity: str, column: str) -> list[Any]:
        """What was logged once."""
        (value,) = self.entities[entity][column]
        return value


def columns_of(chunks: Iterable[Any]) -> dict[str, dict[str, list[Any]]]:
    """The columns of a stream of chunks by entity."""
    entities: dict[str, dict[str, list[Any]]] = {}
    for chunk in chunks:
        batch = chunk.to_record_batch()
        own = entities.setdefault(chunk.entity_path, {})
        for name in batch.schema.names:
            own.setdefault(name, []).extend(batch.column(name).to_pylist())
    return entities


@pytest.fixture(scope="module")
def adjusted(run_folder: Path) -> Scene:
    return with_journeys(read_scene(run_folder), run_folder)


@pytest.fixture(scope="module")
def recording(adjusted: Scene, tmp_path_factory: pytest.TempPathFactory) -> Recording:
    path = tmp_path_factory.mktemp("recording") / "run.rrd"
    write_recording(path, adjusted)
    assert [p.name for p in path.parent.iterdir()] == ["run.rrd"]
    return Recording(path)


@needs_rerun
def test_signs_are_where_the_map_has_them(recording: Recording, adjusted: Scene) -> None:
    hd_map = adjusted.hd_map
    assert hd_map is not None
    signs, mask = hd_map.signs, hd_map.signs.corner_mask
    strips = recording.one("/world/map/signs", "LineStrips3D:strips")
    for strip, corners, own in zip(strips, signs.corners_world, mask, strict=True):
        assert strip[0] == strip[-1]
        assert np.allclose(strip[:-1], corners[own].numpy(), atol=1e-4)
    assert recording.one("/world/map/signs", "sign_id") == list(hd_map.sign_id)
    assert recording.one("/world/map/lanes", "lane_id") == list(hd_map.lane_id)
    triangles = recording.one("/world/map/plates", "Mesh3D:triangle_indices")
    # Fans of both sides, and none reaches from one plate to another.
    assert len(triangles) == 2 * int((mask.sum(1) - 2).sum())
    assert all(len({k // 8 for k in triangle}) == 1 for triangle in triangles)


@needs_rerun
def test_it_opens_on_the_whole_map_from_above(recording: Recording, adjusted: Scene) -> None:
    eyes = [of for name, of in recording.layout.items() if name.endswith("/EyeControls3D")]
    assert len(eyes) == 1
    eye, target, up = (
        torch.tensor(eyes[0][f"EyeControls3D:{part}"]).double().flatten()
        for part in ("position", "look_target", "eye_up")
    )
    assert up.tolist() == [0, 0, 1]
    view = torch.nn.functional.normalize(target - eye, dim=0)
    assert view[2] < -0.9 and view[1] > 0 and abs(view[0]) < 1e-6
    # Whatever is in the map is ahead, within 20 degrees of where the eye looks: in half a window, less its panels.
    assert adjusted.hd_map is not None
    places = [adjusted.hd_map.signs.center_world, *(d.path_world for d in adjusted.drives)]
    rays = torch.nn.functional.normalize(torch.cat(places) - eye, dim=1)
    assert (rays @ view).min() > math.cos(math.radians(20))


@needs_rerun
def test_drives_begin_at_once_though_days_lie_between(recording: Recording) -> None:
    (panel,) = (of for name, of in recording.layout.items() if name.endswith("/time_panel"))
    assert [v for v in panel["TimePanelBlueprint:timeline"] if v is not None] == [["driven"]]


@needs_rerun
def test_ellipsoids_are_the_covariances(recording: Recording, adjusted: Scene) -> None:
    assert adjusted.hd_map is not None
    half = torch.tensor(recording.one("/world/map/uncertainty", "Ellipsoids3D:half_sizes"))
    turned = torch.tensor(recording.one("/world/map/uncertainty", "Ellipsoids3D:quaternions"))
    R, spread = se3.from_quaternion(turned.double()), torch.diag_embed(half.double() ** 2 / 7.815)
    covariance = R @ spread @ R.mT
    assert torch.allclose(covariance, adjusted.hd_map.signs.covariance, rtol=1e-4, atol=1e-8)


@needs_rerun
def test_the_map_lies_on_its_detections_in_every_picture(
    recording: Recording, adjusted: Scene
) -> None:
    """Through the poses and the pinhole of the recording alone."""
    assert adjusted.hd_map is not None
    centers = adjusted.hd_map.signs.center_world.numpy()
    for drive in adjusted.drives:
        entity = f"/world/drives/{drive.journey_id}/camera"
        camera, seen = recording.entities[entity], recording.entities[f"{entity}/signs"]
        K = np.reshape(recording_value(camera, "Pinhole:image_from_camera"), (3, 3), order="F")
        assert seen["frame"] == drive.frame_number.tolist()
        places = [v[0] for v in camera["Transform3D:translation"] if v is not None]
        turns = [v[0] for v in camera["Transform3D:quaternion"] if v is not None]
        missed = []
        rows = zip(places, turns, seen["LineStrips2D:strips"], strict=True)
        for place, turn, strips in rows:
            R = se3.from_quaternion(torch.tensor(turn, dtype=torch.float64)).numpy()
            p = (centers - place) @ R @ K.T
            middle = (p / p[:, 2:])[p[:, 2] > 1, :2]
            for strip in strips or ():
                away = np.linalg.norm(middle - np.mean(strip[:-1], 0), axis=-1)
                missed.append(away.min(initial=np.inf))
        # A drive of the tiny world is off by a few pixels; an axis or a turn the wrong way misses by hundreds.
        assert np.median(missed) < 5.0


def recording_value(columns: dict[str, list[Any]], name: str) -> Any:
    (value,) = (v for v in columns[name] if v is not None)
    return value[0]


@needs_rerun
def test_what_the_adjustment_gave_up_has_another_colour(
    recording: Recording, adjusted: Scene
) -> None:
    assert adjusted.outcomes is not None
    rows = adjusted.outcomes.rows
    lost = int(((rows.sign < 0) | rows.given_up).sum())
    colors = [
        color
        for entity, columns in recording.entities.items()
        if entity.endswith("/camera/signs")
        for frame in columns["LineStrips2D:colors"]
        for color in frame or ()
    ]
    assert len(colors) == len(rows)
    assert sum(color == 0xFF4438FF for color in colors) == lost


@needs_rerun
def test_ids_may_hold_any_letter(scene: Scene, tmp_path: Path) -> None:
    write_recording(tmp_path / "wicked.rrd", scene)
    found = Recording(tmp_path / "wicked.rrd")
    assert found.one("/world/map/signs", "sign_id")[0] == "</script><b>"
    assert sum(name.endswith("/given") for name in found.entities) == 2


def test_a_run_has_the_cameras_that_it_found(adjusted: Scene, run_folder: Path) -> None:
    from crowdmap_torch.io.found_calibration import folder_name
    from crowdmap_torch.io.poses import read_poses
    from crowdmap_torch.io.rigs import read_rig

    assert len(adjusted.journeys) == len(adjusted.drives) > 0
    for journey in adjusted.journeys:
        poses = read_poses(run_folder / "journeys" / journey.journey_id / "poses.parquet")
        folder = run_folder / "rigs" / folder_name(journey.vehicle)
        rig = read_rig(folder) if folder.exists() else journey.rig
        assert torch.equal(journey.T_world_camera, poses.T_world_link @ rig.T_link_camera)
        assert journey.rig.camera.K.tolist() == rig.camera.K.tolist()


def test_of_a_run_in_an_area_its_own_frames_are_shown(run_folder: Path, tmp_path: Path) -> None:
    import shutil

    import pyarrow.parquet as pq

    whole = with_journeys(read_scene(run_folder), run_folder)
    run = run_folder.with_name("part")
    shutil.copytree(run_folder, run)
    first = whole.journeys[0]
    path = run / "journeys" / first.journey_id / "poses.parquet"
    table = pq.read_table(path)
    pq.write_table(table.slice(10, 20), path)
    part = with_journeys(read_scene(run), run).journeys[0]
    shutil.rmtree(run)
    assert part.frame_number.tolist() == first.frame_number[10:30].tolist()
    inside = (first.signs.frame >= 10) & (first.signs.frame < 30)
    assert sorted(part.signs.row.tolist()) == sorted(first.signs.row[inside].tolist())


def test_without_the_package_one_line_says_what_to_install(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("rerun", "rerun.blueprint"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(InputError, match=r"pip install 'crowdmap_torch\[rerun\]'$"):
        write_recording(tmp_path / "view.rrd", scene)
    assert not list(tmp_path.iterdir())
