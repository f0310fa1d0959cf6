from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
import torch
from worlds.nested import flat

from crowdmap_torch.config import MapperConfig
from crowdmap_torch.simulate.dataset import SimulationConfig
from crowdmap_torch.studies.folder import StudyFolder
from crowdmap_torch.studies.scale import QUICK
from crowdmap_torch.studies.tasks import (
    MapJourney,
    MeasureMap,
    Simulate,
    Task,
    open_tasks,
    run_tasks,
)

TINY = replace(QUICK.short_drives(0), journeys=2)


@dataclass(frozen=True)
class Note:
    """A task that says that it ran."""

    key: str
    wants: tuple[Note, ...] = ()
    fails: bool = False
    cost_s: float = 1.0

    def needs(self) -> Sequence[Task]:
        return self.wants

    def is_done(self, folder: StudyFolder) -> bool:
        return folder.has_result(self.key)

    def run(self, folder: StudyFolder) -> None:
        for want in self.wants:
            assert want.is_done(folder), f"{self.key} came before {want.key}"
        if self.fails:
            raise KeyboardInterrupt
        folder.write_result(self.key, {})


def test_needs_come_first_and_nothing_comes_twice(folder: StudyFolder):
    base = Note("base")
    tasks = [Note("late", (Note("middle", (base,)), base)), Note("other", (base,))]
    assert [t.key for t in open_tasks(tasks, folder)] == ["base", "middle", "late", "other"]
    run_tasks(tasks, folder)
    assert open_tasks(tasks, folder) == []


def test_what_is_needed_by_finished_work_alone_is_not_done(folder: StudyFolder):
    folder.write_result("late", {})
    assert open_tasks([Note("late", (Note("base"),))], folder) == []


def test_an_interruption_leaves_what_is_finished(folder: StudyFolder):
    tasks = [Note("first"), Note("second", fails=True), Note("third")]
    with pytest.raises(KeyboardInterrupt):
        run_tasks(tasks, folder)
    assert [t.key for t in open_tasks(tasks, folder)] == ["second", "third"]


def test_processes_make_what_one_process_makes(tmp_path: Path):
    tasks = [MeasureMap(TINY, 2)]
    one, two = StudyFolder(tmp_path / "one"), StudyFolder(tmp_path / "two")
    run_tasks(tasks, one)
    run_tasks(tasks, two, processes=2)
    for task in (*tasks, *tasks[0].journeys()):
        first, second = (folder.read_result(task.key) for folder in (one, two))
        assert first.pop("seconds") and second.pop("seconds")
        assert flat(first) == pytest.approx(flat(second), rel=1e-6)
    signs = [folder.read_journey_map(tasks[0].journeys()[1].key).signs for folder in (one, two)]
    assert torch.equal(signs[0].corners_world, signs[1].corners_world)


def test_keys_follow_what_decides_the_content():
    default = MapperConfig()
    adjust = replace(default, adjust=replace(default.adjust, tukey_c=9.0))
    road = replace(default, road=replace(default.road, method="calibration"))
    other_seed = replace(TINY, seed=1)
    # What comes after single journeys does not make their maps others.
    assert MapJourney(TINY, 0, default).key == MapJourney(TINY, 0, adjust).key
    alone = [MapJourney(TINY, 0), MapJourney(TINY, 1), MapJourney(TINY, 0, road)]
    assert len({task.key for task in [*alone, MapJourney(other_seed, 0)]}) == 4
    maps = [
        MeasureMap(TINY, 2),
        MeasureMap(TINY, 1),
        MeasureMap(TINY, 1, first=1),
        MeasureMap(TINY, 2, config=adjust),
        MeasureMap(TINY, 2, adjusted=False),
        MeasureMap(TINY, 2, control=1),
    ]
    assert len({task.key for task in maps}) == len(maps)
    assert Simulate(TINY).key != Simulate(other_seed).key
    assert Simulate(TINY).key != Simulate(replace(TINY, bad_drives=("jump",))).key
    assert Simulate(SimulationConfig()).key.startswith("suburb-0-")
