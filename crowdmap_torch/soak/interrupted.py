"""Runs that are ended by a signal at a chosen instant, and resumed: what is left, what is repeated, what comes out."""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import signal
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch

from crowdmap_torch import cli
from crowdmap_torch.commands import optimize
from crowdmap_torch.ranges import Count, Seed, argument
from crowdmap_torch.report.progress import Progress
from crowdmap_torch.runs.checkpoint import Checkpoint
from crowdmap_torch.soak.child import Child, Outcome, children, ends
from crowdmap_torch.soak.good import map_here, write_street
from crowdmap_torch.soak.verdict import problems_of_outcome

STAGES = (
    "reading",
    "single journeys",
    "clusters and biases",
    "bundle adjustment",
    "covariances and map",
    "errors and report",
    "putting in place",
)
"""Of a run, in order; the last ones write."""
WITHIN_S = 5.0
"""A signal ends a run within this time, and a run that was killed leaves nobody behind after it."""
_CONFIG = """\
adjust: {lm: {max_iterations: 8}}
sign_triangulation: {fit: {rounds: 1, lm: {max_iterations: 4}, coarse_lm: {max_iterations: 2}}}
crowd: {rounds: 1}
"""
_JOURNEYS = 3
_PATIENCE_S = 600.0
"""For what takes seconds: workers load everything, and the machine may be busy."""
_ATTEMPTS = 8
"""How often an instant is tried that comes after the end of the run, each time half as late."""
_FOUND = re.compile(
    rf"resuming: (\d+) of {_JOURNEYS} journeys(, clusters and biases)?(?:, step (\d+))?$", re.M
)
_TIMES = {
    "map.json": ("provenance.created_at",),
    "metrics.json": ("times_s", "memory_gb", "workers"),
    "run.json": ("dataset",),
}
"""What differs between two runs on the same input, by file: times and memory, and the way from the run to its data set."""


@dataclass(frozen=True)
class Cut:
    """An instant of a run, and what happens then."""

    workers: int
    stage: str
    share: float
    """Of the stage's duration."""
    number: signal.Signals


@dataclass(frozen=True)
class Verdict:
    """A run that was cut and resumed, and what is wrong about it."""

    cut: Cut
    seconds: float
    """From the signal to the end."""
    found: str
    """What `--resume` says there is."""
    repeated: tuple[str, ...]
    """What was finished and made again."""
    problems: tuple[str, ...]


@dataclass(frozen=True)
class _Street:
    """What is mapped, and what comes out of it where nothing is cut."""

    data: Path
    config: Path
    whole: Path
    seconds: Mapping[tuple[int, str], float]
    """How long each stage takes, by workers."""


def add_options(parser: argparse.ArgumentParser, *, count: int) -> None:
    """What says which runs are cut where; `count` is how many are by default, for each signal."""
    parser.add_argument("--count", type=argument(Count), default=count, metavar="N")
    parser.add_argument("--seed", type=argument(Seed), default=0)
    parser.add_argument("--stages", nargs="+", choices=STAGES, default=STAGES, metavar="STAGE")
    parser.add_argument("--keep", type=Path, default=Path("soak-failures"), metavar="FOLDER")


def cuts(
    numbers: Sequence[signal.Signals], count: int, stages: Sequence[str] = STAGES, *, seed: int
) -> list[Cut]:
    """For each signal so many instants, spread over the stages, with one worker and with two in turn."""
    generator = torch.Generator().manual_seed(seed)
    shares = iter(torch.rand(len(numbers) * count, generator=generator).tolist())
    # Where their number is even a round later the turns are exchanged: every stage meets one worker and two.
    swaps = len(stages) % 2 == 0
    return [
        Cut(1 + (k + swaps * (k // len(stages))) % 2, stages[k % len(stages)], next(shares), number)
        for number in numbers
        for k in range(count)
    ]


def interrupt(chosen: Sequence[Cut], keep: Path) -> Iterator[Verdict]:
    """What came of a run cut at each of the instants; what fails is kept in a folder of `keep`."""
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory(prefix="soak-") as temporary:
        workers = sorted({cut.workers for cut in chosen})
        street = _write(Path(temporary) / "good", workers)
        for number, cut in enumerate(chosen):
            place = Path(temporary) / f"{number}"
            verdict = _cut_and_resume(street, place, cut)
            if verdict.problems:
                keep.mkdir(parents=True, exist_ok=True)
                kept = keep / f"{cut.number.name}-{number}"
                shutil.rmtree(kept, ignore_errors=True)
                shutil.move(place, kept)
                (kept / "failure.txt").write_text(f"{verdict}\n")
            yield verdict
            shutil.rmtree(place, ignore_errors=True)


def report(verdicts: Iterable[Verdict]) -> int:
    """Prints what fails and a table of all; 0 if everything held."""
    rows: dict[tuple[str, int], list[Verdict]] = {}
    begun = time.monotonic()
    for verdict in verdicts:
        cut = verdict.cut
        rows.setdefault((cut.number.name, cut.workers), []).append(verdict)
        if verdict.problems:
            print(f"{cut}: {verdict.problems}", flush=True)
        if (done := sum(map(len, rows.values()))) % 10 == 0:
            print(f"{done} in {time.monotonic() - begun:.0f} s", flush=True)
    for (name, workers), some in rows.items():
        stages = Counter(verdict.cut.stage for verdict in some)
        print(
            f"{name}, workers {workers}: {len(some)} runs cut, "
            f"{sum(bool(v.problems) for v in some)} failures; "
            f"ended after {max(v.seconds for v in some):.2f} s at most, "
            f"made again {max(len(v.repeated) for v in some)} at most"
        )
        print(f"  {', '.join(f'{n} in {stage}' for stage, n in stages.items())}")
    return int(any(v.problems for some in rows.values() for v in some))


def _write(folder: Path, counts: Sequence[int]) -> _Street:
    data, config, whole = folder / "data", folder / "config.yaml", folder / "whole"
    write_street(data, length_m=50.0, frame_rate_hz=2.0, seed=2)
    config.write_text(_CONFIG)
    map_here(data, whole, config)
    street, seconds = _Street(data, config, whole, {}), {}
    for workers in counts:
        place = folder / f"workers-{workers}"
        place.mkdir()
        outcome = Child(_main(street, place, workers), place).outcome(seconds=_PATIENCE_S)
        ended = time.monotonic()
        differ = differences(whole, place / "run")
        if outcome.code or differ:
            raise RuntimeError(f"a run with {workers} workers is another one: {outcome} {differ}")
        times = [*_reached(place / "course").values(), ended]
        for stage, (reached, left) in zip(STAGES, pairwise(times), strict=True):
            seconds[workers, stage] = left - reached
    return replace(street, seconds=seconds)


def _cut_and_resume(street: _Street, place: Path, cut: Cut) -> Verdict:
    left, outcome, seconds = _cut(street, place, cut)
    problems = []
    if seconds > WITHIN_S:
        problems.append(f"ended after {seconds:.1f} s")
    if alive := [pid for pid in left if not ends(pid, WITHIN_S)]:
        problems.append(f"{len(alive)} of {len(left)} workers are still there")
    if cut.number != signal.SIGKILL:
        problems += problems_of_outcome(outcome, "optimize", codes=(128 + cut.number,))
    elif outcome.code != -cut.number:
        problems.append(f"exit code {outcome.code}")
    run, course = place / "run", place / "course"
    if (run / "map").exists() and (differ := differences(street.whole / "map", run / "map")):
        problems.append(f"a map is there that is not whole: {differ}")
    finished, kept = _units(course, "made"), _units(course, "kept")
    course.unlink()
    resumed = Child(_main(street, place, cut.workers, "--resume"), place).outcome(
        seconds=_PATIENCE_S
    )
    problems += problems_of_outcome(resumed, "optimize", codes=(0,))
    problems += [f"another result: {name}" for name in differences(street.whole, run)]
    repeated = finished & _units(course, "made")
    if len(repeated) > 1 or repeated & kept:
        problems.append(f"made again: {sorted(repeated)}, though kept: {sorted(repeated & kept)}")
    said = [line for line in resumed.err.splitlines() if line.startswith("resuming: ")]
    if kept and not said and "finished already" not in resumed.out:
        problems.append("nothing is said of what was found")
    problems += [
        f"{line}, kept {sorted(kept)}" for line in said if not _is_true(line, kept, finished)
    ]
    found = said[0] if said else resumed.out.strip()[-80:]
    return Verdict(cut, seconds, found, tuple(sorted(repeated)), tuple(problems))


def _cut(street: _Street, place: Path, cut: Cut) -> tuple[list[int], Outcome, float]:
    """A run that is cut: the processes that it had begun, how it ended, and how long that took."""
    late = cut.share * street.seconds[cut.workers, cut.stage]
    for _ in range(_ATTEMPTS):
        shutil.rmtree(place, ignore_errors=True)
        place.mkdir()
        child = Child(_main(street, place, cut.workers), place)
        at = 0.0
        while not at and not child.has_ended():
            at = _reached(place / "course").get(cut.stage, 0.0)
            time.sleep(0.001)
        while time.monotonic() < at + late and not child.has_ended():
            time.sleep(0.001)
        begun, sent = children(child.pid), time.monotonic()
        if not child.has_ended():
            # A terminal sends to all of its processes; whoever kills one means that one.
            (os.killpg if cut.number == signal.SIGINT else os.kill)(child.pid, cut.number)
        outcome = child.outcome(seconds=_PATIENCE_S)
        if outcome.code:
            return begun, outcome, time.monotonic() - sent
        late /= 2
    raise RuntimeError(f"{cut}: the run always ends before")


# ---- what a run says of its course, for those who judge it ----


def _main(street: _Street, place: Path, workers: int, *options: str) -> Callable[[], int]:
    """Maps the street into `place`/run, and keeps a course of it."""
    arguments = ("optimize", str(street.data), "--out", str(place / "run"))
    more = ("--config", str(street.config), "--workers", str(workers), *options)

    def main() -> int:
        _keep_course(place / "course")
        return cli.main([*arguments, *more], last=True)

    return main


def _keep_course(path: Path) -> None:
    """From now on this process writes a line when it reaches a stage, has made a part of the map, and has kept it."""
    file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND)

    def say(what: str) -> None:
        os.write(file, f"{time.monotonic():.6f} {what}\n".encode())

    def kept(name: Callable[..., str], keep: Callable[..., Any]) -> Callable[..., Any]:
        def call(checkpoint: Checkpoint, *parts: Any) -> Any:
            say(f"made {name(*parts)}")
            returned = keep(checkpoint, *parts)
            say(f"kept {name(*parts)}")
            return returned

        return call

    write, run = optimize.write_report, optimize.run

    def running(options: argparse.Namespace) -> int:
        # What comes before is Python's own start, or the soak's.
        say(f"at {STAGES[0]}")
        return run(options)

    class Told(Progress):
        def __call__(self, stage: str, done: int = 0, total: int = 0, note: str = "") -> None:
            say(f"at {stage.partition(':')[0]}")
            super().__call__(stage, done, total, note)

    def written(*parts: Any) -> None:
        write(*parts)
        say(f"at {STAGES[-1]}")

    optimize.run, optimize.Progress, optimize.write_report = running, Told, written
    for method, name in (
        ("keep_journey", lambda number, made: f"journey {number}"),
        ("keep_first", lambda first: "clusters"),
        ("keep_step", lambda standing, course, anew: f"step {anew}.{standing.steps}"),
    ):
        setattr(Checkpoint, method, kept(name, getattr(Checkpoint, method)))


def _reached(course: Path) -> dict[str, float]:
    """When each stage was reached."""
    found: dict[str, float] = {}
    for line in course.read_text().splitlines() if course.exists() else ():
        at, what, name = line.split(" ", 2)
        if what == "at":
            found.setdefault(name, float(at))
    return found


def _units(course: Path, what: str) -> set[str]:
    """The parts of the map that were `made`, or `kept`."""
    lines = [line.split(" ", 2)[1:] for line in course.read_text().splitlines()]
    return {name for kind, name in lines if kind == what}


def _is_true(line: str, kept: set[str], made: set[str]) -> bool:
    """Whether `--resume` says what was kept, a part more at most: it may be cut before it is noted."""
    found = _FOUND.match(line)
    if found is None:
        return False
    journeys, clusters, step = found.groups()
    said = int(journeys) + bool(clusters) + int(step or 0)
    return len(kept) <= said <= len(made) <= len(kept) + 1


# ---- results ----


def differences(one: Path, other: Path) -> list[str]:
    """Files of two results, or of parts of them, that are not the same bit for bit, times left out."""
    contents = [_contents(folder) for folder in (one, other)]
    return sorted(
        name
        for name in contents[0].keys() | contents[1].keys()
        if contents[0].get(name) != contents[1].get(name)
    )


def _contents(folder: Path) -> dict[str, bytes]:
    found = {}
    for path in folder.rglob("*"):
        name = str(path.relative_to(folder))
        if path.is_dir() or name.startswith("tensorboard/"):
            continue
        found[name] = path.read_bytes()
        if path.name == "report.html":
            # Times are all over it.
            found[name] = found[name][-8:]
        elif path.name in _TIMES:
            found[name] = _without(json.loads(found[name]), *_TIMES[path.name])
    return found


def _without(content: dict[str, Any], *places: str) -> bytes:
    for place in places:
        *sections, key = place.split(".")
        inside = content
        for section in sections:
            inside = inside[section]
        # Results of other versions may lack it.
        inside.pop(key, None)
    return json.dumps(content).encode()
