from __future__ import annotations

import io

import pytest
from worlds.held_memory import held

from crowdmap_torch.processes.memory import peak_bytes
from crowdmap_torch.report import progress
from crowdmap_torch.report.progress import Progress


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The seconds that the next look at the clock shows."""
    now = [0.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    return now


def test_a_stage_has_the_seconds_between_its_name_and_the_next(clock):
    told = Progress(io.StringIO())
    told("read")
    clock[0] = 2.0
    told("map")
    clock[0] = 5.0
    told.finish()
    assert told.seconds == {"read": 2.0, "map": 3.0}


def test_a_stage_that_comes_back_has_the_seconds_of_all_its_times(clock):
    told = Progress(io.StringIO())
    for seconds in (2.0, 5.0):
        told("build")
        clock[0] += seconds
        told("adjust")
        clock[0] += 1.0
    told.finish()
    assert told.seconds == {"build": 7.0, "adjust": 2.0}


@pytest.mark.skipif(peak_bytes() is None, reason="memory is read in /proc")
def test_a_stage_has_the_memory_that_it_held_and_not_what_one_before_it_did():
    told = Progress(io.StringIO())
    told("much")
    with held(200_000_000):
        told("little")
    told("less")
    told.finish()
    assert told.peak_gb["much"] - told.peak_gb["less"] == pytest.approx(0.2, abs=0.03)


def test_without_a_terminal_lines_come_seldom_and_at_the_end(clock):
    stream = io.StringIO()
    told = Progress(stream)
    for done in range(1, 31):
        clock[0] += 1.0
        told("map", done, 30)
    lines = stream.getvalue().splitlines()
    assert [line.split(",")[0] for line in lines] == ["map 11/30", "map 22/30", "map 30/30"]
    assert lines[0].endswith("s left") and "left" not in lines[-1]


def test_a_terminal_has_one_line_that_is_rewritten(clock):
    stream = Terminal()
    told = Progress(stream)
    told("map", 1, 2, "first")
    told("map", 2, 2)
    told.finish()
    assert stream.getvalue().count("\n") == 1
    assert stream.getvalue().count("\r\x1b[K") == 3
    assert ", first" in stream.getvalue()


def test_what_is_left_is_as_slow_as_what_was_done(clock):
    stream = Terminal()
    told = Progress(stream)
    told("map")
    clock[0] = 10.0
    told("map", 1, 4)
    assert stream.getvalue().endswith("map 1/4, 30 s left")


def test_what_was_done_when_a_stage_began_says_nothing_of_what_is_left(clock):
    stream = Terminal()
    told = Progress(stream)
    told("map", 5, 30)
    assert stream.getvalue().endswith("map 5/30")
    clock[0] = 10.0
    told("map", 6, 30)
    assert stream.getvalue().endswith("map 6/30, 240 s left")
