"""Runs that are cut: instants in all stages, and no difference that is not seen."""

from __future__ import annotations

import json
import shutil
import signal
from pathlib import Path

import pytest
from worlds.programs import begin

from crowdmap_torch.soak.interrupted import STAGES, cuts, differences


@pytest.mark.parametrize("stages", [STAGES, STAGES[:2], STAGES[:1]])
def test_instants_are_spread_over_all_stages_and_numbers_of_workers(
    stages: tuple[str, ...],
) -> None:
    chosen = cuts([signal.SIGKILL], 60, stages, seed=1)
    ways = {(cut.workers, cut.stage) for cut in chosen}
    assert len(chosen) == 60 and ways == {(w, stage) for w in (1, 2) for stage in stages}
    assert all(0 <= cut.share < 1 for cut in chosen) and len({cut.share for cut in chosen}) == 60


def test_ten_instants_meet_every_stage() -> None:
    chosen = cuts([signal.SIGINT, signal.SIGTERM], 10, seed=0)
    for number in (signal.SIGINT, signal.SIGTERM):
        assert {cut.stage for cut in chosen if cut.number == number} == set(STAGES)


def test_results_differ_by_whatever_is_no_time(tmp_path: Path) -> None:
    one, other = tmp_path / "one", tmp_path / "other"
    (one / "map").mkdir(parents=True)
    (one / "tensorboard").mkdir()
    (one / "tensorboard" / "events").write_text("one")
    (one / "map" / "map.json").write_text(json.dumps({"provenance": {"created_at": "a", "b": 1}}))
    (one / "map" / "signs.parquet").write_bytes(b"signs")
    (one / "metrics.json").write_text(json.dumps({"times_s": {"a": 1.0}, "counts": {"signs": 2}}))
    shutil.copytree(one, other)
    for path, content in (
        ("tensorboard/events", "other"),
        ("map/map.json", json.dumps({"provenance": {"created_at": "b", "b": 1}})),
        (
            "metrics.json",
            json.dumps({"times_s": {"a": 2.0}, "counts": {"signs": 2}, "workers": {"again": 1}}),
        ),
    ):
        (other / path).write_text(content)
    assert differences(one, other) == []
    (other / "metrics.json").write_text(json.dumps({"times_s": {}, "counts": {"signs": 3}}))
    (other / "map" / "signs.parquet").unlink()
    (other / "stray").touch()
    assert differences(one, other) == ["map/signs.parquet", "metrics.json", "stray"]


def test_a_run_that_is_killed_resumes_to_the_same_bits(tmp_path: Path) -> None:
    # In a process of its own: one with threads, as this one may be, is not to be forked.
    program = begin(
        *("scripts/soak.py", "kills", "--count", "1", "--stages", "bundle adjustment"),
        *("--keep", str(tmp_path)),
    )
    out, err = program.communicate()
    assert program.returncode == 0, out + err
    assert "SIGKILL, workers 1: 1 runs cut, 0 failures" in out
