"""Measures speed and accuracy side by side with other software: `crowdmap benchmark NAME [options]`.

Each benchmark is a module of `crowdmap_torch.benchmark`; `crowdmap benchmark NAME --help` tells its options.
"""

from __future__ import annotations

import argparse

from crowdmap_torch.commands.subcommands import add_subcommands

BENCHMARKS = {
    "adjustment": "the mapper's own adjustment, on a CPU and on a GPU",
    "association": "landmarks told apart, ours against the paper's method",
    "bundle": "bundle adjustment, ours against Ceres and GTSAM",
    "cluster": "clustering at scale, ours against scikit-learn",
    "journey": "one drive: throughput and latency of a step",
    "ladybug": "bundle adjustment in the large, ours against Ceres",
    "stages": "the main job: time and memory of each stage, beside other states of the package",
    "viewer": "the page of crowdmap view: how fast it opens and draws",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The benchmarks, each with options of its own."""
    add_subcommands(parser, "crowdmap_torch.benchmark", BENCHMARKS)
