"""KML for Google Earth and its like: folders of signs, plates and lanes, everything known as extended data.

Heights are written but the viewer lays everything on its ground: KML counts heights from the sea, a map from the ellipsoid,
and tens of metres lie between.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from xml.sax.saxutils import escape, quoteattr

import numpy as np
from jaxtyping import Float

from crowdmap_torch.io.formats.exporters.features import Layer, layers
from crowdmap_torch.io.formats.exporters.head import head, json_text
from crowdmap_torch.tables import HdMap


def write(hd_map: HdMap, path: Path) -> tuple[str, ...]:
    """Writes a document with a folder for each layer; nothing is left out."""
    lines = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        '<kml xmlns="http://www.opengis.net/kml/2.2"><Document>',
        f"<description>{escape(json_text({'crowdmap': head(hd_map)}))}</description>",
    ]
    for layer in layers(hd_map):
        lines += [f"<Folder><name>{layer.name}</name>", *_placemarks(layer), "</Folder>"]
    lines.append("</Document></kml>")
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return ()


def _placemarks(layer: Layer) -> Iterator[str]:
    known = layer.columns | {name: [*map(json_text, c)] for name, c in layer.lists.items()}
    for row, (name, place) in enumerate(zip(layer.feature_id, layer.place, strict=True)):
        yield f"<Placemark><name>{escape(name)}</name><ExtendedData>"
        for key, column in known.items():
            if column[row] is not None:
                value = escape(str(column[row]))
                yield f"<Data name={quoteattr(key)}><value>{value}</value></Data>"
        yield f"</ExtendedData>{_geometry(layer.geometry, place)}</Placemark>"


def _geometry(kind: str, place: Float[np.ndarray, "_ 3"]) -> str:
    ring = kind == "Polygon"
    points = np.concatenate((place, place[:1])) if ring else place
    text = " ".join(f"{lon:.10f},{lat:.10f},{height:.5f}" for lon, lat, height in points.tolist())
    text = f"<coordinates>{text}</coordinates>"
    if ring:
        text = f"<outerBoundaryIs><LinearRing>{text}</LinearRing></outerBoundaryIs>"
    return f"<{kind}><altitudeMode>clampToGround</altitudeMode>{text}</{kind}>"
