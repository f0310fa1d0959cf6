"""Every command that a page names goes through the real parser; make's are targets. test_docs_run.py runs them."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from worlds.pages import PAGES, ROOT, Command, said, words_of

from crowdmap_torch.cli import _parser as command_line
from crowdmap_torch.cli import main

COMMANDS = sorted({command for page in PAGES for command in said(page)})


def refused(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """What the parser finds wrong with a command line; nothing is run."""
    try:
        command_line().parse_args(arguments)
    except SystemExit as ended:
        told = capsys.readouterr()
        return told.err if ended.code else ""
    return ""


def test_pages_name_commands():
    assert len(COMMANDS) > 80
    assert {command.page for command in COMMANDS} >= {"README.md", "OWN_DATA.md", "RESULTS.md"}


@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: f"{command.page}-{command.text}")
def test_commands_are_understood(command: Command, capsys: pytest.CaptureFixture[str]):
    name, *arguments = words_of(command.text)
    if name == "make":
        targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text("utf-8"), flags=re.M)
        assert {word for word in arguments if "=" not in word} <= set(targets)
    elif name == "python":
        assert (ROOT / arguments[0]).exists() or arguments[0] == "-m"
        if arguments[0].startswith("scripts/") and arguments[0] != "scripts/soak.py":
            assert refused([Path(arguments[0]).stem, *arguments[1:]], capsys) == ""
    elif name == "crowdmap":
        error = refused(arguments, capsys)
        if not command.is_whole and re.search(
            r"required|expected (one|at least one) argument", error
        ):
            with pytest.raises(SystemExit):
                main([arguments[0], "--help"])
            error, told = "", capsys.readouterr().out
            assert all(word in told for word in arguments if word.startswith("--"))
        assert error == ""
