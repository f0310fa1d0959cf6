"""Everything in a dataset that breaks FORMAT.md: all files of all journeys, by the readers that the mapper uses."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch
from jaxtyping import Int

from crowdmap_torch.geometry.camera import Camera
from crowdmap_torch.io.budget import reading, refuse_way_out
from crowdmap_torch.io.columns import Sheet
from crowdmap_torch.io.datasets import (
    DATASET_FORMAT,
    JOURNEY_FORMAT,
    journey_folders,
    read_journey_id,
    read_origin,
    refuse_no_journey,
)
from crowdmap_torch.io.detections import read_lane_detections, read_sign_detections
from crowdmap_torch.io.documents import Document, read_json
from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.faults import Fault, attempted, gathered, gathering
from crowdmap_torch.io.map_heads import read_map_head
from crowdmap_torch.io.poses import read_poses
from crowdmap_torch.io.rigs import MAX_SIDE_PX, faults_of_rig, missing_rig
from crowdmap_torch.io.surveys import read_surveyed_lanes, read_surveyed_signs, survey_files
from crowdmap_torch.io.tiled_sheets import path_of
from crowdmap_torch.tables import Origin


def inspect_dataset(folder: Path) -> tuple[Fault, ...]:
    """All faults of the files of a dataset, in the order of files; InputError if there is no such folder.

    Of a Parquet file every wrong row is named, of dataset.json, journey.json, rig.yaml and a survey's map.json every wrong
    key. Rows that the mapper leaves out are among them (`Fault.drops`).
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: the dataset's folder is missing; expected dataset.json in it")
    with reading(inside=folder), gathering() as faults:
        _head(folder / "dataset.json")
        cameras: dict[str, Camera | None] = {}
        journeys: list[Path] = []
        with attempted(folder / "journeys"):
            journeys = journey_folders(folder)
        for journey in journeys:
            _journey(journey, folder / "rigs", cameras)
        _of_survey(folder)
        return tuple(faults)


def _head(path: Path) -> None:
    with attempted(path):
        head = read_json(path)
        head.require_format(DATASET_FORMAT)
        read_origin(head)


def _journey(folder: Path, rigs: Path, cameras: dict[str, Camera | None]) -> None:
    with attempted(folder):
        refuse_no_journey(folder)
        camera = _camera_of(folder / "journey.json", rigs, cameras)
        frames = _frames_of(folder / "poses.parquet")
        _detections(folder / "signs.parquet", read_sign_detections, camera, frames)
        _detections(folder / "lanes.parquet", read_lane_detections, camera, frames)


def _camera_of(path: Path, rigs: Path, cameras: dict[str, Camera | None]) -> Camera | None:
    """The camera of a journey, if it is known; each rig is looked at once."""
    with attempted(path):
        head = read_json(path)
        head.require_format(JOURNEY_FORMAT)
        read_journey_id(head)
        name = head.name("rig")
        if not head.is_known("rig"):
            return None
        rig = rigs / name
        if rig.name not in cameras:
            cameras[rig.name] = None
            with attempted(rig):
                refuse_way_out(rig)
                if not rig.is_dir():
                    raise missing_rig(rig)
                cameras[rig.name] = faults_of_rig(rig)
        return cameras[rig.name]
    return None


def _frames_of(path: Path) -> Int[np.ndarray, " f"] | None:
    """The frame numbers of a journey, those of poses that are wrong otherwise included; None if nothing is known."""
    with attempted(path):
        return read_poses(path).frame_number.numpy()
    try:
        with pq.ParquetFile(path) as file:
            frame = file.read(columns=["frame"]).column("frame")
        return np.unique(np.asarray(frame.drop_null().to_numpy(), dtype=np.int64))
    except (pa.ArrowException, OSError, ValueError, TypeError, KeyError, OverflowError):
        return None


def _detections(
    path: Path,
    read: Callable[[Path, Camera, Int[np.ndarray, " f"]], object],
    camera: Camera | None,
    frames: Int[np.ndarray, " f"] | None,
) -> None:
    faults = gathered()
    before = len(faults or ())
    with attempted(path):
        if frames is None or not len(frames):
            frames = _own_frames(path)
        if len(frames):
            read(path, camera or _ANY, frames)
    if camera is None and faults is not None:
        # Whether outlines lie in the image is not known.
        faults[before:] = [fault for fault in faults[before:] if not fault.drops]


def _own_frames(path: Path) -> Int[np.ndarray, " f"]:
    """The frames that a file of detections names, where nobody else knows any."""
    sheet = Sheet(path, ("frame",))
    return np.unique(sheet.integers("frame")) if len(sheet) else np.zeros(1, dtype=np.int64)


def _any_camera() -> Camera:
    K = torch.tensor([[1e4, 0, MAX_SIDE_PX / 2], [0, 1e4, MAX_SIDE_PX / 2], [0, 0, 1]])
    return Camera("brown_conrady", MAX_SIDE_PX, MAX_SIDE_PX, K.double(), torch.zeros(0).double())


_ANY = _any_camera()
"""Stands for a camera that is not known."""


def _of_survey(folder: Path) -> None:
    survey = folder / "survey"
    if not survey.exists():
        return
    head, told = Document(survey / "map.json", {}), len(gathered() or ())
    with attempted(head.path):
        head = read_map_head(survey)
        _survey_head(head, folder / "dataset.json")
    if len(gathered() or ()) > told and (survey / "tiles").is_dir():
        # Without index and origin nobody knows what belongs in which tile.
        return
    with attempted(survey):
        signs, lanes = survey_files(survey, head)
        if signs is not None:
            with attempted(path_of(signs)):
                read_surveyed_signs(signs)
        if lanes is not None:
            with attempted(path_of(lanes)):
                read_surveyed_lanes(lanes)


def _survey_head(head: Document, dataset: Path) -> None:
    told = len(gathered() or ())
    found, expected = read_origin(head), _origin_of(dataset)
    if len(gathered() or ()) == told and expected is not None and not expected.is_same(found):
        rule = f"origin: {found}; expected that of dataset.json, {expected}"
        raise InputError(f"{head.path}: {rule}", "value")


def _origin_of(dataset: Path) -> Origin | None:
    """The origin in dataset.json; None where it is wrong, which has been told."""
    with gathering() as wrong, attempted(dataset):
        origin = read_origin(read_json(dataset))
        return None if wrong else origin
    return None
