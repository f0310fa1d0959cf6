"""What a run writes beside its map: refined poses, the road, associations (FORMAT.md)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.geometry import se3
from crowdmap_torch.io.datasets import row_count
from crowdmap_torch.io.poses import LinkPoses, write_poses
from crowdmap_torch.io.writing import name_column, write_parquet
from crowdmap_torch.tables import Journey, RoadEstimate


def write_refined_poses(
    path: Path,
    journey: Journey,
    T_world_camera: Float[Tensor, "f 4 4"],
    *,
    sigma_position: Float[Tensor, "f 3"] | None = None,
    sigma_rotation: Float[Tensor, " f"] | None = None,
) -> None:
    """Writes refined camera poses as those of the link that the journey's poses.parquet is about.

    Sigmas that are not given are the journey's own, so that the columns are the input's.
    """
    T_camera_link = se3.inverse(journey.rig.T_link_camera).to(T_world_camera)
    poses = LinkPoses(
        frame_number=journey.frame_number,
        t_ns=journey.t_ns,
        T_world_link=T_world_camera @ T_camera_link,
        sigma_position=journey.sigma_position if sigma_position is None else sigma_position,
        sigma_rotation=journey.sigma_rotation if sigma_rotation is None else sigma_rotation,
    )
    write_poses(path, poses)


def write_road_estimate(path: Path, frame_number: Int[Tensor, " f"], road: RoadEstimate) -> None:
    """Writes the road under the car in every frame: normal (camera), height [m], sigma [rad]."""
    normal, height, sigma = (
        column.detach().cpu().to(torch.float64).numpy()
        for column in (road.normal_camera, road.height, road.sigma)
    )
    axes = {f"n{axis}": normal[:, k] for k, axis in enumerate("xyz")}
    frame = frame_number.cpu().numpy()
    write_parquet(path, {"frame": frame, **axes, "height_m": height, "sigma": sigma})


def write_associations(
    path: Path,
    journeys: Sequence[Journey],
    sign_landmarks: Sequence[Int[Tensor, " _"]],
    lane_landmarks: Sequence[Int[Tensor, " _"]],
    *,
    sign_id: Sequence[str],
    lane_id: Sequence[str],
) -> None:
    """Writes the landmark of every row of every journey's files, dropped rows included.

    For each journey, `sign_landmarks` and `lane_landmarks` hold for each detection of its tables
    the place of its landmark in `sign_id` and `lane_id`, -1 for none.
    """
    parts = [
        part
        for journey, signs, lanes in zip(journeys, sign_landmarks, lane_landmarks, strict=True)
        for part in (
            _associations(journey, "sign", journey.signs.row, signs, sign_id),
            _associations(journey, "lane", journey.lanes.row, lanes, lane_id),
        )
    ]
    table = pa.concat_tables(parts) if parts else _NO_ASSOCIATIONS
    write_parquet(path, dict(zip(table.column_names, table.columns, strict=True)))


_NO_ASSOCIATIONS = pa.table(
    {
        "journey_id": pa.array([], pa.string()),
        "kind": pa.array([], pa.string()),
        "row": pa.array([], pa.int64()),
        "landmark_id": pa.array([], pa.string()),
    }
)


def _associations(
    journey: Journey,
    kind: str,
    row: Int[Tensor, " d"],
    landmark: Int[Tensor, " d"],
    ids: Sequence[str],
) -> pa.Table:
    if len(landmark) != len(row):
        raise ValueError(
            f"journey {journey.journey_id!r}: {len(landmark)} {kind} landmarks for {len(row)} "
            "detections; expected one for each"
        )
    rows = row_count(journey, kind)
    code = np.full(rows, -1)
    code[row.cpu().numpy()] = landmark.cpu().numpy()
    return pa.table(
        {
            "journey_id": pa.repeat(pa.scalar(journey.journey_id, pa.string()), rows),
            "kind": pa.repeat(pa.scalar(kind, pa.string()), rows),
            "row": pa.array(np.arange(rows), pa.int64()),
            "landmark_id": name_column(code, ids),
        },
        schema=_NO_ASSOCIATIONS.schema,
    )
