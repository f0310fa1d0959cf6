"""Places that no run writes, and runs that a signal ends."""

from __future__ import annotations

import signal
import time
from pathlib import Path

import pytest
from worlds.programs import PATIENCE_S, begin

from crowdmap_torch.runs.folder import RunFolder
from crowdmap_torch.soak.child import children, ends


def test_a_folder_that_another_run_writes_is_refused_before_anything_is_read(
    optimize, tmp_path: Path
):
    folder = RunFolder(tmp_path / "run")
    with folder.claimed():
        said = optimize(tmp_path / "no dataset", folder.path)
    assert said.code == 2 and said.err.count("\n") == 1 and "writes there" in said.err


@pytest.mark.parametrize("place", ["file/run", "link", "/proc/run", "x" * 300])
def test_a_place_for_no_folder_is_refused_before_anything_is_read(
    optimize, tmp_path: Path, place: str
):
    (tmp_path / "file").touch()
    (tmp_path / "link").symlink_to(tmp_path / "nothing")
    said = optimize(tmp_path / "no dataset", tmp_path / place)
    assert said.code == 2 and said.err.count("\n") == 1 and "no dataset" not in said.err


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="nobody tells who are children")
@pytest.mark.parametrize(
    ("stage", "workers", "number", "code"),
    [("single journeys", "2", signal.SIGINT, 130), ("clusters", "1", signal.SIGTERM, 143)],
)
def test_a_signal_is_one_line_and_leaves_nobody_behind(
    small: Path,
    rough: Path,
    tmp_path: Path,
    stage: str,
    workers: str,
    number: signal.Signals,
    code: int,
):
    out = tmp_path / "run"
    program = begin(
        *("-m", "crowdmap_torch", "optimize", str(small), "--out", str(out)),
        *("--config", str(rough), "--workers", workers),
    )
    assert program.stderr is not None
    said = [program.stderr.readline()]
    while not said[-1].startswith(stage):
        assert said[-1], said
        said.append(program.stderr.readline())
    if stage == "single journeys":
        # Workers are there since the data set was read.
        assert len(children(program.pid)) == 2
    begun_by_it = children(program.pid)
    program.send_signal(number)
    begun = time.monotonic()
    _, rest = program.communicate(timeout=PATIENCE_S)
    assert program.returncode == code
    # Five seconds are promised on a machine that has nothing else to do.
    assert time.monotonic() - begun < 30
    *progress, last = rest.splitlines()
    assert last == (
        f"crowdmap optimize: ended by {number.name}; what was finished is kept: "
        "the same command with --resume goes on"
    )
    assert all(line.startswith(("clusters", "bundle", "single")) for line in progress)
    assert all(ends(worker, PATIENCE_S) for worker in begun_by_it)
    assert not (out / "run.lock").exists() and not (out / "map").exists()
