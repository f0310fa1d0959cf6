"""The mapper's own adjustment of many drives, on a CPU and on a GPU: `crowdmap benchmark adjustment DATASET`.

Both start from the same bundle. What is timed is the adjustment alone, from its start to its last step.
"""

from __future__ import annotations

import argparse
import copy
import statistics
import time
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import torch
from torch import Tensor

from crowdmap_torch import mapper
from crowdmap_torch.adjustment import adjust
from crowdmap_torch.adjustment.bundle import Bundle
from crowdmap_torch.benchmark.devices import finish, there
from crowdmap_torch.config import MapperConfig
from crowdmap_torch.fleet.choice import engine_of
from crowdmap_torch.io.datasets import load_dataset
from crowdmap_torch.processes.threads import one_core_each, repeatable
from crowdmap_torch.ranges import Workers, argument


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What `crowdmap benchmark adjustment` takes."""
    parser.add_argument("dataset", type=Path, help="folder of a dataset")
    parser.add_argument("--device", default="cuda", help="adjusted there too, if it is there")
    parser.add_argument("--threads", type=argument(Workers), default=2, help="of the CPU's run")
    parser.add_argument(
        "--workers", type=argument(Workers), help="journeys mapped at a time, before it begins"
    )


def run(options: argparse.Namespace) -> None:
    """Prints a line for each device, and how far apart they end."""
    # What is asked for wrongly is said before anything is mapped.
    devices = [torch.device("cpu"), there(options.device)]
    config, dataset = MapperConfig(), load_dataset(options.dataset)
    with engine_of(None, workers=options.workers) as engine:
        maps = mapper.map_journeys(dataset.journeys, config, engine=engine)
    first = mapper.first_map(dataset.journeys, maps, config)
    bundle = mapper.build_bundle(dataset.journeys, maps, first, config)
    torch.set_num_threads(options.threads)
    frames = sum(journey.frame_count for journey in dataset.journeys)
    print(f"{len(dataset.journeys)} journeys, {frames} frames, {len(first.signs)} signs")
    print(f"{'device':<8}{'start':>10}{'steps':>8}{'median':>10}{'in all':>10}{'cost':>18}")
    runs = []
    for device in devices:
        if device is None:
            print(f"{options.device:<8}{'not there':>10}")
            return
        runs.append(_adjusted(copy.deepcopy(bundle), device))
        print(f"{device!s:<8}{runs[-1].line()}", flush=True)
    cpu, other = runs
    print(f"{cpu.total_s / other.total_s:.1f} times faster; largest differences:")
    for name, value in cpu.values.items():
        if value.numel():
            print(f"  {name:<10}{float((value - other.values[name]).abs().max()):>10.1e}")


@dataclass(frozen=True)
class Adjusted:
    """An adjustment on one device."""

    start_s: float
    steps_s: list[float]
    cost: float
    values: dict[str, Tensor]
    """Of every variable at the end, on the CPU."""

    @property
    def total_s(self) -> float:
        """Start and steps."""
        return self.start_s + sum(self.steps_s)

    def line(self) -> str:
        """Of the table."""
        median = statistics.median(self.steps_s)
        return (
            f"{self.start_s:>8.2f} s{len(self.steps_s):>8}{median:>8.2f} s"
            f"{self.total_s:>8.1f} s{self.cost:>18.6f}"
        )


@one_core_each()
def _adjusted(bundle: Bundle, device: torch.device) -> Adjusted:
    """The adjustment of a bundle, moved there before the clock starts."""
    repeatable(device)
    bundle = bundle.to(device)
    finish(device)
    times = [time.perf_counter()]
    last = begun = adjust.start(bundle)
    finish(device)
    times.append(time.perf_counter())
    for _, after, _ in adjust.steps(bundle, begun):
        last = after
        finish(device)
        times.append(time.perf_counter())
    start_s, *steps_s = (b - a for a, b in pairwise(times))
    values = {name: value.detach().cpu() for name, value in last.values.items()}
    return Adjusted(start_s, steps_s, float(last.cost), values)
