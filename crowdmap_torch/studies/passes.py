"""Real drives cut where they come back, alone and as crowds: their signs in the cameras that they were surveyed from."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from crowdmap_torch.config import MapperConfig, config_hash
from crowdmap_torch.evaluation.evaluate import evaluate_map
from crowdmap_torch.evaluation.local import SurveyedFrom, local_errors, read_surveyed_from
from crowdmap_torch.geometry import se3
from crowdmap_torch.geometry.trajectory import passes, station
from crowdmap_torch.io.datasets import load_dataset
from crowdmap_torch.io.documents import plain
from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.maps import certain_part
from crowdmap_torch.io.surveys import read_survey
from crowdmap_torch.mapper import JourneyMap, build_map
from crowdmap_torch.simulate.positioning import PositioningConfig, pose_errors
from crowdmap_torch.studies.folder import StudyFolder, digest
from crowdmap_torch.studies.recorded_errors import read_recorded_errors
from crowdmap_torch.studies.tasks import Task
from crowdmap_torch.tables import Dataset, HdMap, Journey, Survey

COPIES = 10
"""Journeys that one pass is made into."""


@dataclass(frozen=True)
class MeasureDrives(Task):
    """What drives made of a real sequence are worth, alone and mapped together, in the cameras of the survey."""

    dataset: Path
    surveyed_from: Path
    gate_m: float
    crowd: str
    """`alone`: every pass by itself; `passes`: all passes together; `copies`: the pass that saw most, ten times."""
    errors: str = "none"
    """Of the poses: `none`, `simulated` biases and drifts, or those that a receiver had, `recorded`."""
    recorded: Path | None = None
    """Segment of comma2k19 with a receiver's fixes."""
    config: MapperConfig = field(default_factory=MapperConfig)
    seen_from: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Where the camera of the images is, in the axes of the one that poses and survey are of [m]."""

    @property
    def key(self) -> str:
        """Of the name of the drive and the settings."""
        settings: dict[str, object] = {"config": config_hash(self.config), "gate_m": self.gate_m}
        if any(self.seen_from):
            settings["seen_from"] = self.seen_from
        crowd = f"{self.crowd}-{self.errors}"
        return f"drives-{self.dataset.name}-{crowd}-{digest(settings)}"

    @property
    def cost_s(self) -> float:
        """Of some minutes of driving."""
        return 300.0 if self.crowd == "copies" else 60.0

    def run(self, folder: StudyFolder) -> None:
        """Maps the drives and measures their maps and the common one."""
        dataset, survey = load_dataset(self.dataset), read_survey(self.dataset / "survey")
        surveyed = read_surveyed_from(self.surveyed_from).get(self.dataset.name)
        if surveyed is None:
            raise InputError(f"{self.surveyed_from}: expected the data set {self.dataset.name!r}")
        begun = time.process_time()
        every = [drive for journey in dataset.journeys for drive in drives_of(journey)]
        crowds = [
            [self._driven(drive, number) for number, drive in crowd]
            for crowd in self._crowds(every, surveyed)
        ]
        found = [self._measured(dataset, survey, crowd, surveyed) for crowd in crowds]
        folder.write_result(
            self.key,
            {
                "single": _joined([one["single"] for one in found]),
                "map": _joined([one["map"] for one in found]),
                "relative": [one["relative"] for one in found],
                "drives": sum(map(len, crowds)),
                "seconds": time.process_time() - begun,
            },
        )  # fmt: skip

    def _crowds(
        self, every: Sequence[Journey], surveyed: dict[str, SurveyedFrom]
    ) -> Iterator[list[tuple[int, Journey]]]:
        """The numbered drives that are mapped together."""
        if self.crowd == "passes":
            yield list(enumerate(every))
            return
        count = [_signs_of(drive, surveyed) for drive in every]
        if self.crowd == "copies":
            most = every[count.index(max(count))]
            yield [(k, replace(most, journey_id=f"{most.journey_id}-{k}")) for k in range(COPIES)]
            return
        yield from ([(k, drive)] for k, drive in enumerate(every) if count[k])

    def _driven(self, drive: Journey, number: int) -> Journey:
        """The drive with the errors of a positioning of its own; the reference's sigmas then hold no more."""
        T = _beside(drive.T_world_camera, self.seen_from)
        if self.errors == "none":
            return replace(drive, T_world_camera=T, sigma_position=None, sigma_rotation=None)
        if self.errors == "simulated":
            way = station(T).numpy()
            drawn = pose_errors(way, PositioningConfig(), np.random.default_rng(number))
            error = np.concatenate([drawn.translation, drawn.rotation], axis=1)
        else:
            assert self.recorded is not None
            t_s = drive.t_ns.numpy() * 1e-9
            moved = read_recorded_errors(self.recorded).laid_over(t_s, copy=number)
            error = np.concatenate([moved, np.zeros_like(moved)], axis=1)
        moved_by = torch.from_numpy(error).to(T)
        return replace(
            drive, T_world_camera=se3.retract(T, moved_by), sigma_position=None, sigma_rotation=None
        )

    def _measured(
        self,
        dataset: Dataset,
        survey: Survey,
        crowd: Sequence[Journey],
        surveyed: dict[str, SurveyedFrom],
    ) -> dict[str, Any]:
        together = replace(dataset, journeys=tuple(crowd))
        result = build_map(together, self.config)
        final = certain_part(result.hd_map, self.config.min_confidence)
        alone = [
            self._local(made.signs.center_world, drive.T_world_camera, drive, surveyed)
            for made, drive in zip(result.journey_maps, crowd, strict=True)
        ]
        adjusted = [
            self._local(final.signs.center_world, poses, drive, surveyed)
            for poses, drive in zip(result.poses, crowd, strict=True)
        ]
        return {
            "single": _means(alone),
            "map": _means(adjusted),
            "relative": self._relative(survey, final, result.journey_maps),
        }

    def _local(
        self,
        center_world: Float[Tensor, "n 3"],
        T_world_camera: Float[Tensor, "f 4 4"],
        drive: Journey,
        surveyed: dict[str, SurveyedFrom],
    ) -> dict[str, float]:
        back = [-one for one in self.seen_from]
        poses = _beside(T_world_camera, back)
        return local_errors(center_world, poses, drive.frame_number, surveyed, gate_m=self.gate_m)

    def _relative(
        self, survey: Survey, final: HdMap, journey_maps: Sequence[JourneyMap]
    ) -> dict[str, Any]:
        """In the world: relative errors of the drives' own maps, in the mean, and of the common one."""
        maps = [replace(final, signs=made.signs) for made in journey_maps]
        figures = [
            evaluate_map(m, survey, gate_m=self.gate_m).signs.relative_center.total.mean
            for m in (final, *maps)
        ]
        single = [x for x in figures[1:] if np.isfinite(x)]
        return plain({"map": figures[0], "single": fmean(single) if single else float("nan")})


def drives_of(journey: Journey) -> list[Journey]:
    """The passes of a journey, as journeys of their own."""
    pieces = passes(journey.T_world_camera)
    frames = torch.arange(journey.frame_count)
    return [
        replace(journey.with_frames(frames[piece]), journey_id=f"{journey.journey_id}-pass-{k}")
        for k, piece in enumerate(pieces)
    ]


def _signs_of(drive: Journey, surveyed: dict[str, SurveyedFrom]) -> int:
    """How many signs were surveyed from a drive."""
    return sum(
        bool(torch.isin(seen.frame_number, drive.frame_number).any()) for seen in surveyed.values()
    )


def _beside(
    T_world_camera: Float[Tensor, "f 4 4"], place: Sequence[float]
) -> Float[Tensor, "f 4 4"]:
    """Poses of a camera at a place in the axes of the given one [m], turned as it is."""
    turn = torch.eye(3).to(T_world_camera)
    return T_world_camera @ se3.make(turn, T_world_camera.new_tensor(place))


def _means(by_drive: Sequence[dict[str, float]]) -> dict[str, float]:
    """Of every sign, over the drives that have it."""
    names = sorted({name for errors in by_drive for name in errors})
    return {name: fmean(errors[name] for errors in by_drive if name in errors) for name in names}


def _joined(parts: Sequence[dict[str, float]]) -> dict[str, float]:
    """Signs of several maps; one that was surveyed from two passes counts in each."""
    return {f"{name}@{k}": error for k, part in enumerate(parts) for name, error in part.items()}
