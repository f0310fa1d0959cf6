from __future__ import annotations

from worlds.studied import fill, measured, rows, work

from crowdmap_torch.studies import control
from crowdmap_torch.studies.folder import StudyFolder
from crowdmap_torch.studies.study import Settings


def test_a_seed_is_a_row_once_both_of_its_maps_are_there(settings: Settings, folder: StudyFolder):
    tasks = work(control, settings)
    assert [task.control > 0 for task in tasks] == [False, True] * settings.scale.curve_seeds
    fill(
        folder,
        tasks[:3],
        lambda task: measured(absolute=0.05 if getattr(task, "control", 0) else 0.3),
    )
    (table,) = control.chapter(settings, folder).tables
    (row,) = rows(table)
    assert row[:4] == (0, 2, 0.3, 0.05)
