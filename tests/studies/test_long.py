from __future__ import annotations

import math
from dataclasses import replace

import pytest
from worlds.studied import figures, fill, rows, work

from crowdmap_torch.studies import long
from crowdmap_torch.studies.folder import StudyFolder
from crowdmap_torch.studies.study import Settings
from crowdmap_torch.studies.tasks import Task


def result(task: Task) -> dict:
    """Stages that take a second a kilometre, and adjustments that grow by its square."""
    if not isinstance(task, long.MeasureLong):
        return {}
    km = task.simulation.world.length_m / 1000
    stage = {"seconds": km, "peak_mb": 100 * km}
    stages = dict.fromkeys(("first map", "adjustment", "covariances"), stage)
    stages["adjustment"] = {"seconds": km**2, "peak_mb": 1.0}
    made = {"stages": stages, "steps": 10, "scale": [1.0, 1.0, 1.0, 4.0], "unknowns": 8}
    maps = {
        name: {**made, "map": figures(0.1 if name == "one bias" else 0.2, 0.3)}
        for name in task.variants
    }
    driven = task.simulation.journeys * km
    return {"maps": maps, "single": stage, "seconds": 1.0, "driven_km": driven}


def test_short_and_long_drives_stand_beside_each_other(settings: Settings, folder: StudyFolder):
    fill(folder, work(long, settings), result)
    table, series = long.chapter(settings, folder).tables
    found = rows(table)
    assert [row[:2] for row in found] == [
        (length, name) for length in ("0.06 km", "0.12 km") for name in long.VARIANTS
    ]
    assert [row[3] for row in found] == pytest.approx([0.1, 0.2, 0.1, 0.2])
    assert {row[4] for row in found} == {95.0} and {row[6] for row in found} == {4.0}
    exponents = rows(series)[-1]
    assert exponents[0] == "exponent"
    # Single journeys, the first map, the adjustment and a step of it, covariances, memory, unknowns.
    assert exponents[1:] == pytest.approx((1, 1, 2, 2, 1, 1, 0), abs=0.1)


def test_as_many_kilometres_are_driven_of_either_length(settings: Settings):
    scale = replace(settings.scale, long_lengths_m=(1000.0, 20000.0), long_share=1.0)
    tasks = [task for _, task in long.tasks(replace(settings, scale=scale))]
    driven: dict[float, float] = {}
    for task in tasks:
        assert isinstance(task, long.MeasureLong)
        if len(task.variants) == len(long.VARIANTS):
            length = task.simulation.world.length_m
            driven[length] = driven.get(length, 0.0) + length
    assert driven == {1000.0: 20000.0, 20000.0: 20000.0}


def test_a_chapter_of_nothing_is_there(settings: Settings, folder: StudyFolder):
    table, series = long.chapter(settings, folder).tables
    assert all(math.isnan(row[3]) for row in rows(table)) and rows(series) == []
