from __future__ import annotations

import pytest
from worlds.studied import fill, measured, rows, work

from crowdmap_torch.studies import preset
from crowdmap_torch.studies.folder import StudyFolder
from crowdmap_torch.studies.study import Settings


def test_each_positioning_has_its_own_drives(settings: Settings):
    drives = {task.simulation.positioning for task in work(preset, settings)}
    assert drives == set(preset.POSITIONING.values())
    assert len(drives) == len(preset.POSITIONING)


def test_the_papers_preset_is_judged_by_its_cluster_heads(settings: Settings, folder: StudyFolder):
    paper = preset.POSITIONING["paper"]

    def result(task) -> dict:
        return measured(relative=0.06 if task.simulation.positioning == paper else 0.5)

    fill(folder, work(preset, settings), result)
    (table,) = preset.chapter(settings, folder).tables
    judged = {row[1]: row for row in rows(table) if row[0] == "paper, all seeds"}
    # The heads of these results err twice as much as the map.
    assert judged["relative"][3] == pytest.approx(0.12)
    assert judged["relative"][-1] == "0.10 to 0.16"
    others = [row[3] for row in rows(table) if row[:2] == ("consumer", "relative")]
    assert others == pytest.approx([1.0] * len(others)) and others
