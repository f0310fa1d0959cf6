"""The work of studies in pieces: each is done once, says what it needs, and leaves one file."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol, runtime_checkable

import torch

from crowdmap_torch.config import MapperConfig, config_hash
from crowdmap_torch.evaluation.evaluate import evaluate_map
from crowdmap_torch.evaluation.evidence import named_in, read_observable_ids
from crowdmap_torch.io.datasets import load_dataset
from crowdmap_torch.io.maps import certain_part
from crowdmap_torch.io.surveys import read_survey
from crowdmap_torch.mapper import JourneyMap, build_map, map_journey
from crowdmap_torch.processes.workers import Workers
from crowdmap_torch.report.progress import Progress
from crowdmap_torch.simulate.dataset import SimulationConfig, write_dataset
from crowdmap_torch.studies.folder import StudyFolder, dataset_name, digest, journey_config_hash
from crowdmap_torch.studies.measure import (
    Drives,
    load_drives,
    measure_journey,
    measure_map,
    shared_part,
)

_STAGE = "studies, seconds of work"


@runtime_checkable
class Task(Protocol):
    """A piece of work: a dataclass of all that decides what it leaves behind."""

    @property
    def key(self) -> str:
        """Differs where what is left behind differs."""
        ...

    @property
    def cost_s(self) -> float:
        """About how many seconds of a core it takes; for the time that is left, nothing else."""
        ...

    def needs(self) -> Sequence[Task]:
        """What must be done before; nothing, unless a kind of work says otherwise."""
        return ()

    def is_done(self, folder: StudyFolder) -> bool:
        """True if it need not be done again: as a rule, if its result is there."""
        return folder.has_result(self.key)

    def run(self, folder: StudyFolder) -> None:
        """Does it."""
        ...


@dataclass(frozen=True)
class Simulate(Task):
    """A dataset."""

    simulation: SimulationConfig

    @property
    def key(self) -> str:
        """The dataset's name."""
        return dataset_name(self.simulation)

    @property
    def cost_s(self) -> float:
        """Of all its journeys."""
        return 0.3 * _kilometres(self.simulation, self.simulation.journeys)

    def is_done(self, folder: StudyFolder) -> bool:
        """True if the dataset is there: it is written as a whole."""
        return folder.dataset(self.simulation).exists()

    def run(self, folder: StudyFolder) -> None:
        """Writes it."""
        write_dataset(self.simulation, folder.dataset(self.simulation))


@dataclass(frozen=True)
class MapJourney(Task):
    """The map of one journey, and what it is worth."""

    simulation: SimulationConfig
    row: int
    """Number of the journey in its dataset."""
    config: MapperConfig = field(default_factory=MapperConfig)

    @property
    def key(self) -> str:
        """Of the dataset, the journey and what the configuration says of single journeys."""
        name, settings = dataset_name(self.simulation), journey_config_hash(self.config)
        return f"{name}-{self.row:03d}-{settings}"

    @property
    def cost_s(self) -> float:
        """Of one journey."""
        return 4.5 * _kilometres(self.simulation, 1)

    def needs(self) -> Sequence[Task]:
        """The dataset."""
        return (Simulate(self.simulation),)

    def run(self, folder: StudyFolder) -> None:
        """Maps the journey and measures the map."""
        drives = load_drives(folder.dataset(self.simulation))
        begun = time.process_time()
        made = map_journey(drives.dataset.journeys[self.row], 0, self.config)
        seconds = time.process_time() - begun
        folder.write_journey_map(self.key, made)
        measured = measure_journey(drives, self.row, made)
        folder.write_result(self.key, {**measured, "seconds": seconds})


@dataclass(frozen=True)
class MeasureMap(Task):
    """What the map of some journeys of a dataset is worth."""

    simulation: SimulationConfig
    count: int
    first: int = 0
    """The first of these journeys."""
    config: MapperConfig = field(default_factory=MapperConfig)
    adjusted: bool = True
    """False: the cluster heads alone."""
    control: int = 0
    """Surveyed signs that pin the map."""

    @property
    def key(self) -> str:
        """Of all the fields."""
        settings = {
            "config": config_hash(self.config),
            "adjusted": self.adjusted,
            "control": self.control,
        }
        name = dataset_name(self.simulation)
        return f"{name}-{self.first}+{self.count}-{digest(settings)}"

    @property
    def cost_s(self) -> float:
        """Of all the journeys together."""
        driven = _kilometres(self.simulation, self.count)
        return 2.0 + (2.5 if self.adjusted else 0.6) * driven

    @property
    def rows(self) -> range:
        """The journeys."""
        return range(self.first, self.first + self.count)

    def journeys(self) -> tuple[MapJourney, ...]:
        """The maps of the single journeys."""
        return tuple(MapJourney(self.simulation, row, self.config) for row in self.rows)

    def needs(self) -> Sequence[Task]:
        """The single journeys, and the dataset should it have been removed."""
        return (Simulate(self.simulation), *self.journeys())

    def run(self, folder: StudyFolder) -> None:
        """Maps the journeys together and measures the map."""
        drives, maps = self.load(folder)
        measured = measure_map(
            drives, maps, self.config, adjusted=self.adjusted, control=self.control
        )
        if self.adjusted:
            stated = torch.tensor(measured["shared_covariance"], dtype=torch.float64)
            measured["shared"] = shared_part(drives, self.simulation.positioning, stated)
        folder.write_result(self.key, measured)

    def load(self, folder: StudyFolder) -> tuple[Drives, list[JourneyMap]]:
        """The journeys and the map of each of them."""
        drives = load_drives(folder.dataset(self.simulation)).select(self.rows)
        maps = [
            _numbered(folder.read_journey_map(journey.key), number)
            for number, journey in enumerate(self.journeys())
        ]
        return drives, maps


@dataclass(frozen=True)
class MeasureReal(Task):
    """What the map of a real drive is worth, against positions that were measured."""

    dataset: Path
    eligible: Path
    """JSON with the ids of the surveyed signs that can be seen."""
    gate_m: float
    config: MapperConfig = field(default_factory=MapperConfig)

    @property
    def key(self) -> str:
        """Of the name of the drive and the settings."""
        settings = {"config": config_hash(self.config), "gate_m": self.gate_m}
        return f"real-{self.dataset.name}-{digest(settings)}"

    @property
    def cost_s(self) -> float:
        """Of a drive of a few minutes."""
        return 20.0

    def run(self, folder: StudyFolder) -> None:
        """Maps the drive and measures the map."""
        dataset = load_dataset(self.dataset)
        survey = read_survey(self.dataset / "survey")
        begun = time.process_time()
        result = build_map(dataset, self.config)
        seconds = time.process_time() - begun
        alone = replace(result.hd_map, signs=result.journey_maps[0].signs)
        ids = named_in(survey, read_observable_ids(self.eligible))
        measured = {
            name: evaluate_map(hd_map, survey, observable_ids=ids, gate_m=self.gate_m).as_dict()
            for name, hd_map in (
                ("journey", alone),
                ("heads", certain_part(result.map_clusters, self.config.min_confidence)),
                ("map", certain_part(result.hd_map, self.config.min_confidence)),
            )
        }
        frames = sum(journey.frame_count for journey in dataset.journeys)
        folder.write_result(self.key, {**measured, "frames": frames, "seconds": seconds})


def open_tasks(tasks: Iterable[Task], folder: StudyFolder) -> list[Task]:
    """What is not done yet of `tasks` and of all that they need, each once, needs first."""
    return _with_needs(tasks, lambda task: task.is_done(folder))


def finished_keys(tasks: Iterable[Task], folder: StudyFolder) -> list[str]:
    """Keys of the results that there are of `tasks` and of all that they need, each once."""
    every = _with_needs(tasks, lambda task: False)
    return [task.key for task in every if folder.has_result(task.key)]


def _with_needs(tasks: Iterable[Task], is_left_out: Callable[[Task], bool]) -> list[Task]:
    """`tasks` and all that they need, each once, needs first; what is left out needs nothing."""
    found: dict[str, Task] = {}
    seen: set[str] = set()

    def visit(task: Task) -> None:
        if task.key in seen:
            return
        seen.add(task.key)
        if is_left_out(task):
            return
        for need in task.needs():
            visit(need)
        found[task.key] = task

    for task in tasks:
        visit(task)
    return list(found.values())


def run_tasks(
    tasks: Sequence[Task],
    folder: StudyFolder,
    *,
    processes: int = 1,
    progress: Progress | None = None,
) -> None:
    """Does what is not done yet, `processes` at a time, each on one core, in the order given as far as needs allow.

    What is finished stays finished, whenever this is interrupted.
    """
    waiting = {task.key: task for task in open_tasks(tasks, folder)}
    needs = {key: {need.key for need in task.needs()} for key, task in waiting.items()}
    total, done = sum(task.cost_s for task in waiting.values()), 0.0
    progress = progress or Progress()

    def tell(task: Task) -> None:
        nonlocal done
        done += task.cost_s
        progress(_STAGE, round(done), max(round(total), 1), task.key)

    if processes <= 1:
        torch.set_num_threads(1)
        for task in waiting.values():
            task.run(folder)
            tell(task)
        progress.finish()
        return
    running: dict[str, Task] = {}
    with Workers(processes, torch.set_num_threads, 1) as pool:
        while waiting or running:
            unfinished = waiting.keys() | running.keys()
            ready = [key for key in waiting if not needs[key] & unfinished]
            for key in ready[: pool.free]:
                running[key] = waiting.pop(key)
                pool.start(key, (key, running[key].run, (folder,)))
            for key, _ in pool.wait():
                tell(running.pop(key))
    progress.finish()


def _numbered(made: JourneyMap, number: int) -> JourneyMap:
    """The map of the `number`-th journey of those that are mapped together."""
    signs = replace(made.signs, journey=torch.full_like(made.signs.journey, number))
    lanes = replace(made.lanes, journey=torch.full_like(made.lanes.journey, number))
    return replace(made, signs=signs, lanes=lanes)


def _kilometres(simulation: SimulationConfig, journeys: int) -> float:
    return journeys * simulation.world.length_m / 1000
