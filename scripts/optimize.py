"""Maps a dataset: `optimize.py DATASET --out RUN [--config configs/NAME.yaml] [--device cpu|cuda]`.

Reads like a training loop: load, map each journey, tell the landmarks of all journeys apart, then adjust everything at
once, step by step, watched in TensorBoard; last the map, its errors against the survey, and a report. `RUN` is
described in FORMAT.md. Exit code 2: the input or the configuration is wrong, said in one line.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

# Before torch: its threads then sleep while they wait, and do not spin. On a busy machine that is several times faster.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import torch

from crowdmap_torch import mapper
from crowdmap_torch.config import config_hash, dump, load_config
from crowdmap_torch.evaluation.text import format_figures
from crowdmap_torch.io.datasets import load_dataset
from crowdmap_torch.report.checkpoints import load_checkpoint, save_checkpoint
from crowdmap_torch.report.html import write_report
from crowdmap_torch.report.progress import Progress
from crowdmap_torch.report.tensorboard import TensorBoardLog
from crowdmap_torch.report.watch import Watch
from crowdmap_torch.run_folder import (
    RunFolder,
    figures_of,
    read_survey_at,
    read_survey_of,
    read_truth_of,
)
from crowdmap_torch.run_metrics import metrics_of, record_of
from crowdmap_torch.stages import adjust


def main(arguments: list[str] | None = None) -> int:
    """The exit code: 0 a map was written, 2 the input is wrong."""
    options = _parser().parse_args(arguments)
    try:
        run = RunFolder(options.out, overwrite=options.overwrite, resume=options.resume)
        config = load_config(options.config)
        device = _device(options.device)
        dataset = load_dataset(options.dataset, device=device, strict=options.strict)
        survey = read_survey_of(options.dataset, dataset.origin)
        truth = read_truth_of(options.dataset, dataset, survey)
        control = None
        if options.control is not None:
            control = read_survey_at(options.control, dataset.origin)
    except ValueError as error:
        print(f"optimize.py: {error}", file=sys.stderr)
        return 2
    for rejected in dataset.rejected:
        print(f"set aside {rejected.journey_id}: {rejected.reason}", file=sys.stderr)

    progress = Progress()
    run.prepare()
    with TensorBoardLog(run.tensorboard) as log:
        log.log_config(dump(config))

        # ---- one journey at a time (section IV) ----
        journeys = dataset.journeys
        maps = mapper.map_journeys(journeys, config, workers=options.workers, progress=progress)

        # ---- landmarks of all journeys told apart, biases found (section V-A) ----
        progress("clusters and biases")
        first = mapper.first_map(journeys, maps, config)

        # ---- everything at once (section V-B) ----
        progress("bundle adjustment: building")
        known = None if control is None else control.signs.to(device)
        bundle = mapper.build_bundle(journeys, maps, first, config, control=known)
        start = 0
        if options.resume and run.checkpoint.exists():
            try:
                saved = load_checkpoint(run.checkpoint, bundle, config_hash=config_hash(config))
            except ValueError as error:
                print(f"optimize.py: {error}", file=sys.stderr)
                return 2
            start = saved.iteration
        state = adjust.start(bundle)
        backend = bundle.backend()
        watch = Watch(log, survey, first.signs, first.lanes, every=options.log_every)
        watch.start(bundle, mapper.clusters_map(dataset, first))
        most = config.adjust.lm.max_iterations
        for iteration in range(start, most):
            state, finished = adjust.adjust_step(bundle, state, backend)
            watch.step(iteration, state, bundle)
            save_checkpoint(
                run.checkpoint, bundle, config_hash=config_hash(config), iteration=iteration + 1
            )
            progress("bundle adjustment", iteration + 1, most, f"cost {float(state.cost):.1f}")
            if finished:
                break

        # ---- the map ----
        progress("covariances and map")
        result = mapper.finish_map(dataset, maps, first, bundle, state, config)
        watch.finish(bundle, result.hd_map)
    run.write_result(dataset, result, config)

    # ---- its errors against the survey, the report ----
    progress("errors and report")
    figures = figures_before = None
    if survey is not None:
        final, before = (
            mapper.certain_part(m, config.min_confidence)
            for m in (result.hd_map, result.map_clusters)
        )
        figures = figures_of(final, survey, truth, run, control)
        figures_before = figures_of(before, survey, truth, None, control)
        print(format_figures(figures))
    progress.finish()
    seconds, compared = progress.seconds, (figures, figures_before)
    run.write_metrics(metrics_of(dataset, result, config, watch.iterations, seconds, *compared))
    record = record_of(dataset, result, config, watch, seconds, survey, truth, *compared)
    write_report(run.report, record)
    print(f"map: {run.map}")
    print(f"report: {run.report}")
    return 0


def _device(name: str) -> torch.device:
    if name.startswith("cuda") and not torch.cuda.is_available():
        raise ValueError(f"--device {name}: no CUDA device is there; use --device cpu")
    try:
        return torch.device(name)
    except RuntimeError:
        raise ValueError(f"--device {name}: expected cpu or cuda") from None


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("dataset", type=Path, metavar="DATASET", help="a folder as in FORMAT.md")
    parser.add_argument("--out", type=Path, required=True, metavar="RUN", help="folder to write")
    parser.add_argument("--config", type=Path, metavar="YAML", help="what differs from defaults")
    parser.add_argument(
        "--control", type=Path, metavar="MAP", help="surveyed signs that pin the map, as a survey"
    )
    parser.add_argument("--device", default="cpu", help="cpu (default) or cuda")
    parser.add_argument(
        "--workers",
        type=int,
        default=os.cpu_count() or 1,
        metavar="N",
        help="journeys mapped at a time (default: one for each core)",
    )
    parser.add_argument("--strict", action="store_true", help="a bad journey is an error")
    parser.add_argument("--overwrite", action="store_true", help="replace what RUN holds")
    parser.add_argument("--resume", action="store_true", help="go on where RUN was interrupted")
    parser.add_argument(
        "--log-every", type=int, default=1, metavar="N", help="errors and histograms every N steps"
    )
    return parser


if __name__ == "__main__":
    sys.exit(main())
