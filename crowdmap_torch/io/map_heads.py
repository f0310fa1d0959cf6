"""The `map.json` of a map or survey."""

from __future__ import annotations

from pathlib import Path

from crowdmap_torch.io.documents import Document, read_json
from crowdmap_torch.io.errors import InputError

MAP_FORMAT = "crowdmap-map"


def read_map_head(folder: Path) -> Document:
    """The `map.json` of a map or survey, its format checked."""
    if not folder.is_dir():
        rule = f"{folder}: the map's folder is missing; expected map.json in it"
        raise InputError(rule, "missing-file")
    head = read_json(folder / "map.json")
    head.require_format(MAP_FORMAT)
    return head
