from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from crowdmap_torch.studies.folder import StudyFolder
from crowdmap_torch.studies.maps import (
    curve,
    in_short_turns,
    in_turns,
    our_maps,
    paper_heads,
    short_maps,
)
from crowdmap_torch.studies.scale import FULL

SCALE = replace(FULL, counts=(1, 5, 10, 20), journeys=10, seeds=3, curve_seeds=2, most_seeds=1)


def test_a_curve_has_the_same_seeds_at_every_number(tmp_path: Path):
    folder = StudyFolder(tmp_path)
    maps = {count: our_maps(SCALE, count) for count in SCALE.counts}
    for tasks in maps.values():
        for task in tasks:
            folder.write_result(task.key, {"seed": task.simulation.seed})
    found = curve(SCALE, maps, folder)
    # The third seed is there at ten journeys alone; more than those have a seed of their own.
    assert {n: {r["seed"] for r in results} for n, results in found.items()} == {
        1: {0, 1},
        5: {0, 1},
        10: {0, 1},
        20: {0},
    }
    (one_of_many, *_) = [task for task in maps[1] if task.simulation.seed == 1]
    (tmp_path / "results" / f"{one_of_many.key}.json").unlink()
    assert {r["seed"] for r in curve(SCALE, maps, folder)[10]} == {0}


def test_few_journeys_are_other_ones_each_time():
    maps = [task for task in our_maps(SCALE, 2) if task.simulation.seed == 0]
    rows = [row for task in maps for row in task.rows]
    assert len(maps) == SCALE.draws
    assert len(set(rows)) == len(rows) and max(rows) < SCALE.journeys


def test_what_decides_comes_first():
    turns = {(t.simulation.seed, t.count): turn for turn, t in in_turns(SCALE, our_maps(SCALE, 10))}
    assert [turns[seed, 10] for seed in range(3)] == [0, 1, 2]
    ((turn, _),) = in_turns(SCALE, our_maps(SCALE, 20))
    assert turn > max(turns.values())


def test_the_papers_heads_have_no_lanes_and_the_same_signs():
    ours, theirs = our_maps(SCALE, 10)[1].simulation, paper_heads(SCALE, 10)[1].simulation
    assert theirs.lanes.max_lanes == 0
    assert replace(theirs, lanes=ours.lanes) == ours


def test_seeds_of_the_short_road_come_in_turn_whatever_the_variant():
    worse = short_maps(SCALE, change=lambda drives: replace(drives, bad_drives=("jump",)))
    assert all(task.simulation.bad_drives == ("jump",) for task in worse)
    turns = [
        (task.simulation.seed, turn) for turn, task in in_short_turns(2, [short_maps(SCALE), worse])
    ]
    assert turns[: len(worse)] == turns[len(worse) :]
    assert [turn for _, turn in sorted(turns[: len(worse)])] == [2, 6, 10]
