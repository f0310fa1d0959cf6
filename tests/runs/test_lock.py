"""A lock ends with its process; what is left in the file decides only where nobody can know."""

from __future__ import annotations

import json
import os
import signal
from dataclasses import asdict, replace
from pathlib import Path

import pytest
from worlds.programs import PATIENCE_S, begin

from crowdmap_torch.runs import lock
from crowdmap_torch.runs.lock import Writer, locked

HOLD = """
import sys, time
from pathlib import Path
from crowdmap_torch.runs.lock import locked
with locked(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(600)
"""


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "run.lock"


@pytest.fixture
def here(path: Path) -> Writer:
    """What this process writes into a lock."""
    with locked(path):
        return Writer(**json.loads(path.read_text()))


def refused(path: Path) -> str:
    with pytest.raises(ValueError) as raised, locked(path):
        pass
    return str(raised.value)


def test_a_lock_that_is_held_names_its_process_and_is_free_when_that_is_killed(path: Path):
    holder = begin("-c", HOLD, str(path))
    assert holder.stdout is not None and holder.stdout.readline() == "held\n"
    assert f"process {holder.pid} on" in refused(path)
    holder.send_signal(signal.SIGKILL)
    holder.communicate(timeout=PATIENCE_S)
    assert path.exists()
    with locked(path):
        assert json.loads(path.read_text())["pid"] == os.getpid()
    assert not path.exists()


def test_a_file_of_another_machine_is_refused_and_says_how_to_go_on(path: Path, here: Writer):
    path.write_text(json.dumps(asdict(replace(here, host="elsewhere", boot="another"))))
    assert f"on elsewhere (since {here.since}) writes there" in (said := refused(path))
    assert said.endswith(f"if it does so no longer, delete {path}") and path.exists()


@pytest.mark.parametrize("change", [{"boot": "before"}, {"host": "a container"}])
def test_a_file_from_before_the_machine_was_started_or_of_a_container_on_it_is_stale(
    path: Path, here: Writer, change: dict[str, str]
):
    if not here.boot:
        pytest.skip("this system does not tell when it was started")
    path.write_text(json.dumps(asdict(replace(here, **change))))
    with locked(path):
        assert Writer(**json.loads(path.read_text())).host == here.host


@pytest.mark.parametrize("content", ["", "nonsense", "[1, 2]", '{"host": "h"}'])
def test_a_file_that_names_nobody_is_stale(path: Path, content: str):
    path.write_text(content)
    with locked(path):
        pass
    assert not path.exists()


def test_without_locks_a_process_number_that_is_used_again_is_told_apart(
    path: Path, here: Writer, monkeypatch: pytest.MonkeyPatch
):
    if not here.started:
        pytest.skip("this system does not tell when a process was started")

    def unknown(file: int, how: int) -> None:
        raise OSError(lock.errno.ENOLCK, "No locks available")

    monkeypatch.setattr(lock.fcntl, "flock", unknown)
    path.write_text(json.dumps(asdict(here)))
    assert "writes there" in refused(path)
    path.write_text(json.dumps(asdict(replace(here, started="1"))))
    with locked(path):
        pass


def test_a_lock_is_no_way_out_of_the_folder(path: Path, tmp_path: Path):
    (tmp_path / "precious").write_text("content")
    path.symlink_to(tmp_path / "precious")
    with pytest.raises(OSError), locked(path):
        pass
    assert (tmp_path / "precious").read_text() == "content"
