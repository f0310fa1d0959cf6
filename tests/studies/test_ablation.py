from __future__ import annotations

import pytest
from worlds.studied import fill, measured, rows, work

from crowdmap_torch.studies import ablation
from crowdmap_torch.studies.folder import StudyFolder
from crowdmap_torch.studies.study import Settings


def test_every_variant_differs_from_ours_and_from_the_others():
    variants = ablation.VARIANTS
    assert len({repr(config.resolved()) for config in variants.values()}) == len(variants)


def test_a_row_is_the_mean_over_the_seeds_of_its_variant(settings: Settings, folder: StudyFolder):
    without_lanes = ablation.VARIANTS["adjustment without lanes"]

    def result(task) -> dict:
        worse = getattr(task, "config", None) == without_lanes
        return measured(relative=(0.3 if worse else 0.1) + 0.02 * task.simulation.seed)

    fill(folder, work(ablation, settings), result)
    (table,) = ablation.chapter(settings, folder).tables
    found = {row[0]: row for row in rows(table)}
    assert list(found) == list(ablation.VARIANTS)
    assert found["ours"][1] == pytest.approx(0.11)
    assert found["adjustment without lanes"][1] == pytest.approx(0.31)
    assert all(row[-1] == settings.scale.short_seeds for row in found.values())
