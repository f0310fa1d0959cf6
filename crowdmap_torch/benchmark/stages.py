"""The main job, files to map: the time of each stage, and the memory of all its processes together.

Beside other checkouts of the package if asked to, in turns, so that whatever else the machine does falls to all alike.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median

import crowdmap_torch
from crowdmap_torch.io.errors import InputError, input_read
from crowdmap_torch.processes.memory import ARROW_POOL
from crowdmap_torch.ranges import CountOrNone, argument

_EVERY_S = 0.05
"""How often memory is looked at."""
_BESIDE = "reading, writing, start"
"""What of a run is in no stage that metrics.json has."""


@dataclass(frozen=True)
class Measured:
    """What one run took."""

    stages: dict[str, float]
    """Seconds by stage, `_BESIDE` the rest."""
    wall_s: float
    processor_s: float
    peak_gb: float
    """Most memory of all processes together at one time; what several share counts once."""
    main_gb: dict[str, float]
    """The most that the main process held, by stage; states before that was told have none."""
    relative_m: float | None
    """The map's relative error against its survey, where there is one."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What `crowdmap benchmark stages` takes."""
    parser.add_argument("dataset", type=Path, help="folder of a dataset")
    parser.add_argument(
        "--against",
        type=Path,
        nargs="+",
        default=[],
        metavar="CHECKOUT",
        help="other states of the repository",
    )
    parser.add_argument("--repeats", type=int, default=1, help="runs of each, in turns")
    parser.add_argument("--workers", type=argument(CountOrNone), default=os.cpu_count() or 1)


def run(options: argparse.Namespace) -> None:
    """Prints a table: a row for each stage, a column for each checkout, medians of the runs."""
    here = Path(crowdmap_torch.__file__).parent.parent
    checkouts = [here, *options.against]
    for checkout in checkouts:
        if not (checkout / "crowdmap_torch").is_dir():
            raise InputError(f"{checkout}: expected a checkout with a folder crowdmap_torch")
    names = ["this one", *(str(path) for path in options.against)]
    runs: list[list[Measured]] = [[] for _ in checkouts]
    for _ in range(options.repeats):
        for of_checkout, checkout in zip(runs, checkouts, strict=True):
            of_checkout.append(measured(checkout, options.dataset, options.workers))
    print(
        f"{options.dataset}: {options.workers} workers, medians of {options.repeats}, load "
        f"{os.getloadavg()[0]:.1f} on {os.cpu_count()} cores"
    )
    for line in table(names, runs):
        print(line)


def table(names: Sequence[str], runs: Sequence[Sequence[Measured]]) -> list[str]:
    """Medians of the runs of each checkout, a line for each stage and for the whole."""
    stages = list(dict.fromkeys(stage for of in runs for one in of for stage in one.stages))
    rows = [
        (f"{stage} [s]", [median(one.stages.get(stage, 0.0) for one in of) for of in runs], 1)
        for stage in stages
    ]
    rows.append(("files to map [s]", [median(one.wall_s for one in of) for of in runs], 1))
    rows.append(("of a processor [s]", [median(one.processor_s for one in of) for of in runs], 1))
    rows.append(
        ("memory of all processes [GB]", [median(one.peak_gb for one in of) for of in runs], 2)
    )
    for stage in dict.fromkeys(stage for of in runs for one in of for stage in one.main_gb):
        held = [median(one.main_gb.get(stage, 0.0) for one in of) for of in runs]
        rows.append((f"of the main one, {stage} [GB]", held, 2))
    errors = [[one.relative_m for one in of if one.relative_m is not None] for of in runs]
    if all(errors):
        rows.append(("relative error [m]", [median(of) for of in errors], 4))
    width = max(len(row[0]) for row in rows) + 2
    return [
        f"{'':<{width}}" + "".join(f"{name:>16}" for name in names),
        *(
            f"{name:<{width}}" + "".join(f"{value:>16.{digits}f}" for value in values)
            for name, values, digits in rows
        ),
    ]


def measured(checkout: Path, dataset: Path, workers: int) -> Measured:
    """One run of a checkout's main job; InputError, with its last line, if it fails."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as scratch:
        out, said = Path(scratch) / "run", Path(scratch) / "said"
        command = [sys.executable, "-m", "crowdmap_torch", "optimize", str(dataset.resolve())]
        command += ["--out", str(out), "--workers", str(workers)]
        # Where Arrow takes its memory is for each checkout to say.
        environment = {**os.environ, "PYTHONPATH": str(checkout.resolve())}
        environment.pop(ARROW_POOL, None)
        begun, peak = time.perf_counter(), 0
        with said.open("wb") as file:
            process = subprocess.Popen(
                command, cwd=scratch, env=environment, stdout=file, stderr=subprocess.STDOUT
            )
            while True:
                ended, status, used = os.wait4(process.pid, os.WNOHANG)
                if ended:
                    break
                peak = max(peak, _memory(process.pid))
                time.sleep(_EVERY_S)
        process.returncode = os.waitstatus_to_exitcode(status)
        wall = time.perf_counter() - begun
        if process.returncode:
            last = said.read_text(errors="replace").strip().splitlines()[-1:]
            raise InputError(f"{checkout}: {' '.join(last) or f'exit {process.returncode}'}")
        with input_read():
            metrics = json.loads((out / "metrics.json").read_text(encoding="utf-8"))
        stages = dict(metrics["times_s"])
        stages[_BESIDE] = wall - sum(stages.values())
        survey = metrics.get("survey") or {}
        relative = survey.get("signs", {}).get("relative", {}).get("total", {}).get("mean")
        held = metrics.get("memory_gb", {})
        return Measured(stages, wall, used.ru_utime + used.ru_stime, peak / 1e9, held, relative)


def _memory(pid: int) -> int:
    """Bytes that a process and all that it began hold, what they share counted once; 0 where there is no /proc."""
    total, left = 0, [pid]
    while left:
        one = left.pop()
        try:
            lines = Path(f"/proc/{one}/smaps_rollup").read_text().splitlines()
            total += sum(int(line.split()[1]) * 1024 for line in lines if line.startswith("Pss:"))
            for thread in Path(f"/proc/{one}/task").iterdir():
                left += [int(child) for child in (thread / "children").read_text().split()]
        except (OSError, ValueError):
            # It ended in between, or this is no Linux.
            continue
    return total
