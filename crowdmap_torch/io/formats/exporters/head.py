"""What a map says of itself: origin, shared covariance and provenance, for formats with a place for a text."""

from __future__ import annotations

import json
from dataclasses import asdict

from crowdmap_torch.tables import HdMap


def head(hd_map: HdMap) -> dict:
    """The contents of map.json beside its format and version."""
    return {
        "origin": asdict(hd_map.origin),
        "shared_covariance": hd_map.shared_covariance.detach().cpu().flatten().tolist(),
        "provenance": hd_map.provenance,
    }


def json_text(value: object) -> str:
    """JSON on one line; ValueError for a number that is not finite."""
    return json.dumps(value, allow_nan=False, ensure_ascii=False, separators=(",", ":"))
