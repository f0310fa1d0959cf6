"""Scenes of nuScenes: the folder of its tables (v1.0-mini and the like), poses and all images of one camera.

`--drive` names the scene, `--camera` the camera (CAM_FRONT if nobody says). The world is that of the scene's map, its
origin the map's southern and western corner. Poses lie on the road under the rear axle, so the camera's height is that of
its mount. Images are named as in the tables; a time ends each name: `--images us` with detections.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from crowdmap_torch.geometry.camera import Camera
from crowdmap_torch.io.documents import Document, read_json_content
from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.formats.composing.lines import rotations
from crowdmap_torch.io.formats.composing.parts import Asked, CarRig, Importer, Parts, Track
from crowdmap_torch.io.formats.composing.sources import file_in, the_one
from crowdmap_torch.tables import Origin

_ORIGINS = {
    "boston-seaport": Origin(42.336849169438615, -71.05785369873047, 0.0),
    "singapore-onenorth": Origin(1.2882100868743724, 103.78475189208984, 0.0),
    "singapore-hollandvillage": Origin(1.2993652317780957, 103.78217697143555, 0.0),
    "singapore-queenstown": Origin(1.2782562240223188, 103.76741409301758, 0.0),
}
"""South-western corners of the maps, as the data set's own tools have them; heights are not in the data."""
_MOST_M = 1e6


def read(sources: tuple[Path, ...], asked: Asked) -> Parts:
    """Poses and rig of one scene."""
    folder = the_one(sources, "the folder of the tables, with scene.json in it")
    scene = _scene(folder, asked.drive)
    logs = {row.text("token"): row for row in _rows(folder, "log")}
    log = _joined(logs, scene, "log_token")
    location = log.text("location")
    if location not in _ORIGINS:
        raise log.fault(
            f"{location!r} is unknown; expected one of {', '.join(_ORIGINS)}", "location"
        )
    images, sensor = _images(folder, scene, asked.camera or "CAM_FRONT")
    poses = {row.text("token"): row for row in _rows(folder, "ego_pose")}
    places = [_joined(poses, row, "ego_pose_token") for row in images]
    # Times are in microseconds.
    t_ns = np.array([row.integer("timestamp", low=0, high=2**51) * 1000 for row in images])
    order = np.argsort(t_ns, kind="stable")
    if (stays := np.diff(t_ns[order]) <= 0).any():
        row = images[int(order[int(stays.argmax()) + 1])]
        raise row.fault("its time is that of another image", "timestamp")
    T = np.stack([_transform(places[k]) for k in order])
    sizes = {(row.take("width"), row.take("height")) for row in images}
    if len(sizes) != 1:
        raise images[0].fault(f"images of {len(sizes)} sizes; expected one", "width")
    rig = _rig(sensor, images[0], asked.camera or "CAM_FRONT")
    track = Track(folder / scene.text("name"), t_ns[order], T)
    return Parts(track=track, rig=rig, origin=_ORIGINS[location])


def _rows(folder: Path, table: str) -> Iterator[Document]:
    path = file_in(folder, f"{table}.json")
    rows = read_json_content(path)
    if not isinstance(rows, list):
        raise InputError(f"{path}: expected a list of rows")
    return (Document(path, row, f"[{number}]") for number, row in enumerate(rows))


def _joined(table: dict[str, Document], row: Document, key: str) -> Document:
    found = table.get(row.text(key))
    if found is None:
        raise row.fault("no row with this token in its table", key)
    return found


def _scene(folder: Path, name: str | None) -> Document:
    scenes = {row.text("name"): row for row in _rows(folder, "scene")}
    if name is None and len(scenes) == 1:
        return next(iter(scenes.values()))
    if name not in scenes:
        some = ", ".join(list(scenes)[:10])
        asked = "" if name is None else f" {name!r} is not there;"
        raise InputError(f"{folder / 'scene.json'}:{asked} give --drive SCENE, one of {some}")
    return scenes[name]


def _images(folder: Path, scene: Document, camera: str) -> tuple[list[Document], Document]:
    """The rows of the camera's images in a scene, and its calibration."""
    samples = {
        row.text("token")
        for row in _rows(folder, "sample")
        if row.text("scene_token") == scene.text("token")
    }
    channels = {row.text("token"): row.text("channel") for row in _rows(folder, "sensor")}
    if camera not in channels.values():
        raise InputError(
            f"--camera {camera}: expected one of {', '.join(sorted(channels.values()))}"
        )
    sensors = {
        row.text("token"): row
        for row in _rows(folder, "calibrated_sensor")
        if channels.get(row.text("sensor_token")) == camera
    }
    images = [
        row
        for row in _rows(folder, "sample_data")
        if row.text("sample_token") in samples and row.text("calibrated_sensor_token") in sensors
    ]
    if not images:
        raise scene.fault(f"has no images of {camera} in sample_data.json", "name")
    calibrations = {row.text("calibrated_sensor_token") for row in images}
    if len(calibrations) > 1:
        raise images[0].fault("a scene with two calibrations", "calibrated_sensor_token")
    return images, sensors[calibrations.pop()]


def _transform(row: Document) -> Float[np.ndarray, "4 4"]:
    quaternion = np.array(row.numbers("rotation", 4, most=2))
    if abs(np.sqrt(np.square(quaternion).sum()) - 1) > 1e-2:
        raise row.fault("expected a unit quaternion", "rotation")
    T = np.eye(4)
    # The quaternion's real part comes first here.
    T[:3, :3] = rotations(np.roll(quaternion, -1)[None])[0]
    T[:3, 3] = row.numbers("translation", 3, most=_MOST_M)
    return T


def _rig(sensor: Document, image: Document, camera: str) -> CarRig:
    T_link_camera = _transform(sensor)
    rows = sensor.take("camera_intrinsic")
    if not isinstance(rows, list) or len(rows) != 3:
        raise sensor.fault("expected a matrix of 3 x 3", "camera_intrinsic")
    inside = Document(
        sensor.path, {f"camera_intrinsic[{k}]": row for k, row in enumerate(rows)}, sensor.section
    )
    K = torch.tensor([inside.numbers(key, 3) for key in inside.content], dtype=torch.float64)
    width, height = (image.integer(key, low=2, high=10**5) for key in ("width", "height"))
    lens = Camera("brown_conrady", width, height, K, torch.zeros(0, dtype=torch.float64))
    return CarRig(camera, lens, T_link_camera, camera_height=float(T_link_camera[2, 3]))


IMPORTER = Importer(
    summary="a scene of nuScenes: the folder of its tables; --drive SCENE, --camera CAM_FRONT, --images us",
    gives=("poses", "rig"),
    tested_on="small files after the published layout",
    read=read,
)
