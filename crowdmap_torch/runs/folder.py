"""The folder that a run writes: who may write there, and every output that FORMAT.md names."""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import torch
from torch import Tensor

from crowdmap_torch import __version__
from crowdmap_torch.config import MapperConfig, dump
from crowdmap_torch.evaluation.evaluate import Against, evaluate_map, refuse_other_origin
from crowdmap_torch.evaluation.evidence import read_journey_landmarks
from crowdmap_torch.evaluation.map_figures import MapFigures
from crowdmap_torch.io.atomic import atomic_file, atomic_folder, drop_halves
from crowdmap_torch.io.documents import plain, read_json, write_json
from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.landmarks import write_lanes, write_signs
from crowdmap_torch.io.maps import write_map
from crowdmap_torch.io.remote import Place
from crowdmap_torch.io.runs import write_associations, write_refined_poses, write_road_estimate
from crowdmap_torch.io.sign_outcomes import NamedOutcomes, write_sign_outcomes
from crowdmap_torch.io.surveys import read_survey
from crowdmap_torch.io.truth import Truth, has_truth, read_associations, read_truth
from crowdmap_torch.mapper import JourneyMap, MapResult
from crowdmap_torch.processes.interrupts import held
from crowdmap_torch.processes.threads import in_order
from crowdmap_torch.runs.calibration import write_found
from crowdmap_torch.runs.lock import locked
from crowdmap_torch.tables import Dataset, HdMap, Journey, Origin, Survey

_MAKES = (
    *("map", "map_clusters", "journeys", "associations.parquet", "config.yaml"),
    "sign_detections.parquet",
    *("tensorboard", "metrics.json", "report.html", "calibration.json", "rigs"),
)
"""What a result consists of."""
_MAP_FILES = ("map.json", "signs.parquet", "tentative_signs.parquet", "lanes.parquet")
_MADE = (
    *_MAKES,
    *(f"{name}/{file}" for name in ("map", "map_clusters") for file in _MAP_FILES),
    *(f"map/tiles/*/{file}" for file in _MAP_FILES[1:]),
    *(f"journeys/*/{name}.parquet" for name in ("poses", "signs", "lanes", "road")),
    "tensorboard/events.out.tfevents.*",
    *("rigs/*/rig.yaml", "rigs/*/rig.urdf"),
)
"""Every file of a result; what else is in its folders is somebody else's."""
_NO_PLACE = {
    *(errno.ENOENT, errno.ENOTDIR, errno.EEXIST, errno.ELOOP, errno.ENAMETOOLONG, errno.EINVAL)
}
"""Errors of a path that can be no folder, whatever the disk."""
_LOCK = "run.lock"
_FORMAT = "crowdmap-run"


class RunFolder:
    """RUN of FORMAT.md. A new result is made in `unfinished` and then takes the place of an older one as a whole."""

    def __init__(self, path: Path, *, overwrite: bool = False, resume: bool = False) -> None:
        """ValueError if there is something already, and neither `overwrite` nor `resume` is given or no run made it."""
        if path.is_symlink() and not path.exists():
            raise ValueError(f"{path}: is a link to nothing; --out names a folder")
        if path.exists() and not path.is_dir():
            raise ValueError(f"{path}: is a file; --out names a folder")
        if path.exists() and any(entry.name != _LOCK for entry in path.iterdir()):
            if not (overwrite or resume):
                raise ValueError(
                    f"{path}: exists already; give --overwrite to replace it or --resume to go on"
                )
            if not _is_run(path):
                raise ValueError(
                    f"{path}: holds files that no run made (there is no run.json); it is left alone, "
                    "name another folder"
                )
        self.path = path
        self.resume = resume
        self.map = path / "map"
        self.report = path / "report.html"
        self.checkpoint = path / "checkpoint"
        self.unfinished = path / "unfinished"
        self.tensorboard = self.unfinished / "tensorboard"
        self._older = self.unfinished / "older"
        self._is_begun = self._is_published = False

    @contextmanager
    def claimed(self) -> Iterator[None]:
        """Makes the folder, and keeps others from writing there until the block ends.

        ValueError, at once, if that is no place for a folder or another run writes there; OSError if the disk refuses.
        """
        made = self._make()
        try:
            with locked(self.path / _LOCK):
                if self._older.exists():
                    # A run was killed while it put its result in place.
                    self._swap()
                    self._drop_older()
                try:
                    yield
                finally:
                    with held():
                        self._drop_result()
        finally:
            for folder in made:
                # It goes if nothing was written into it.
                with suppress(OSError):
                    folder.rmdir()

    def prepare(self, dataset: Place | None = None) -> None:
        """Begins a run of a data set, whose place is kept; without `resume` what an interrupted one has left goes."""
        self._is_begun = True
        place = {} if dataset is None else {"dataset": _way(self.path, dataset)}
        write_json(self.path / "run.json", {"format": _FORMAT, "version": 1, **place})
        if self.resume:
            # A run that was killed could clear nothing away; its finished stages alone are gone on from.
            self._drop_result()
        else:
            shutil.rmtree(self.unfinished, ignore_errors=True)
            shutil.rmtree(self.checkpoint, ignore_errors=True)
        drop_halves(self.path)
        self.unfinished.mkdir(exist_ok=True)
        if self.resume:
            self._take_back_events()

    def _take_back_events(self) -> None:
        """Copies the event files of a run that was cut when its result was in its place: no others show its stages."""
        published = self.path / self.tensorboard.name
        # Events are written before the first stage is kept: where there are none beside stages, they were moved.
        is_ours = any(self.checkpoint.rglob("*.pt")) and not self.tensorboard.exists()
        if is_ours and published.is_dir():
            with atomic_folder(self.tensorboard) as beside:
                for path in published.glob("events.out.tfevents.*"):
                    shutil.copy2(path, beside / path.name)

    def kept(self) -> str:
        """What there is of the run, should it end before its time."""
        if self._is_published:
            return f"the map is whole: {self.map}"
        older = "; the older result stands" if self.map.exists() else ""
        if not self._is_begun:
            return f"nothing was written{older}"
        if not self.unfinished.exists():
            return f"nothing is left of the run{older}"
        return f"what was finished is kept: the same command with --resume goes on{older}"

    def write_result(
        self,
        dataset: Dataset,
        result: MapResult,
        config: MapperConfig,
        *,
        tile_level: int | None = None,
    ) -> None:
        """The maps, what each journey made, the associations and the configuration, not in their place yet.

        With `tile_level` the map is in tiles; that of the clusters never is.
        """
        provenance = {
            **result.hd_map.provenance,
            "version": __version__,
            "created_at": datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ"),
        }
        self._require_claimed()
        self._write_journeys(self.unfinished / "journeys", dataset, result)
        write_associations(
            self.unfinished / "associations.parquet",
            dataset.journeys,
            [a.sign for a in result.associations],
            [a.lane for a in result.associations],
            sign_id=result.hd_map.sign_id,
            lane_id=result.hd_map.lane_id,
        )
        write_found(self.unfinished, dataset, result.uncertainty.calibration)
        with atomic_file(self.unfinished / "config.yaml") as beside:
            beside.write_text(dump(config), encoding="utf-8")
        for name, hd_map, level in (
            ("map_clusters", result.map_clusters, None),
            ("map", result.hd_map, tile_level),
        ):
            write_map(
                replace(hd_map, provenance=provenance),
                self.unfinished / name,
                min_confidence=config.min_confidence,
                tile_level=level,
            )

    def keep_outcomes(self, outcomes: NamedOutcomes) -> NamedOutcomes:
        """Writes sign_detections.parquet, and hands on what it holds."""
        write_sign_outcomes(self.unfinished / "sign_detections.parquet", outcomes)
        return outcomes

    def write_metrics(self, metrics: Mapping[str, object]) -> None:
        """metrics.json."""
        write_json(self.unfinished / "metrics.json", plain(metrics))

    @contextmanager
    def publishing(self) -> Iterator[None]:
        """Puts the result in its place when the block ends, be it with an error: what scores or draws a map never costs it.

        A signal, or a disk that takes no more, leaves an older result where it is.
        """
        is_wanted = True
        try:
            yield
        except (OSError, KeyboardInterrupt):
            is_wanted = False
            raise
        finally:
            if is_wanted:
                self._publish()

    def _publish(self) -> None:
        self._require_claimed()
        with held():
            self._swap()
            self._is_published = True
        self._drop_older()

    def _make(self) -> list[Path]:
        """Makes the folder and those around it; which were made, innermost first."""
        missing = []
        for folder in (self.path, *self.path.parents):
            if folder.exists():
                break
            missing.append(folder)
        try:
            self.path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            if error.errno not in _NO_PLACE:
                raise
            raise InputError(
                f"{self.path}: no folder can be made there ({error.strerror}); name another one"
            ) from None
        return missing

    def _require_claimed(self) -> None:
        """OSError if the folder is not the one that was claimed: it was deleted or replaced under the run."""
        if not (self.path / _LOCK).exists() or not self.unfinished.exists():
            raise OSError(f"{self.path}: was deleted or replaced while this run wrote there")

    def _swap(self) -> None:
        """Puts the new result in the place of the older one, or leaves all as it was; goes on where it was killed."""
        goes_on = self._older.exists()
        self._older.mkdir(exist_ok=True)
        moved: list[tuple[Path, Path]] = []

        def move(path: Path, to: Path) -> None:
            path.rename(to)
            moved.append((path, to))

        try:
            for name in _MAKES:
                new, place, older = (p / name for p in (self.unfinished, self.path, self._older))
                if goes_on and not os.path.lexists(new):
                    # It is in its place already.
                    continue
                if os.path.lexists(place):
                    move(place, older)
                if os.path.lexists(new):
                    move(new, place)
        except OSError:
            for path, to in reversed(moved):
                to.rename(path)
            self._older.rmdir()
            raise

    def _drop_older(self) -> None:
        """Removes what a run made of the result before; what else was in its folders stays in them."""
        for path in sorted(self._older.rglob("*"), reverse=True):
            inside = path.relative_to(self._older)
            if path.is_dir() and not path.is_symlink():
                if not any(path.iterdir()):
                    path.rmdir()
            elif any(
                len(inside.parts) == made.count("/") + 1 and inside.match(made) for made in _MADE
            ):
                path.unlink()
            elif not os.path.lexists(place := self.path / inside):
                place.parent.mkdir(parents=True, exist_ok=True)
                path.rename(place)
        for folder in (self._older, self.unfinished):
            if not any(folder.iterdir()):
                folder.rmdir()

    def _drop_result(self) -> None:
        """Removes a result that was not whole; what a run goes on from stays."""
        for name in _MAKES:
            path = self.unfinished / name
            if path == self.tensorboard:
                continue
            if path.is_dir():
                shutil.rmtree(path, ignore_errors=True)
            else:
                path.unlink(missing_ok=True)

    def _write_journeys(self, folder: Path, dataset: Dataset, result: MapResult) -> None:
        def written(of: tuple[Journey, JourneyMap, Tensor]) -> None:
            journey, made, poses = of
            place = folder / journey.journey_id
            write_refined_poses(place / "poses.parquet", journey, poses)
            write_road_estimate(place / "road.parquet", journey.frame_number, made.road)
            signs = [f"{journey.journey_id}-s{i}" for i in made.signs.tracklet.tolist()]
            write_signs(place / "signs.parquet", made.signs, signs, dataset.type_names)
            lanes = [f"{journey.journey_id}-l{i}" for i in range(len(made.lanes))]
            write_lanes(place / "lanes.parquet", made.lanes, lanes)

        every = zip(dataset.journeys, result.journey_maps, result.poses, strict=True)
        for _ in in_order(written, list(every), torch.device("cpu"), worth=1):
            pass


def _way(run: Path, dataset: Place) -> str:
    """The data set as seen from the run, so that both can be moved together; a URL without its keys."""
    if not isinstance(dataset, Path):
        return str(dataset)
    return os.path.relpath(dataset.resolve(), run.resolve())


def _is_run(path: Path) -> bool:
    """Whether a run made this folder: by its run.json, or, where an older version made it, by what is in it."""
    try:
        read_json(path / "run.json").require_format(_FORMAT)
        return True
    except ValueError:
        return (path / "metrics.json").is_file() and (path / "map" / "map.json").is_file()


def refuse_overlap(run: Path, dataset: Place) -> None:
    """ValueError if a run would write into the dataset that it reads, or around it, links followed."""
    if not isinstance(dataset, Path):
        return
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
    hd_map: HdMap, survey: Survey, truth: Truth | None, run: Path | None, asked: Against
) -> MapFigures:
    """METRICS.md's figures of a map; with a run's folder those of associations and single journeys too."""
    if truth is None:
        note = "no truth with the survey: every surveyed sign is observable"
        return evaluate_map(hd_map, survey, notes=(note,), asked=asked)
    if run is None:
        return evaluate_map(hd_map, survey, truth=truth, asked=asked)
    ids = [t.journey.journey_id for t in truth.journeys]
    return evaluate_map(
        hd_map,
        survey,
        truth=truth,
        associations=read_associations(run / "associations.parquet", ids),
        landmarks=read_journey_landmarks(run, ids),
        asked=asked,
    )
