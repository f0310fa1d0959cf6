"""Maps of others read as maps, for what wants one at once: markers, and signs whose corners are known."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.formats.composing import registry
from crowdmap_torch.io.formats.composing.parts import Asked
from crowdmap_torch.io.formats.composing.survey import write_survey
from crowdmap_torch.io.maps import read_map
from crowdmap_torch.tables import HdMap

ENDINGS = {".osm": "lanelet2", ".xodr": "opendrive"}
"""Formats of map files."""


def map_of_file(path: Path, asked: Asked | None = None) -> HdMap:
    """The map that a file of Lanelet2 or OpenDRIVE is; InputError for another ending, or what it cannot be read as."""
    if path.suffix not in ENDINGS:
        raise InputError(f"{path}: expected a map's folder, or a file {' or '.join(ENDINGS)}")
    parts = registry.find(ENDINGS[path.suffix]).read((path,), asked or Asked())
    rows, origin = parts.survey, parts.origin
    if rows is None or origin is None:
        raise InputError(f"{path}: holds no map with a place on the earth")
    whole = [k for k, corners in enumerate(rows.sign_corners) if len(corners) > 1]
    rows = replace(
        rows,
        sign_id=tuple(rows.sign_id[k] for k in whole),
        sign_shape=rows.sign_shape[np.array(whole, dtype=np.int64)],
        sign_code=tuple(rows.sign_code[k] for k in whole),
        sign_corners=tuple(rows.sign_corners[k] for k in whole),
    )
    with tempfile.TemporaryDirectory() as folder:
        write_survey(Path(folder), rows, origin)
        return read_map(folder)
