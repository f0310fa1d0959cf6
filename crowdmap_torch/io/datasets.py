"""Datasets on disk to `tables.Dataset`: what FORMAT.md asks for is checked here, at the door."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch

from crowdmap_torch.io.budget import reading, refuse_way_out
from crowdmap_torch.io.copies import SAME_PX, copies
from crowdmap_torch.io.detections import (
    DROPPED_LANE,
    DROPPED_SIGN,
    FROZEN,
    read_lane_detections,
    read_sign_detections,
    seen_in,
)
from crowdmap_torch.io.documents import Document, read_json
from crowdmap_torch.io.errors import InputError, one_line
from crowdmap_torch.io.poses import read_poses
from crowdmap_torch.io.remote import Url, at_hand, matching, place_of
from crowdmap_torch.io.rigs import read_rig
from crowdmap_torch.noise.bursts import without_bursts
from crowdmap_torch.noise.freezes import driven_on, frozen_frames
from crowdmap_torch.noise.leaps import without_leaps
from crowdmap_torch.processes.at_rest import rest
from crowdmap_torch.ranges import shown
from crowdmap_torch.tables import Dataset, Journey, Origin, RejectedJourney, Rig

DATASET_FORMAT = "crowdmap-dataset"
JOURNEY_FORMAT = "crowdmap-journey"
_MOST_NAMED = 5
"""Journeys that a message names; of more it says how many."""
_LONGEST_NAME = 100
"""Characters of a vehicle's name; a longer one is cut and told apart by a number."""


def load_dataset(
    path: Path | str,
    *,
    device: torch.device | str = "cpu",
    strict: bool = False,
    journeys: Sequence[str] | None = None,
) -> Dataset:
    """The journeys of a dataset, in the order of their names, and those set aside with the reason.

    `path` may be a URL: what is read is copied first (`io.remote`). `journeys`: only those with these ids, or that match
    these patterns (`2026-05-*`); None: all. A drive counts once: copies of a journey are set aside, and what was cut out of
    it. InputError if the dataset itself breaks FORMAT.md, if an id or pattern is that of no journey, if none is left
    (`NoJourneyLeft`), or, `strict`, if a single one is set aside.
    """
    folder = place_of(path)
    if isinstance(folder, Url):
        with at_hand(folder, journeys, survey=False) as copy:
            return load_dataset(copy, device=device, strict=strict, journeys=journeys)
    if not folder.is_dir():
        raise InputError(f"{folder}: the dataset's folder is missing; expected dataset.json in it")
    with reading(inside=folder):
        dataset = _load_dataset(folder, strict, journeys)
    moved = tuple(_moved(journey, device) for journey in dataset.journeys)
    return replace(dataset, journeys=moved)


def _load_dataset(folder: Path, strict: bool, wanted: Sequence[str] | None) -> Dataset:
    head = read_json(folder / "dataset.json")
    head.require_format(DATASET_FORMAT)
    origin = read_origin(head)
    journeys: list[Journey] = []
    names: list[tuple[str, ...]] = []
    rejected: list[RejectedJourney] = []
    rigs: dict[str, Rig | InputError] = {}
    folders = journey_folders(folder)
    for journey_folder in folders if wanted is None else _named(folders, wanted):
        try:
            journey, type_names = _load_journey(journey_folder, folder / "rigs", rigs)
        except InputError as error:
            name = printable(journey_folder.name)
            if strict:
                raise InputError(f"journey {name!r}: {one_line(error)}", error.code) from error
            rejected.append(RejectedJourney(name, one_line(error), error.code))
            continue
        journeys.append(rest(journey))
        names.append(type_names)
    if not journeys:
        raise NoJourneyLeft(
            f"{folder}: all {len(rejected)} journeys are set aside; the first, "
            f"{rejected[0].journey_id!r}, because {rejected[0].reason}",
            tuple(rejected),
        )
    doubles = _copies(journeys)
    if strict and doubles:
        first = min(doubles)
        raise InputError(f"journey {first!r}: {doubles[first]}", "copy")
    rejected += [RejectedJourney(name, reason, "copy") for name, reason in doubles.items()]
    rejected.sort(key=lambda aside: aside.journey_id)
    once = [k for k, journey in enumerate(journeys) if journey.journey_id not in doubles]
    journeys, names = [journeys[k] for k in once], [names[k] for k in once]
    all_names = tuple(sorted(set().union(*names)))
    alike = (recoded(journey, own, all_names) for journey, own in zip(journeys, names, strict=True))
    return Dataset(
        origin=origin, journeys=tuple(alike), rejected=tuple(rejected), type_names=all_names
    )


def load_journey(
    path: Path | str, *, device: torch.device | str = "cpu"
) -> tuple[Journey, tuple[str, ...]]:
    """One journey of a dataset, and the traffic-sign codes that its `type` column counts.

    InputError if it breaks FORMAT.md.
    """
    folder = Path(path)
    with reading(inside=folder.parent.parent):
        journey, type_names = _load_journey(folder, folder.parent.parent / "rigs", {})
    return _moved(journey, device), type_names


class NoJourneyLeft(InputError):
    """All journeys of a dataset are set aside."""

    def __init__(self, text: str, rejected: tuple[RejectedJourney, ...]) -> None:
        super().__init__(text)
        self.rejected = rejected
        """Each with its reason."""


def read_origin(head: Document) -> Origin:
    """The `origin` of a dataset.json or map.json."""
    origin = head.part("origin")
    return Origin(
        lat_deg=origin.number("lat_deg", low=-90, high=90),
        lon_deg=origin.number("lon_deg", low=-180, high=180),
        height_m=origin.number("height_m", low=-12_000, high=12_000),
    )


def row_count(journey: Journey, kind: str) -> int:
    """How many rows the journey's file of `sign` or `lane` detections has, those dropped at the door included."""
    detections = journey.signs if kind == "sign" else journey.lanes
    prefix = DROPPED_SIGN if kind == "sign" else DROPPED_LANE
    dropped = (count for reason, count in journey.dropped.items() if reason.startswith(prefix))
    return len(detections) + sum(dropped)


def journey_folders(folder: Path) -> list[Path]:
    """The folders of a dataset's journeys, by name; InputError if there are none."""
    journeys = folder / "journeys"
    if not journeys.is_dir():
        rule = f"{journeys}: the folder is missing; expected one folder for each journey"
        raise InputError(rule, "missing-file")
    refuse_way_out(journeys)
    entries = (p for p in journeys.iterdir() if not p.name.startswith("."))
    # A link may be a journey that went astray: it is not passed over as other files are.
    found = [p for p in entries if p.is_dir() or p.is_symlink()]
    if not found:
        rule = f"{journeys}: has no journeys; expected one folder for each journey"
        raise InputError(rule, "missing-file")
    return sorted(found)


def _named(folders: Sequence[Path], wanted: Sequence[str]) -> list[Path]:
    """Those of the journeys' folders that are named, or that a pattern matches."""
    chosen: set[str] = set()
    names = [p.name for p in folders]
    for name in wanted:
        found = matching(names, name)
        if not found:
            known = ", ".join(printable(p.name) for p in folders[:_MOST_NAMED])
            more = len(folders) - _MOST_NAMED
            raise InputError(
                f"{folders[0].parent}: no journey is called {shown(name)}; there are {known}"
                + (f" and {more} more" if more > 0 else "")
            )
        chosen.update(found)
    return [p for p in folders if p.name in chosen]


def refuse_no_journey(folder: Path) -> None:
    """InputError for a journey's folder that is a link to somewhere else, or to nothing."""
    refuse_way_out(folder)
    if not folder.is_dir():
        rule = f"{folder}: a link that leads to no folder; expected a journey's folder"
        raise InputError(rule, "missing-file")


def _load_journey(
    folder: Path, rigs_folder: Path, rigs: dict[str, Rig | InputError]
) -> tuple[Journey, tuple[str, ...]]:
    """A journey with the codes of its own signs; `rigs` keeps rigs, or what is wrong with them."""
    refuse_no_journey(folder)
    head = read_json(folder / "journey.json")
    head.require_format(JOURNEY_FORMAT)
    journey_id = read_journey_id(head)
    rig_id = head.name("rig")
    if rig_id not in rigs:
        try:
            refuse_way_out(rigs_folder / rig_id)
            rigs[rig_id] = read_rig(rigs_folder / rig_id)
        except InputError as error:
            rigs[rig_id] = error
    rig = rigs[rig_id]
    if isinstance(rig, InputError):
        raise InputError(str(rig), rig.code)
    poses = read_poses(folder / "poses.parquet")
    frame_number = poses.frame_number.numpy()
    signs = read_sign_detections(folder / "signs.parquet", rig.camera, frame_number)
    lanes = read_lane_detections(folder / "lanes.parquet", rig.camera, frame_number)
    T_world_link, frozen = poses.T_world_link, frozen_frames(poses.T_world_link, poses.t_ns)
    if bool(frozen.any()):
        T_world_link = driven_on(T_world_link, poses.t_ns, frozen)
    T_world_link, noisy = without_bursts(T_world_link, poses.t_ns)
    T_world_link, leaps_m = without_leaps(T_world_link, poses.t_ns)
    journey = Journey(
        journey_id=journey_id,
        rig=rig,
        frame_number=poses.frame_number,
        t_ns=poses.t_ns,
        T_world_camera=T_world_link @ rig.T_link_camera,
        sigma_position=poses.sigma_position,
        sigma_rotation=poses.sigma_rotation,
        signs=signs.detections,
        lanes=lanes.detections,
        lane_points=lanes.points,
        dropped=signs.dropped | lanes.dropped,
        vehicle_id=_vehicle_id(head.content.get("vehicle_id")),
        leaps_m=tuple(leaps_m.tolist()),
        noisy_frames=noisy,
    )
    if bool(frozen.any()):
        journey = seen_in(journey, ~frozen, FROZEN)
    return journey, signs.type_names


def read_journey_id(head: Document) -> str:
    """The `journey_id` of a journey.json; InputError unless it is its folder's name."""
    journey_id, folder = head.name("journey_id"), head.path.parent.name
    if journey_id != folder:
        rule = f"{journey_id!r} in the folder {folder!r}; expected the same name"
        head.refuse(rule, "journey_id")
    return journey_id


def _vehicle_id(stated: object) -> str:
    """A name, or a number for one, as it can be shown anywhere; whatever else is there names nobody."""
    if isinstance(stated, bool) or not isinstance(stated, str | int):
        return ""
    if isinstance(stated, int) and abs(stated) >= 10**_LONGEST_NAME:
        return ""
    plain = "".join(c if c.isprintable() else f"\\u{ord(c):04x}" for c in str(stated))
    if len(plain) <= _LONGEST_NAME:
        return plain
    return f"{plain[:_LONGEST_NAME]}-{hashlib.sha256(plain.encode()).hexdigest()[:8]}"


def _copies(journeys: Sequence[Journey]) -> dict[str, str]:
    """Journeys that are copies of others, and what is said of them."""
    return {
        journeys[copy.journey].journey_id: (
            f"copy of journey {journeys[copy.other].journey_id!r}: {copy.share:.0%} of its "
            f"detections are that one's, to {SAME_PX} px; a drive counts once"
        )
        for copy in copies(journeys)
    }


def printable(name: str) -> str:
    """A folder's name on one line, whatever bytes it has."""
    text = os.fsencode(name).decode("utf-8", "backslashreplace")
    return text if text.isprintable() else ascii(text)[1:-1]


def recoded(journey: Journey, own: Sequence[str], names: Sequence[str]) -> Journey:
    """The journey with the signs' `type` counted in `names`, which has all of them, instead of in its `own` list."""
    place = {name: code for code, name in enumerate(names)}
    # The last entry is for -1; what is new in a file that has changed is none of them either.
    table = torch.tensor([*(place.get(name, -1) for name in own), -1])
    signs = replace(journey.signs, type=table[journey.signs.type])
    return replace(journey, signs=signs)


def _moved(journey: Journey, device: torch.device | str) -> Journey:
    # Left alone where it is there already: journeys with one rig share what its camera has computed.
    return journey if torch.device(device).type == "cpu" else journey.to(device)
