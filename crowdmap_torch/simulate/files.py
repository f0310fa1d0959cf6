"""Simulated journeys, rigs and the exact survey in FORMAT.md's form."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pyarrow as pa
import torch
from jaxtyping import Float

from crowdmap_torch.geometry import polygon
from crowdmap_torch.io import poses
from crowdmap_torch.io.detections import write_lane_detections, write_sign_detections
from crowdmap_torch.io.documents import plain, write_json
from crowdmap_torch.io.rigs import rig_yaml
from crowdmap_torch.io.writing import name_column, points_column, row_column, write_parquet
from crowdmap_torch.simulate.fleet import Vehicle
from crowdmap_torch.simulate.lane_perception import TYPES, LaneRows
from crowdmap_torch.simulate.rigs import SimulatedRig
from crowdmap_torch.simulate.sign_detections import SignRows, all_codes
from crowdmap_torch.simulate.vehicle import Drive
from crowdmap_torch.simulate.worlds import World

_CORNERS = polygon.CORNER_COUNT.numpy()


def write_rig(folder: Path, rig: SimulatedRig) -> None:
    """`rig.yaml` and, for a rig with a mount, `rig.urdf`."""
    folder.mkdir(parents=True, exist_ok=True)
    mount = None
    if rig.pose_link is not None:
        mount = ("rig.urdf", rig.pose_link, "camera_optical")
    text = rig_yaml(rig.camera, rig.road_normal_camera, rig.camera_height, mount)
    (folder / "rig.yaml").write_text(text, encoding="utf-8")
    if rig.urdf is not None:
        (folder / "rig.urdf").write_text(rig.urdf, encoding="utf-8")


def write_drive_poses(
    path: Path,
    drive: Drive,
    T_world_link: Float[np.ndarray, "f 4 4"],
    started_ns: int,
    sigmas: tuple[Float[np.ndarray, " 3"], float] | None = None,
) -> None:
    """`poses.parquet`, with or without the module's own sigmas."""
    frames = len(drive)
    sigma_position = sigma_rotation = None
    if sigmas is not None:
        sigma_position = torch.from_numpy(sigmas[0]).expand(frames, 3)
        sigma_rotation = torch.full((frames,), sigmas[1], dtype=torch.float64)
    poses.write_poses(
        path,
        poses.LinkPoses(
            frame_number=torch.from_numpy(drive.frame),
            t_ns=torch.from_numpy(started_ns + np.rint(drive.t * 1e9).astype(np.int64)),
            T_world_link=torch.from_numpy(T_world_link),
            sigma_position=sigma_position,
            sigma_rotation=sigma_rotation,
        ),
    )


def write_sign_rows(path: Path, rows: SignRows, drive: Drive, world: World) -> None:
    """`signs.parquet` of a journey."""
    write_sign_detections(
        path,
        drive.frame[rows.frame],
        rows.shape,
        rows.corners_px,
        rows.code,
        all_codes(world.signs.code),
        rows.score,
        rows.track,
    )


def write_lane_rows(path: Path, rows: LaneRows, drive: Drive) -> None:
    """`lanes.parquet` of a journey."""
    write_lane_detections(
        path, drive.frame[rows.frame], rows.px, rows.count, rows.type, TYPES, rows.score
    )


def write_truth(
    folder: Path,
    world: World,
    drive: Drive,
    T_world_link: Float[np.ndarray, "f 4 4"],
    started_ns: int,
    signs: SignRows,
    lanes: LaneRows,
) -> None:
    """What scorers may know of a journey: true poses, what each row shows, the road below."""
    folder.mkdir(parents=True, exist_ok=True)
    write_drive_poses(folder / "poses.parquet", drive, T_world_link, started_ns)
    write_parquet(
        folder / "signs.parquet",
        {
            "row": np.arange(len(signs)),
            "sign_id": name_column(signs.sign, world.signs.sign_id),
            "outlier": signs.is_outlier,
        },
    )
    write_parquet(
        folder / "lanes.parquet",
        {
            "row": np.arange(len(lanes)),
            "lane_id": name_column(lanes.marker, world.markers.lane_id),
            "merged": lanes.is_merged,
        },
    )
    normal = drive.road_normal_camera
    write_parquet(
        folder / "road.parquet",
        {
            "frame": drive.frame,
            **{f"n{axis}": normal[:, k] for k, axis in enumerate("xyz")},
            "height_m": drive.camera_height,
        },
    )


def write_vehicles(path: Path, fleet: Sequence[Vehicle]) -> None:
    """What is truly different about each vehicle."""
    content = {
        vehicle.vehicle_id: {"rig": vehicle.rig.rig_id, **plain(asdict(vehicle.errors))}
        for vehicle in fleet
    }
    write_json(path, content)


def write_survey(folder: Path, world: World, provenance: dict) -> None:
    """The exact map: every sign and marker of the world, whether anybody drove past it or not."""
    write_json(
        folder / "map.json",
        {
            "format": "crowdmap-map",
            "version": 1,
            "origin": asdict(world.origin),
            "shared_covariance": [0.0] * 9,
            "provenance": provenance,
        },
    )
    signs = world.signs
    count = _CORNERS[signs.shape]
    corners = signs.corners()[np.arange(8)[None] < count[:, None]]
    write_parquet(
        folder / "signs.parquet",
        {
            "sign_id": pa.array(signs.sign_id, pa.string()),
            "shape": name_column(signs.shape, polygon.SHAPES),
            "type": pa.array(signs.code, pa.string()),
            "corners": points_column(corners, count),
            "center": row_column(signs.center),
            "normal": row_column(signs.normal),
            "width_m": signs.size[:, 0],
            "height_m": signs.size[:, 1],
            "sigma_m": np.full(len(signs), 1e-3),
        },
    )
    markers = world.markers
    points = []
    for marker in range(len(markers)):
        # Every other point: half a metre apart; the last one closes the marker.
        thinned = markers.points_of(marker)
        keep = np.arange(len(thinned)) % 2 == 0
        keep[-1] = True
        thinned = thinned[keep]
        points.append(thinned[::-1] if markers.is_oncoming[marker] else thinned)
    write_parquet(
        folder / "lanes.parquet",
        {
            "lane_id": pa.array(markers.lane_id, pa.string()),
            "type": pa.array(markers.type, pa.string()),
            "points": points_column(
                np.concatenate(points) if points else np.zeros((0, 3)),
                np.array([len(p) for p in points], dtype=np.int64),
            ),
            "sigma_m": np.full(len(markers), 1e-3),
        },
    )
