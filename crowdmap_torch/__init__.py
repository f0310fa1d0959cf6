"""Crowd-sourced maps of traffic signs and lane markings from many noisy journeys.

The names below are what other programs need; each is imported from its module when it is first asked for.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from crowdmap_torch.config import MapperConfig, load_config
    from crowdmap_torch.evaluation.evaluate import evaluate_map
    from crowdmap_torch.io.area import Area, cut_dataset
    from crowdmap_torch.io.datasets import load_dataset
    from crowdmap_torch.io.errors import InputError
    from crowdmap_torch.io.formats.exporters.frames import to_geojson, to_geopandas, to_pandas
    from crowdmap_torch.io.maps import read_map, write_map
    from crowdmap_torch.io.surveys import read_survey
    from crowdmap_torch.mapper import MapResult, build_map
    from crowdmap_torch.report.plots import plot
    from crowdmap_torch.simulate.dataset import SimulationConfig, write_dataset
    from crowdmap_torch.single_journey import SingleJourneyMapper
    from crowdmap_torch.tables import (
        Dataset,
        HdMap,
        Journey,
        LaneDetections,
        Lanes,
        Rig,
        SignDetections,
        Signs,
        Survey,
    )

__version__ = "0.1.0"

__all__ = [
    "Area",
    "Dataset",
    "HdMap",
    "InputError",
    "Journey",
    "LaneDetections",
    "Lanes",
    "MapResult",
    "MapperConfig",
    "Rig",
    "SignDetections",
    "Signs",
    "SimulationConfig",
    "SingleJourneyMapper",
    "Survey",
    "build_map",
    "cut_dataset",
    "evaluate_map",
    "load_config",
    "load_dataset",
    "plot",
    "read_map",
    "read_survey",
    "to_geojson",
    "to_geopandas",
    "to_pandas",
    "write_dataset",
    "write_map",
]

_NAMES_OF = {
    "config": ("MapperConfig", "load_config"),
    "evaluation.evaluate": ("evaluate_map",),
    "io.area": ("Area", "cut_dataset"),
    "io.datasets": ("load_dataset",),
    "io.errors": ("InputError",),
    "io.formats.exporters.frames": ("to_geojson", "to_geopandas", "to_pandas"),
    "io.maps": ("read_map", "write_map"),
    "io.surveys": ("read_survey",),
    "mapper": ("MapResult", "build_map"),
    "report.plots": ("plot",),
    "simulate.dataset": ("SimulationConfig", "write_dataset"),
    "single_journey": ("SingleJourneyMapper",),
    "tables": (
        *("Dataset", "HdMap", "Journey", "LaneDetections", "Lanes", "Rig", "SignDetections"),
        *("Signs", "Survey"),
    ),
}
_HOME = {name: f"{__name__}.{module}" for module, names in _NAMES_OF.items() for name in names}


def __getattr__(name: str) -> object:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    found = getattr(import_module(_HOME[name]), name)
    # The next look finds it here.
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
