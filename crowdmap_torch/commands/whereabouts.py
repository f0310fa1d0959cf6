"""Where `crowdmap optimize` works, by `--device`, `--engine`, `--workers` and `--address`."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import TypedDict

import torch

from crowdmap_torch import mapper
from crowdmap_torch.adjustment.bundle import Bundle
from crowdmap_torch.config import MapperConfig
from crowdmap_torch.fleet.choice import engine_of
from crowdmap_torch.fleet.engine import Engine, Spent
from crowdmap_torch.io.budget import reading
from crowdmap_torch.io.errors import input_read, needing
from crowdmap_torch.io.remote import Place, at_hand
from crowdmap_torch.io.stored_drives import StoredDrive, stored_drives
from crowdmap_torch.plausibility.dataset import Look, look_over
from crowdmap_torch.processes.progress import silent
from crowdmap_torch.processes.threads import repeatable
from crowdmap_torch.processes.workers import WorkerLost
from crowdmap_torch.tables import Dataset, Tracklets, to_device


class ByWhom(TypedDict):
    """What `mapper.map_journeys` is told of who works."""

    engine: Engine | None
    stored: Sequence[StoredDrive] | None
    tracklets: Mapping[int, Tracklets]


class Whereabouts(ExitStack):
    """The device and the engine of a run, and the workers that look at its journeys and map them.

    A context manager that ends the workers, if they have not been ended.
    """

    def __init__(self, options: argparse.Namespace) -> None:
        """ValueError if what is asked for is not there; nothing is begun."""
        super().__init__()
        self._options = options
        self.device = _device(options.device)
        """Where the map is made of the journeys."""
        self.engine = _engine(options)
        self.of_journeys = self.device if self.engine.name == "local" else torch.device("cpu")
        """Where journeys are read and mapped: by other processes on CPUs, which are faster at it than a GPU."""
        self.at_work: Engine | None = None
        """The engine, where there is work for it."""
        self.at_hand = Path()
        """The folder of the data set that was brought."""
        self.stored: tuple[StoredDrive, ...] | None = None
        """Where workers find the journeys; None: they are handed over."""
        self._starting = 0

    def begin(self, *, is_needed: bool) -> None:
        """Begins the engine if there is work for it and it has not been begun."""
        if is_needed and self.at_work is None:
            with input_read():
                self.at_work = self.enter_context(self.engine)

    def begin_early(self, place: Place) -> None:
        """Begins workers beside this process for the journeys of a data set that is yet to be read.

        They import what they need, which takes seconds, while it is read.
        """
        if self.engine.name != "processes":
            return
        self.begin(is_needed=True)
        with suppress(OSError):
            most = self.engine.free
            if isinstance(place, Path):
                most = min(most, sum(1 for _ in (place / "journeys").iterdir()))
            for number in range(most):
                # To come to it, a worker imports all that mapping a journey takes.
                self.engine.submit(number, ("the start of a worker", silent, ()))
                self._starting += 1

    def bring(self, place: Place, journeys: Sequence[str] | None) -> None:
        """Has those journeys of a data set at hand: where they are or, until all are mapped, in a copy; copying is told."""
        if not isinstance(place, Path) and not self._options.quiet:
            print(f"copying {place}", file=sys.stderr)
        self.at_hand = self.enter_context(at_hand(place, journeys))

    def _await_workers(self) -> None:
        """Waits for the workers that were begun early."""
        while self._starting:
            try:
                self._starting -= len(self.engine.gather())
            except WorkerLost:
                # The first task begins another one.
                self._starting -= 1

    def looked_over(
        self, place: Place, dataset: Dataset, config: MapperConfig, digests: Mapping[str, str]
    ) -> Look:
        """What looks wrong with the data set at hand, by the workers; `digests` are those of the journeys, by id."""
        if self.engine.name == "ray":
            # Workers may be elsewhere. Those beside this process would take longer to read a journey than to be handed it.
            self.stored = stored_drives(place, dataset, digests, config.reading)
        self._await_workers()
        noise, association = config.positioning, config.sign_association
        with reading(config.reading):
            look = look_over(
                *(self.at_hand, dataset, noise, association),
                engine=self.at_work,
                stored=self.stored,
            )
        # What metrics.json says that workers took is mapping's.
        self.engine.spent = Spent()
        return look

    def by_whom(self, look: Look, config: MapperConfig) -> ByWhom:
        """Who maps journeys, and the signs that were told apart for the look where mapping would do it alike."""
        is_alike = config.resolved().sign_association == config.sign_association
        tracklets = look.tracklets if is_alike and self.of_journeys.type == "cpu" else {}
        return {"engine": self.at_work, "stored": self.stored, "tracklets": tracklets}

    def mapped(
        self, dataset: Dataset, maps: tuple[mapper.JourneyMap, ...]
    ) -> tuple[Dataset, tuple[mapper.JourneyMap, ...]]:
        """The journeys and their maps where the map is made; the workers are ended."""
        self.close()
        return to_device((dataset, maps), self.device)

    def of_convoys(self, bundle: Bundle) -> Engine | None:
        """An engine for the convoys of an adjustment, begun; None: there is one convoy, for this process.

        What is on a GPU stays in this process.
        """
        if len(bundle.convoys) == 1:
            return None
        on_gpu = self.device.type == "cuda"
        engine = engine_of("local") if on_gpu else _engine(self._options)
        engine.spent = self.engine.spent
        with input_read():
            return self.enter_context(engine)


def _device(name: str) -> torch.device:
    if name.startswith("cuda") and not torch.cuda.is_available():
        raise ValueError(f"--device {name}: no CUDA device is there; use --device cpu")
    try:
        device = torch.device(name)
    except RuntimeError:
        raise ValueError(f"--device {name}: expected cpu or cuda") from None
    repeatable(device)
    return device


def _engine(options: argparse.Namespace) -> Engine:
    """Where journeys are mapped, not begun yet."""
    name = options.engine
    with needing(f"--engine {name}", "'crowdmap_torch[ray]'"):
        return engine_of(name, workers=options.workers, address=options.address)
