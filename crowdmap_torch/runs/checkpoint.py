"""What an interrupted run had finished: kept stage by stage under RUN, and taken up again by `--resume`.

    RUN/checkpoint/
      inputs.json          what the run is made of: configuration, hash of every journey, survey, versions
      journeys/00000.pt    what each journey shows by itself, as soon as it is known (section IV)
      first_map.pt         clusters, biases and the map of the cluster heads (V-A)
      start.pt             the pixel residuals before the adjustment, for the report
      step.pt              where the adjustment stands after its last step, and its course (V-B)
      anew.pt              what it began again with, and its course up to there, where signs turned out to be one

Nothing in it is taken on trust: a run goes on only with what it was made of, a stage that is damaged is made anew, and as
every stage gives the same bits from the same input, so does the map.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, TypeVar

import torch

from crowdmap_torch import __version__
from crowdmap_torch.adjustment.adjust import Standing
from crowdmap_torch.config import MapperConfig, as_dict
from crowdmap_torch.io.atomic import drop_halves
from crowdmap_torch.io.documents import read_json, write_json
from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.stages import read_stage, write_stage
from crowdmap_torch.io.trees import digest
from crowdmap_torch.io.truth import Truth
from crowdmap_torch.mapper import FirstMap, JourneyMap
from crowdmap_torch.noise.calibration import KnownCalibration
from crowdmap_torch.report.watch import Course, Residuals
from crowdmap_torch.tables import Dataset, Survey

_FORMAT = "crowdmap-checkpoint"
_MOST_NAMED = 4
"""Differences that a refusal names; the others are counted."""
Kind = TypeVar("Kind")


@dataclass(frozen=True)
class Step:
    """The last step of the adjustment that was taken."""

    standing: Standing
    course: Course
    """Of all steps up to it."""
    anew: int
    """How often the map that it began with had been made anew."""


@dataclass(frozen=True)
class Anew:
    """What the adjustment began again with."""

    first: FirstMap
    course: Course
    """Of all steps up to there."""


@dataclass(frozen=True)
class Found:
    """The stages of an interrupted run that need not be made again."""

    journeys: Mapping[int, JourneyMap] = field(default_factory=dict)
    """By number."""
    first: FirstMap | None = None
    start: Residuals | None = None
    """Before the first step."""
    again: Anew | None = None
    step: Step | None = None
    """Of the last beginning."""
    damaged: tuple[str, ...] = ()
    """What is made anew, and why."""

    @property
    def steps(self) -> int:
        """How many steps were taken since the adjustment last began."""
        return 0 if self.step is None else self.step.standing.steps

    @property
    def course(self) -> Course:
        """The steps that were taken, as they were watched."""
        last = self.step or self.again
        return Course(()) if last is None else last.course

    def lines(self, journeys: int) -> list[str]:
        """What was damaged, a line each, and in the last one what was found."""
        parts = [f"{len(self.journeys)} of {journeys} journeys"]
        if self.first is not None:
            parts.append("clusters and biases")
        if self.step is not None:
            parts.append(f"step {len(self.course.iterations)}")
        return [*(f"{what}; it is made anew" for what in self.damaged), ", ".join(parts)]


class Checkpoint:
    """The stages that one run keeps in a folder."""

    def __init__(self, folder: Path, inputs: Mapping[str, Any]) -> None:
        """`inputs` is what `inputs_of` gives."""
        self.folder = folder
        self._inputs = json.loads(json.dumps(inputs))
        text = json.dumps(self._inputs, sort_keys=True)
        self._key = hashlib.sha256(text.encode()).hexdigest()

    def is_finished(self, map_folder: Path) -> bool:
        """Whether the run came to its end and its map is still there.

        InputError if it was begun with other inputs, naming what differs.
        """
        kept = self._kept()
        if kept is None:
            return False
        before, now = _flat(kept["inputs"]), _flat(self._inputs)
        differ = [
            _difference(name, before.get(name), now.get(name))
            for name in sorted({*before, *now})
            if before.get(name) != now.get(name)
        ]
        if differ:
            more = f" and {len(differ) - _MOST_NAMED} more" if len(differ) > _MOST_NAMED else ""
            raise InputError(
                f"{self.folder.parent}: was begun with something else: "
                f"{'; '.join(differ[:_MOST_NAMED])}{more}. Resume with what it was begun with, or "
                "start anew with --overwrite."
            )
        return kept["finished"] and map_folder.exists()

    def begin(self) -> None:
        """Says what the run is made of."""
        self._write(finished=False)

    def finish(self) -> None:
        """Says that the run is finished, and removes the stages; what it was made of stays."""
        self._write(finished=True)
        self.drop_stages()

    def drop_stages(self) -> None:
        """Removes the stages of a run that is finished."""
        shutil.rmtree(self.folder / "journeys", ignore_errors=True)
        for name in ("first_map", "start", "anew", "step"):
            self._path(name).unlink(missing_ok=True)
        drop_halves(self.folder)

    def found(self, journeys: int, *, device: torch.device) -> Found:
        """All stages that were kept of a run with so many journeys."""
        damaged: list[str] = []

        def read(name: str, kind: type[Kind]) -> Kind | None:
            try:
                return read_stage(self._path(name), kind, key=self._key, device=device)
            except (ValueError, OSError) as error:
                damaged.append(str(error))
                return None

        maps = {n: read(_of_journey(n), JourneyMap) for n in range(journeys)}
        known = {number: made for number, made in maps.items() if made is not None}
        first, start = read("first_map", FirstMap), read("start", Residuals)
        again, step = read("anew", Anew), read("step", Step)
        if start is None:
            return Found(known, first, damaged=tuple(damaged))
        # A run may have ended between the two: the step is of the beginning before then.
        if step is not None and step.anew != (0 if again is None else again.first.anew):
            step = None
        return Found(known, first, start, again, step, tuple(damaged))

    def keep_journey(self, number: int, made: JourneyMap) -> None:
        """Keeps what the `number`-th journey shows by itself."""
        self._keep(_of_journey(number), made)

    def keep_first(self, first: FirstMap) -> FirstMap:
        """Keeps the map of the cluster heads, and hands it back."""
        self._keep("first_map", first)
        return first

    def keep_start(self, residuals: Residuals) -> None:
        """Keeps the residuals before the first step."""
        self._keep("start", residuals)

    def keep_step(self, standing: Standing, course: Course, anew: int) -> None:
        """Keeps a step in place of the one before; how often the map that it began with had been made `anew`."""
        self._keep("step", Step(standing, course, anew))

    def keep_anew(self, first: FirstMap, course: Course) -> FirstMap:
        """Keeps what the adjustment begins again with, and hands it back."""
        self._keep("anew", Anew(first, course))
        return first

    def _keep(self, name: str, value: object) -> None:
        write_stage(self._path(name), value, key=self._key)

    def _path(self, name: str) -> Path:
        return self.folder / f"{name}.pt"

    def _kept(self) -> dict[str, Any] | None:
        path = self.folder / "inputs.json"
        if not path.exists():
            return None
        head = read_json(path)
        head.require_format(_FORMAT)
        inputs, finished = head.take("inputs"), head.take("finished")
        if not isinstance(inputs, dict) or not isinstance(finished, bool):
            raise head.fault("expected what a run is made of; start anew with --overwrite")
        return {"inputs": inputs, "finished": finished}

    def _write(self, *, finished: bool) -> None:
        content = {"format": _FORMAT, "version": 1, "finished": finished, "inputs": self._inputs}
        write_json(self.folder / "inputs.json", content)


def inputs_of(
    dataset: Dataset,
    config: MapperConfig,
    survey: Survey | None,
    truth: Truth | None,
    control: Survey | None,
    known_cars: Mapping[str, KnownCalibration] | None = None,
    *,
    device: torch.device,
) -> dict[str, Any]:
    """What a run is made of, by name: the configuration in full, of everything else a hash or a version."""
    known = None
    if truth is not None:
        known = [{f.name: getattr(t, f.name) for f in fields(t)[1:]} for t in truth.journeys]
    beside = {"survey": survey, "truth of the survey": known, "control": control}
    beside["calibration"] = known_cars or None
    return {
        "crowdmap": __version__,
        "torch": torch.__version__,
        "device": device.type,
        "configuration": _written(config),
        "dataset": {"origin": digest(dataset.origin), "types": digest(dataset.type_names)},
        "journey": {journey.journey_id: digest(journey) for journey in dataset.journeys},
        **({} if dataset.bbox is None else {"bbox": [*dataset.bbox]}),
        **{name: digest(table) for name, table in beside.items() if table is not None},
    }


def _written(config: MapperConfig) -> dict[str, Any]:
    """The configuration as JSON can have it: numbers without end, which switch terms off, as YAML spells them."""
    return json.loads(json.dumps(as_dict(config)), parse_constant=lambda _: ".inf")


def _of_journey(number: int) -> str:
    return f"journeys/{number:05d}"


def _flat(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Every value by its path."""
    found: dict[str, Any] = {}
    for key, value in tree.items():
        name = (
            f"{prefix} {key}" if prefix in ("", "journey", "configuration") else f"{prefix}.{key}"
        )
        name = name.strip()
        found.update(_flat(value, name) if isinstance(value, dict) else {name: value})
    return found


def _difference(name: str, before: Any, now: Any) -> str:
    if before is None:
        return f"{name} is new"
    if now is None:
        return f"{name} is not there any more"
    hashed = not name.startswith(("configuration", "crowdmap", "torch", "device", "bbox"))
    return f"{name} has changed" if hashed else f"{name} was {before}, is {now}"
