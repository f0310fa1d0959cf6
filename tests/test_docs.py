"""What the pages say: links lead somewhere, names exist, and nothing outside the repository is cited."""

from __future__ import annotations

import re
import tomllib
from importlib import import_module
from pathlib import Path
from types import ModuleType

import architecture
import configuration
import pytest
import yaml

import crowdmap_torch
from crowdmap_torch import __version__
from crowdmap_torch.geometry import polygon

ROOT = Path(__file__).parents[1]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")])
SOURCES = sorted(
    path
    for folder in ("crowdmap_torch", "scripts", "tests", "configs", "docs")
    for path in (ROOT / folder).rglob("*")
    if path.suffix in (".py", ".yaml", ".toml", ".patch")
)


def text(path: Path) -> str:
    return path.read_text(encoding="utf-8")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page: Path):
    links = re.findall(r"\]\((?!https?:)([^)#\s]+)[^)]*\)", text(page))
    assert [link for link in links if not (page.parent / link).exists()] == []


def test_pages_that_are_cited_are_in_the_repository():
    known = {page.name for page in PAGES}
    for path in (*SOURCES, *PAGES, ROOT / "Makefile", ROOT / "pyproject.toml"):
        cited = set(re.findall(r"\b[A-Za-z]+\.md\b", text(path)))
        assert cited <= known, f"{path}: {sorted(cited - known)}"


def test_nothing_outside_the_repository_is_cited():
    # Where the real data may be is said in conftest.py alone; without them those tests skip.
    outside = re.compile(r"\.\./" + "shared|/" + r"work/|(?<![\w.])/" + "tmp/")
    for path in (*SOURCES, *PAGES):
        if path != ROOT / "tests" / "conftest.py":
            assert not outside.search(text(path)), path


def test_extras_that_are_told_of_are_there():
    declared = tomllib.loads(text(ROOT / "pyproject.toml"))["project"]["optional-dependencies"]
    rows = set(re.findall(r"^\| `(\w+)` \| ", text(ROOT / "README.md"), flags=re.M))
    assert rows == declared.keys() - {"dev", "docs", "bench"}
    named = {
        extra
        for path in (*SOURCES, *PAGES)
        for group in re.findall(r"(?:crowdmap_torch|'\.|extra )\[([a-z,]+)\]", text(path))
        for extra in group.split(",")
    }
    assert {"gis", "lanelet", "rerun", "ray"} <= named <= declared.keys()


def test_terms_of_the_glossary_live_where_it_says():
    rows = re.findall(r"^\| (?!term |---)(.+)\|$", text(ROOT / "docs" / "GLOSSARY.md"), flags=re.M)
    assert len(rows) > 40
    rooms = {name.rpartition(".")[0] for name in architecture.modules()}
    for row in rows:
        term, _, _, places = (cell.strip() for cell in row.split("|"))
        homes = re.findall(r"`([\w.]+)`", places)
        assert homes, f"{term}: no module"
        assert set(homes) <= {*architecture.modules(), *rooms}, f"{term}: {homes}"


def test_modules_that_pages_name_exist():
    for page in PAGES:
        named = re.findall(r"`(?:crowdmap_torch/)?((?:\w+/)+\w+\.py)`", text(page))
        folders = (ROOT, ROOT / "crowdmap_torch")
        lost = [name for name in named if not any((folder / name).exists() for folder in folders)]
        assert lost == [], page


def test_the_format_has_a_row_for_every_shape():
    rows = re.findall(r"^\| `(\w+)` \| (\d) \|", text(ROOT / "docs" / "FORMAT.md"), flags=re.M)
    counts = zip(polygon.SHAPES, polygon.CORNER_COUNT.tolist(), strict=True)
    assert sorted((name, int(count)) for name, count in rows) == sorted(counts)


def test_the_citation_names_this_version():
    cited = yaml.safe_load(text(ROOT / "CITATION.cff"))
    assert cited["version"] == __version__ and cited["license"] == "Apache-2.0"


def papers_equations() -> list[list[str]]:
    """The rows of the table of equations."""
    rows = re.findall(r"^\| (?!what |---)(.+) \|$", text(ROOT / "docs" / "PAPER.md"), flags=re.M)
    return [cells for row in rows if len(cells := [c.strip() for c in row.split(" | ")]) == 6]


def test_functions_that_the_papers_equations_name_exist():
    rows = papers_equations()
    assert len(rows) > 20
    for what, _, _, papers, ours, _ in rows:
        for cell in (papers, ours):
            (name,) = re.findall(r"^`([\w.]+)`$", cell)
            found: object = crowdmap_torch
            for part in name.split("."):
                is_room = isinstance(found, ModuleType) and hasattr(found, "__path__")
                path = f"{getattr(found, '__name__', '')}.{part}"
                found = import_module(path) if is_room else getattr(found, part)
            assert callable(found), f"{what}: {name}"


def test_every_label_of_the_papers_equations_stands_once():
    labels = [label for _, _, label, *_ in papers_equations() if label != "-"]
    assert sorted(labels) == ["eq:ba", "eq:ipm", "eq:rne", "eq:simlane", "eq:simsign"]
    named = [what for what, *_ in papers_equations()]
    assert len(set(named)) == len(named)


def test_each_of_the_papers_equations_has_its_test():
    sources = [*(ROOT / "tests" / "paper").glob("*.py"), ROOT / "tests/adjustment/test_bundle.py"]
    tests = set(re.findall(r"^def (test_\w+)", "\n".join(map(text, sources)), flags=re.M))
    for what, *_, test in papers_equations():
        assert test.strip("`") in tests, what


def test_the_reference_of_the_configuration_is_that_of_the_dataclasses():
    assert text(configuration.PAGE) == configuration.page(), (
        "docs/CONFIGURATION.md is out of date: run `python docs/configuration.py --write`"
    )


def test_every_key_of_the_configuration_has_a_text():
    rows = re.findall(
        r"^\| `(\w+)` \| `(.*?)` \| (.*?) \| (.*) \|$", configuration.page(), flags=re.M
    )
    assert len(rows) > 100
    assert [name for name, _, _, meaning in rows if len(meaning) < 5] == []
