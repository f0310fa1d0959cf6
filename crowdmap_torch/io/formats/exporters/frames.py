"""Maps, datasets and surveys for a notebook: as data frames of pandas and GeoPandas, and as GeoJSON."""

from __future__ import annotations

from dataclasses import fields
from typing import TYPE_CHECKING, Any

import numpy as np
from torch import Tensor

from crowdmap_torch.io.errors import needing
from crowdmap_torch.io.formats.exporters.drives import layers_of
from crowdmap_torch.io.formats.exporters.geojson import features
from crowdmap_torch.io.formats.exporters.head import head
from crowdmap_torch.tables import Dataset, HdMap, Rows, Survey

if TYPE_CHECKING:
    import geopandas as gpd  # pyright: ignore[reportMissingModuleSource]
    import pandas as pd  # pyright: ignore[reportMissingImports]


def to_pandas(what: HdMap | Dataset | Survey | Rows) -> dict[str, pd.DataFrame] | pd.DataFrame:
    """By layer a frame with a row for each thing; of a flat table, such as `hd_map.signs`, one frame.

    Layers are `signs` and `lanes` of a map or survey, `drives` and `frames` of a dataset. Names and units of their
    columns are those of FORMAT.md; those of a flat table are its fields, with arrays in cells where a row has more
    than one number. InputError where pandas is not installed.
    """
    with needing("to_pandas", "pandas"):
        import pandas as pd  # pyright: ignore[reportMissingImports]
    if isinstance(what, Rows):
        own = {f.name: getattr(what, f.name) for f in fields(what)}
        columns = {n: v.detach().cpu().numpy() for n, v in own.items() if isinstance(v, Tensor)}
        return pd.DataFrame({n: list(v) if v.ndim > 1 else v for n, v in columns.items()})
    return {
        layer.name: pd.DataFrame(layer.columns | layer.lists)
        for layer in layers_of(what)
        # Corners of signs are geometry; all else is in `signs` too.
        if layer.name != "plates"
    }


def to_geopandas(what: HdMap | Dataset | Survey) -> dict[str, gpd.GeoDataFrame]:
    """By layer a frame with geometry on WGS84 with heights (EPSG:4979).

    Layers are those of `to_pandas`, and `plates`, the signs of a map or survey as polygons.
    InputError where GeoPandas is not installed.
    """
    with needing("to_geopandas", "'crowdmap_torch[gis]'"):
        import geopandas as gpd  # pyright: ignore[reportMissingModuleSource]
        import shapely  # pyright: ignore[reportMissingModuleSource]

        from crowdmap_torch.io.formats.exporters.gis_layers import CRS, wkb
    return {
        layer.name: gpd.GeoDataFrame(
            layer.columns | layer.lists,
            geometry=shapely.from_wkb(
                np.array([wkb(layer.geometry, place) for place in layer.place], dtype=object)
            ),
            crs=CRS,
        )
        for layer in layers_of(what)
    }


def to_geojson(what: HdMap | Dataset | Survey) -> dict[str, Any]:
    """A feature collection of all layers, each feature with its `layer` among the properties; of a map as it is exported."""
    own = {"crowdmap": head(what)} if isinstance(what, HdMap) else {}
    found = [feature for layer in layers_of(what) for feature in features(layer)]
    return {"type": "FeatureCollection", **own, "features": found}
