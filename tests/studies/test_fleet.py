from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from worlds.studied import errors, figures, fill, measured, rows, work

from crowdmap_torch.adjustment.calibration import CalibrationConfig
from crowdmap_torch.config import MapperConfig
from crowdmap_torch.simulate.errors import ERRORS
from crowdmap_torch.studies import fleet
from crowdmap_torch.studies.folder import StudyFolder
from crowdmap_torch.studies.scale import FULL
from crowdmap_torch.studies.study import Settings

ONE_SEED = Settings(
    replace(
        FULL,
        fleet_seeds=1,
        fleet_sets=0,
        whole_fleet_seeds=1,
        kinds=2,
        fleet_journeys=2,
        journeys=3,
        counts=(3,),
    ),
    None,
)


def by_error(table) -> dict[tuple[str, float, str], dict[str, object]]:
    named = [dict(zip(table.columns, row, strict=True)) for row in rows(table)]
    return {(row["error"], row["times"], row["calibration"]): row for row in named}


def test_each_error_comes_alone_and_at_twice_its_size_and_all_together():
    found = {(v.error, v.factor) for v in fleet.variants(FULL)}
    assert found == {("none", 1.0)} | {(e, f) for e in (*ERRORS, "fleet") for f in (1.0, 2.0)}


def test_variants_differ_in_their_errors_and_nothing_else():
    right, *wrong = (v.spoil(FULL.fleet_drives(3)) for v in fleet.variants(FULL))
    assert right == FULL.fleet_drives(3)
    for drives in wrong:
        assert drives != right and drives.fleet.vehicles == right.fleet.vehicles
        same = {name: getattr(right, name) for name in ("fleet", "positioning", "signs")}
        assert replace(drives, **same) == right


def test_drives_without_errors_are_those_of_other_studies():
    scale = ONE_SEED.scale
    whole = [t for t in work(fleet, ONE_SEED) if t.count == scale.journeys]
    right, spoilt = whole[: len(fleet.CALIBRATIONS)], whole[len(fleet.CALIBRATIONS) :]
    assert all(task.simulation == scale.drives(0) for task in right)
    assert all(task.simulation.fleet.vehicles == 8 for task in spoilt)
    for tasks in (right, spoilt):
        off, on = (task.config.calibration for task in tasks)
        assert off == CalibrationConfig.off() and on == MapperConfig().calibration


def test_errors_are_told_beside_the_drives_without_them(folder: StudyFolder):
    def result(task):
        size = 1 + 100 * getattr(task.simulation.fleet, "focal_error", 0.0)
        return measured(relative=0.1 * size, absolute=0.2)

    fill(folder, work(fleet, ONE_SEED), result)
    alone, straight, whole = map(by_error, fleet.chapter(ONE_SEED, folder).tables[:3])
    ratio = "relative / without errors"
    assert alone["none", 0.0, "off"][ratio] == 1.0
    assert alone["focals", 1.0, "off"][ratio] == pytest.approx(1.2)
    assert alone["focals", 2.0, "off"][ratio] == pytest.approx(1.4)
    assert alone["mounts", 2.0, "off"][ratio] == pytest.approx(1.0)
    for pair in (straight, whole):
        assert pair["fleet", 1.0, "off"][ratio] == pytest.approx(1.2)


def test_coverage_counts_every_sign_once(tmp_path: Path):
    settings = Settings(replace(ONE_SEED.scale, fleet_seeds=2, kinds=0), None)
    folder = StudyFolder(tmp_path)

    def result(task):
        of_map = figures(0.1, 0.2)
        signs, inside = (30, 1.0) if task.simulation.seed else (10, 0.6)
        of_map["uncertainty"] |= {"signs": signs, "coverage": inside}
        return measured() | {"map": of_map, "clean": {"lane_width": errors(0.1)}}

    fill(folder, work(fleet, settings), result)
    table = by_error(fleet.chapter(settings, folder).tables[0])
    assert table["none", 0.0, "off"]["inside 95 % [%]"] == pytest.approx(90.0)


def test_whether_fleets_know_how_wrong_they_are_is_asked_of_many_sets(tmp_path: Path):
    settings = Settings(replace(ONE_SEED.scale, kinds=0, fleet_sets=4), None)
    folder = StudyFolder(tmp_path)

    def result(task):
        of_map, seed = figures(0.1, 0.2), task.simulation.seed
        told = {"signs": 10, "coverage": 0.8 + 0.04 * seed, "mean_nees": 3.0, "shared_nees": seed}
        of_map["uncertainty"] |= told
        return measured() | {"map": of_map, "clean": {"lane_width": errors(0.1)}}

    fill(folder, work(fleet, settings), result)
    (table,) = (t for t in fleet.chapter(settings, folder).tables if t.name == "fleet-honest")
    found = {title: value for title, value, _ in rows(table)}
    assert found["sets"] == 4
    assert found["sign centres inside their 95 % ellipsoid [%]"] == pytest.approx(86.0)
    assert found["the shared part's, mean over the data sets"] == pytest.approx(1.5)


def test_a_second_configuration_has_rows_and_work_of_its_own(
    folder: StudyFolder, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(fleet, "CALIBRATIONS", {"off": fleet.OURS})
    before = len(work(fleet, ONE_SEED))
    other = replace(fleet.OURS, min_confidence=0.4)
    monkeypatch.setattr(fleet, "CALIBRATIONS", {"off": fleet.OURS, "on": other})
    tasks = work(fleet, ONE_SEED)
    assert len(tasks) == 2 * before
    fill(
        folder,
        tasks,
        lambda task: measured(0.05 if getattr(task, "config", None) == other else 0.1),
    )
    table = by_error(fleet.chapter(ONE_SEED, folder).tables[0])
    assert table["fleet", 1.0, "on"]["relative / without errors"] == pytest.approx(0.5)
    # Single journeys are mapped once for both.
    assert len({need.key for t in tasks for need in t.needs()}) == len(
        {need.key for t in tasks if t.config == fleet.OURS for need in t.needs()}
    )
