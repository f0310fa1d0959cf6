"""A data set of FORMAT.md, put together from what several sources give: poses, a rig, detections of signs and lanes."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Int

from crowdmap_torch.geometry.camera import Camera
from crowdmap_torch.io.atomic import atomic_folder, scratch_folder
from crowdmap_torch.io.datasets import DATASET_FORMAT, JOURNEY_FORMAT, load_dataset, read_origin
from crowdmap_torch.io.detections import write_lane_detections, write_sign_detections
from crowdmap_torch.io.documents import Document, plain, read_json, write_json
from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.formats.composing.frames import Frames, find_frames
from crowdmap_torch.io.formats.composing.parts import (
    Asked,
    LaneRows,
    Parts,
    SignRows,
    SurveyRows,
    Track,
)
from crowdmap_torch.io.formats.composing.rig import (
    GivenRig,
    camera_or_link_poses,
    described_rig,
    read_given_rig,
)
from crowdmap_torch.io.formats.composing.survey import write_survey
from crowdmap_torch.io.poses import LinkPoses, write_poses
from crowdmap_torch.processes.interrupts import held
from crowdmap_torch.tables import LANE_TYPES, Dataset, Origin, Survey

T = TypeVar("T")


@dataclass(frozen=True)
class Drive:
    """A journey that can be written."""

    journey_id: str
    vehicle_id: str | None
    origin: Origin
    rig: GivenRig
    frames: Frames
    signs: tuple[SignRows, ...]
    lanes: tuple[LaneRows, ...]
    survey: SurveyRows | None
    notes: tuple[str, ...]
    """What was left out on the way, a line each."""


def compose(
    parts: Sequence[Parts],
    asked: Asked,
    *,
    rig: Path | None = None,
    journey_id: str | None = None,
    vehicle_id: str | None = None,
) -> Drive:
    """One journey from the parts of all sources; InputError if a part is missing, there twice, or contradicts another."""
    track = _only("poses", [(p.track, p.track.source) for p in parts if p.track is not None])
    _refuse_unsaid(parts, asked, track)
    rigs = [(described_rig(p.rig, asked), Path(p.rig.rig_id)) for p in parts if p.rig is not None]
    if rig is not None:
        rigs.append((read_given_rig(rig), rig))
    own_rig = _only("rig", rigs)
    signs = tuple(p.signs for p in parts if p.signs is not None)
    lanes = tuple(p.lanes for p in parts if p.lanes is not None)
    for rows in (*signs, *lanes):
        _refuse_other_size(rows, own_rig.camera)
    moved = replace(track, T_world_link=camera_or_link_poses(track, own_rig, asked))
    frames = find_frames(
        moved,
        [name for rows in (*signs, *lanes) for name in rows.images],
        key=asked.images,
        first_frame=asked.first_frame,
        time_offset_s=asked.time_offset_s,
    )
    return Drive(
        journey_id=_plain_name(journey_id or track.source.stem),
        vehicle_id=vehicle_id,
        origin=_origin(parts, asked, track),
        rig=own_rig,
        frames=frames,
        signs=signs,
        lanes=lanes,
        survey=the_survey(parts),
        notes=tuple(note for p in parts for note in p.notes) + frames.notes,
    )


def the_survey(parts: Sequence[Parts]) -> SurveyRows | None:
    """The survey of all sources, if one has it."""
    found = [(p.survey, p.survey.source) for p in parts if p.survey is not None]
    return _only("survey", found) if found else None


def write_survey_alone(out: Path, parts: Sequence[Parts], *, overwrite: bool = False) -> Survey:
    """Writes the survey of sources that give nothing else, complete or not there."""
    rows = the_survey(parts)
    origins = [p.origin for p in parts if p.origin is not None]
    assert rows is not None and origins
    _refuse_existing(out, "map.json", overwrite)
    with atomic_folder(out) as folder:
        return write_survey(folder, rows, origins[0])


def write_new(out: Path, drive: Drive, *, overwrite: bool = False) -> Dataset:
    """Writes a data set with one journey, complete or not there; it is what its own reader reads of it."""
    _refuse_existing(out, "dataset.json", overwrite)
    with atomic_folder(out) as folder:
        return _write(folder, drive, out)


def add_to(out: Path, drive: Drive) -> Dataset:
    """Writes one more journey into a data set with the same origin, complete or not there; returns that journey alone."""
    origin = existing_origin(out)
    if not origin.is_same(drive.origin):
        raise InputError(f"{out / 'dataset.json'}: its origin is {origin}, not {drive.origin}")
    journey, rig = (
        out / name / own
        for name, own in (("journeys", drive.journey_id), ("rigs", drive.rig.rig_id))
    )
    if drive.survey is not None and os.path.lexists(out / "survey"):
        raise InputError(
            f"{out / 'survey'} exists already; a data set has one survey: take the other source's poses "
            "alone, or begin a data set of its own"
        )
    if os.path.lexists(journey):
        raise InputError(f"{journey} exists already; give the journey another name by --journey")
    with scratch_folder(out / "added") as folder:
        dataset = _write(folder, drive, out)
        new_rig = folder / "rigs" / drive.rig.rig_id
        is_known = os.path.lexists(rig)
        if is_known and _content(rig) != _content(new_rig):
            raise InputError(
                f"{rig}: a rig of this name is another one; put rig.yaml into a folder with another name "
                "and give that by --rig"
            )
        with held():
            if not is_known:
                rig.parent.mkdir(exist_ok=True)
                new_rig.rename(rig)
            if drive.survey is not None:
                (folder / "survey").rename(out / "survey")
            (folder / "journeys" / drive.journey_id).rename(journey)
    return dataset


def _refuse_existing(out: Path, head: str, overwrite: bool) -> None:
    """InputError unless there is nothing yet, or what has this head and may be replaced."""
    if not os.path.lexists(out):
        return
    what = head.removesuffix(".json")
    if not overwrite:
        raise InputError(f"{out} exists already; choose another folder, --add or --overwrite")
    if not out.is_dir() or (any(out.iterdir()) and not (out / head).exists()):
        raise InputError(f"{out} is no {what} (it has no {head}); it is left alone")


def existing_origin(out: Path) -> Origin:
    """The origin of a data set that is there."""
    head = read_json(out / "dataset.json")
    head.require_format(DATASET_FORMAT)
    return read_origin(head)


def _write(folder: Path, drive: Drive, out: Path) -> Dataset:
    """Writes into an empty folder, and reads it back; complaints name `out`."""
    head = {"format": DATASET_FORMAT, "version": 1, "origin": plain(drive.origin)}
    write_json(folder / "dataset.json", head)
    drive.rig.write(folder / "rigs" / drive.rig.rig_id)
    journey = folder / "journeys" / drive.journey_id
    journey.mkdir(parents=True)
    head = {"format": JOURNEY_FORMAT, "version": 1, "journey_id": drive.journey_id}
    head["rig"] = drive.rig.rig_id
    if drive.vehicle_id is not None:
        head["vehicle_id"] = drive.vehicle_id
    write_json(journey / "journey.json", head)
    _write_track(journey / "poses.parquet", drive.frames.track)
    _write_signs(journey / "signs.parquet", drive.signs, drive.frames.of_image)
    _write_lanes(journey / "lanes.parquet", drive.lanes, drive.frames.of_image)
    if drive.survey is not None:
        write_survey(folder / "survey", drive.survey, drive.origin)
    try:
        return load_dataset(folder, strict=True)
    except InputError as error:
        text = str(error).replace(str(folder), str(out))
        raise InputError(f"what the sources hold breaks FORMAT.md: {text}") from error


def _write_track(path: Path, track: Track) -> None:
    assert track.frame_number is not None
    sigmas = (track.sigma_position, track.sigma_rotation)
    position, rotation = (None if s is None else torch.from_numpy(s) for s in sigmas)
    poses = LinkPoses(
        frame_number=torch.from_numpy(track.frame_number),
        t_ns=torch.from_numpy(track.t_ns),
        T_world_link=torch.from_numpy(track.T_world_link),
        sigma_position=position,
        sigma_rotation=rotation,
    )
    write_poses(path, poses)


def _write_signs(path: Path, tables: Sequence[SignRows], of_image: dict[str, int]) -> None:
    kept = [(rows, *_frames_of(rows, of_image)) for rows in tables]
    codes = [rows.code[k] for rows, is_kept, _ in kept for k in np.flatnonzero(is_kept)]
    names = sorted({code for code in codes if code is not None})
    place: dict[str | None, int] = {None: -1, **{name: k for k, name in enumerate(names)}}
    empty = np.zeros((0, 8, 2))
    write_sign_detections(
        path,
        _joined([frame for _, _, frame in kept]),
        _joined([rows.shape[is_kept] for rows, is_kept, _ in kept]),
        np.concatenate([empty, *(rows.corners_px[is_kept] for rows, is_kept, _ in kept)]),
        np.array([place[code] for code in codes], dtype=np.int64),
        names,
        np.concatenate([empty[:, 0, 0], *(rows.score[is_kept] for rows, is_kept, _ in kept)]),
        _joined([rows.track[is_kept] for rows, is_kept, _ in kept]),
    )


def _write_lanes(path: Path, tables: Sequence[LaneRows], of_image: dict[str, int]) -> None:
    kept = [(rows, *_frames_of(rows, of_image)) for rows in tables]
    empty = np.zeros((0, 2))
    points = [rows.px[np.repeat(is_kept, rows.count)] for rows, is_kept, _ in kept]
    write_lane_detections(
        path,
        _joined([frame for _, _, frame in kept]),
        np.concatenate([empty, *points]),
        _joined([rows.count[is_kept] for rows, is_kept, _ in kept]),
        _joined([rows.type[is_kept] for rows, is_kept, _ in kept]),
        LANE_TYPES,
        np.concatenate([empty[:, 0], *(rows.score[is_kept] for rows, is_kept, _ in kept)]),
    )


def _joined(columns: Sequence[Int[np.ndarray, " n"]]) -> Int[np.ndarray, " m"]:
    return np.concatenate([np.zeros(0, dtype=np.int64), *columns])


def _frames_of(
    rows: SignRows | LaneRows, of_image: dict[str, int]
) -> tuple[np.ndarray, Int[np.ndarray, " n"]]:
    """Which rows have a frame, and the numbers of those."""
    number = np.array([of_image.get(name, -1) for name in rows.images], dtype=np.int64)
    known = np.array([name in of_image for name in rows.images], dtype=bool)
    is_kept = known[rows.image]
    return is_kept, number[rows.image[is_kept]]


def _only(what: str, found: Sequence[tuple[T, object]]) -> T:
    if not found:
        how = "--rig FOLDER with rig.yaml" if what == "rig" else "--from FORMAT FILE with poses"
        raise InputError(f"no source gives the {what}; expected one: {how}")
    if len(found) > 1:
        raise InputError(f"{found[0][1]} and {found[1][1]} both give the {what}; expected one")
    return found[0][0]


def _refuse_unsaid(parts: Sequence[Parts], asked: Asked, track: Track) -> None:
    """InputError that names all options at once, if several are missing."""
    has_images = any(p.signs is not None or p.lanes is not None for p in parts)
    is_placed = asked.origin is not None or any(p.origin is not None for p in parts)
    missing = [
        text
        for is_missing, text in (
            (track.world is None and asked.world is None, "--world (the axes of their world)"),
            (track.link is None and asked.link is None, "--axes (the axes of what moves)"),
            (has_images and asked.images is None, "--images (which frame an image is)"),
            (not is_placed, "--origin LAT LON HEIGHT (where their world is on the earth)"),
        )
        if is_missing
    ]
    if len(missing) > 1:
        raise InputError(
            f"{track.source}: some things about poses are not in the files, and nothing is guessed; give "
            f"{', '.join(missing)}: see crowdmap convert --help"
        )


def _origin(parts: Sequence[Parts], asked: Asked, track: Track) -> Origin:
    origins = [p.origin for p in parts if p.origin is not None]
    if asked.origin is not None:
        origins.insert(0, asked.origin)
    if not origins:
        raise InputError(
            f"{track.source}: where on the earth its world's origin is does not stand there; give "
            "--origin LAT LON HEIGHT (degrees, metres; any will do where nobody needs it)"
        )
    for other in origins[1:]:
        if not origins[0].is_same(other):
            raise InputError(f"two origins, {origins[0]} and {other}; expected one")
    return origins[0]


def _refuse_other_size(rows: SignRows | LaneRows, camera: Camera) -> None:
    if rows.size_px not in (None, (camera.width, camera.height)):
        raise InputError(
            f"{rows.source}: its images have {rows.size_px[0]} x {rows.size_px[1]} px, the rig's camera "
            f"has {camera.width} x {camera.height}; expected the calibration of these images"
        )


def _plain_name(name: str) -> str:
    return Document(Path("--journey"), {"name": name}).name("name")


def _content(folder: Path) -> dict[str, bytes]:
    files = (path for path in sorted(folder.rglob("*")) if path.is_file())
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}
