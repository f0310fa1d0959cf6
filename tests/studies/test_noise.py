from __future__ import annotations

import pytest
from worlds.studied import fill, measured, rows, work

from crowdmap_torch.studies import noise
from crowdmap_torch.studies.folder import StudyFolder
from crowdmap_torch.studies.study import Settings


@pytest.mark.parametrize("name", noise.SWEEPS)
def test_a_sweep_starts_at_the_value_of_the_presets(settings: Settings, name: str):
    sweep, drives = noise.SWEEPS[name], settings.scale.short_drives(0)
    changed = sweep.change(drives, sweep.default)
    # What is swept of lanes has a default of its own.
    assert (changed.signs, changed.positioning) == (drives.signs, drives.positioning)
    assert sweep.default not in sweep.values
    assert all(sweep.change(drives, value) != changed for value in sweep.values)


def test_rows_come_in_the_order_of_the_values(settings: Settings, folder: StudyFolder):
    fill(
        folder,
        work(noise, settings),
        lambda task: measured(relative=0.1 * task.simulation.signs.pixel_noise_px),
    )
    (table,) = noise.chapter(settings, folder).tables
    pixels = [row for row in rows(table) if row[0] == "pixel noise"]
    assert [row[1] for row in pixels] == [1.0, 2.0]
    assert pixels[1][2] == pytest.approx(2 * pixels[0][2])
