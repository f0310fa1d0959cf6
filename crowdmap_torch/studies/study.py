"""A study: the work that it asks for, and the chapter that it draws from what is done."""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from crowdmap_torch.processes.interrupts import keeping
from crowdmap_torch.ranges import Workers, argument
from crowdmap_torch.studies.chapter import Chapter, Table, write_chapters
from crowdmap_torch.studies.folder import StudyFolder
from crowdmap_torch.studies.numbers import seconds
from crowdmap_torch.studies.scale import FULL, QUICK, Scale
from crowdmap_torch.studies.tasks import Task, finished_keys, open_tasks, run_tasks

STOPPED = "what is done is kept: the same command goes on from there, --report-only draws it"


@dataclass(frozen=True)
class Settings:
    """What the command line says of a study."""

    scale: Scale
    real: Path | None
    """Folder of real drives."""
    recorded: Path | None = None
    """Segment of comma2k19 with a receiver's errors."""


@dataclass(frozen=True)
class Study:
    """A module of this package is run by its `add_arguments` and `run`; those of a study are these methods."""

    name: str
    title: str
    tasks: Callable[[Settings], Iterable[tuple[int, Task]]]
    """Each with its turn, lower ones first: the seed as a rule, so that studies that are stopped all have something to
    show."""
    chapter: Callable[[Settings, StudyFolder], Chapter]
    """Drawn from what is done, whatever that is."""

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """Where, how much, and how many at a time."""
        add_arguments(parser)

    def run(self, options: argparse.Namespace) -> None:
        """Does what is not done yet and writes the page."""
        run_studies(self.name, (self,), options)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What every study takes."""
    parser.add_argument("--out", type=Path, default=Path("study"), help="folder of all results")
    parser.add_argument(
        "--quick", action="store_true", help="a tiny world: only shows that it runs"
    )
    parser.add_argument(
        "--processes", type=argument(Workers), default=os.cpu_count() or 1, metavar="N"
    )
    parser.add_argument("--real", type=Path, metavar="DIR", help="folder of kitti-signs")
    parser.add_argument(
        "--recorded-errors",
        type=Path,
        metavar="DIR",
        help="segment of comma2k19 whose receiver's errors are laid over the real drives",
    )
    parser.add_argument(
        "--report-only", action="store_true", help="tables and plots of what is done, no more work"
    )


def run_studies(name: str, studies: Sequence[Study], options: argparse.Namespace) -> None:
    """Does what is not done yet of all studies, seed after seed, and writes one page."""
    settings = Settings(QUICK if options.quick else FULL, options.real, options.recorded_errors)
    folder = StudyFolder(options.out / "quick" if options.quick else options.out)
    turns = [turn for study in studies for turn in study.tasks(settings)]
    tasks = [task for _, task in sorted(turns, key=lambda turn: turn[0])]
    if not options.report_only:
        with keeping(lambda: STOPPED):
            run_tasks(tasks, folder, processes=options.processes)
    chapters = [(study.name, study.title, study.chapter(settings, folder)) for study in studies]
    chapters.append(("times", "Times", time_chapter(studies, settings, folder)))
    title = studies[0].title if len(studies) == 1 else "Studies"
    print(write_chapters(folder.path, name, title, chapters))
    left = len(open_tasks(tasks, folder))
    if left:
        print(f"{left} pieces of work are not done yet")


def time_chapter(studies: Sequence[Study], settings: Settings, folder: StudyFolder) -> Chapter:
    """What the work of each study took."""
    rows, every = [], set()
    for study in studies:
        keys = finished_keys((task for _, task in study.tasks(settings)), folder)
        every |= set(keys)
        rows.append((study.title, len(keys), _minutes(keys, folder)))
    rows.append(("all, shared work once", len(every), _minutes(every, folder)))
    return Chapter(
        text=(
            "Minutes of a core for mapping, without simulating and measuring. Studies share work: each has all that it "
            "rests on counted as its own.",
        ),
        tables=(Table("times", ("study", "results", "minutes of a core"), tuple(rows)),),
    )


def _minutes(keys: Iterable[str], folder: StudyFolder) -> float:
    return seconds([folder.read_result(key) for key in keys]) / 60
