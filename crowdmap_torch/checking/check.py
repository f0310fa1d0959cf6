"""Everything that is wrong with a data set: what breaks FORMAT.md, and what looks wrong though it does not."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from crowdmap_torch.checking.causes import EXPLANATIONS, repair_of
from crowdmap_torch.config import MapperConfig
from crowdmap_torch.io.budget import reading
from crowdmap_torch.io.datasets import load_dataset
from crowdmap_torch.io.errors import Code, InputError
from crowdmap_torch.io.faults import Fault
from crowdmap_torch.io.inspection import inspect_dataset
from crowdmap_torch.plausibility.dataset import look_over
from crowdmap_torch.plausibility.finding import Finding, Repair
from crowdmap_torch.plausibility.lever import HIDDEN_LEVER
from crowdmap_torch.plausibility.poses import ONE_HEIGHT
from crowdmap_torch.plausibility.put_right import FRAMES_LEFT_OUT, LEAPS_TAKEN_OUT
from crowdmap_torch.plausibility.units import raw_findings, read_raw_poses
from crowdmap_torch.tables import Dataset

STOPS, SPOILS, NOTE = "stops", "spoils", "note"
"""How grave: a journey or the data set is refused; the map will be wrong; worth knowing."""
_NOTES = ("sigmas", ONE_HEIGHT, FRAMES_LEFT_OUT, LEAPS_TAKEN_OUT, HIDDEN_LEVER)
"""Findings that cost a map little."""
_ROWS = 5
"""Rows that a line names."""


@dataclass(frozen=True)
class Item:
    """One thing that is wrong, wherever it is."""

    severity: str
    kind: str
    evidence: str
    """What was found."""
    cause: str
    cure: str
    journeys: tuple[str, ...] = ()
    """Where it was seen; none: it is of the data set, a rig, or the survey."""
    file: str = ""
    """The file in the data set's folder, if it is one file."""
    rows: tuple[int, ...] = ()
    """All rows of that file in which it is so; none: it is about the whole."""
    repairs: tuple[tuple[str, Repair], ...] = ()
    """What puts it right, with the journey to be changed; none: a person has to."""
    codes: tuple[str, ...] = ()
    """The rules of FORMAT.md that are broken (`io.errors.Code`); none: it is allowed."""

    @property
    def place(self) -> str:
        """Where it is, for a person."""
        if self.file:
            rows = ", ".join(map(str, self.rows[:_ROWS]))
            more = f" and {len(self.rows) - _ROWS} more" if len(self.rows) > _ROWS else ""
            return self.file + (f", row{'s' * (len(self.rows) > 1)} {rows}{more}" if rows else "")
        if not self.journeys:
            return "the data set"
        named = ", ".join(self.journeys[:3])
        more = f" and {len(self.journeys) - 3} more" if len(self.journeys) > 3 else ""
        return f"journey{'s' * (len(self.journeys) > 1)} {named}{more}"


@dataclass(frozen=True)
class Check:
    """What was found in a data set."""

    items: tuple[Item, ...]
    """The gravest first."""
    dataset: Dataset | None
    """The journeys that can be used; None if there are none."""
    unseen: tuple[str, ...]
    """Journeys that are refused, and so were looked at by their files alone."""

    @property
    def is_sound(self) -> bool:
        """Whether nothing stops or spoils a map."""
        return all(item.severity == NOTE for item in self.items)


def check_dataset(folder: Path, config: MapperConfig | None = None) -> Check:
    """Looks at every file and every journey of a data set; InputError if there is none."""
    config = config or MapperConfig()
    with reading(config.reading):
        faults = inspect_dataset(folder)
        dataset = _usable(folder)
        found = _format_items(folder, faults)
        if dataset is not None:
            seen = look_over(folder, dataset, config.positioning, config.sign_association)
            found += _items_of(seen.by_journey)
            found += _copies(dataset, {f.path for f in faults if not f.drops})
    order = (STOPS, SPOILS, NOTE)
    found.sort(key=lambda item: order.index(item.severity))
    refused = {_journey_of(folder, f.path) for f in faults if not f.drops} - {""}
    return Check(tuple(found), dataset, tuple(sorted(refused)))


def _usable(folder: Path) -> Dataset | None:
    try:
        return load_dataset(folder)
    except InputError:
        # What is wrong is among the faults.
        return None


def _format_items(folder: Path, faults: Sequence[Fault]) -> list[Item]:
    """What breaks FORMAT.md; of poses that are refused for their units or their order, that."""
    items = []
    for path in dict.fromkeys(fault.path for fault in faults):
        own = [fault for fault in faults if fault.path == path]
        file = path.relative_to(folder).as_posix() if path != folder else "."
        journey = _journey_of(folder, path)
        journeys = (journey,) if journey else ()
        refused = [fault for fault in own if not fault.drops]
        explained: set[Fault] = set()
        if path.name == "poses.parquet" and refused:
            for item, faults_of_it in _of_columns(path, refused):
                explained |= faults_of_it
                repairs = tuple((journey, repair) for _, repair in item.repairs)
                items.append(replace(item, file=file, journeys=journeys, repairs=repairs))
        for fault in own:
            if fault in explained:
                continue
            known, repair = EXPLANATIONS[fault.code], repair_of(fault)
            items.append(
                Item(
                    NOTE if fault.drops else STOPS,
                    known.kind,
                    fault.rule,
                    known.cause,
                    known.cure,
                    journeys,
                    file,
                    fault.rows,
                    ((journey, repair),) if repair is not None and journey else (),
                    (fault.code,),
                )
            )
    return items


_EXPLAINS: dict[str, tuple[tuple[Code, str], ...]] = {
    "unsorted-frames": (("order", "frame"), ("order", "t_ns")),
    "frame-times": (("leap", ""), ("column-type", "t_ns")),
    "speed": (("leap", ""), ("far-away", "")),
    "quaternion-length": (("quaternion-length", ""),),
    "held-positions": (("leap", ""),),
}
"""What is said of a file that is refused for what a finding about its columns names: codes, with the column if it is one."""


def _of_columns(path: Path, refused: Sequence[Fault]) -> Iterator[tuple[Item, set[Fault]]]:
    raw = read_raw_poses(path)
    if raw is None:
        return
    for finding in raw_findings(raw):
        own = {fault for fault in refused if (fault.code, fault.column) in _EXPLAINS[finding.kind]}
        # Rows are in another order once they are sorted.
        rows = sorted({row for fault in own for row in fault.rows})
        told = replace(finding, journeys=())
        codes = tuple(dict.fromkeys(f.code for f in refused if f in own))
        yield replace(_item(told, STOPS), rows=tuple(rows), codes=codes), own


def _items_of(found: Sequence[tuple[str, Finding]]) -> list[Item]:
    """One item for each finding, whichever journeys it was seen in."""
    alike: dict[tuple[str, str], list[tuple[str, Finding]]] = {}
    for journey, finding in found:
        alike.setdefault((finding.kind, finding.cause), []).append((journey, finding))
    items = []
    for rows in alike.values():
        first = rows[0][1]
        journeys = tuple(dict.fromkeys(journey for journey, _ in rows))
        repairs = tuple((j, f.repair) for j, f in rows if f.repair is not None)
        severity = NOTE if first.kind in _NOTES else SPOILS
        items.append(replace(_item(first, severity), journeys=journeys, repairs=repairs))
    return items


def _item(finding: Finding, severity: str) -> Item:
    repairs = () if finding.repair is None else (("", finding.repair),)
    return Item(
        severity, finding.kind, finding.evidence, finding.cause, finding.cure, repairs=repairs
    )


def _copies(dataset: Dataset, faulty: set[Path]) -> list[Item]:
    """Journeys that are set aside though their files are right: copies of others."""
    named = {path.name for path in faulty} | {path.parent.name for path in faulty}
    known = EXPLANATIONS["copy"]
    return [
        Item(
            STOPS,
            known.kind,
            one.reason,
            known.cause,
            known.cure,
            (one.journey_id,),
            repairs=((one.journey_id, Repair("leave-out-journey")),),
            codes=(one.code,),
        )
        for one in dataset.rejected
        if one.code == "copy" and one.journey_id not in named
    ]


def _journey_of(folder: Path, path: Path) -> str:
    """The journey that a file belongs to, empty if it is none's."""
    parts = path.relative_to(folder).parts
    return parts[1] if len(parts) > 1 and parts[0] == "journeys" else ""
