"""Draws the paper's figures, ours beside them: `crowdmap study NAME [--out DIR] [--quick]`.

Each study is a module of `crowdmap_torch.studies`; `crowdmap study all` runs those of docs/RESULTS.md. What is done is
kept in DIR and not done again: a study that was stopped goes on where it was.
"""

from __future__ import annotations

import argparse

from crowdmap_torch.commands.subcommands import add_subcommands

STUDIES = {
    "all": "all of the studies below but the last two",
    "journeys": "errors over the number of journeys (the paper's first figure)",
    "data-loss": "detections that end in no landmark (the paper's second figure)",
    "bundle-gain": "cluster heads against the adjusted map",
    "road-normal": "lane width with and without the online road normal",
    "preset": "the positioning presets, checked by the paper's own method",
    "ablation": "each idea beyond the paper switched off in turn",
    "noise": "pixel noise, bias, outliers and missed detections swept",
    "bad-drives": "one bad drive among good ones",
    "control": "a few surveyed signs pin the map",
    "convergence": "whether a start a metre off and gross outliers decide",
    "honesty": "whether the map knows how wrong it is",
    "efficiency": "ours beside the best linear estimator and the Cramer-Rao bound",
    "real": "real drives: kitti-signs by sequence",
    "long": "drives of 1 km and of 20 km whose bias wanders, and what a drive takes by its length",
    "fleet": "wrong calibrations, late clocks, rolling shutters and detectors with habits",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The studies, each with options of its own."""
    add_subcommands(parser, "crowdmap_torch.studies", STUDIES)
