"""GeoJSON (RFC 7946): signs as points, their plates as polygons, lane markers as lines, all with heights.

Everything that FORMAT.md says of a map is there: places of the local frame, covariances and control points as properties,
origin, shared covariance and provenance as the collection's own member `crowdmap`.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Float

from crowdmap_torch.io.formats.exporters.features import Layer, layers
from crowdmap_torch.io.formats.exporters.head import head, json_text
from crowdmap_torch.tables import HdMap

_DEGREES, _METRES = 10, 5
"""Decimals of coordinates: both hundredths of a millimetre."""


def write(hd_map: HdMap, path: Path) -> tuple[str, ...]:
    """Writes a feature collection, one feature a line; nothing is left out."""
    lines = ",\n".join(
        json_text(feature) for layer in layers(hd_map) for feature in features(layer)
    )
    path.write_text(
        f'{{"type":"FeatureCollection","crowdmap":{json_text(head(hd_map))},"features":[\n{lines}\n]}}\n',
        encoding="utf-8",
    )
    return ()


def features(layer: Layer) -> Iterator[dict]:
    """The features of a layer, as GeoJSON has them."""
    for row, (name, place) in enumerate(zip(layer.feature_id, layer.place, strict=True)):
        properties = {key: column[row] for key, column in (layer.columns | layer.lists).items()}
        yield {
            "type": "Feature",
            "id": name,
            "geometry": {"type": layer.geometry, "coordinates": _coordinates(layer, place)},
            "properties": {"layer": layer.name} | properties,
        }


def _coordinates(layer: Layer, place: Float[np.ndarray, "_ 3"]) -> list:
    if layer.geometry == "Polygon":
        # Outer rings run anticlockwise as seen from above (3.1.6), and end where they begin.
        ring = place - place[:1]
        x, y = ring[:, 0], ring[:, 1]
        is_clockwise = np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y) < 0
        place = place[::-1] if is_clockwise else place
        place = np.concatenate((place, place[:1]))
    numbers = [
        [round(lon, _DEGREES), round(lat, _DEGREES), round(height, _METRES)]
        for lon, lat, height in place.tolist()
    ]
    if layer.geometry == "Polygon":
        return [numbers]
    return numbers[0] if layer.geometry == "Point" else numbers
