"""Writes what one can walk around in: `crowdmap view MAP|RUN|DATASET [--out FILE.html] [--rerun FILE.rrd]`.

The page is one HTML file that needs no network: the map from above and in 3D, signs with their numbers, their drives and
their detections in the image, the map before and after the adjustment, errors against a survey. A MAP alone shows the map,
a RUN everything, a DATASET its raw drives, frame by frame. `--rerun` writes the same as a recording for the rerun viewer,
every camera with what it detected along time, instead of the page; with `--out` beside it.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from crowdmap_torch.io.errors import InputError, input_read
from crowdmap_torch.viewer.page import write_page
from crowdmap_torch.viewer.recording import rerun_sdk, write_recording
from crowdmap_torch.viewer.sources import read_scene, with_journeys


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What `crowdmap view` takes."""
    parser.add_argument("path", type=Path, metavar="MAP|RUN|DATASET", help="what is shown")
    parser.add_argument(
        "--out", type=Path, metavar="FILE.html", help="default: beside it, named after it"
    )
    parser.add_argument(
        "--rerun",
        type=Path,
        metavar="FILE.rrd",
        help="a recording for the rerun viewer (needs crowdmap_torch[rerun]); the page only with --out",
    )
    parser.add_argument(
        "--dataset", type=Path, help="of a RUN: the data set it was made of, if it was moved"
    )
    parser.add_argument(
        "--survey", type=Path, metavar="MAP", help="default: the survey of the data set"
    )
    parser.add_argument("--overwrite", action="store_true", help="replace a file that exists")


def run(options: argparse.Namespace) -> None:
    """Writes the page, the recording or both, and says where."""
    shown: Path = options.path
    page, recording = options.out, options.rerun
    if page is None and recording is None:
        page = shown.resolve().with_name(f"{shown.resolve().name}.html")
    for out in (page, recording):
        if out is not None:
            _require_free(out, options.overwrite)
    if recording is not None:
        # Reading takes longer than to see that nothing can be written.
        rerun_sdk()
    with input_read():
        scene = read_scene(shown, dataset=options.dataset, survey=options.survey)
        recorded = scene
        if recording is not None:
            recorded = with_journeys(scene, shown, options.dataset)
    if page is not None:
        write_page(page, scene)
    if recording is not None:
        write_recording(recording, recorded)
    for note in recorded.notes:
        print(f"note: {note}")
    for kind, out in (("view", page), ("recording", recording)):
        if out is not None:
            print(f"{kind}: {out}")


def _require_free(out: Path, overwrite: bool) -> None:
    """InputError if something stands at `out` that is not to be replaced."""
    if out.is_dir():
        raise InputError(f"{out}: a folder; expected the name of a file")
    if out.exists() and not overwrite:
        raise InputError(f"{out}: exists; choose another name or give --overwrite")
