"""GeoPackage: one file of the layers `signs`, `plates` and `lanes`, for QGIS and all that stands on GDAL."""

from __future__ import annotations

import os
from pathlib import Path

from crowdmap_torch.io.formats.exporters.features import layers
from crowdmap_torch.io.formats.exporters.gis_layers import append_texts, write_layer
from crowdmap_torch.io.formats.exporters.head import head, json_text
from crowdmap_torch.tables import HdMap


def write(hd_map: HdMap, path: Path) -> tuple[str, ...]:
    """Writes the layers, and a table `crowdmap` with what the map says of itself; nothing is left out."""
    # GDAL would warn of another ending.
    whole = path.with_name(f"{path.name}.gpkg")
    try:
        for number, layer in enumerate(layers(hd_map)):
            write_layer(layer, whole, "GPKG", append=number > 0)
        texts = {name: json_text(value) for name, value in head(hd_map).items()}
        append_texts("crowdmap", texts, whole, "GPKG")
        os.replace(whole, path)
    finally:
        whole.unlink(missing_ok=True)
    return ()
