"""Which formats a map can be exported to, and how: by the module of the format, complete or not at all."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from crowdmap_torch.io.atomic import atomic_file, atomic_folder
from crowdmap_torch.io.errors import InputError, needing
from crowdmap_torch.io.formats.exporters.trajectories import write_kitti, write_tum
from crowdmap_torch.io.formats.plugins import brought, loaded
from crowdmap_torch.tables import HdMap


@dataclass(frozen=True)
class ExportFormat:
    """A format: what people call it, and how its files end."""

    title: str
    ending: str
    extra: str = ""
    """The extra of the package that brings what the format needs; empty: nothing but the package."""
    is_folder: bool = False
    """Whether it is a folder of files."""


@dataclass(frozen=True)
class Exporter:
    """A format that another package brings, by an entry point of the group `crowdmap_torch.exporters`."""

    form: ExportFormat
    write: Callable[[HdMap, Path], tuple[str, ...]]
    """Writes a map to a path that is free (into a folder that is there), and returns what it left out, a line each.

    OSError if it cannot be written; the path is beside the file's own, and renamed when it is whole.
    """


GROUP = "crowdmap_torch.exporters"
"""Entry points with the name of a format lead to an `Exporter`."""
FORMATS = {
    "geojson": ExportFormat("GeoJSON", ".geojson"),
    "lanelet2": ExportFormat("Lanelet2 (OSM)", ".osm"),
    "opendrive": ExportFormat("ASAM OpenDRIVE 1.7", ".xodr"),
    "geopackage": ExportFormat("GeoPackage", ".gpkg", extra="gis"),
    "flatgeobuf": ExportFormat("FlatGeobuf", ".fgb", extra="gis", is_folder=True),
    "kml": ExportFormat("KML", ".kml"),
    "compact": ExportFormat("compact map", ".cmap"),
}
"""By the name of the module in this folder, whose `write(hd_map, path)` returns what it had to leave out, a line each."""


def export_map(hd_map: HdMap, path: Path, to: str) -> tuple[str, ...]:
    """Writes a map in a format, and returns what the format has no place for, a line each.

    What was at `path` stays until the new file is complete. InputError for a format that nobody knows, or that needs
    an extra which is not installed; OSError if the file cannot be written.
    """
    form = form_of(to)
    write = _own_writer(to) if to in FORMATS else loaded(brought(GROUP)[to], Exporter).write
    with atomic_folder(path) if form.is_folder else atomic_file(path) as beside:
        return write(hd_map, beside)


def names() -> tuple[str, ...]:
    """All formats of maps, the package's own first."""
    return (*FORMATS, *sorted(brought(GROUP).keys() - FORMATS.keys() - TRAJECTORIES.keys()))


def form_of(to: str) -> ExportFormat:
    """A format of maps; InputError if nobody knows it, or if what brings it cannot be loaded."""
    if to in FORMATS:
        return FORMATS[to]
    if to not in names():
        raise InputError(f"format {to!r} is unknown; expected one of {', '.join(names())}")
    return loaded(brought(GROUP)[to], Exporter).form


def _own_writer(to: str) -> Callable[[HdMap, Path], tuple[str, ...]]:
    with needing(FORMATS[to].title, f"'crowdmap_torch[{FORMATS[to].extra}]'"):
        return importlib.import_module(f"{__package__}.{to}").write


TRAJECTORIES = {
    "tum": ExportFormat("TUM trajectories", ".tum", is_folder=True),
    "kitti": ExportFormat("KITTI trajectories", ".kitti", is_folder=True),
}
"""Of the refined poses of a run, a file for each journey."""


def export_run(run: Path, path: Path, to: str) -> tuple[str, ...]:
    """Writes the trajectories of a run into a folder, and returns what the format has no place for, a line each.

    InputError for a format that nobody knows, or a folder that is no run's.
    """
    if to not in TRAJECTORIES:
        raise InputError(f"format {to!r} is unknown; expected one of {', '.join(TRAJECTORIES)}")
    with atomic_folder(path) as folder:
        return {"tum": write_tum, "kitti": write_kitti}[to](run, folder)
