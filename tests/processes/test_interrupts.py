"""Signals end a program in time, with one line and their exit code, wherever it is."""

from __future__ import annotations

import signal
import subprocess

import pytest
from worlds.programs import PATIENCE_S, begin

from crowdmap_torch.processes.interrupts import Interruptible, held, keeping, kept

PROGRAM = """
import hashlib, signal, sys, time
from crowdmap_torch.processes.interrupts import Interruptible, held
# The tests themselves may run under `nohup`, which programs inherit.
signal.signal(signal.SIGHUP, signal.SIG_DFL)
say = lambda name: sys.stderr.write(f"ended by {name}\\n")

def begun():
    print("begun", flush=True)

def swallow():
    begun()
    while True:
        try:
            time.sleep(0.01)
        except BaseException:
            pass

def finalize():
    class Slow:
        def __del__(self):
            begun()
            time.sleep(600)
    Slow()
    time.sleep(600)

def outside():
    begun()
    hashlib.pbkdf2_hmac("sha256", b"", b"", 2**31 - 1)

def two_renames():
    with held():
        begun()
        while not signals.number:
            time.sleep(0.01)
        print("renamed", flush=True)
    time.sleep(600)

def clear_away():
    try:
        begun()
        time.sleep(600)
    finally:
        print("cleared", flush=True)

def slow_end():
    import atexit
    atexit.register(time.sleep, 600)
    clear_away()

def nothing():
    pass

with Interruptible(say, last=sys.argv[1] == "nothing") as signals:
    globals()[sys.argv[1]]()
if sys.argv[1] == "nothing":
    begun()
    sys.stdin.read()
sys.exit(128 + signals.number)
"""
CODE = {signal.SIGINT: 130, signal.SIGTERM: 143, signal.SIGHUP: 129}


def interrupt(work: str, number: signal.Signals) -> tuple[int, str, str]:
    """Exit code and what was said after the beginning."""
    program = begin("-c", PROGRAM, work)
    assert program.stdout is not None and program.stdout.readline() == "begun\n"
    program.send_signal(number)
    out, err = program.communicate(timeout=PATIENCE_S)
    return program.returncode, out, err


@pytest.mark.parametrize("number", CODE)
def test_a_signal_is_one_line_and_its_code_and_what_was_begun_is_cleared_away(number):
    code, out, err = interrupt("clear_away", number)
    assert (code, out, err) == (CODE[number], "cleared\n", f"ended by {number.name}\n")


@pytest.mark.parametrize("work", ["swallow", "outside", "finalize", "slow_end"])
def test_a_signal_ends_what_does_not_listen(work: str):
    code, _, err = interrupt(work, signal.SIGTERM)
    assert (code, err) == (143, "ended by SIGTERM\n")


def test_a_signal_waits_for_renames_that_belong_together():
    assert interrupt("two_renames", signal.SIGINT) == (130, "renamed\n", "ended by SIGINT\n")


def test_a_signal_after_the_work_of_a_process_changes_nothing():
    program = begin("-c", PROGRAM, "nothing", stdin=subprocess.PIPE)
    assert program.stdout is not None and program.stdout.readline() == "begun\n"
    program.send_signal(signal.SIGTERM)
    out, err = program.communicate(timeout=PATIENCE_S)
    assert (program.returncode, out, err) == (128, "", "")


def test_what_goes_on_after_the_work_of_a_process_is_ended():
    program = begin("-c", PROGRAM, "nothing", stdin=subprocess.PIPE)
    assert program.stdout is not None and program.stdout.readline() == "begun\n"
    program.send_signal(signal.SIGTERM)
    assert program.wait(PATIENCE_S) == 143
    assert program.communicate()[1] == "ended by SIGTERM\n"


def test_handlers_are_put_back():
    before = [signal.getsignal(number) for number in CODE]
    with Interruptible(lambda name: None) as signals, held():
        assert [signal.getsignal(number) for number in CODE] != before
    assert [signal.getsignal(number) for number in CODE] == before and signals.number == 0


def test_what_is_kept_is_asked_for_when_work_ends_before_its_time():
    with Interruptible(lambda name: None):
        assert kept() == "nothing half-written is left"
        with keeping(lambda: "all of it"):
            assert kept() == "all of it"
        assert kept() == "nothing half-written is left"
        with pytest.raises(OSError, match="full"), keeping(lambda: "the first half"):
            raise OSError("full")
        assert kept() == "the first half"
    with Interruptible(lambda name: None):
        assert kept() == "nothing half-written is left"
