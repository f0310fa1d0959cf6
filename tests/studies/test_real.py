from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from worlds.studied import figures, rows, work

from crowdmap_torch.studies import real
from crowdmap_torch.studies.folder import StudyFolder
from crowdmap_torch.studies.passes import MeasureDrives
from crowdmap_torch.studies.study import Settings


@pytest.fixture
def drives(tmp_path: Path, settings: Settings) -> Settings:
    """Two sequences of which nothing but their names is known."""
    for name in ("kitti-01", "kitti-00"):
        (tmp_path / "drives" / name).mkdir(parents=True)
        (tmp_path / "drives" / name / "dataset.json").touch()
    return replace(settings, real=tmp_path / "drives")


def test_sequences_come_by_name_each_by_both_methods(drives: Settings):
    tasks = work(real, drives)
    # Where nobody says from where signs were surveyed there are no passes.
    assert [task.dataset.name for task in tasks] == 2 * ["kitti-00", "kitti-01"]
    assert [task.config.method for task in tasks] == 2 * ["joint"] + 2 * ["paper2017"]
    # There is one journey: what it saw alone is the map.
    assert all(task.config.crowd.min_journeys == 1 for task in tasks)


def test_the_signs_of_one_journey_are_told_of_ours_alone_if_at_all(
    drives: Settings, folder: StudyFolder
):
    signs = figures(0.1, 0.2)
    for task in work(real, drives):
        result = dict.fromkeys(("journey", "heads", "map"), signs) | {"frames": 7, "seconds": 1.5}
        folder.write_result(task.key, result)
    (table,) = real.chapter(drives, folder).tables
    told = [(row[0], row[2]) for row in rows(table) if row[1] == "kitti-00"]
    assert told == [
        ("ours", "one journey's signs"),
        ("ours", "cluster heads"),
        ("ours", "adjusted"),
        ("paper2017", "one journey's signs"),
    ]
    assert rows(table)[0][3:7] == (7, 10, 9, 0.2)


def test_a_folder_without_datasets_is_refused(tmp_path: Path, settings: Settings):
    with pytest.raises(ValueError, match=r"no dataset in it; expected folders with dataset\.json"):
        work(real, replace(settings, real=tmp_path))


def test_passes_are_measured_alone_and_as_crowds(drives: Settings, folder: StudyFolder):
    assert drives.real is not None
    (drives.real / "surveyed_from.json").write_text("{}")
    crowds = [task for task in work(real, drives) if isinstance(task, MeasureDrives)]
    # Each sequence: by itself with calibration, without, and from where its boxes were drawn; both crowds with two kinds
    # of errors.
    assert len(crowds) == 2 * (3 + 2 * 2) == len({task.key for task in crowds})
    recorded = work(real, replace(drives, recorded=Path("segment")))
    assert sum(isinstance(task, MeasureDrives) for task in recorded) == 2 * (3 + 2 * 3)
    for task in crowds:
        far = 0.4 if task.dataset.name == "kitti-00" else 0.2
        errors = {"single": {"a@0": far, "b@0": 9.0}, "map": {"a@0": far / 2, "c@0": 9.0}}
        # A map of one sign has no relative error.
        relative = [{"single": 0.3, "map": 0.1}, {"single": None, "map": None}]
        folder.write_result(task.key, {**errors, "relative": relative, "drives": 3, "seconds": 2.0})
    (table,) = [t for t in real.chapter(drives, folder).tables if t.name == "passes"]
    told = [row for row in rows(table) if row[:3] == ("each pass by itself", "none", "found")]
    # Of all sequences the signs that drives and map have both count, each once.
    assert [row[3:8] for row in told] == [
        ("all", "", 2, pytest.approx(0.3), pytest.approx(0.15)),
        ("kitti-00", 3, 1, 0.4, 0.2),
        ("kitti-01", 3, 1, 0.2, 0.1),
    ]
    assert told[1][8:] == (0.3, 0.1, 2.0)
