"""Writes a map in a format of others: `crowdmap export MAP --to FORMAT [-o FILE] [--bbox E0,N0,E1,N1] [--overwrite]`.

MAP is a map, a survey whose signs have corners, or a RUN, whose map is taken; `tum` and `kitti` write the refined poses of a
RUN, into a folder. What the format has no place for is said in a line each. `tiles` and `map` write FORMAT.md's own two
forms of a map, with everything that is in it. With `--bbox` it is what lies in an area alone; of a map in tiles those are
read that hold something there.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from crowdmap_torch.io.area import Area, read_area
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
from crowdmap_torch.io.maps import read_map, write_map
from crowdmap_torch.io.tiled_maps import DEFAULT_LEVEL, TileLevel, rewrite_map, tentative_count
from crowdmap_torch.ranges import argument
from crowdmap_torch.tables import HdMap

_FORMS = {
    "tiles": ExportFormat("map in tiles", ".tiles", is_folder=True),
    "map": ExportFormat("map in one piece", ".map", is_folder=True),
}
"""Of FORMAT.md's own maps."""
_MAP_NAMES = ("map.json", "signs.parquet", "tentative_signs.parquet", "lanes.parquet", "tiles")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What `crowdmap export` takes."""
    parser.add_argument("map", type=Path, metavar="MAP", help="a map, a survey, or a RUN")
    titles = [f"{name}: {form.title}" for name, form in (FORMATS | TRAJECTORIES).items()]
    titles += [f"{name}: of another package" for name in names() if name not in FORMATS]
    titles += [f"{name}: {form.title}" for name, form in _FORMS.items()]
    choices = [*names(), *TRAJECTORIES, *_FORMS]
    parser.add_argument(
        "--to", required=True, choices=choices, metavar="FORMAT", help="; ".join(titles)
    )
    parser.add_argument(
        "-o", "--out", type=Path, metavar="FILE", help="default: beside MAP, named after it"
    )
    parser.add_argument(
        "--bbox",
        type=_area,
        metavar="E0,N0,E1,N1",
        help="what lies in this area alone [m east and north of the origin]; markers that reach into it are whole",
    )
    parser.add_argument("--overwrite", action="store_true", help="replace a FILE that exists")
    parser.add_argument(
        "--level",
        type=argument(TileLevel),
        default=DEFAULT_LEVEL,
        metavar="L",
        help=f"of --to tiles (default: {DEFAULT_LEVEL})",
    )


def run(options: argparse.Namespace) -> None:
    """Writes the file, and prints what went into it and what did not."""
    if options.to in TRAJECTORIES:
        _run_trajectories(options, TRAJECTORIES[options.to])
        return
    if options.to in _FORMS:
        _run_form(options, _FORMS[options.to])
        return
    form = form_of(options.to)
    folder = _map_folder(options.map)
    out = options.out or folder.resolve().with_name(f"{folder.resolve().name}{form.ending}")
    _require_free(out, folder, form, options.overwrite)
    hd_map = _read(folder, options.bbox)
    with input_read():
        left = 0 if options.bbox is not None else tentative_count(folder)
    losses = export_map(hd_map, out, options.to)
    print(f"{form.title}: {out}: {len(hd_map.signs)} signs, {len(hd_map.lanes)} lane pieces")
    if left:
        losses = (f"{left} tentative signs, which are not part of the map", *losses)
    for loss in losses:
        print(f"left out: {loss}")


def _run_form(options: argparse.Namespace, form: ExportFormat) -> None:
    folder = _map_folder(options.map)
    out = options.out or folder.resolve().with_name(f"{folder.resolve().name}{form.ending}")
    _require_free(out, folder, form, options.overwrite)
    level = options.level if options.to == "tiles" else None
    if options.bbox is not None:
        hd_map = _read(folder, options.bbox)
        write_map(hd_map, out, min_confidence=0.0, tile_level=level)
        print(f"{form.title}: {out}: {len(hd_map.signs)} signs, {len(hd_map.lanes)} lane pieces")
        print("left out: tentative signs, and columns that FORMAT.md does not know")
        return
    with input_read():
        counts = rewrite_map(folder, out, level=level)
    told = [f"{count} {kind.replace('_', ' ')}" for kind, count in counts.items()]
    print(f"{form.title}: {out}: {', '.join(told)}")
    for path in sorted(folder.iterdir()):
        if path.name not in _MAP_NAMES:
            print(f"left out: {path.name}, which is not part of the map")


def _read(folder: Path, area: Area | None) -> HdMap:
    """The map, or what of it lies in an area; InputError where nothing does."""
    with input_read():
        hd_map = read_map(folder, area=area)
    if area is not None and not len(hd_map.signs) and not len(hd_map.lanes):
        raise InputError(f"{folder}: nothing of it lies in the area {area}")
    return hd_map


def _area(text: str) -> Area:
    try:
        return read_area(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def _run_trajectories(options: argparse.Namespace, form: ExportFormat) -> None:
    if options.bbox is not None:
        raise InputError(f"--bbox is of maps; --to {options.to} writes the drives of a RUN whole")
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
    known = _MAP_NAMES if form in _FORMS.values() else ()
    others = [] if not out.is_dir() else [p for p in out.iterdir() if p.name not in known]
    if any(file.suffix != form.ending for file in others):
        raise InputError(f"{out}: a folder with other files in it; choose another name")
    if out.exists() and not overwrite:
        raise InputError(f"{out}: exists; choose another name or give --overwrite")
