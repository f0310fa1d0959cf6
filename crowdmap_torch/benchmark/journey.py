"""One drive at a time: how long a step takes, how much faster than the drive the batch is, whether memory stays flat."""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from crowdmap_torch.benchmark.devices import finish
from crowdmap_torch.config import METHODS, MapperConfig
from crowdmap_torch.geometry import se3
from crowdmap_torch.io.datasets import load_dataset
from crowdmap_torch.mapper import map_journey, map_journeys
from crowdmap_torch.ranges import CountOrNone, FrameRate, argument
from crowdmap_torch.single_journey import SingleJourneyMapper, frame_of
from crowdmap_torch.tables import Journey

REPORTS = 12
"""Lines of the table of an endless drive."""


@dataclass(frozen=True)
class StepTimes:
    """How long the steps of a drive took."""

    ms: Float[np.ndarray, " f"]
    fed_hz: float | None
    """Frames came at this rate; None: as soon as the last was done."""

    def row(self, name: str) -> str:
        """A line of the table."""
        fed = "flat out" if self.fed_hz is None else f"{self.fed_hz:g} Hz"
        median, p99 = np.quantile(self.ms, (0.5, 0.99))
        return (
            f"{name:<12}{fed:>10}{median:>12.1f}{p99:>12.1f}{self.ms.max():>12.1f}"
            f"{1000 / self.ms.mean():>14.0f}"
        )


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What `crowdmap benchmark journey` takes."""
    parser.add_argument("dataset", type=Path, help="folder of a dataset")
    parser.add_argument(
        "--journey", type=argument(CountOrNone), default=0, help="which of its journeys is driven"
    )
    parser.add_argument(
        "--rate", type=argument(FrameRate), default=15.0, help="frames a second of the camera"
    )
    parser.add_argument("--device", default="cuda", help="also mapped there, if there is one")
    parser.add_argument(
        "--endless",
        type=float,
        metavar="HOURS",
        help="instead: repeat the journey for so long a drive and watch the memory",
    )


def run(options: argparse.Namespace) -> None:
    """Prints the tables."""
    journeys = load_dataset(options.dataset).journeys
    journey = journeys[options.journey]
    if options.endless is not None:
        _endless(journey, options.endless, options.rate)
        return
    on_one_core()
    print(f"steps of {journey.journey_id}, {journey.frame_count} frames, one core")
    print(
        f"{'method':<12}{'fed':>10}{'median ms':>12}{'99 % ms':>12}{'max ms':>12}{'frames/s':>14}"
    )
    for method in METHODS:
        config = MapperConfig(method=method)
        for fed in (options.rate, None):
            print(step_times(journey, config, fed).row(method), flush=True)
    print(
        f"\nbatch of {len(journeys)} journeys, method joint, against a drive at {options.rate:g} Hz"
    )
    print(f"{'device':<12}{'seconds/journey':>18}{'times faster':>14}")
    devices = ["cpu"] + ([options.device] if torch.cuda.is_available() else [])
    for device in devices:
        seconds, faster = batch_speed(journeys, options.rate, device)
        print(f"{device:<12}{seconds:>18.2f}{faster:>14.1f}", flush=True)
    if len(devices) == 1:
        print(f"{options.device:<12}{'not installed':>18}")


def on_one_core() -> None:
    """Keeps this process, threads and all, on one core."""
    torch.set_num_threads(1)
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})


def step_times(journey: Journey, config: MapperConfig, fed_hz: float | None) -> StepTimes:
    """Times of every step of a drive, its frames fed at a rate as a camera would."""
    mapper = SingleJourneyMapper(journey.rig, config)
    frames = [frame_of(journey, index) for index in range(journey.frame_count)]
    ms = np.zeros(len(frames))
    begun = time.perf_counter()
    for index, frame in enumerate(frames):
        if fed_hz is not None:
            time.sleep(max(begun + index / fed_hz - time.perf_counter(), 0.0))
        start = time.perf_counter()
        mapper.step(frame)
        ms[index] = 1000 * (time.perf_counter() - start)
    mapper.finish()
    return StepTimes(ms, fed_hz)


def batch_speed(journeys: tuple[Journey, ...], rate_hz: float, device: str) -> tuple[float, float]:
    """Seconds per journey, and how much faster than the drives that is."""
    moved = tuple(journey.to(device) for journey in journeys)
    # What is paid once, such as the start of the device, is no part of the speed.
    map_journey(moved[0], 0, MapperConfig())
    start = time.perf_counter()
    map_journeys(moved, MapperConfig())
    finish(torch.device(device))
    spent = time.perf_counter() - start
    driven = sum(journey.frame_count for journey in journeys) / rate_hz
    return spent / len(journeys), driven / spent


def repeated(journey: Journey, count: int) -> Iterator[Journey]:
    """`count` frames of a drive that goes on for ever: the journey again and again, each where the last one ended."""
    frames = [frame_of(journey, index) for index in range(journey.frame_count)]
    first, last = journey.T_world_camera[0], journey.T_world_camera[-1]
    again = level_turn(first, last)
    period = int(journey.t_ns[-1] - journey.t_ns[0]) + int(torch.diff(journey.t_ns).median())
    onward = torch.eye(4, dtype=first.dtype, device=first.device)
    for number in range(count):
        lap, index = divmod(number, len(frames))
        if index == 0 and lap > 0:
            onward = onward @ again
        frame = frames[index]
        yield replace(
            frame,
            frame_number=frame.frame_number + lap * (int(journey.frame_number[-1]) + 1),
            t_ns=frame.t_ns + lap * period,
            T_world_camera=onward @ frame.T_world_camera,
        )


def level_turn(
    T_world_from: Float[Tensor, "4 4"], T_world_to: Float[Tensor, "4 4"]
) -> Float[Tensor, "4 4"]:
    """The motion about the world's vertical that takes one camera's place and direction to another's."""

    def level(T: Float[Tensor, "4 4"]) -> Float[Tensor, "4 4"]:
        heading = torch.atan2(T[1, 2], T[0, 2])
        zero = torch.zeros_like(heading)
        return se3.make(se3.so3_exp(torch.stack((zero, zero, heading))), T[:3, 3])

    return level(T_world_to) @ se3.inverse(level(T_world_from))


def _endless(journey: Journey, hours: float, rate_hz: float) -> None:
    total = round(hours * 3600 * rate_hz)
    mapper = SingleJourneyMapper(journey.rig)
    signs = lanes = 0
    print(f"{journey.journey_id} again and again: {total} frames, {hours:g} h at {rate_hz:g} Hz")
    print(f"{'driven h':<12}{'frames held':>12}{'memory MB':>12}{'signs':>10}{'lane pieces':>14}")
    for number, frame in enumerate(repeated(journey, total), start=1):
        result = mapper.step(frame)
        signs += 0 if result.signs is None else len(result.signs)
        lanes += 0 if result.lanes is None else len(result.lanes)
        if number % max(total // REPORTS, 1) == 0:
            print(
                f"{number / rate_hz / 3600:<12.2f}{mapper.frames_held:>12}{resident_mb():>12.0f}"
                f"{signs:>10}{lanes:>14}",
                flush=True,
            )
    mapper.finish()


def resident_mb() -> float:
    """Memory of this process that is in use; NaN where the system does not say."""
    status = Path("/proc/self/statm")
    if not status.exists():
        return float("nan")
    return int(status.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20
