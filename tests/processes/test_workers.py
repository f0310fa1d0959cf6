"""Workers do their tasks, name what went wrong, and never outlive the process that began them."""

from __future__ import annotations

import math
import operator
import os
import signal
import time

import pytest
from worlds.programs import PATIENCE_S, begin

from crowdmap_torch.processes.workers import Workers
from crowdmap_torch.soak.child import ends

BEGIN = """
import os, sys, time
from crowdmap_torch.processes.workers import Workers
with Workers(2, os.getpid) as pool:
    pool.start(0, ("one", os.getpid, ()))
    pool.start(1, ("two", os.getpid, ()))
    found = []
    while len(found) < 2:
        found += [made for _, made in pool.wait()]
    for number in range(2):
        pool.start(number, ("long", time.sleep, (600,)))
    print(*found, flush=True)
    pool.wait()
"""


def test_every_call_is_done_once_and_by_another_process():
    calls = [(f"{n} + 1", operator.add, (n, 1)) for n in range(7)]
    with Workers(2, os.getpid) as pool:
        assert dict(pool.each(calls)) == {n: n + 1 for n in range(7)}
        (_, process), *_ = pool.each([("who", os.getpid, ())])
    assert process != os.getpid() and ends(process, PATIENCE_S)


def test_what_a_task_raises_is_raised_here_and_tells_where():
    with (
        Workers(1, os.getpid) as pool,
        pytest.raises(ValueError, match="math domain error") as raised,
    ):
        list(pool.each([("root", math.sqrt, (-1.0,))]))
    assert "in a worker" in raised.value.__notes__[0]


@pytest.mark.parametrize(
    ("killer", "how"),
    [(signal.SIGKILL, "SIGKILL: by hand, or out of memory"), (signal.SIGSEGV, "SIGSEGV")],
)
def test_a_process_that_is_killed_is_an_error_that_names_its_task(killer: int, how: str):
    with (
        Workers(2, os.getpid) as pool,
        pytest.raises(ChildProcessError, match=f"^journey-7: its process was killed.*{how}"),
    ):
        pool.start(0, ("journey-8", time.sleep, (600,)))
        pool.start(1, ("journey-7", signal.raise_signal, (killer,)))
        pool.wait()


def test_an_exit_within_a_task_is_an_error_that_names_it():
    with (
        Workers(1, os.getpid) as pool,
        pytest.raises(ChildProcessError, match=r"^it: .* exit code 5"),
    ):
        pool.start(0, ("it", os._exit, (5,)))
        pool.wait()


def test_a_block_that_is_left_leaves_no_worker():
    processes = []
    with pytest.raises(KeyboardInterrupt), Workers(1, os.getpid) as pool:
        processes += [made for _, made in pool.each([("who", os.getpid, ())])]
        pool.start(0, ("long", time.sleep, (600,)))
        raise KeyboardInterrupt
    assert [ends(process, PATIENCE_S) for process in processes] == [True]


@pytest.mark.parametrize("killer", [signal.SIGKILL, signal.SIGTERM])
def test_workers_end_with_the_process_that_began_them(killer: signal.Signals):
    program = begin("-c", BEGIN)
    assert program.stdout is not None
    workers = [int(number) for number in program.stdout.readline().split()]
    assert len(workers) == 2
    program.send_signal(killer)
    _, said = program.communicate(timeout=PATIENCE_S)
    assert program.returncode == -killer and said == ""
    assert all(ends(worker, PATIENCE_S) for worker in workers)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_worker_is_deaf_to_what_a_terminal_sends_to_all(number: int):
    with Workers(1, os.getpid) as pool:
        (_, process), *_ = pool.each([("who", os.getpid, ())])
        os.kill(process, number)
        assert [*pool.each([("who", os.getpid, ())])] == [(0, process)]
