"""What there is to judge a map by, gathered from the folders of a run and of a dataset."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch

from crowdmap_torch.evaluation.single_journey import JourneyLandmarks
from crowdmap_torch.io.area import area_of, cut_truth
from crowdmap_torch.io.datasets import load_journey, read_origin
from crowdmap_torch.io.documents import read_json
from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.landmarks import read_lanes, read_signs
from crowdmap_torch.io.map_heads import read_map_head
from crowdmap_torch.io.maps import read_map
from crowdmap_torch.io.truth import (
    SignAssociations,
    Truth,
    has_truth,
    read_associations,
    read_truth,
)
from crowdmap_torch.tables import HdMap, Journey, Survey


@dataclass(frozen=True)
class Evidence:
    """What `evaluate.evaluate_map` takes beside a map and a survey; None or empty where unknown."""

    truth: Truth | None = None
    associations: SignAssociations | None = None
    landmarks: tuple[JourneyLandmarks, ...] = ()
    notes: tuple[str, ...] = ()
    """What is missing, and what follows from it."""


def gather_evidence(
    hd_map: HdMap,
    survey: Survey,
    survey_folder: Path,
    *,
    dataset_folder: Path | None = None,
    run_folder: Path | None = None,
) -> Evidence:
    """The truth of the journeys in use, and what a run says of its detections and journeys.

    `dataset_folder` is that of the survey by default. Journeys in use are those that the map's
    provenance lists, or all. InputError if what is there cannot be read.
    """
    if not has_truth(survey_folder):
        return Evidence(notes=("no truth with the survey: every surveyed sign is observable",))
    dataset_folder = survey_folder.parent if dataset_folder is None else dataset_folder
    if not (dataset_folder / "journeys").is_dir():
        note = f"{dataset_folder} has no journeys: every surveyed sign is observable, no oracle"
        return Evidence(notes=(note,))
    journeys, notes = _load_journeys(hd_map, survey_folder, dataset_folder)
    truth = read_truth(survey_folder, survey, journeys)
    area = area_of(hd_map.provenance)
    if area is not None:
        truth = cut_truth(truth, area)
        journeys = tuple(one.journey for one in truth.journeys)
    if run_folder is None:
        notes = (*notes, "not the map of a run: nothing on associations")
        return Evidence(truth=truth, notes=notes)
    ids = [j.journey_id for j in journeys]
    associations = None
    if (run_folder / "associations.parquet").exists():
        associations = read_associations(run_folder / "associations.parquet", ids)
    else:
        notes = (*notes, f"{run_folder} has no associations.parquet: nothing on associations")
    return Evidence(
        truth=truth,
        associations=associations,
        landmarks=read_journey_landmarks(run_folder, ids),
        notes=notes,
    )


def run_of(map_folder: Path) -> Path | None:
    """The run that a map folder is part of, if it is the final map of one."""
    run = map_folder.resolve().parent
    is_run = map_folder.resolve().name == "map" and (run / "metrics.json").exists()
    return run if is_run else None


def read_journey_landmarks(run_folder: Path, ids: list[str]) -> tuple[JourneyLandmarks, ...]:
    """What single journeys made of the world, of those named that the run has."""
    found = []
    for name in ids:
        folder = run_folder / "journeys" / name
        if (folder / "signs.parquet").exists() and (folder / "lanes.parquet").exists():
            signs, _, _ = read_signs(folder / "signs.parquet")
            lanes, _ = read_lanes(folder / "lanes.parquet")
            found.append(JourneyLandmarks(name, signs, lanes))
    return tuple(found)


def read_map_or_journey(folder: Path) -> HdMap:
    """A map, or RUN/journeys/ID as a map: it has no map.json, its origin is that of RUN/map."""
    if (folder / "map.json").exists() or folder.parent.name != "journeys":
        return read_map(folder)
    signs, sign_id, type_names = read_signs(folder / "signs.parquet")
    lanes, lane_id = read_lanes(folder / "lanes.parquet")
    return HdMap(
        origin=read_origin(read_map_head(folder.parent.parent / "map")),
        signs=signs,
        lanes=lanes,
        sign_id=sign_id,
        lane_id=lane_id,
        type_names=type_names,
        shared_covariance=torch.zeros(3, 3, dtype=torch.float64),
        provenance={"journeys": [folder.name]},
    )


def read_observable_ids(path: Path) -> tuple[str, ...]:
    """Sign ids of a JSON file: `{"observable": [...]}` or lists of ids by name."""
    content = read_json(path).content
    lists = [v for v in content.values() if isinstance(v, list)]
    ids = tuple(i for one in lists for i in one)
    if not ids or not all(isinstance(i, str) for i in ids):
        raise InputError(f"{path}: expected an object with lists of sign ids")
    return ids


def named_in(survey: Survey, ids: tuple[str, ...]) -> tuple[str, ...]:
    """Those ids that the survey has."""
    known = set(survey.sign_id)
    return tuple(i for i in ids if i in known)


def _load_journeys(
    hd_map: HdMap, survey_folder: Path, dataset_folder: Path
) -> tuple[tuple[Journey, ...], tuple[str, ...]]:
    """The journeys in use, and a note for each that was not listed and cannot be read."""
    there = sorted(p.name for p in (survey_folder / "truth").iterdir() if p.is_dir())
    listed = hd_map.provenance.get("journeys")
    names = listed if isinstance(listed, list) else []
    is_list = isinstance(listed, list) and all(isinstance(name, str) for name in names)
    wanted = set(names) if is_list else set(there)
    missing = sorted(wanted - set(there))
    if missing:
        raise InputError(
            f"{survey_folder}: no truth of journey {missing[0]!r}, which the map was made from. "
            "Is it the survey of another dataset?"
        )
    journeys: list[Journey] = []
    notes: list[str] = []
    for name in (n for n in there if n in wanted):
        try:
            journeys.append(load_journey(dataset_folder / "journeys" / name)[0])
        except InputError as error:
            if is_list:
                raise
            notes.append(f"journey {name!r} is left out: {error}")
    return tuple(journeys), tuple(notes)
