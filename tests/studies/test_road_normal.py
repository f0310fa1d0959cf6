from __future__ import annotations

import math

import pytest
from worlds.studied import errors, figures, fill, measured, rows, work

from crowdmap_torch.studies import road_normal
from crowdmap_torch.studies.folder import StudyFolder
from crowdmap_torch.studies.study import Settings


def test_a_width_is_told_as_a_share_of_that_by_calibration_alone(
    settings: Settings, folder: StudyFolder
):
    def result(task) -> dict:
        width = 0.4 if task.config.road.method == "calibration" else 0.1
        adjusted = figures(0.1, 0.2)
        adjusted["lanes"]["width"] = errors(width)
        return measured(map=adjusted) if hasattr(task, "config") else {}

    tasks = work(road_normal, settings)
    for task in tasks:
        folder.write_result(task.key, result(task))
        fill(folder, task.journeys(), lambda _: measured(clean={"lane_width": errors(0.5)}))
    (table,) = road_normal.chapter(settings, folder).tables
    share = {(name, stage): of for name, stage, _, _, of, _ in rows(table)}
    assert share["our lanes, our normal", "adjusted"] == pytest.approx(0.25)
    assert math.isnan(share["our lanes, calibration alone", "adjusted"])
    # Every journey alone errs alike here.
    assert share["our lanes, our normal", "single journeys"] == 1
