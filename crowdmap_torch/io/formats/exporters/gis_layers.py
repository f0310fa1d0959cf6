"""Layers of features as GDAL writes them (pyogrio, extra `gis`): geometry as WKB, lists as JSON texts."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pyogrio.raw  # pyright: ignore[reportMissingImports]
from jaxtyping import Float

from crowdmap_torch.io.formats.exporters.features import Layer
from crowdmap_torch.io.formats.exporters.head import json_text

CRS = "EPSG:4979"
"""WGS84 with heights above the ellipsoid."""
_WKB = {"Point": 1001, "LineString": 1002, "Polygon": 1003}


def write_layer(layer: Layer, path: Path, driver: str, *, append: bool = False) -> None:
    """Writes features into a file, a new one or as one more layer."""
    # GDAL writes version 1.4, of which QGIS 3.22 warns that it may not read all of it.
    options = {"VERSION": "1.3"} if driver == "GPKG" and not append else {}
    columns = {name: _column(values) for name, values in columns_of(layer).items()}
    pyogrio.raw.write(
        path,
        geometry=np.array([wkb(layer.geometry, place) for place in layer.place], dtype=object),
        field_data=[values for values, _ in columns.values()],
        field_mask=[missing for _, missing in columns.values()],
        fields=[*columns],
        layer=layer.name,
        driver=driver,
        geometry_type=f"{layer.geometry} Z",
        crs=CRS,
        append=append,
        dataset_options=options,
    )


def append_texts(name: str, texts: dict[str, str], path: Path, driver: str) -> None:
    """Adds a table without geometry, of one row of texts."""
    pyogrio.raw.write(
        path,
        geometry=None,
        field_data=[np.array([text], dtype=object) for text in texts.values()],
        fields=[*texts],
        layer=name,
        driver=driver,
        append=True,
    )


def columns_of(layer: Layer) -> dict[str, list]:
    """All that is known of features in columns of single values."""
    return layer.columns | {n: [json_text(v) for v in column] for n, column in layer.lists.items()}


def wkb(geometry: str, place: Float[np.ndarray, "_ 3"]) -> bytes:
    """Well-known binary of a geometry with heights, little-endian; rings are closed."""
    if geometry == "Polygon":
        place = np.concatenate((place, place[:1]))
    counts = {"Point": (), "LineString": (len(place),), "Polygon": (1, len(place))}[geometry]
    head = struct.pack(f"<BI{len(counts)}I", 1, _WKB[geometry], *counts)
    return head + np.ascontiguousarray(place, dtype="<f8").tobytes()


def _column(values: list) -> tuple[np.ndarray, np.ndarray | None]:
    """Values as GDAL takes them, and where there are none."""
    missing = np.array([value is None for value in values], dtype=bool)
    if not values or missing.any() or isinstance(values[0], str):
        # Texts alone may be missing: a type that is unknown.
        return np.array(["" if v is None else v for v in values], dtype=object), missing
    return np.array(values), None
