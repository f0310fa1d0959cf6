"""Surveys written: the maps of others as FORMAT.md has them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pyarrow as pa
from jaxtyping import Float

from crowdmap_torch.geometry import polygon
from crowdmap_torch.io.documents import write_json
from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.formats.composing.parts import SurveyRows
from crowdmap_torch.io.map_heads import MAP_FORMAT
from crowdmap_torch.io.surveys import read_survey
from crowdmap_torch.io.writing import name_column, points_column, write_parquet
from crowdmap_torch.tables import LANE_TYPES, Origin, Survey


def write_survey(folder: Path, rows: SurveyRows, origin: Origin) -> Survey:
    """Writes a survey into a folder, and reads it back."""
    folder.mkdir(parents=True, exist_ok=True)
    write_json(
        folder / "map.json",
        {
            "format": MAP_FORMAT,
            "version": 1,
            "origin": asdict(origin),
            "provenance": {"generator": "crowdmap convert", "source": rows.source.name},
        },
    )
    count = np.array([len(points) for points in rows.lane_points], dtype=np.int64)
    write_parquet(
        folder / "lanes.parquet",
        {
            "lane_id": pa.array(rows.lane_id, pa.string()),
            "type": name_column(rows.lane_type, LANE_TYPES),
            "points": points_column(np.concatenate([np.zeros((0, 3)), *rows.lane_points]), count),
        },
    )
    write_parquet(
        folder / "signs.parquet",
        {
            "sign_id": pa.array(rows.sign_id, pa.string()),
            "shape": name_column(rows.sign_shape, polygon.SHAPES),
            "type": pa.array(rows.sign_code, pa.string()),
            "corners": _corner_column(rows.sign_corners),
            "center": pa.array([mean.tolist() for mean in _means(rows.sign_corners)], _POINT),
        },
    )
    try:
        return read_survey(folder)
    except InputError as error:
        text = str(error).replace(str(folder), str(rows.source))
        raise InputError(f"what the source holds breaks FORMAT.md: {text}") from error


_POINT = pa.list_(pa.float64())


def _corner_column(corners: Sequence[Float[np.ndarray, "_ 3"]]) -> pa.Array:
    """Corners of each sign; null where there is but one point, its centre."""
    lists = [None if len(own) == 1 else own.tolist() for own in corners]
    return pa.array(lists, pa.list_(_POINT))


def _means(corners: Sequence[Float[np.ndarray, "_ 3"]]) -> list[Float[np.ndarray, " 3"]]:
    return [own.mean(0) for own in corners]
