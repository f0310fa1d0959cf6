"""Scenes from folders: a map, what a run knows more, or the drives of a data set."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch
from jaxtyping import Bool
from torch import Tensor

from crowdmap_torch.evaluation.evaluate import refuse_other_origin
from crowdmap_torch.evaluation.evidence import run_of
from crowdmap_torch.io.budget import reading
from crowdmap_torch.io.datasets import load_dataset
from crowdmap_torch.io.documents import Document, read_json
from crowdmap_torch.io.errors import InputError, one_line
from crowdmap_torch.io.found_calibration import folder_name
from crowdmap_torch.io.map_heads import read_map_head
from crowdmap_torch.io.maps import read_map
from crowdmap_torch.io.poses import LinkPoses, read_poses
from crowdmap_torch.io.rigs import read_camera, read_rig
from crowdmap_torch.io.sign_outcomes import read_sign_outcomes
from crowdmap_torch.io.surveys import read_survey, survey_files
from crowdmap_torch.tables import HdMap, Journey, Survey
from crowdmap_torch.viewer.scene import Drive, Scene, scene_of_dataset

_POSES, _OUTCOMES = "poses.parquet", "sign_detections.parquet"


def read_scene(path: Path, *, dataset: Path | None = None, survey: Path | None = None) -> Scene:
    """What the folder `path` shows: a map, a RUN (or its map), a survey, or a data set; InputError for anything else.

    A run's `dataset` adds the drives as they were given, and its survey; by default it is the one that the run
    remembers, if it is still there.
    """
    if (path / "dataset.json").exists():
        return _read_dataset(path, survey)
    run = _run(path)
    if run is not None:
        return _read_run(run, dataset, survey)
    if not path.is_dir() or not (path / "map.json").exists():
        raise InputError(
            f"{path}: is no map, run or data set; expected a folder with map.json, map/map.json or dataset.json"
        )
    try:
        hd_map = read_map(path)
    except InputError as error:
        return _only_surveyed(path, error)
    return Scene(
        kind="map",
        title=_name(path),
        subtitle=_subtitle(hd_map),
        origin=hd_map.origin,
        hd_map=hd_map,
        survey=None if survey is None else _survey(survey, hd_map),
    )


def _only_surveyed(path: Path, error: InputError) -> Scene:
    """A survey that is no map as it has signs of which the centre alone is known, or one of its files; else `error`."""
    survey = read_survey(path)
    bare, half = (
        int((~survey.signs.has_corners).sum()),
        None in survey_files(path, read_map_head(path)),
    )
    if not bare and not half:
        raise error
    told = f"a survey: of {bare} of its {len(survey.sign_id)} signs the centre alone is known"
    return Scene(
        kind="map",
        title=_name(path),
        origin=survey.origin,
        survey=survey,
        notes=(told,) if bare else (),
    )


def with_journeys(scene: Scene, path: Path, dataset: Path | None = None) -> Scene:
    """The scene of the folder `path` with what every camera detected, of a run from where the adjustment put it.

    A run's cameras are those that it found, its detections those of `dataset`, or of the one that it remembers. InputError
    where that cannot be read; where there is none a note says so.
    """
    run = _run(path)
    if run is None or scene.journeys or scene.kind != "run":
        return scene
    source = _remembered(run) if dataset is None else dataset
    if source is None:
        note = "cameras are left out: give --dataset, the data set of the run"
        return replace(scene, notes=(*scene.notes, note))
    given = load_dataset(source, journeys=[drive.journey_id for drive in scene.drives])
    adjusted = {journey.journey_id: _adjusted(run, journey) for journey in given.journeys}
    if missing := [d.journey_id for d in scene.drives if d.journey_id not in adjusted]:
        raise InputError(f"{source}: journey {missing[0]!r} of the run is set aside there")
    journeys = tuple(adjusted[drive.journey_id] for drive in scene.drives)
    return replace(scene, journeys=journeys, type_names=given.type_names)


def _adjusted(run: Path, journey: Journey) -> Journey:
    """A journey with the poses that a run found, through the camera that it found, if it asked for calibrations."""
    path, own = run / "journeys" / journey.journey_id / _POSES, run / "rigs"
    with reading(inside=run):
        poses = read_poses(path)
        folder = own / folder_name(journey.vehicle)
        rig = read_rig(folder) if folder.exists() else journey.rig
    kept = torch.isin(journey.frame_number, poses.frame_number).nonzero()[:, 0]
    if journey.frame_number[kept].tolist() != poses.frame_number.tolist():
        raise InputError(
            f"{path}: its frames are not those of journey {journey.journey_id!r}; "
            "expected the data set that the run was made of"
        )
    # A run of a part of the world has lost the frames outside it; rows of detections stay those of the file.
    _, row = torch.nonzero(kept[:, None] == journey.signs.frame, as_tuple=True)
    inside = journey.with_frames(kept)
    return replace(
        inside,
        rig=rig,
        T_world_camera=poses.T_world_link @ rig.T_link_camera,
        signs=replace(inside.signs, row=journey.signs.row[row]),
    )


def _run(path: Path) -> Path | None:
    """The run that a folder is, or whose map it is."""
    if (path / "map.json").exists():
        return run_of(path)
    return path if (path / "map" / "map.json").exists() else None


def _read_dataset(path: Path, survey: Path | None) -> Scene:
    dataset = load_dataset(path)
    folder = path / "survey" if survey is None else survey
    found = read_survey(folder) if folder.exists() or survey is not None else None
    if found is not None:
        refuse_other_origin(dataset.origin, found.origin)
    return scene_of_dataset(dataset, _name(path), found)


def _read_run(run: Path, dataset: Path | None, survey: Path | None) -> Scene:
    hd_map, notes = read_map(run / "map"), []
    scene = Scene(
        kind="run",
        title=_name(run),
        subtitle=_subtitle(hd_map),
        origin=hd_map.origin,
        hd_map=hd_map,
    )
    if (run / "map_clusters" / "map.json").exists():
        scene = replace(scene, map_before=read_map(run / "map_clusters"))
    if (run / _OUTCOMES).exists():
        scene = replace(scene, outcomes=read_sign_outcomes(run / _OUTCOMES, hd_map.sign_id))
    else:
        notes.append(
            f"detections are not shown: an older version made the run, without {_OUTCOMES}"
        )
    remembered = _remembered(run) if dataset is None else dataset
    try:
        given = {} if remembered is None else _given_drives(run, remembered)
        if survey is None and remembered is not None and (remembered / "survey").exists():
            scene = replace(scene, survey=_survey(remembered / "survey", hd_map))
    except InputError as error:
        # What is asked for has to be there; what is only remembered may have changed.
        if dataset is not None:
            raise
        given = {}
        notes.append(f"the data set is left out: {one_line(error)}")
    if remembered is None:
        notes.append("positions as given are not shown: give --dataset, the data set of the run")
    if survey is not None:
        scene = replace(scene, survey=_survey(survey, hd_map))
    drives = tuple(_drive(run, entry, given) for entry in _journeys(run))
    return replace(scene, drives=drives, notes=tuple(notes))


def _journeys(run: Path) -> list[Document]:
    """What metrics.json says of every journey; nothing without it."""
    path = run / "metrics.json"
    return read_json(path).parts("journeys") if path.exists() else []


def _drive(run: Path, entry: Document, given: dict[str, Drive]) -> Drive:
    journey_id = entry.name("journey_id")
    path = run / "journeys" / journey_id / _POSES
    with reading(inside=run):
        poses = read_poses(path)
    before = given.get(journey_id)
    bias = _three(entry.content.get("bias_m"))
    covariance = entry.content.get("bias_covariance")
    sigma = None
    if isinstance(covariance, list) and len(covariance) == 9:
        diagonal = _three(covariance[::4])
        sigma = None if diagonal is None else [max(x, 0.0) ** 0.5 for x in diagonal]
    return Drive(
        journey_id=journey_id,
        frame_number=poses.frame_number,
        t_ns=poses.t_ns,
        path_world=_places(poses),
        given_world=None if before is None else before.path_world[_inside(before, poses)],
        vehicle="" if before is None else before.vehicle,
        image=None if before is None else before.image,
        bias=bias,
        bias_sigma=sigma,
        remark=_remark(run, journey_id),
    )


def _inside(drive: Drive, poses: LinkPoses) -> Bool[Tensor, " f"]:
    """Which frames of a drive are in the part of the world that the run is of."""
    return torch.isin(drive.frame_number, poses.frame_number)


def _three(values: object) -> list[float] | None:
    """Three numbers, or None for whatever else a file has there."""
    if not isinstance(values, list) or len(values) != 3:
        return None
    return [float(x) for x in values] if all(isinstance(x, int | float) for x in values) else None


def _remark(run: Path, journey_id: str) -> str:
    """Why a journey has no say, if it has none."""
    for entry in read_json(run / "metrics.json").parts("suspect_journeys"):
        if entry.content.get("journey_id") == journey_id:
            return str(entry.content.get("reason", ""))
    return ""


def _given_drives(run: Path, dataset: Path) -> dict[str, Drive]:
    """The drives of a run as its data set has them; InputError where one cannot be read."""
    if not (dataset / "dataset.json").exists():
        raise InputError(f"{dataset}: the data set is missing; expected dataset.json in it")
    found = {}
    names = [entry.name("journey_id") for entry in _journeys(run)]
    with reading(inside=dataset):
        for journey_id in names:
            folder = dataset / "journeys" / journey_id
            head = read_json(folder / "journey.json")
            rig = head.name("rig")
            camera = read_camera(dataset / "rigs" / rig)
            poses = read_poses(folder / _POSES)
            vehicle = head.content.get("vehicle_id")
            found[journey_id] = Drive(
                journey_id=journey_id,
                frame_number=poses.frame_number,
                t_ns=poses.t_ns,
                path_world=_places(poses),
                vehicle=str(vehicle or rig),
                image=(camera.width, camera.height),
            )
    return found


def _places(poses: LinkPoses):
    return poses.T_world_link[:, :3, 3]


def _remembered(run: Path) -> Path | None:
    """The data set that a run says it was made of, if one is there."""
    path = run / "run.json"
    if not path.exists():
        return None
    name = read_json(path).content.get("dataset")
    if not isinstance(name, str) or "\0" in name or not (run / name / "dataset.json").exists():
        return None
    return run / name


def _survey(folder: Path, hd_map: HdMap) -> Survey:
    survey = read_survey(folder)
    refuse_other_origin(hd_map.origin, survey.origin)
    return survey


def _subtitle(hd_map: HdMap) -> str:
    said = (hd_map.provenance.get(key) for key in ("created_at", "version"))
    created, version = (value if isinstance(value, str) else "" for value in said)
    return ", ".join(text for text in (created, f"version {version}" if version else "") if text)


def _name(path: Path) -> str:
    resolved = path.resolve()
    if resolved.name in ("map", "map_clusters", "survey"):
        return f"{resolved.parent.name}/{resolved.name}"
    return resolved.name
