"""Destroyed data sets: what is left is mapped, set aside or refused, and the same seed destroys the same."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch

from crowdmap_torch.soak import child, verdict
from crowdmap_torch.soak.child import run_apart
from crowdmap_torch.soak.mutations import destroy
from crowdmap_torch.soak.soak import write_small_dataset
from crowdmap_torch.soak.verdict import digest, problems

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("soak") / "good"
    write_small_dataset(folder)
    return folder


def test_destroyed_data_sets_break_nothing(tmp_path: Path) -> None:
    # In a process of its own: one with threads, as this one may be, is not to be forked.
    command = [
        sys.executable,
        str(ROOT / "scripts" / "soak.py"),
        "--mutants",
        "24",
        "--mapped",
        "0.1",
    ]
    done = subprocess.run(
        [*command, "--seed", "7", "--keep", str(tmp_path)],
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "24 mutants" in done.stdout and "0 failures" in done.stdout


def test_the_same_seed_destroys_the_same(good: Path, tmp_path: Path) -> None:
    seen = []
    for attempt in range(2):
        # One name for both: links and hashes have it in them.
        folder = tmp_path / "data"
        shutil.copytree(good, folder)
        done = [destroy(folder, np.random.default_rng([3, k])) for k in range(6)]
        seen.append((done, digest(folder)))
        folder.rename(tmp_path / f"{attempt}")
    assert seen[0] == seen[1]
    assert seen[0][1] != digest(good)


def test_what_is_forbidden_is_seen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(child, "_mapped_bytes", lambda: 2**40)
    data, run = tmp_path / "data", tmp_path / "run"
    data.mkdir()
    (data / "a").write_text("a")
    before = digest(data)

    def judged(main, **limits) -> list[str]:
        return problems(data, run, run_apart(main, tmp_path, **limits), before)

    def refuses() -> int:
        os.write(2, b"crowdmap optimize: a: is no such thing\n")
        return 2

    assert judged(refuses) == []
    assert any("traceback: ZeroDivisionError" in p for p in judged(lambda: 1 // 0))
    assert any("exit code -9" in p for p in judged(lambda: time.sleep(60) or 0, seconds=0.2))
    monkeypatch.setattr(verdict, "RESIDENT_BYTES", 1)
    assert any(p.endswith(" MB") for p in judged(refuses))
    monkeypatch.undo()
    monkeypatch.setattr(child, "_mapped_bytes", lambda: 2**40)

    def writes() -> int:
        Path("stray").write_text("here")
        (data / "a").write_text("changed")
        return refuses()

    found = judged(writes)
    assert "the data set was changed" in found and "written beside RUN: ['stray']" in found


def test_the_good_data_set_is_mapped_without_a_word(good: Path) -> None:
    from crowdmap_torch.io.datasets import load_dataset

    dataset = load_dataset(good)
    assert len(dataset.journeys) == 3 and not dataset.rejected
    assert all(torch.isfinite(j.T_world_camera).all() for j in dataset.journeys)
