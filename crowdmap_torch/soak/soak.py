"""What the mapper stands: `python scripts/soak.py NAME [options]`."""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence

# Before torch: a process with threads cannot be forked.
os.environ["OMP_NUM_THREADS"] = "1"

from crowdmap_torch.commands.subcommands import OneLineParser, add_subcommands

STUDIES = {
    "mutants": "destroy inputs at random, and run commands on what is left",
    "kills": "kill runs at random instants, and resume them",
    "mended": "map good data sets, the same with a mistake, and these put right",
    "mistakes": "make the usual mistakes on good data sets, and check and mend them",
    "signals": "interrupt runs at random instants, and resume them",
    "worlds": "map roads, cameras, detectors and receivers of all kinds",
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Reads the command line and runs one study; 0 if everything held."""
    parser = OneLineParser(prog="soak", description="What the mapper stands.")
    add_subcommands(parser, "crowdmap_torch.soak", STUDIES)
    options = argparse.Namespace(prog="soak")
    parser.parse_args(arguments, options)
    return options.module.run(options)
