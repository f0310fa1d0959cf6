"""The folder that a run writes: who may write there, and every output that FORMAT.md names."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

from crowdmap_torch import __version__
from crowdmap_torch.config import MapperConfig, dump
from crowdmap_torch.evaluation.evaluate import control_ids_of, evaluate_map, refuse_other_origin
from crowdmap_torch.evaluation.evidence import read_journey_landmarks
from crowdmap_torch.evaluation.map_figures import MapFigures
from crowdmap_torch.io.atomic import atomic_file, atomic_folder
from crowdmap_torch.io.documents import plain, write_json
from crowdmap_torch.io.landmarks import write_lanes, write_signs
from crowdmap_torch.io.maps import write_map
from crowdmap_torch.io.runs import write_associations, write_refined_poses, write_road_estimate
from crowdmap_torch.io.surveys import read_survey
from crowdmap_torch.io.truth import Truth, has_truth, read_associations, read_truth
from crowdmap_torch.mapper import MapResult
from crowdmap_torch.tables import Dataset, HdMap, Origin, Survey


class RunFolder:
    """RUN of FORMAT.md. What a finished run left there stays untouched until the new one is complete."""

    def __init__(self, path: Path, *, overwrite: bool = False, resume: bool = False) -> None:
        """ValueError if there is something already and neither `overwrite` nor `resume` is given."""
        if path.exists() and not path.is_dir():
            raise ValueError(f"{path}: is a file; --out names a folder")
        if path.exists() and any(path.iterdir()) and not (overwrite or resume):
            raise ValueError(
                f"{path}: exists already; give --overwrite to replace it or --resume to go on"
            )
        self.path = path
        self.resume = resume
        self.map = path / "map"
        self.report = path / "report.html"
        self.tensorboard = path / "tensorboard"
        self.checkpoint = path / "checkpoint.pt"

    def prepare(self) -> None:
        """Makes the folder; without `resume` the events and the checkpoint of an older run go."""
        self.path.mkdir(parents=True, exist_ok=True)
        if not self.resume:
            shutil.rmtree(self.tensorboard, ignore_errors=True)
            self.checkpoint.unlink(missing_ok=True)

    def write_result(self, dataset: Dataset, result: MapResult, config: MapperConfig) -> None:
        """The maps, what each journey made, the associations and the configuration."""
        provenance = {
            **result.hd_map.provenance,
            "version": __version__,
            "created_at": datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ"),
        }
        with atomic_folder(self.path / "journeys") as folder:
            self._write_journeys(folder, dataset, result)
        write_associations(
            self.path / "associations.parquet",
            dataset.journeys,
            [a.sign for a in result.associations],
            [a.lane for a in result.associations],
            sign_id=result.hd_map.sign_id,
            lane_id=result.hd_map.lane_id,
        )
        with atomic_file(self.path / "config.yaml") as beside:
            beside.write_text(dump(config), encoding="utf-8")
        for name, hd_map in (("map_clusters", result.map_clusters), ("map", result.hd_map)):
            write_map(
                replace(hd_map, provenance=provenance),
                self.path / name,
                min_confidence=config.min_confidence,
            )

    def write_metrics(self, metrics: Mapping[str, object]) -> None:
        """metrics.json."""
        write_json(self.path / "metrics.json", plain(metrics))

    def _write_journeys(self, folder: Path, dataset: Dataset, result: MapResult) -> None:
        for journey, made, poses in zip(
            dataset.journeys, result.journey_maps, result.poses, strict=True
        ):
            place = folder / journey.journey_id
            write_refined_poses(place / "poses.parquet", journey, poses)
            write_road_estimate(place / "road.parquet", journey.frame_number, made.road)
            signs = [f"{journey.journey_id}-s{i}" for i in made.signs.tracklet.tolist()]
            write_signs(place / "signs.parquet", made.signs, signs, dataset.type_names)
            lanes = [f"{journey.journey_id}-l{i}" for i in range(len(made.lanes))]
            write_lanes(place / "lanes.parquet", made.lanes, lanes)


def refuse_overlap(run: Path, dataset: Path) -> None:
    """ValueError if a run would write into the dataset that it reads, or around it, links followed."""
    out, source = run.resolve(), dataset.resolve()
    if out == source or out in source.parents or source in out.parents:
        raise ValueError(
            f"{run}: overlaps the dataset {dataset}, which a run never changes; name a folder beside it"
        )


def read_survey_of(dataset_folder: Path, origin: Origin) -> Survey | None:
    """The dataset's survey, or None if it has none; ValueError if it cannot be read or has another origin."""
    folder = dataset_folder / "survey"
    return read_survey_at(folder, origin) if folder.exists() else None


def read_survey_at(folder: Path, origin: Origin) -> Survey:
    """The survey in a folder; ValueError if it cannot be read or has another origin than `origin`."""
    survey = read_survey(folder)
    refuse_other_origin(origin, survey.origin)
    return survey


def read_truth_of(dataset_folder: Path, dataset: Dataset, survey: Survey | None) -> Truth | None:
    """What a simulation knows of the journeys in use, for the scores alone; ValueError if it cannot be read."""
    folder = dataset_folder / "survey"
    if survey is None or not has_truth(folder):
        return None
    return read_truth(folder, survey, dataset.journeys)


def figures_of(
    hd_map: HdMap,
    survey: Survey,
    truth: Truth | None,
    run: RunFolder | None,
    control: Survey | None = None,
) -> MapFigures:
    """METRICS.md's figures of a map; with a run's folder those of associations and single journeys too.

    Signs that were `control` points are left out.
    """
    known = () if control is None else control_ids_of(control, survey)
    if truth is None:
        note = "no truth with the survey: every surveyed sign is observable"
        return evaluate_map(hd_map, survey, control_ids=known, notes=(note,))
    if run is None:
        return evaluate_map(hd_map, survey, truth=truth, control_ids=known)
    ids = [t.journey.journey_id for t in truth.journeys]
    return evaluate_map(
        hd_map,
        survey,
        truth=truth,
        associations=read_associations(run.path / "associations.parquet", ids),
        landmarks=read_journey_landmarks(run.path, ids),
        control_ids=known,
    )
