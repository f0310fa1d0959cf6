from __future__ import annotations

import pytest
from worlds.studied import figures, measured, rows, work

from crowdmap_torch.studies import efficiency
from crowdmap_torch.studies.folder import StudyFolder
from crowdmap_torch.studies.study import Settings


def test_only_data_sets_with_both_estimates_are_compared(settings: Settings, folder: StudyFolder):
    tasks = work(efficiency, settings)
    ours, linear = tasks[:2]
    folder.write_result(ours.key, measured(relative=0.12))
    folder.write_result(tasks[2].key, measured(relative=9.0))
    signs = figures(0.1, 0.2)["signs"]
    bound = {"signs": signs, "own_sigma_m": 0.03, "shared_sigma_m": 0.1, "seconds": 1.0}
    folder.write_result(linear.key, bound)
    table, bounds = efficiency.chapter(settings, folder).tables
    relative = rows(table)[0]
    assert relative[1:3] == pytest.approx((0.12, 0.1))
    assert relative[3] == pytest.approx(1.2)
    assert [row[1] for row in rows(bounds)] == pytest.approx([0.03, 0.1])
