"""The paper's method beside ours on the same simulated datasets: what each makes of the crowd's detections."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from crowdmap_torch.config import METHODS, MapperConfig
from crowdmap_torch.evaluation.evaluate import evaluate_map
from crowdmap_torch.evaluation.map_figures import MapFigures
from crowdmap_torch.io.datasets import load_dataset
from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.maps import certain_part
from crowdmap_torch.io.truth import SignAssociations
from crowdmap_torch.mapper import build_map
from crowdmap_torch.ranges import Workers, argument
from crowdmap_torch.runs.folder import read_survey_of, read_truth_of
from crowdmap_torch.tables import Association, Dataset


@dataclass(frozen=True)
class Compared:
    """What one method makes of a dataset."""

    heads: MapFigures
    """The cluster heads, before adjustment."""
    adjusted: MapFigures


COLUMNS = (
    ("pairs: precision", lambda c: c.adjusted.association.pair_precision),
    ("recall", lambda c: c.adjusted.association.pair_recall),
    ("data loss", lambda c: c.adjusted.association.data_loss),
    ("signs: recall", lambda c: c.adjusted.signs.recall),
    ("precision", lambda c: c.adjusted.signs.precision),
    ("duplicates", lambda c: c.adjusted.signs.duplicates),
    ("close pairs", lambda c: c.adjusted.signs.close_pairs_told_apart),
    ("heads: relative [m]", lambda c: c.heads.signs.relative.total.mean),
    ("relative [m]", lambda c: c.adjusted.signs.relative.total.mean),
    ("absolute [m]", lambda c: c.adjusted.signs.absolute.total.mean),
    ("lanes: recall", lambda c: c.adjusted.lanes.recall),
    ("precision", lambda c: c.adjusted.lanes.precision),
    ("duplicates", lambda c: c.adjusted.lanes.duplicates),
)
"""Heading and value of each column of the table."""


def compare(
    dataset_folder: Path, methods: Sequence[str] = METHODS, *, workers: int = 1
) -> dict[str, Compared]:
    """Figures of the map that each method makes of a simulated dataset; InputError if its truth is missing."""
    dataset = load_dataset(dataset_folder)
    survey = read_survey_of(dataset_folder, dataset.origin)
    truth = read_truth_of(dataset_folder, dataset, survey)
    if survey is None or truth is None:
        raise InputError(f"{dataset_folder}: expected a simulated dataset with survey/truth")
    figures = {}
    for method in methods:
        config = replace(MapperConfig(), method=method)
        result = build_map(dataset, config, workers=workers)
        figures[method] = Compared(
            heads=evaluate_map(
                certain_part(result.map_clusters, config.min_confidence), survey, truth=truth
            ),
            adjusted=evaluate_map(
                certain_part(result.hd_map, config.min_confidence),
                survey,
                truth=truth,
                associations=sign_associations(dataset, result.associations),
            ),
        )
    return figures


def sign_associations(dataset: Dataset, associations: Sequence[Association]) -> SignAssociations:
    """The rows of the journeys' signs files that a map has in a landmark, as its run folder would say."""
    number = torch.arange(len(dataset.journeys))
    size = torch.tensor([len(a.sign) for a in associations])
    landmark = torch.cat([a.sign for a in associations])
    used = landmark >= 0
    return SignAssociations(
        journey=torch.repeat_interleave(number, size)[used],
        row=torch.cat([journey.signs.row for journey in dataset.journeys])[used],
        landmark=landmark[used],
    )


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Which datasets."""
    parser.add_argument("datasets", type=Path, nargs="+", metavar="DATASET", help="simulated ones")
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS))
    parser.add_argument(
        "--workers", type=argument(Workers), default=1, help="journeys mapped at a time"
    )


def run(options: argparse.Namespace) -> None:
    """Prints a line for each dataset and method."""
    headings = [heading for heading, _ in COLUMNS]
    print(f"{'dataset':<16} {'method':<10}", *headings, sep="  ")
    for folder in options.datasets:
        for method, figures in compare(folder, options.methods, workers=options.workers).items():
            values = (f"{float(value(figures)):>{len(heading)}.4g}" for heading, value in COLUMNS)
            print(f"{folder.name:<16} {method:<10}", *values, sep="  ", flush=True)
