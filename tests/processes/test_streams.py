"""Printing never fails a program; what became of standard output is known at its end."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest
from worlds.programs import PATIENCE_S, begin

from crowdmap_torch.processes.streams import Forgiving, StandardStreams

PROGRAM = """
import os, sys
from crowdmap_torch.processes.streams import StandardStreams
with StandardStreams() as streams:
    for line in range(3000):
        print("a line that is printed")
        print("progress", file=sys.stderr)
    fault = streams.output_fault()
    opened = os.open(os.devnull, os.O_RDONLY)
    with open(sys.argv[1], "w") as told:
        print(type(fault).__name__, opened > 2, file=told)
"""


@pytest.mark.parametrize(
    ("redirection", "fault"),
    [
        ("", "NoneType"),
        (">&-", "NoneType"),
        ("2>&-", "NoneType"),
        ("<&- >&- 2>&-", "NoneType"),
        (">/dev/full", "OSError"),
        ("2>/dev/full", "NoneType"),
        ("| true", "BrokenPipeError"),
    ],
)
def test_a_stream_that_fails_does_not_end_the_program(redirection: str, fault: str, tmp_path: Path):
    if "full" in redirection and not Path("/dev/full").exists():
        pytest.skip("there is no /dev/full here")
    program, told = tmp_path / "program.py", tmp_path / "told"
    program.write_text(PROGRAM)
    call = f'"$0" "$1" "$2" {redirection}'
    shell = begin(
        *("-c", "import subprocess, sys; sys.exit(subprocess.run(sys.argv[1:]).returncode)"),
        *("bash", "-o", "pipefail", "-c", call, sys.executable, str(program), str(told)),
    )
    _, err = shell.communicate(timeout=PATIENCE_S)
    assert shell.returncode == 0
    assert told.read_text().split() == [fault, "True"]
    assert "Traceback" not in err and "ignored" not in err


def test_what_is_printed_arrives(capsys: pytest.CaptureFixture[str]):
    with StandardStreams() as streams:
        print("some words")
        assert streams.output_fault() is None
    assert capsys.readouterr().out == "some words\n"


def test_a_stream_is_left_alone_after_its_first_error():
    reads, writes = os.pipe()
    os.close(reads)
    with open(writes, "w", buffering=1, encoding="utf-8") as stream:
        forgiving = Forgiving(stream)
        for _ in range(2):
            assert forgiving.write("a line\n") == 7
        assert isinstance(forgiving.error, BrokenPipeError)
