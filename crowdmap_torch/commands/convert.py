"""Brings drives in other formats into a dataset: `crowdmap convert --from FORMAT SOURCE ... --rig RIG --out DATASET`.

`--from` may be given several times: one source has the poses, others the detections. Each call writes
one journey; `--add` puts it into a dataset that is there. `--formats` lists what can be read.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from crowdmap_torch.io.budget import ReadingBudget, reading
from crowdmap_torch.io.errors import InputError, input_read
from crowdmap_torch.io.formats.composing import axes, registry
from crowdmap_torch.io.formats.composing.compose import (
    Drive,
    add_to,
    compose,
    existing_origin,
    write_new,
    write_survey_alone,
)
from crowdmap_torch.io.formats.composing.lines import TIME_UNITS
from crowdmap_torch.io.formats.composing.parts import Asked, Parts
from crowdmap_torch.ranges import Length, Offset, argument
from crowdmap_torch.tables import Dataset, Origin, Survey

_BUDGET = ReadingBudget(text_bytes=2 * 2**30, nodes=500_000_000)
"""Detections of a whole drive are one text file in many formats."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What `crowdmap convert` takes."""
    parser.add_argument(
        "--from",
        dest="sources",
        action="append",
        nargs="+",
        default=[],
        metavar=("FORMAT", "SOURCE"),
        help="a format and its files; may be given several times",
    )
    parser.add_argument("--out", type=Path, metavar="DATASET", help="folder of the dataset")
    parser.add_argument("--formats", action="store_true", help="list the formats, and end")
    parser.add_argument("--add", action="store_true", help="adds the journey to a dataset in OUT")
    parser.add_argument("--overwrite", action="store_true", help="replaces a dataset in OUT")
    parser.add_argument("--rig", type=Path, help="rig.yaml (docs/FORMAT.md), or its folder")
    parser.add_argument("--journey", metavar="NAME", help="default: the name of the poses' file")
    parser.add_argument("--vehicle", metavar="NAME", help="whose drives share a calibration")
    _add_conventions(parser.add_argument_group("what stands in no file"))
    _add_detections(parser.add_argument_group("detections"))


def _add_conventions(group: argparse._ArgumentGroup) -> None:
    group.add_argument(
        "--origin",
        type=float,
        nargs=3,
        metavar=("LAT", "LON", "HEIGHT"),
        help="where the poses' world touches the earth [degrees, m]",
    )
    group.add_argument(
        "--world",
        choices=tuple(axes.WORLD_TEXTS),
        help=_texts("axes of the poses' world", axes.WORLD_TEXTS),
    )
    group.add_argument(
        "--axes", choices=tuple(axes.LINK_TEXTS), help=_texts("axes of the poses", axes.LINK_TEXTS)
    )
    group.add_argument(
        "--camera-at",
        type=argument(Offset),
        nargs=3,
        metavar=("X", "Y", "Z"),
        help="place of a camera that looks straight ahead, in those axes [m]",
    )
    group.add_argument("--drive", metavar="NAME", help="the drive of a source with several")
    group.add_argument("--camera", metavar="NAME", help="the camera of a log with several")
    group.add_argument(
        "--camera-height",
        type=argument(Length),
        metavar="M",
        help="of a log's camera over the road, if the log does not say it or is wrong [m]",
    )
    group.add_argument(
        "--heading",
        choices=("course",),
        help="fixes without headings: the direction of travel stands for them",
    )
    units = ", ".join(TIME_UNITS)
    group.add_argument(
        "--images",
        metavar="number|UNIT|FILE",
        help=f"which frame an image is: the last number in its name is the row of the pose (number) or a "
        f"time (UNIT: {units}), or FILE has lines of time and name",
    )
    group.add_argument(
        "--first-frame", type=int, default=0, metavar="N", help="number of the first frame (0)"
    )
    group.add_argument(
        "--time-offset",
        type=argument(Offset),
        default=0.0,
        metavar="S",
        help="what to add to the images' times to have the poses' [s]",
    )


def _add_detections(group: argparse._ArgumentGroup) -> None:
    group.add_argument(
        "--sign-names",
        type=Path,
        metavar="FILE",
        help="CSV or YAML: name, shape, code, width_m, height_m",
    )
    group.add_argument(
        "--skip-unknown-signs", action="store_true", help="leaves out classes that no table has"
    )
    group.add_argument(
        "--pixel-origin",
        choices=("centre", "corner"),
        help="where (0, 0) is of the first pixel, if not where the format has it",
    )


def run(options: argparse.Namespace) -> None:
    """Writes the dataset, and shows what is in it and what was left out."""
    if options.formats:
        _list_formats()
        return
    with input_read(), reading(_BUDGET):
        if not options.sources or options.out is None:
            raise InputError(
                "expected --from FORMAT SOURCE ... and --out DATASET; --formats lists formats"
            )
        asked = _asked(options)
        parts = _read(options, asked)
        if not options.add and all(_is_survey_alone(part) for part in parts):
            survey = write_survey_alone(options.out, parts, overwrite=options.overwrite)
            _show_survey(options.out, survey, [note for part in parts for note in part.notes])
            return
        drive = compose(
            parts, asked, rig=options.rig, journey_id=options.journey, vehicle_id=options.vehicle
        )
        if options.add:
            dataset = add_to(options.out, drive)
        else:
            dataset = write_new(options.out, drive, overwrite=options.overwrite)
    _show(options.out, drive, dataset)


def _is_survey_alone(part: Parts) -> bool:
    return part.survey is not None and part.track is None and part.rig is None


def _read(options: argparse.Namespace, asked: Asked) -> list[Parts]:
    """What the sources give."""
    sources = [(name, tuple(map(Path, paths))) for name, *paths in options.sources]
    for name, paths in sources:
        if not paths:
            raise InputError(f"--from {name}: expected a file or a folder after the format")
        for path in paths:
            _refuse_missing(path, options.out)
    return [registry.find(name).read(paths, asked) for name, paths in sources]


def _asked(options: argparse.Namespace) -> Asked:
    """What the command line says of the sources."""
    origin = None if options.origin is None else Origin(*options.origin)
    if options.add:
        there = existing_origin(options.out)
        if origin is not None and not origin.is_same(there):
            raise InputError(f"{options.out}: its origin is {there}; leave --origin out")
        origin = there
    return Asked(
        origin=origin,
        world=options.world,
        link=options.axes,
        camera_at=None if options.camera_at is None else tuple(options.camera_at),
        images=options.images,
        first_frame=options.first_frame,
        time_offset_s=options.time_offset,
        sign_names=options.sign_names,
        skip_unknown_signs=options.skip_unknown_signs,
        drive=options.drive,
        camera=options.camera,
        camera_height=options.camera_height,
        heading=options.heading,
        pixel_origin=options.pixel_origin,
    )


def _refuse_missing(path: Path, out: Path) -> None:
    if not path.exists():
        raise InputError(f"{path}: the file is missing; expected a source")
    if path.resolve().is_relative_to(out.resolve()):
        raise InputError(f"{path}: a source inside {out}; expected it elsewhere")


def _show(out: Path, drive: Drive, dataset: Dataset) -> None:
    journey = dataset.journeys[0]
    counts = (
        (journey.frame_count, "frames"),
        (len(journey.signs), "signs"),
        (len(journey.lanes), "lane markers"),
    )
    print(
        f"{out}: journey {journey.journey_id!r} with "
        + ", ".join(f"{n} {what}" for n, what in counts)
    )
    if drive.survey is not None:
        print(
            f"  a survey with {len(drive.survey.sign_id)} signs and {len(drive.survey.lane_id)} lane markers"
        )
    for note in drive.notes:
        print(f"  {note}")
    for reason, count in journey.dropped.items():
        print(f"  {count} left out by FORMAT.md's rules: {reason}")
    if sizes := sorted({size for rows in drive.signs for size in rows.sizes_m}):
        known = ", ".join(f"[{width:g}, {height:g}]" for width, height in sizes)
        print(f"  sizes of these signs, for a --config: adjust: {{size_classes_m: [{known}]}}")


def _show_survey(out: Path, survey: Survey, notes: list[str]) -> None:
    print(
        f"{out}: a survey with {len(survey.sign_id)} signs and {len(survey.lane_id)} lane markers"
    )
    for note in notes:
        print(f"  {note}")


def _list_formats() -> None:
    for name in registry.names():
        importer = registry.find(name)
        print(
            f"{name:<16} {', '.join(importer.gives):<14} {importer.summary}; tested on {importer.tested_on}"
        )


def _texts(what: str, texts: dict[str, str]) -> str:
    return f"{what}: " + "; ".join(f"{name} = {text}" for name, text in texts.items())
