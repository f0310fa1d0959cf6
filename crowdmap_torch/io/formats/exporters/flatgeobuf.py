"""FlatGeobuf: a folder with a file for each of the layers `signs`, `plates` and `lanes`, as a file has one layer."""

from __future__ import annotations

from pathlib import Path

from crowdmap_torch.io.formats.exporters.features import layers
from crowdmap_torch.io.formats.exporters.gis_layers import write_layer
from crowdmap_torch.tables import HdMap


def write(hd_map: HdMap, path: Path) -> tuple[str, ...]:
    """Writes the layers into a folder; returns what they have no place for."""
    for layer in layers(hd_map):
        write_layer(layer, path / f"{layer.name}.fgb", "FlatGeobuf")
    return ("origin, shared_covariance and provenance: layers have no place for them",)
