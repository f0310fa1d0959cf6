"""Destroys small inputs thousands of times and runs commands on what is left.

What fails is kept: a folder with the destroyed inputs, what was said, and `failure.json` with its number, seed,
mutations and problems. `--only NUMBER` repeats one.
"""

from __future__ import annotations

import argparse
import json
import shutil
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from multiprocessing import get_context
from pathlib import Path

import torch

from crowdmap_torch.ranges import Count, CountOrNone, Seed, Share, Workers, argument
from crowdmap_torch.soak.attempt import Verdict, attempt
from crowdmap_torch.soak.good import write_good
from crowdmap_torch.soak.verdict import digest

_BATCH = 250
"""Mutants after which a process makes its good inputs anew."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What `soak mutants` takes."""
    parser.add_argument("--count", type=argument(Count), default=10_000, metavar="N")
    parser.add_argument("--first", type=argument(CountOrNone), default=0, metavar="NUMBER")
    parser.add_argument("--only", type=argument(CountOrNone), metavar="NUMBER", help="that one")
    parser.add_argument("--seed", type=argument(Seed), default=0)
    parser.add_argument("--processes", type=argument(Workers), default=1, metavar="N")
    parser.add_argument(
        "--mapped", type=argument(Share), default=1.0, help="share that is mapped, not only read"
    )
    parser.add_argument("--keep", type=Path, default=Path("soak-failures"), metavar="FOLDER")


def run(options: argparse.Namespace) -> int:
    """Tries all mutants, prints what fails and a line of all; 0 if everything held."""
    options.keep = options.keep.resolve()
    numbers = range(options.first, options.first + options.count)
    if options.only is not None:
        numbers = range(options.only, options.only + 1)
    codes: Counter[tuple[str, int]] = Counter()
    begun, failures, longest, most = time.monotonic(), 0, 0.0, 0
    for verdict in _verdicts(numbers, options):
        outcome = verdict.outcome
        codes[verdict.kind, outcome.code] += 1
        longest, most = max(longest, outcome.seconds), max(most, outcome.resident_bytes)
        if verdict.problems:
            failures += 1
            print(f"{verdict.number}: {verdict.mutations}: {verdict.problems}", flush=True)
        if codes.total() % 100 == 0:
            print(f"{codes.total()} in {time.monotonic() - begun:.0f} s", flush=True)
    print(f"{codes.total()} mutants in {time.monotonic() - begun:.0f} s, {failures} failures;")
    print(f"the longest took {longest:.1f} s, the largest {most / 2**20:.0f} MB")
    for kind in sorted({kind for kind, _ in codes}):
        ended = ", ".join(f"{n} with {c}" for (k, c), n in sorted(codes.items()) if k == kind)
        print(f"{kind}: exit codes {ended}")
    return 1 if failures else 0


def soak(
    numbers: Sequence[int], seed: int, *, keep: Path, mapped: float = 1.0
) -> Iterator[Verdict]:
    """What came of one mutant for each number; what fails is kept in a folder of `keep`.

    Of the data sets only a share `mapped` is mapped, the others are read and looked over.
    """
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory(prefix="soak-") as temporary:
        folder = Path(temporary) / "good"
        good = write_good(folder)
        before = digest(folder)
        for number in numbers:
            place = Path(temporary) / f"{number}"
            verdict = attempt(good, place, number, seed, mapped=mapped)
            if digest(folder) != before:
                raise RuntimeError(f"mutant {number} of seed {seed} changed the good inputs")
            if verdict.problems:
                _keep(place, keep / f"{seed}-{number}", verdict, seed)
            yield verdict
            shutil.rmtree(place, ignore_errors=True)


def _keep(place: Path, folder: Path, verdict: Verdict, seed: int) -> None:
    folder.parent.mkdir(parents=True, exist_ok=True)
    shutil.rmtree(folder, ignore_errors=True)
    shutil.move(place, folder)
    content = {"seed": seed, **asdict(verdict)}
    (folder / "failure.json").write_text(json.dumps(content, indent=2) + "\n")


def _verdicts(numbers: Sequence[int], options: argparse.Namespace) -> Iterator[Verdict]:
    """The verdicts of all numbers, batch by batch in as many processes as there should be."""
    if options.processes == 1:
        yield from soak(numbers, options.seed, keep=options.keep, mapped=options.mapped)
        return
    size = min(1 + (len(numbers) - 1) // options.processes, _BATCH)
    batches = [numbers[k : k + size] for k in range(0, len(numbers), size)]
    tasks = [(batch, options.seed, options.keep, options.mapped) for batch in batches]
    with get_context("spawn").Pool(options.processes) as pool:
        for found in pool.imap_unordered(_batch, tasks):
            yield from found


def _batch(task: tuple[Sequence[int], int, Path, float]) -> list[Verdict]:
    numbers, seed, keep, mapped = task
    return list(soak(numbers, seed, keep=keep, mapped=mapped))
