"""The whole of `crowdmap study all --quick`, once: every study runs, draws, and finds its work done the second time."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from html.parser import HTMLParser
from itertools import islice
from pathlib import Path
from typing import Any

import pytest
from conftest import data_folder
from worlds.pages import PAGES, said, words_of

from crowdmap_torch.adjustment import adjust
from crowdmap_torch.cli import main
from crowdmap_torch.studies import all as every
from crowdmap_torch.studies.scale import QUICK
from crowdmap_torch.studies.study import Settings

DRAWN = {study.name for study in every.STUDIES} - {"real"}


@dataclass(frozen=True)
class Quick:
    """What `crowdmap study all --quick` left."""

    out: Path
    code: int

    @property
    def folder(self) -> Path:
        return self.out / "quick"

    def arguments(self, name: str = "all") -> list[str]:
        return ["study", name, "--quick", "--out", str(self.out), "--processes", "1"]


class Sections(HTMLParser):
    """The anchors of a page, and where its links lead."""

    def __init__(self) -> None:
        super().__init__()
        self.ids: set[str] = set()
        self.links: set[str] = set()

    def handle_starttag(self, tag, attrs) -> None:
        named = {name: value or "" for name, value in attrs}
        if tag == "section":
            self.ids.add(named["id"])
        if named.get("href", "").startswith("#"):
            self.links.add(named["href"][1:])


@contextmanager
def few_steps(most: int = 1) -> Iterator[None]:
    """Bundles take that many steps at most: it is not their maps that are judged."""
    steps = adjust.steps

    def first_ones(*given: Any, **options: Any) -> Iterator[Any]:
        yield from islice(steps(*given, **options), most)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(adjust, "steps", first_ones)
        yield


@pytest.fixture(scope="module")
def quick(tmp_path_factory: pytest.TempPathFactory) -> Quick:
    """The quick form, run once for all tests: under a minute of one core. Maps of the first study are finished ones."""
    out = tmp_path_factory.mktemp("study")
    asked = Quick(out, -1)
    assert main(asked.arguments("journeys")) == 0
    with few_steps():
        return Quick(out, main(asked.arguments()))


def choose_real_drives(folder: Path, kitti: Path) -> None:
    """A folder with the shortest of the real drives alone."""
    folder.mkdir()
    for name in ("kitti-06", "eligible.json"):
        (folder / name).symlink_to(kitti / name)


def test_the_page_has_a_section_for_every_study(quick: Quick):
    assert quick.code == 0
    page = Sections()
    page.feed((quick.folder / "all.html").read_text(encoding="utf-8"))
    assert page.ids == page.links == {study.name for study in every.STUDIES} | {"times"}


def test_every_study_has_a_table_and_a_plot(quick: Quick):
    for name in DRAWN:
        with (quick.folder / "tables" / f"{name}.csv").open(encoding="utf-8") as file:
            heading, *rows = csv.reader(file)
        assert rows, name
        assert all(len(row) == len(heading) for row in rows), name
        assert (quick.folder / "plots" / f"{name}.png").read_bytes().startswith(b"\x89PNG"), name


def test_times_are_those_of_the_work_that_a_study_rests_on(quick: Quick):
    with (quick.folder / "tables" / "times.csv").open(encoding="utf-8") as file:
        _, *rows = csv.reader(file)
    minutes = {name: float(spent) for name, _, spent in rows}
    total = minutes.pop("all, shared work once")
    assert set(minutes) == {study.title for study in every.STUDIES}
    # The second figure of the paper is drawn from the maps of the first.
    assert max(minutes.values()) < total < sum(minutes.values())
    assert minutes["Data loss"] > 0 and minutes["Real drives"] == 0


def test_our_map_of_the_quick_street_is_near_the_oracle(quick: Quick):
    with (quick.folder / "tables" / "journeys-targets.csv").open(encoding="utf-8") as file:
        mean = {row[""]: row["mean"] for row in csv.DictReader(file)}
    # Three journeys on a short street: their mean pose error is about 0.3 m.
    assert 0.5 < float(mean["absolute / oracle"]) < 1.5
    assert float(mean["relative error [m]"]) < 0.1
    assert float(mean["sign recall"]) == 1


def test_what_is_done_is_not_done_again(quick: Quick, capsys: pytest.CaptureFixture):
    results = sorted((quick.folder / "results").iterdir())
    before = [path.stat().st_mtime_ns for path in results]
    assert main(quick.arguments("control")) == 0
    assert [path.stat().st_mtime_ns for path in results] == before
    assert "not done yet" not in capsys.readouterr().out


def test_a_lost_result_alone_is_made_again(quick: Quick):
    lost = _a_map(quick)
    before = {p.name: p.stat().st_mtime_ns for p in (quick.folder / "results").iterdir()}
    lost.unlink()
    assert main(quick.arguments("journeys")) == 0
    after = {p.name: p.stat().st_mtime_ns for p in (quick.folder / "results").iterdir()}
    assert {name for name in before if after[name] != before[name]} == {lost.name}
    assert (quick.folder / "journeys.html").exists()


def test_the_report_of_a_study_that_has_not_begun_is_empty_but_there(
    tmp_path: Path, capsys: pytest.CaptureFixture
):
    assert main(["study", "all", "--quick", "--out", str(tmp_path), "--report-only"]) == 0
    said = capsys.readouterr().out
    assert (tmp_path / "quick" / "all.html").exists()
    assert "not done yet" in said


def test_a_folder_without_real_drives_is_wrong_input(tmp_path: Path, capsys: pytest.CaptureFixture):
    out = tmp_path / "out"
    code = main(["study", "real", "--quick", "--out", str(out), "--real", str(tmp_path)])
    assert code == 2
    error = capsys.readouterr().err
    assert error.startswith("crowdmap study real: ") and error.count("\n") == 1


def test_real_drives_are_skipped_with_a_reason(tmp_path: Path):
    assert main(["study", "real", "--quick", "--out", str(tmp_path), "--processes", "1"]) == 0
    assert "--real DIR" in (tmp_path / "quick" / "real.html").read_text(encoding="utf-8")


def test_real_drives_make_a_table(tmp_path: Path, real_data: Callable[[str], Path]):
    chosen = tmp_path / "drives"
    choose_real_drives(chosen, real_data("kitti-signs"))
    arguments = ["--quick", "--out", str(tmp_path / "out"), "--processes", "1"]
    assert main(["study", "real", *arguments, "--real", str(chosen)]) == 0
    with (tmp_path / "out" / "quick" / "tables" / "real.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    ours = next(row for row in rows if row["method"] == "ours")
    assert ours["eligible"] == ours["mapped"] == "2"
    assert 0 < float(ours["mean [m]"]) < 1


STUDIED = [c.text for page in PAGES for c in said(page) if c.text.startswith("crowdmap study ")]


@pytest.mark.parametrize("command", sorted(set(STUDIED)))
def test_the_studies_that_pages_name_run(command: str, quick: Quick, tmp_path: Path):
    known = {"DIR": tmp_path / "drives", "SEGMENT": data_folder() / "comma2k19" / "example_1"}
    words = [str(known.get(word, word)) for word in words_of(command)[1:]]
    if (data_folder() / "kitti-signs").exists():
        choose_real_drives(known["DIR"], data_folder() / "kitti-signs")
    else:
        for option in {"--real", "--recorded-errors"} & set(words):
            del words[(at := words.index(option)) : at + 2]
    try:
        with few_steps():
            assert main([*words, *quick.arguments()[2:]]) == 0
    except SystemExit as ended:
        assert "--help" in words and ended.code == 0


def _a_map(quick: Quick) -> Path:
    settings = Settings(QUICK, None)
    study = next(study for study in every.STUDIES if study.name == "journeys")
    task = next(task for _, task in study.tasks(settings) if "+3-" in task.key)
    return quick.folder / "results" / f"{task.key}.json"
