"""Maps a dataset: `crowdmap optimize DATASET --out RUN [--config configs/NAME.yaml] [--device cpu|cuda]`.

Counts and figures are printed on stdout, progress and what looks wrong on stderr.

Reads like a training loop: load, map each journey, tell the landmarks of all journeys apart, then adjust everything at
once, step by step, watched in TensorBoard; last the map, its errors against the survey, and a report. `RUN` is
described in FORMAT.md.
"""

from __future__ import annotations

import argparse
import io
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import cached_property, partial
from pathlib import Path
from typing import TypedDict

# Before torch: its threads then sleep while they wait, and do not spin. On a busy machine that is several times faster.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import torch

from crowdmap_torch import __version__, mapper
from crowdmap_torch.adjustment import adjust
from crowdmap_torch.adjustment.bundle import Bundle
from crowdmap_torch.adjustment.calibration import CalibrationConfig
from crowdmap_torch.commands.whereabouts import Whereabouts
from crowdmap_torch.config import MapperConfig, dump, load_config
from crowdmap_torch.evaluation.evaluate import Against, against, control_ids_of
from crowdmap_torch.evaluation.map_figures import MapFigures
from crowdmap_torch.evaluation.text import format_figures
from crowdmap_torch.fleet.choice import ENGINES
from crowdmap_torch.io.area import Area, Cut, cut_dataset, cut_truth, read_area
from crowdmap_torch.io.budget import reading
from crowdmap_torch.io.datasets import NoJourneyLeft, load_dataset
from crowdmap_torch.io.documents import plain
from crowdmap_torch.io.errors import InputError, input_read, one_line
from crowdmap_torch.io.maps import certain_part
from crowdmap_torch.io.remote import place_of
from crowdmap_torch.io.tiled_maps import DEFAULT_LEVEL, TileLevel
from crowdmap_torch.io.truth import Truth
from crowdmap_torch.noise.calibration import KnownCalibration
from crowdmap_torch.optim.levenberg_marquardt import LmState
from crowdmap_torch.plausibility.finding import Finding
from crowdmap_torch.processes.interrupts import keeping
from crowdmap_torch.processes.memory import keep_in_one_place
from crowdmap_torch.processes.threads import one_core_each
from crowdmap_torch.ranges import Count, Workers, argument
from crowdmap_torch.report.fates import missing_findings
from crowdmap_torch.report.html import write_report
from crowdmap_torch.report.outcomes import sign_outcomes
from crowdmap_torch.report.progress import Progress
from crowdmap_torch.report.record import record_of
from crowdmap_torch.report.rotations import rotation_findings
from crowdmap_torch.report.stages import keep_and_log, log_crowd
from crowdmap_torch.report.summaries import counts_line
from crowdmap_torch.report.tensorboard import TensorBoardLog
from crowdmap_torch.report.unsettled import unsettled_findings
from crowdmap_torch.report.watch import Watch
from crowdmap_torch.runs.calibration import read_found
from crowdmap_torch.runs.checkpoint import Checkpoint, Found, Step, inputs_of
from crowdmap_torch.runs.folder import (
    RunFolder,
    figures_of,
    read_survey_at,
    read_survey_of,
    read_truth_of,
    refuse_overlap,
)
from crowdmap_torch.runs.metrics import metrics_of
from crowdmap_torch.tables import Dataset, RejectedJourney, Survey, SurveySigns, to_device

_OFF = "off"
"""`--calibration off`."""
EMPTY_MAP = 3
"""Exit code with `--strict` where a map was written without the signs or lanes that were detected."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What `crowdmap optimize` takes."""
    parser.add_argument(
        "dataset", type=place_of, nargs="?", metavar="DATASET", help="folder as in FORMAT.md or URL"
    )
    parser.add_argument("--out", type=Path, metavar="RUN", help="folder to write")
    parser.add_argument("--config", type=Path, metavar="YAML", help="what differs from defaults")
    parser.add_argument(
        "--control", type=Path, metavar="MAP", help="surveyed signs that pin the map, as a survey"
    )
    parser.add_argument(
        "--calibration",
        metavar="RUN|off",
        help="start from what an earlier run found of the cars; off: rig.yaml is right in all of them",
    )
    parser.add_argument("--influence", action="store_true", help="what each drive does to the map")
    parser.add_argument(
        "--journeys",
        metavar="ID,ID...",
        help="map these alone: ids, or patterns such as 2026-05-*, with commas between them",
    )
    parser.add_argument(
        "--bbox",
        type=_area,
        metavar="E0,N0,E1,N1",
        help="map what drives saw from inside this area alone [m east and north of the origin]",
    )
    parser.add_argument(
        "--tiles",
        type=argument(TileLevel),
        nargs="?",
        const=DEFAULT_LEVEL,
        metavar="LEVEL",
        help=f"write the map in tiles of HERE's and NDS's grid (level {DEFAULT_LEVEL} without LEVEL)",
    )
    parser.add_argument(
        "--device",
        default="cpu",
        help="cpu (default), or cuda: from the clusters on, with --engine local from the first frame on",
    )
    parser.add_argument(
        "--workers",
        type=argument(Workers),
        metavar="N",
        help="journeys mapped at a time (default: one for each core)",
    )
    parser.add_argument(
        "--engine",
        choices=ENGINES,
        help="where drives are mapped: in this process, in processes beside it (default), on Ray",
    )
    parser.add_argument(
        "--address",
        metavar="HOST:PORT",
        help="of a Ray cluster (default: one of this machine, which ends with the run)",
    )
    parser.add_argument(
        "--strict", action="store_true", help="a bad journey or an empty map is an error"
    )
    parser.add_argument("--overwrite", action="store_true", help="replace what RUN holds")
    parser.add_argument("--resume", action="store_true", help="go on where RUN was interrupted")
    parser.add_argument(
        "--log-every",
        type=argument(Count),
        default=1,
        metavar="N",
        help="errors and histograms every N steps",
    )
    parser.add_argument("-q", "--quiet", action="store_true", help="no progress on stderr")
    parser.add_argument(
        "--print-config",
        action="store_true",
        help="print the whole configuration as YAML, defaults filled in, and do nothing else",
    )


def run(options: argparse.Namespace) -> int:
    """Maps a dataset into a folder; the exit code."""
    keep_in_one_place()
    with input_read():
        config = load_config(options.config)
        if options.calibration == _OFF:
            config = replace(config, calibration=CalibrationConfig.off())
        if options.influence:
            config = replace(config, adjust=replace(config.adjust, influence=True))
    if options.print_config:
        print(dump(config), end="")
        return 0
    if options.dataset is None or options.out is None:
        missing = "DATASET" if options.dataset is None else "--out RUN"
        raise InputError(f"{missing} is missing; see {options.prog} --help")
    with input_read():
        refuse_overlap(options.out, options.dataset)
        folder = RunFolder(options.out, overwrite=options.overwrite, resume=options.resume)
        where = Whereabouts(options)
    # The folder first: whether it can be written, and by nobody else, is known before anything is read at length.
    with keeping(folder.kept), folder.claimed(), one_core_each(), where:
        if not options.resume:
            where.begin_early(options.dataset)
        with reading(config.reading):
            where.bring(options.dataset, _wanted(options))
        return _map(options, folder, config, where)


def _map(
    options: argparse.Namespace, folder: RunFolder, config: MapperConfig, where: Whereabouts
) -> int:
    with input_read():
        device, given = where.device, _read(options, config, where)
        dataset, survey, truth = given.dataset, given.survey, given.truth
        inputs = inputs_of(dataset, config, survey, truth, given.control, given.cars, device=device)
        kept = Checkpoint(folder.checkpoint, inputs)
        found = _take_up(kept, folder, len(dataset.journeys), device) if options.resume else Found()
    if found is None:
        return 0
    where.begin(is_needed=len(found.journeys) < len(dataset.journeys))
    look = where.looked_over(options.dataset, dataset, config, inputs["journey"])
    findings = _told(look.findings, dataset)

    progress = Progress(io.StringIO() if options.quiet else None)
    folder.prepare(options.dataset)
    kept.begin()
    with TensorBoardLog(folder.tensorboard) as log:
        log.log_config(dump(config))

        # ---- one journey at a time (section IV) ----
        keep = keep_and_log(kept.keep_journey, log, dataset.journeys)
        how = {"known": found.journeys, "progress": progress, "keep": keep}
        maps = mapper.map_journeys(dataset.journeys, config, **where.by_whom(look, config), **how)
        dataset, maps = where.mapped(dataset, maps)
        journeys = dataset.journeys

        # ---- landmarks of all journeys told apart, biases found (section V-A) ----
        progress("clusters and biases")
        first = found.first or kept.keep_first(mapper.first_map(journeys, maps, config))
        if found.first is None:
            log_crowd(log, dataset, first)

        # ---- everything at once (section V-B), and again where signs turned out to be one ----
        watch = given.watch(log, first, config, found, every=options.log_every)
        last, step = found.again.first if found.again else first, found.step
        while True:
            progress("bundle adjustment: building")
            bundle = mapper.build_bundle(journeys, maps, last, config, **given.beside(device))
            begun = adjust.start(bundle) if step is None else adjust.go_on(bundle, step.standing)
            if found.start is None and not last.anew:
                kept.keep_start(watch.start(bundle, mapper.clusters_map(dataset, first)))
            watch.follow(last.signs, last.lanes, bundle if last.anew and step is None else None)
            by, how = where.of_convoys(bundle), _how(bundle, step, last.anew, kept, watch, progress)
            ask = partial(mapper.made_anew, journeys, maps, last, bundle, config, by)
            state, (again, uncertainty) = adjust.adjust_until(bundle, begun, ask, engine=by, **how)
            if again is None:
                break
            last, step = kept.keep_anew(again, watch.course), None
            del ask, how, bundle, begun, state  # As large as the next ones.

        # ---- the map ----
        progress("covariances and map")
        result = mapper.finish_map(dataset, maps, last, bundle, state, config, by, uncertainty)
        watch.finish(bundle, result.hd_map)
    dataset, result = to_device((dataset, result), "cpu")  # To be written and drawn.
    folder.write_result(dataset, result, config, tile_level=options.tiles)

    # ---- its errors against the survey, the report ----
    with folder.publishing():
        progress("errors and report")
        compared = None, None
        with _spared("figures"):
            compared = _compared(result, config, given, folder)
        progress.finish()
        missing = _told(missing_findings(dataset, result, config), dataset)
        strained = *unsettled_findings(dataset, first), *rotation_findings(dataset, result)
        warnings = (*findings, *_told(strained, dataset), *missing)
        spent = progress, where.engine.spent_on()
        metrics = metrics_of(dataset, result, config, watch.iterations, *spent, *compared)
        folder.write_metrics({**metrics, "area": plain(given.cut), "warnings": plain(warnings)})
        with _spared("report"):
            outcomes = folder.keep_outcomes(sign_outcomes(dataset, result, bundle, config))
            known = (progress, survey, truth, *compared, warnings, outcomes)
            record = record_of(dataset, result, config, watch, *known, _facts(options, given.cut))
            write_report(folder.unfinished / folder.report.name, record)
    kept.finish()
    print(f"{counts_line(dataset, result, config)}\nmap: {folder.map}\nreport: {folder.report}")
    return EMPTY_MAP if options.strict and missing else 0


class _How(TypedDict):
    told: adjust.ToldCall
    first: int


def _how(
    bundle: Bundle, step: Step | None, anew: int, kept: Checkpoint, watch: Watch, progress: Progress
) -> _How:
    """From which step on an adjustment is to be taken, and what watches and keeps every step."""

    def told(number: int, state: LmState, seen: adjust.Seen) -> None:
        watch.step(len(watch.iterations), state, bundle, seen())
        kept.keep_step(adjust.standing(bundle, state, number + 1), watch.course, anew)
        most = bundle.config.lm.max_iterations
        progress("bundle adjustment", number + 1, most, f"cost {float(state.cost):.1f}")

    return {"told": told, "first": 0 if step is None else step.standing.steps}


@contextmanager
def _spared(what: str) -> Iterator[None]:
    """What scorers or the report trip over costs figures or a page, with a line, and never the map."""
    try:
        yield
    except (ValueError, ArithmeticError, LookupError, RuntimeError, TypeError) as error:
        reason = f"{type(error).__name__}: {one_line(error)}"
        print(f"looks wrong: no {what} could be made ({reason}); the map is whole", file=sys.stderr)


class _Beside(TypedDict):
    control: SurveySigns | None
    known_cars: Mapping[str, KnownCalibration]


@dataclass(frozen=True)
class _Given:
    dataset: Dataset
    survey: Survey | None
    truth: Truth | None
    control: Survey | None
    """Surveyed signs that pin the map."""
    cars: Mapping[str, KnownCalibration]
    """What an earlier run found of their calibrations."""
    cut: Cut | None
    """What `--bbox` left out."""

    def watch(
        self,
        log: TensorBoardLog,
        first: mapper.FirstMap,
        config: MapperConfig,
        found: Found,
        *,
        every: int,
    ) -> Watch:
        """What watches the adjustment from where it was found, with errors against what is asked of the finished map."""
        least = config.min_confidence
        watch = Watch(log, self.asked, first.signs, first.lanes, every=every, min_confidence=least)
        if found.start is not None:
            watch.go_on(found.start, found.course)
        return watch

    @cached_property
    def asked(self) -> Against | None:
        """What the survey asks of the map, of the finished one as of those on the way there."""
        if self.survey is None:
            return None
        known = () if self.control is None else control_ids_of(self.control, self.survey)
        area = None if self.cut is None else Area(*self.cut.bbox)
        truth = to_device(self.truth, "cpu")
        return against(self.survey, truth=truth, control_ids=known, area=area)

    def beside(self, device: torch.device) -> _Beside:
        """What is known beside the drives, for the bundle."""
        pins = None if self.control is None else self.control.signs.to(device)
        return {"control": pins, "known_cars": self.cars}


def _read(options: argparse.Namespace, config: MapperConfig, where: Whereabouts) -> _Given:
    """What there is to map from, and to judge the map by."""
    folder = where.at_hand
    with reading(config.reading, inside=folder):
        dataset = _load(options, folder, where.of_journeys)
        survey = read_survey_of(folder, dataset.origin)
        truth, cut = read_truth_of(folder, dataset, survey), None
    if options.bbox is not None:
        dataset, cut = cut_dataset(dataset, options.bbox)
        truth = truth and cut_truth(truth, options.bbox)
        print(cut)
    with reading(config.reading):
        control = options.control and read_survey_at(options.control, dataset.origin)
        is_known = (earlier := options.calibration) not in (None, _OFF)
        cars = read_found(Path(earlier), dataset.journeys) if is_known else {}
    new = sorted({journey.vehicle for journey in dataset.journeys} - cars.keys())
    if is_known and new:
        names = ", ".join(new[:5]) + (f" and {len(new) - 5} others" if len(new) > 5 else "")
        print(f"warning: --calibration {earlier}: nothing is known of {names}", file=sys.stderr)
    return _Given(dataset, survey, truth, control, cars, cut)


def _wanted(options: argparse.Namespace) -> list[str] | None:
    return None if options.journeys is None else options.journeys.split(",")


def _load(options: argparse.Namespace, folder: Path, device: torch.device) -> Dataset:
    """The dataset; every journey that is set aside is named, also where none is left."""
    wanted = _wanted(options)
    try:
        dataset = load_dataset(folder, device=device, strict=options.strict, journeys=wanted)
    except NoJourneyLeft as error:
        _tell_rejected(error.rejected)
        raise
    _tell_rejected(dataset.rejected)
    return dataset


def _tell_rejected(rejected: Sequence[RejectedJourney]) -> None:
    for journey in rejected:
        print(f"set aside {journey.journey_id}: {journey.reason}", file=sys.stderr)


def _told(findings: tuple[Finding, ...], dataset: Dataset) -> tuple[Finding, ...]:
    """The findings, each told on stderr in a line."""
    for finding in findings:
        print(f"looks wrong: {finding.line(len(dataset.journeys))}", file=sys.stderr)
    return findings


def _take_up(
    kept: Checkpoint, folder: RunFolder, journeys: int, device: torch.device
) -> Found | None:
    """What an interrupted run had finished, said in a line; None if it was not interrupted."""
    if kept.is_finished(folder.map):
        # It may have been killed while it removed its stages.
        kept.drop_stages()
        print(f"finished already: {folder.map}")
        return None
    found = kept.found(journeys, device=device)
    for line in found.lines(journeys):
        print(f"resuming: {line}", file=sys.stderr)
    return found


def _compared(
    result: mapper.MapResult, config: MapperConfig, given: _Given, folder: RunFolder
) -> tuple[MapFigures | None, MapFigures | None]:
    """Figures of the map, which are printed, and of that of the cluster heads, where there is a survey."""
    survey, truth, asked = given.survey, given.truth, given.asked
    if survey is None or asked is None:
        return None, None
    final, before = (
        certain_part(m, config.min_confidence) for m in (result.hd_map, result.map_clusters)
    )
    figures = figures_of(final, survey, truth, folder.unfinished, asked)
    print(format_figures(figures))
    return figures, figures_of(before, survey, truth, None, asked)


def _facts(options: argparse.Namespace, cut: Cut | None) -> dict[str, str]:
    """What a report says at its head of what was mapped, when and with what."""
    place = options.dataset
    facts = {
        "data set": str(place.resolve() if isinstance(place, Path) else place),
        "mapped": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "with": f"crowdmap {__version__}",
    }
    if options.config is not None:
        facts["configuration"] = str(options.config)
    return facts if cut is None else {**facts, "cut to": str(cut)}


def _area(text: str) -> Area:
    try:
        return read_area(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None
