"""Writes a map in a format of others: `crowdmap export MAP --to FORMAT [-o FILE] [--overwrite]`.

MAP is a map, a survey whose signs have corners, or a RUN, whose map is taken; `tum` and `kitti` write the refined poses of a
RUN, into a folder. What the format has no place for is said in a line each.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import pyarrow.parquet as pq

from crowdmap_torch.io.errors import InputError, input_read
from crowdmap_torch.io.formats.exporters.export import (
    FORMATS,
    TRAJECTORIES,
    ExportFormat,
    export_map,
    export_run,
    form_of,
    names,
)
from crowdmap_torch.io.maps import read_map


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What `crowdmap export` takes."""
    parser.add_argument("map", type=Path, metavar="MAP", help="a map, a survey, or a RUN")
    titles = [f"{name}: {form.title}" for name, form in (FORMATS | TRAJECTORIES).items()]
    titles += [f"{name}: of another package" for name in names() if name not in FORMATS]
    choices = [*names(), *TRAJECTORIES]
    parser.add_argument(
        "--to", required=True, choices=choices, metavar="FORMAT", help="; ".join(titles)
    )
    parser.add_argument(
        "-o", "--out", type=Path, metavar="FILE", help="default: beside MAP, named after it"
    )
    parser.add_argument("--overwrite", action="store_true", help="replace a FILE that exists")


def run(options: argparse.Namespace) -> None:
    """Writes the file, and prints what went into it and what did not."""
    if options.to in TRAJECTORIES:
        _run_trajectories(options, TRAJECTORIES[options.to])
        return
    form = form_of(options.to)
    folder = _map_folder(options.map)
    out = options.out or folder.resolve().with_name(f"{folder.resolve().name}{form.ending}")
    _require_free(out, folder, form, options.overwrite)
    with input_read():
        hd_map = read_map(folder)
        tentative = folder / "tentative_signs.parquet"
        left = pq.read_metadata(tentative).num_rows if tentative.is_file() else 0
    losses = export_map(hd_map, out, options.to)
    print(f"{form.title}: {out}: {len(hd_map.signs)} signs, {len(hd_map.lanes)} lane pieces")
    if left:
        losses = (f"{left} tentative signs, which are not part of the map", *losses)
    for loss in losses:
        print(f"left out: {loss}")


def _run_trajectories(options: argparse.Namespace, form: ExportFormat) -> None:
    run = options.map.resolve()
    out = options.out or run.with_name(f"{run.name}{form.ending}")
    _require_free(out, run, form, options.overwrite)
    with input_read():
        losses = export_run(run, out, options.to)
    print(f"{form.title}: {out}: {len([*out.iterdir()])} journeys")
    for loss in losses:
        print(f"left out: {loss}")


def _map_folder(given: Path) -> Path:
    """The folder of a map: itself, or that of a run."""
    inside = given / "map"
    return inside if not (given / "map.json").exists() and inside.is_dir() else given


def _require_free(out: Path, folder: Path, form: ExportFormat, overwrite: bool) -> None:
    """InputError if something stands at `out` that is not to be replaced."""
    if out.resolve().is_relative_to(folder.resolve()):
        raise InputError(f"{out}: inside the map {folder}; choose a place outside it")
    if folder.resolve().is_relative_to(out.resolve()):
        raise InputError(f"{out}: holds the map {folder}; choose a place outside it")
    if out.is_dir() and not form.is_folder:
        raise InputError(f"{out}: a folder; expected the name of a file")
    if out.is_dir() and any(file.suffix != form.ending for file in out.iterdir()):
        raise InputError(f"{out}: a folder with other files in it; choose another name")
    if out.exists() and not overwrite:
        raise InputError(f"{out}: exists; choose another name or give --overwrite")
