"""What a look at a data set finds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

_NAMED = 3
"""Journeys that a line names; of more it says how many."""


@dataclass(frozen=True)
class Repair:
    """The one change of a data set's files that puts a mistake right; `checking.repair` carries it out."""

    name: str
    numbers: tuple[float, ...] = ()
    """Such as a factor, a shift, or the rows of matrices."""
    of: str = ""
    """A journey or columns, where it is about some of them."""


@dataclass(frozen=True)
class Finding:
    """Something that FORMAT.md allows and physics or habit do not: probably a mistake."""

    kind: str
    """What it is called, the same in every data set: `body-frame`."""
    evidence: str
    """What was seen, with numbers."""
    cause: str
    """What it probably comes from."""
    cure: str
    """What to do about it."""
    journeys: tuple[str, ...] = ()
    """The journeys in which it was seen; none: it is the data set's."""
    repair: Repair | None = None
    """None where more than one thing may be done, or what is to be written is not in the files."""

    def line(self, total: int) -> str:
        """One line for a person; `total` journeys were looked at."""
        return f"{self.seen(total)}: {self.cause}; {self.cure}"

    def seen(self, total: int) -> str:
        """What was seen, and in which of the `total` journeys."""
        named = ", ".join(self.journeys[:_NAMED])
        if len(self.journeys) > _NAMED:
            named += f" and {len(self.journeys) - _NAMED} more"
        where = f" ({len(self.journeys)} of {total} journeys: {named})" if self.journeys else ""
        return self.evidence + where


def gathered(found: Sequence[tuple[str, Finding]]) -> tuple[Finding, ...]:
    """One finding of each kind, with the journeys in which it was seen and the evidence of the first."""
    kinds: dict[str, list[tuple[str, Finding]]] = {}
    for journey, finding in found:
        kinds.setdefault(finding.kind, []).append((journey, finding))
    return tuple(
        replace(first, journeys=tuple(dict.fromkeys(journey for journey, _ in rows)))
        for rows in kinds.values()
        for _, first in rows[:1]
    )
