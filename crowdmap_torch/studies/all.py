"""All studies of docs/RESULTS.md, on one page."""

from __future__ import annotations

import argparse

from crowdmap_torch.studies import (
    ablation,
    bad_drives,
    bundle_gain,
    control,
    convergence,
    data_loss,
    efficiency,
    honesty,
    journeys,
    noise,
    preset,
    real,
    road_normal,
)
from crowdmap_torch.studies.study import add_arguments, run_studies

__all__ = ["STUDIES", "add_arguments", "run"]

STUDIES = (
    journeys.STUDY,
    data_loss.STUDY,
    bundle_gain.STUDY,
    road_normal.STUDY,
    control.STUDY,
    preset.STUDY,
    ablation.STUDY,
    noise.STUDY,
    bad_drives.STUDY,
    convergence.STUDY,
    honesty.STUDY,
    efficiency.STUDY,
    real.STUDY,
)


def run(options: argparse.Namespace) -> None:
    """Does what is not done yet of all of them and writes the page."""
    run_studies("all", STUDIES, options)
