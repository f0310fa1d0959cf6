"""Compares a map with a survey: `crowdmap evaluate MAP SURVEY [--control MAP] [--json OUT]`.

Prints a table of the figures that METRICS.md defines. With a simulated survey (`truth/` in it) and
the dataset around it, what the journeys could have seen is taken from the truth; MAP may be
RUN/map, and then associations and single journeys are judged too, or RUN/journeys/ID, the landmarks
of one journey.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from crowdmap_torch.evaluation.evaluate import control_ids_of, evaluate_map
from crowdmap_torch.evaluation.evidence import (
    gather_evidence,
    named_in,
    read_map_or_journey,
    read_observable_ids,
    run_of,
)
from crowdmap_torch.evaluation.text import format_figures
from crowdmap_torch.io.documents import write_json
from crowdmap_torch.io.errors import input_read
from crowdmap_torch.io.surveys import read_survey
from crowdmap_torch.ranges import Length, argument


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What `crowdmap evaluate` takes."""
    parser.add_argument("map", type=Path, metavar="MAP", help="a map, or RUN/journeys/ID")
    parser.add_argument("survey", type=Path, metavar="SURVEY", help="the survey, itself a map")
    parser.add_argument(
        "--control", type=Path, metavar="MAP", help="control signs, left out of all figures"
    )
    parser.add_argument("--json", type=Path, metavar="OUT", help="write the figures here too")
    parser.add_argument(
        "--gate",
        type=argument(Length),
        default=3.0,
        metavar="M",
        help="of sign centres [m] (default 3)",
    )
    parser.add_argument(
        "--observable", type=Path, metavar="JSON", help="lists of the ids of observable signs"
    )
    parser.add_argument(
        "--dataset", type=Path, metavar="DATASET", help="default: the folder that SURVEY is in"
    )
    parser.add_argument(
        "--run", type=Path, metavar="RUN", help="default: the folder of MAP, if it is RUN/map"
    )


def run(options: argparse.Namespace) -> None:
    """Prints the figures, and writes them where `options.json` says."""
    with input_read():
        hd_map = read_map_or_journey(options.map)
        survey = read_survey(options.survey)
        control_ids = ()
        if options.control is not None:
            control_ids = control_ids_of(read_survey(options.control), survey)
        observable_ids = None
        if options.observable is not None:
            observable_ids = named_in(survey, read_observable_ids(options.observable))
        evidence = gather_evidence(
            hd_map,
            survey,
            options.survey,
            dataset_folder=options.dataset,
            run_folder=options.run or run_of(options.map),
        )
        figures = evaluate_map(
            hd_map,
            survey,
            truth=evidence.truth,
            associations=evidence.associations,
            landmarks=evidence.landmarks,
            control_ids=control_ids,
            observable_ids=observable_ids,
            gate_m=options.gate,
            notes=evidence.notes,
        )
    print(format_figures(figures))
    if options.json is not None:
        write_json(options.json, figures.as_dict())
