"""Maps of good data sets beside those of the same sets with a mistake, and of what `crowdmap check --fix` made of these.

Prints for each set and mistake how many signs the map has, their relative error against the survey, how far signs are from
those of the good set's map, and the lanes' recall. What is mapped in spite of a mistake shows what the mistake costs.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import torch

from crowdmap_torch.checking.check import check_dataset
from crowdmap_torch.checking.repair import write_repaired
from crowdmap_torch.config import MapperConfig
from crowdmap_torch.evaluation.evaluate import evaluate_map
from crowdmap_torch.evaluation.map_figures import MapFigures
from crowdmap_torch.io.datasets import load_dataset
from crowdmap_torch.io.surveys import read_survey
from crowdmap_torch.mapper import build_map
from crowdmap_torch.soak.spoiled import MISTAKES, spoiled
from crowdmap_torch.soak.varied import GOOD, write_good_set
from crowdmap_torch.tables import Dataset, HdMap

_MISTAKES = ("w-x-y-z", "north-east-down", "rounded")
_MOVED = ("utm",)
"""Made by moving the drives to where no survey is."""
_MENDED = "put right"
_CHOICES = [name for name in MISTAKES if name not in _MOVED]


@dataclass(frozen=True)
class Mapped:
    """A map of a data set, and its figures against the survey of the good one."""

    hd_map: HdMap
    figures: MapFigures


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What `soak mended` takes."""
    parser.add_argument("--sets", nargs="+", choices=[*GOOD], default=["winding"], metavar="NAME")
    parser.add_argument(
        "--only", nargs="+", choices=_CHOICES, default=[*_MISTAKES], metavar="MISTAKE"
    )


def run(options: argparse.Namespace) -> int:
    """Maps all and prints the table; 0 if each set that was put right gave a map with as many signs as the good one."""
    print(f"{'set':<12} {'map of':<30} {'signs':>5} {'relative':>9} {'from good':>10} {'lanes':>6}")
    lost = 0
    with tempfile.TemporaryDirectory(prefix="soak-") as temporary:
        for set_name in options.sets:
            place = Path(temporary) / set_name.replace(" ", "-")
            write_good_set(set_name, place / "good")
            survey = place / "good" / "survey"
            good = mapped(load_dataset(place / "good"), survey)
            _show(set_name, "the good set", good, good)
            for mistake in options.only:
                bad = spoiled(place / "good", place / f"{mistake}-bad", mistake)
                for what, dataset in _of_both(bad, place / f"{mistake}-new"):
                    made = None if dataset is None else mapped(dataset, survey)
                    _show(set_name, f"{mistake}, {what}", made, good)
                    count = 0 if made is None else len(made.hd_map.signs)
                    is_whole = count == len(good.hd_map.signs) or MISTAKES[mistake].leaves
                    lost += what == _MENDED and not is_whole
    return 1 if lost else 0


def _of_both(bad: Path, new: Path) -> Iterator[tuple[str, Dataset | None]]:
    check = check_dataset(bad)
    yield "as it is", check.dataset
    yield _MENDED, write_repaired(bad, new, check).check.dataset


def mapped(dataset: Dataset, survey: Path) -> Mapped:
    """The map of all journeys; its figures are against the surveyed signs and lanes."""
    torch.set_num_threads(1)
    made = build_map(dataset, MapperConfig()).hd_map
    return Mapped(made, evaluate_map(made, read_survey(survey)))


def _show(set_name: str, what: str, made: Mapped | None, good: Mapped) -> None:
    begin = f"{set_name:<12} {what:<30}"
    if made is None:
        print(f"{begin} refused", flush=True)
        return
    signs, lanes = made.figures.signs, made.figures.lanes
    recall = "-" if lanes is None else f"{lanes.recall:.1%}"
    away = farthest(good.hd_map, made.hd_map)
    print(
        f"{begin} {len(made.hd_map.signs):>5} {signs.relative.total.mean:>7.3f} m {away:>8.1g} m {recall:>6}",
        flush=True,
    )


def farthest(good: HdMap, other: HdMap) -> float:
    """How far a sign of one map is from the nearest one of another, at most [m]; infinite if that has none."""
    if not len(other.signs):
        return float("inf")
    away = torch.cdist(good.signs.center_world, other.signs.center_world)
    return float(away.amin(1).max())
