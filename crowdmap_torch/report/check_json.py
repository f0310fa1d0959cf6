"""What was found in a data set, as JSON."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from crowdmap_torch.checking.check import Check, Item
from crowdmap_torch.checking.repair import Mended
from crowdmap_torch.io.remote import Place


def check_content(
    place: Place, check: Check, new: Path | None, mended: Mended | None
) -> dict[str, Any]:
    """The findings of a data set, and of what `--fix` made of it."""
    content: dict[str, Any] = {
        "format": "crowdmap-check",
        "version": 1,
        "dataset": str(place),
        "is_sound": check.is_sound,
        "journeys": [j.journey_id for j in check.dataset.journeys] if check.dataset else [],
        "refused_journeys": list(check.unseen),
        "findings": [_finding(item) for item in check.items],
    }
    if mended is not None:
        content["fix"] = {
            "dataset": str(new),
            "changes": list(mended.changes),
            "is_sound": mended.check.is_sound,
            "findings": [_finding(item) for item in mended.check.items],
        }
    return content


def _finding(item: Item) -> dict[str, Any]:
    return {
        "severity": item.severity,
        "kind": item.kind,
        "codes": list(item.codes),
        "journeys": list(item.journeys),
        "file": item.file or None,
        "rows": list(item.rows),
        "evidence": item.evidence,
        "cause": item.cause,
        "cure": item.cure,
        "fix": bool(item.repairs),
    }
