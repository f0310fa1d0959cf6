"""Every command that a page names: what is small is run, the rest goes through the real parser; make's are targets."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import pytest

import crowdmap_torch as cm
from crowdmap_torch.cli import _parser as command_line
from crowdmap_torch.cli import main

ROOT = Path(__file__).parents[1]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")])
PROGRAMS = ("crowdmap", "make", "python", "tensorboard", "pip", "git")
WORDS = {"NAME": "journeys", "S": "1", "N": "1", "NUMBER": "1", "FORMAT": "geojson"}
"""What stands for a word that a reader replaces, where it may not be any text."""
SMALL = ("--length-m", "70", "--frame-rate-hz", "5", "--journeys", "2", "--rigs", "1")


def said(page: Path) -> Iterator[tuple[str, bool]]:
    """The commands of a page, and whether each stands in a block: those are whole, others may be a part of one."""
    text = page.read_text(encoding="utf-8")
    blocks = re.findall(r"^```(\w*)\n(.*?)^```", text, flags=re.M | re.S)
    lines = [line for kind, block in blocks if not kind for line in block.splitlines()]
    for line in lines:
        command = line.removeprefix("$ ")
        if re.match(rf"({'|'.join(PROGRAMS)}) [\w.-]", command):
            yield from ((part, True) for part in command.split(" && "))
    plain = re.sub(r"^```.*?^```", "", text, flags=re.M | re.S)
    for code in re.findall(r"`([^`]+)`", plain):
        if re.match(r"(crowdmap|make|python (scripts|docs)/\S+) [\w-]+( |$)", code):
            yield from ((" ".join(part.split()), False) for part in code.split(" && "))


COMMANDS = sorted({(*command, page.name) for page in PAGES for command in said(page)})


def words_of(command: str) -> list[str]:
    """A command's words without comments and optional parts, with the first of alternatives."""
    command = re.sub(r"\[[^]]*\]", "", re.sub(r"\s#.*", "", command))
    words = [word.split("|")[0] for word in shlex.split(command)]
    return [WORDS.get(word, word) for word in words]


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
    assert {page for _, _, page in COMMANDS} >= {"README.md", "OWN_DATA.md", "RESULTS.md"}


@pytest.mark.parametrize(("command", "is_whole", "page"), COMMANDS)
def test_commands_are_understood(
    command: str, is_whole: bool, page: str, capsys: pytest.CaptureFixture[str]
):
    name, *arguments = words_of(command)
    if name == "make":
        targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text("utf-8"), flags=re.M)
        assert {word for word in arguments if "=" not in word} <= set(targets)
    elif name == "python":
        assert (ROOT / arguments[0]).exists() or arguments[0] == "-m"
        if arguments[0].startswith("scripts/") and arguments[0] != "scripts/soak.py":
            assert refused([Path(arguments[0]).stem, *arguments[1:]], capsys) == ""
    elif name == "crowdmap":
        error = refused(arguments, capsys)
        if not is_whole and re.search(r"required|expected (one|at least one) argument", error):
            with pytest.raises(SystemExit):
                main([arguments[0], "--help"])
            error, told = "", capsys.readouterr().out
            assert all(word in told for word in arguments if word.startswith("--"))
        assert error == ""


def test_what_the_readme_shows_is_what_happens(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    """The commands of its block of use, on a street that is small, and then the lines for a notebook."""
    page = (ROOT / "README.md").read_text("utf-8")
    shown = re.findall(r"^\$ (.+)$", page, flags=re.M)
    assert [line.split()[1] for line in shown][:4] == ["simulate", "optimize", "check", "evaluate"]
    monkeypatch.chdir(tmp_path)
    for line in shown:
        name, *arguments = words_of(line)
        if name != "crowdmap" or arguments[0] == "study":
            continue
        if arguments[0] == "simulate":
            arguments += SMALL
        assert main(arguments) == 0, capsys.readouterr().err
    for path in ("RUN/report.html", "check.html", "RUN.html", "RUN/map.geojson"):
        assert Path(path).stat().st_size > 1000, path
    names: dict[str, object] = {}
    for line in re.findall(r"^>>> (.+)$", page, flags=re.M):
        # Drawing a map of the world in a notebook takes folium, and a network.
        if "geopandas" in line and find_spec("geopandas") is None:
            continue
        exec(line.replace(".explore()", ""), names)
    assert repr(names["hd_map"]).startswith("HdMap(") and isinstance(names["hd_map"], cm.HdMap)
