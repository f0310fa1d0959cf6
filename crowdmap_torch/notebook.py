"""What tables offer at a prompt: the package's `to_pandas`, `to_geojson`, `to_geopandas` and `plot` as methods.

What draws tables stands on them, not below: a method asks the package for its function by name, when it is called, as a
user would.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import geopandas as gpd  # pyright: ignore[reportMissingModuleSource]
    import pandas as pd  # pyright: ignore[reportMissingImports]
    from matplotlib.figure import Figure


def _package() -> Any:
    return import_module("crowdmap_torch")


class HasFrame:
    """A flat table."""

    def to_pandas(self) -> pd.DataFrame:
        """The table as a frame of pandas (`crowdmap_torch.to_pandas`); InputError where pandas is not installed."""
        return _package().to_pandas(self)


class HasLayers:
    """A map, a survey or a dataset: things with a place on earth, in layers."""

    def to_pandas(self) -> dict[str, pd.DataFrame]:
        """A frame for each layer (`crowdmap_torch.to_pandas`); InputError where pandas is not installed."""
        return _package().to_pandas(self)

    def to_geopandas(self) -> dict[str, gpd.GeoDataFrame]:
        """A frame with geometry for each layer (`crowdmap_torch.to_geopandas`); InputError without GeoPandas."""
        return _package().to_geopandas(self)

    def to_geojson(self) -> dict[str, Any]:
        """A feature collection of all layers (`crowdmap_torch.to_geojson`)."""
        return _package().to_geojson(self)


class HasPicture(HasLayers):
    """What can be drawn from above as well."""

    def plot(self, survey: Any = None) -> Figure:
        """A picture from above (`crowdmap_torch.plot`), of a map with a survey under it."""
        return _package().plot(self, survey)
