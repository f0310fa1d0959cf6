"""A data set with its mistakes put right, as a new one: in rounds, since some hide others."""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from crowdmap_torch.checking.changes import CHANGES, Changed, Task
from crowdmap_torch.checking.check import Check, Item, check_dataset
from crowdmap_torch.config import MapperConfig
from crowdmap_torch.io.atomic import atomic_folder
from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.remote import Place
from crowdmap_torch.plausibility.finding import Repair

_MOST_ROUNDS = 6
"""No more mistakes hide one another."""


@dataclass(frozen=True)
class Mended:
    """What was changed, and what is found in what came of it."""

    changes: tuple[str, ...]
    """Each in a line."""
    check: Check


def write_repaired(
    folder: Path, new: Path, before: Check, config: MapperConfig | None = None
) -> Mended:
    """Writes the data set in `folder` to `new` with all of `before` put right that has one cure, and checks that again.

    `new` is complete or not there. InputError if it exists, or nothing can be put right.
    """
    refuse_place(folder, new)
    if not any(item.repairs for item in before.items):
        raise InputError(f"{folder}: nothing in it that --fix can put right; {new} is not written")
    with atomic_folder(new) as beside:
        shutil.copytree(folder, beside, symlinks=True, dirs_exist_ok=True)
        check, lines, done = before, [], set()
        for _ in range(_MOST_ROUNDS):
            wanted = [one for one in _wanted(check) if one[1:] not in done]
            if not wanted:
                break
            # What did not help once is not done again.
            done.update(one[1:] for one in wanted)
            lines += _applied(beside, check, wanted)
            check = check_dataset(beside, config)
    return Mended(tuple(lines), check)


_TURNS = ("quaternion-order", "inverse-poses", "axes")
"""Changes after which heights are others."""


def _wanted(check: Check) -> list[tuple[Item, str, Repair]]:
    every = [(item, journey, repair) for item in check.items for journey, repair in item.repairs]
    turned = {journey for _, journey, repair in every if repair.name in _TURNS}
    return [one for one in every if one[2].name != "heights" or one[1] not in turned]


def refuse_place(dataset: Place, new: Path) -> None:
    """InputError if nothing may be written to `new`."""
    if isinstance(dataset, Path):
        here, there = Path(os.path.realpath(dataset)), Path(os.path.realpath(new))
        if there.is_relative_to(here) or here.is_relative_to(there):
            rule = f"inside {dataset}, or around it; choose another folder for --fix"
            raise InputError(f"{new}: {rule}")
    if os.path.lexists(new):
        raise InputError(f"{new}: exists; expected the name of a new folder for --fix")


def _applied(folder: Path, check: Check, wanted: Sequence[tuple[Item, str, Repair]]) -> list[str]:
    """Carries out the changes; a line for each kind of them, with how many files it was done to."""
    lines: dict[tuple[str, str], list[Changed]] = {}
    rigs_done: set[tuple[str, Repair]] = set()
    for item, journey, repair in wanted:
        change = CHANGES[repair.name]
        changed = change(Task(folder, journey, repair, item.file, check.dataset, rigs_done))
        if changed is not None:
            lines.setdefault((item.cause, changed.what), []).append(changed)
    return [
        f"{cause}: {what} ({_places([c.place for c in changed])})"
        for (cause, what), changed in lines.items()
    ]


def _places(places: Sequence[str]) -> str:
    named = list(dict.fromkeys(places))
    more = f" and {len(named) - 3} more" if len(named) > 3 else ""
    return ", ".join(named[:3]) + more
