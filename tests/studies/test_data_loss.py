from __future__ import annotations

import pytest
from worlds.studied import fill, measured, rows, work

from crowdmap_torch.studies import data_loss
from crowdmap_torch.studies.folder import StudyFolder
from crowdmap_torch.studies.study import Settings


def test_left_out_is_the_share_of_signs_that_clustering_left_out(
    settings: Settings, folder: StudyFolder
):
    fill(
        folder,
        work(data_loss, settings),
        lambda task: measured(clusters={"signs": 40, "left_out": 3}),
    )
    (table,) = data_loss.chapter(settings, folder).tables
    found = {(method, measure): mean for _, method, measure, mean, *_ in rows(table)}
    assert found["ours", "left out"] == found["paper2017", "left out"] == pytest.approx(3 / 40)
    assert found["ours", "lost"] == pytest.approx(0.02)


def test_a_single_journey_has_no_part_in_it(settings: Settings):
    assert all(task.count > 1 for task in work(data_loss, settings))
