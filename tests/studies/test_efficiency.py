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
    table, bounds, *others = efficiency.chapter(settings, folder).tables
    assert not any(rows(other) for other in others)
    relative = rows(table)[0]
    assert relative[1:3] == pytest.approx((0.12, 0.1))
    assert relative[3] == pytest.approx(1.2)
    assert [row[1] for row in rows(bounds)] == pytest.approx([0.03, 0.1])


def test_detectors_that_tremble_are_held_against_those_that_stand_still(
    settings: Settings, folder: StudyFolder
):
    first = len(efficiency._pairs(settings.scale))
    count = 2 * len(efficiency.TREMBLES)
    tasks = work(efficiency, settings)[2 * first : 2 * first + count]
    steady, twice = tasks[:2], tasks[-2:]
    linear = {"signs": figures(0.1, 0.2)["signs"]}
    for at, pair in enumerate((steady, twice)):
        folder.write_result(pair[0].key, measured(relative=0.12 + 0.06 * at))
        folder.write_result(pair[1].key, linear)
    *_, table, _ = efficiency.chapter(settings, folder).tables
    # What trembles less is not known yet.
    assert [row[0] for row in rows(table)] == pytest.approx([0.0, 1.4])
    assert rows(table)[0] == pytest.approx((0.0, 0.12, 1.0, 0.1, 1.0, 1.2, 1))
    for task in tasks[2:-2]:
        is_linear = task.key.endswith("linear")
        folder.write_result(task.key, linear if is_linear else measured(relative=0.15))
    *_, table, _ = efficiency.chapter(settings, folder).tables
    assert [row[0] for row in rows(table)] == pytest.approx([0.0, 0.7, 1.4])
    assert [row[2] for row in rows(table)] == pytest.approx([1.0, 1.25, 1.5])


def test_fleets_are_held_against_drives_without_errors(settings: Settings, folder: StudyFolder):
    for told, pairs in efficiency._fleet_pairs(settings.scale):
        for ours, linear in pairs:
            wrong = bool(efficiency.FLEETS[str(told)])
            folder.write_result(ours.key, measured(relative=0.18 if wrong else 0.12))
            folder.write_result(linear.key, {"signs": figures(0.1, 0.2)["signs"]})
    *_, table = efficiency.chapter(settings, folder).tables
    assert [row[0] for row in rows(table)] == list(efficiency.FLEETS)
    assert [row[2] for row in rows(table)] == pytest.approx([1.0, 1.5, 1.5])
    assert [row[5] for row in rows(table)] == pytest.approx([1.2, 1.8, 1.8])
    trembling = dict(efficiency._fleet_pairs(settings.scale))["these, and outlines tremble"]
    drawn = trembling[0][0].simulation
    assert drawn.signs.jitter_px == 0.7 and drawn.fleet.mount_error_deg == 0.2
    # The linear estimator knows how far poses are off: nothing that is said of it is wrong.
    assert drawn.positioning.sigma_spread == 1.0 and drawn.positioning.outages == 0.0
