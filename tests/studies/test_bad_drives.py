from __future__ import annotations

from worlds.studied import fill, measured, rows, work

from crowdmap_torch.simulate.faults import KINDS
from crowdmap_torch.studies import bad_drives
from crowdmap_torch.studies.folder import StudyFolder
from crowdmap_torch.studies.study import Settings


def test_a_bad_drive_counts_as_named_if_it_is_and_good_ones_as_named_wrongly(
    settings: Settings, folder: StudyFolder
):
    def result(task) -> dict:
        faults = list(task.simulation.bad_drives)
        is_named = faults and task.simulation.seed == 0
        named = ["journey-001"] if is_named else ["journey-000"]
        return measured(bad=["journey-001"] if faults else [], outlier_journeys=named)

    tasks = work(bad_drives, settings)
    fill(folder, tasks, result)
    (table,) = bad_drives.chapter(settings, folder).tables
    none, *spoilt = rows(table)
    assert none[:3] == ("none", "-", 2)
    assert [row[1:3] for row in spoilt] == [("1 of 2", 1)] * len(spoilt)


def test_there_is_a_map_of_every_fault_and_seed(settings: Settings):
    drives = {(t.simulation.bad_drives, t.simulation.seed) for t in work(bad_drives, settings)}
    kinds = {faults for faults, _ in drives}
    assert len(kinds) == 1 + len(settings.scale.first(KINDS))
    assert len(drives) == len(kinds) * settings.scale.short_seeds
