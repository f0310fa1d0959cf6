"""The pages of the repository, and the commands that they name."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[2]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")])
PROGRAMS = ("crowdmap", "make", "python", "tensorboard", "pip", "git", "ray")
WORDS = {
    **{"NAME": "journeys", "FORMAT": "geojson", "ID": "journey-000"},
    **{"NUMBER": "1", "N": "1", "S": "1", "E0,N0,E1,N1": "-500,-500,500,500"},
}
"""What stands for a word that a reader replaces, where it may not be any text."""


class Command(NamedTuple):
    """What a page says to type."""

    text: str
    is_whole: bool
    """It stands in a block; others may be a part of a command, such as a name and an option."""
    page: str


def said(page: Path) -> Iterator[Command]:
    """The commands of a page in its order, those in blocks first."""
    text = page.read_text(encoding="utf-8")
    blocks = re.findall(r"^```(\w*)\n(.*?)^```", text, flags=re.M | re.S)
    lines = [line for kind, block in blocks if not kind for line in block.splitlines()]
    for line in lines:
        command = line.removeprefix("$ ")
        if re.match(rf"({'|'.join(PROGRAMS)}) [\w.-]", command):
            yield from (Command(part, True, page.name) for part in command.split(" && "))
    plain = re.sub(r"^```.*?^```", "", text, flags=re.M | re.S)
    for code in re.findall(r"`([^`]+)`", plain):
        if re.match(r"(crowdmap|make|python (scripts|docs)/\S+) [\w-]+( |$)", code):
            parts = (" ".join(part.split()) for part in code.split(" && "))
            yield from (Command(part, False, page.name) for part in parts)


def bare(text: str) -> str:
    """A command without its comment."""
    return re.sub(r"\s+#.*", "", text)


def words_of(text: str) -> list[str]:
    """A command's words without comments and optional parts, with the first of alternatives."""
    words = shlex.split(re.sub(r"\[[^]]*\]", "", bare(text)))
    first = (word.split("|")[0] for word in words)
    return ["/".join(WORDS.get(part, part) for part in word.split("/")) for word in first]
