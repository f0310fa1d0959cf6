"""Interrupts runs at random instants, as a terminal and as an operator does, and resumes them."""

from __future__ import annotations

import argparse
import signal

from crowdmap_torch.soak.interrupted import add_options, cuts, interrupt, report

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What `soak signals` takes."""
    add_options(parser, count=10)


def run(options: argparse.Namespace) -> int:
    """Cuts and resumes all runs, prints what fails and a table; 0 if everything held."""
    chosen = cuts(_SIGNALS, options.count, options.stages, seed=options.seed)
    return report(interrupt(chosen, options.keep.resolve()))
