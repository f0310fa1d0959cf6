"""Makes the usual mistakes on good data sets: what `crowdmap check` says of them, and what its `--fix` makes of them.

Prints a line for each mistake and good data set where something is not as it should be, and a table: in how many sets a
mistake was named by its right cause and by no other, and in how many it was put right, so that the drives are those of
the good set again, or near to them.
"""

from __future__ import annotations

import argparse
import itertools
import shutil
import tempfile
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import torch

from crowdmap_torch.checking.check import NOTE, Check, check_dataset
from crowdmap_torch.checking.repair import write_repaired
from crowdmap_torch.soak.spoiled import MISTAKES, spoiled
from crowdmap_torch.soak.varied import GOOD, write_good_set
from crowdmap_torch.tables import Dataset, Journey

_FEW = ("one drive", "no signs", "no lanes")
"""Good sets in which mistakes are not made: too little is there to show them all."""
NEAR = {"place_m": 2e-3, "turn_rad": 1e-5, "time_s": 1.1e-3, "pixel": 2e-3, "rig": 1e-6}
"""How far a data set that was put right may be from the good one and still be it."""
ROUGH = {
    "rounded": {"turn_rad": 0.02, "place_m": 0.06},
    "whole-pixels": {"pixel": 0.72},
    "boxes": {"detections": 0.03},
    "unit-pixels": {"pixel": 2e-2},
    "row-by-row": {"detections": 0.03},
    "frames-late": {"detections": 0.03},
    "last-fix": {"place_m": 0.6, "turn_rad": 0.02},
    "overlap": {"detections": 0.02},
}
"""What else a mistake has taken away for good: of outlines that are detected wrongly some are left out in one set only,
frames at the ends of drives are lost, a car that drives back over its way sees the same once more, and
where it was between two fixes is not known."""


@dataclass(frozen=True)
class Outcome:
    """What became of one mistake on one good set."""

    named: bool
    cured: bool
    told: str
    """What was found, and how far what was put right is from the good set."""
    hidden: str = ""
    """What is said where it does not show, and why."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What `soak mistakes` takes."""
    parser.add_argument("--sets", nargs="+", choices=[*GOOD], default=[*GOOD], metavar="NAME")
    parser.add_argument(
        "--only", nargs="+", choices=[*MISTAKES], default=[*MISTAKES], metavar="MISTAKE"
    )
    parser.add_argument(
        "--seeds", nargs="+", type=int, metavar="SEED", help="sets of these seeds, not their own"
    )
    parser.add_argument("--folder", type=Path, help="keep the data sets here")


def run(options: argparse.Namespace) -> int:
    """Tries all, prints what fails and the table; 0 if good sets are sound, and all mistakes named and put right."""
    torch.set_num_threads(1)
    named: Counter[str] = Counter()
    cured: Counter[str] = Counter()
    tried: Counter[str] = Counter()
    alarms = short = good_sets = 0
    with tempfile.TemporaryDirectory(prefix="soak-") as temporary:
        folder = options.folder or Path(temporary)
        for set_name, seed in itertools.product(options.sets, options.seeds or [None]):
            label = set_name if seed is None else f"{set_name} {seed}"
            good = folder / label.replace(" ", "-")
            if not good.exists():
                write_good_set(set_name, good, seed)
            sound = check_dataset(good)
            found = grave(sound)
            alarms += bool(found)
            good_sets += 1
            print(f"{label}: {', '.join(sorted(found)) or 'nothing found'}", flush=True)
            for mistake in () if set_name in _FEW else options.only:
                if sound.dataset is None or not MISTAKES[mistake].can_be_made(sound.dataset):
                    continue
                outcome = attempt(good, sound.dataset, Path(temporary) / "attempt", mistake)
                tried[mistake] += 1
                named[mistake] += outcome.named
                cured[mistake] += outcome.cured
                expected = MISTAKES[mistake]
                if outcome.named and outcome.cured == expected.is_cured:
                    continue
                is_hidden = expected.may_hide and not outcome.told
                is_hidden &= bool(outcome.hidden) or not expected.hidden_as
                short += not is_hidden
                told = outcome.told or "nothing found"
                print("; ".join(filter(None, (f"  {mistake}: {told}", outcome.hidden))), flush=True)
    print(f"\n{'mistake':<18} {'named':>7} {'put right':>10}")
    for mistake in options.only:
        of = tried[mistake]
        right = f"{cured[mistake]}/{of}" if MISTAKES[mistake].is_cured else "-"
        print(f"{mistake:<18} {f'{named[mistake]}/{of}':>7} {right:>10}")
    print(f"false alarms: {alarms} of {good_sets} good data sets")
    return 1 if alarms or short else 0


def attempt(good: Path, drives: Dataset | None, place: Path, mistake: str) -> Outcome:
    """Makes a mistake on a copy of a good set, whose drives these are, checks that, and puts it right."""
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir(parents=True)
    bad = spoiled(good, place / "bad", mistake)
    check = check_dataset(bad)
    told = ", ".join(
        f"{i.kind}: {i.evidence}: {i.cause}" for i in check.items if i.severity != NOTE
    )
    is_named = names(check, mistake)
    if not any(item.repairs for item in check.items):
        note = MISTAKES[mistake].hidden_as
        hidden = ", ".join(i.evidence for i in check.items if note and i.kind == note)
        return Outcome(is_named, False, told, hidden)
    mended = write_repaired(bad, place / "new", check)
    left = grave(mended.check) ^ ({MISTAKES[mistake].leaves} - {""})
    away = differences(drives, mended.check.dataset)
    near = is_near(away, mistake)
    far = ", ".join(f"{name} {value:.2g}" for name, value in away.items())
    return Outcome(
        is_named,
        near and not left,
        f"{told}; put right: {sorted(grave(mended.check))} left, off by {far}",
    )


def grave(check: Check) -> set[str]:
    """The kinds of findings that stop or spoil a map."""
    return {item.kind for item in check.items if item.severity != NOTE}


def names(check: Check, mistake: str) -> bool:
    """Whether a mistake is named by its cause and by no other."""
    expected = MISTAKES[mistake]
    items = [i for i in check.items if i.severity != NOTE or i.kind == expected.kind]
    return bool(items) and all(i.kind == expected.kind and expected.cause in i.cause for i in items)


def is_near(away: Mapping[str, float], mistake: str) -> bool:
    """Whether what was put right is the good set again, but for what the mistake itself took away."""
    allowed = {**NEAR, "detections": 0.0, **ROUGH.get(mistake, {})}
    return all(value <= allowed[name] for name, value in away.items())


def differences(theirs: Dataset | None, ours: Dataset | None) -> dict[str, float]:
    """How far the drives of a set that was put right are from those of the good one, at most; None: it has none."""
    if theirs is None or ours is None:
        return dict.fromkeys((*NEAR, "detections"), float("inf"))
    away = dict.fromkeys((*NEAR, "detections"), 0.0)
    for a, b in _pairs(ours, theirs):
        for name, value in _of_journeys(a, b):
            away[name] = max(away[name], value)
    counts = [sum(len(j.signs) + len(j.lanes) for j in d.journeys) for d in (ours, theirs)]
    away["detections"] = max(away["detections"], abs(counts[0] - counts[1]) / counts[1])
    return away


def _pairs(ours: Dataset, theirs: Dataset) -> Iterator[tuple[Journey, Journey]]:
    """Journeys by name; of what was cut into pieces the frames that they have in common."""
    known = {j.journey_id: j for j in theirs.journeys}
    first = theirs.journeys[0]
    for journey in ours.journeys:
        other = known.get(journey.journey_id, first)
        rows = torch.nonzero(torch.isin(other.frame_number, journey.frame_number))[:, 0]
        yield journey, other if len(rows) == other.frame_count else other.with_frames(rows)


def _of_journeys(a: Journey, b: Journey) -> Iterator[tuple[str, float]]:
    T, S = a.T_world_camera, b.T_world_camera
    if len(T) != len(S):
        yield "detections", float("inf")
        return
    yield "place_m", float((T[:, :3, 3] - S[:, :3, 3]).abs().max())
    yield "turn_rad", float((T[:, :3, :3] - S[:, :3, :3]).abs().max())
    yield "time_s", float((a.t_ns - b.t_ns).abs().max()) * 1e-9
    yield "rig", float((a.rig.road_normal_camera - b.rig.road_normal_camera).abs().max())
    yield "rig", abs(a.rig.camera_height - b.rig.camera_height)
    for rows, others in ((a.signs, b.signs), (a.lanes, b.lanes)):
        yield "detections", abs(len(rows) - len(others)) / max(len(others), 1)
    if len(a.signs) == len(b.signs) and bool((a.signs.frame == b.signs.frame).all()):
        px, other = a.signs.corners_px, b.signs.corners_px
        # Rows of a frame are in the order of their corners, which may begin elsewhere.
        middle = [p.amin(1) + p.amax(1) for p in (px, other)]
        yield "pixel", float((middle[0].sort(0).values - middle[1].sort(0).values).abs().max()) / 2
    if len(a.lane_points) == len(b.lane_points):
        yield "pixel", float((a.lane_points.px - b.lane_points.px).abs().max())
