"""Every command that a page names is run: in the order of the page, on a street of a few seconds, in sizes that are small.

Commands of studies run in studies/test_study.py, those of the tutorial in commands/test_convert.py, where what they make is
looked at; here is a list of the few that no test can run, and of those that others run.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from conftest import data_folder
from examples import own_data
from worlds.garage import write_garage
from worlds.pages import PAGES, ROOT, Command, bare, said, words_of
from worlds.programs import begin, checkout
from worlds.runs import ROUGH

import crowdmap_torch as cm
from crowdmap_torch.cli import main

NOT_RUN: Mapping[str, str] = {
    "make install": "fetches packages; every job of CI begins with it",
    "make test": "is what runs this test",
    "make lint": "a job of CI; takes minutes",
    "make lint test": "both of these",
    "make test-coverage": "the whole suite once more",
    "make format": "changes the working tree",
    "make demo": "installs first; its two commands are those of README.md, which are run",
    "make docs": "tests/test_site.py builds the site by the same command",
    "make bench": "installs first and takes minutes; its two commands are run, in small",
    "make bench AGAINST=../older": "takes another checkout",
    "make soak": "takes hours; its three commands are run, in small",
    "python scripts/soak.py mended": "maps a data set three times: half a minute in its smallest form",
    "python scripts/soak.py signals": "maps for a minute; test_interrupted.py does the same by SIGKILL",
    "crowdmap optimize /data/city --out /data/run --engine ray --address FIRST:6379": "needs a cluster",
    "crowdmap optimize --engine ray --address HOST:PORT": "needs a cluster",
    "crowdmap benchmark bundle --device cuda --solvers ours --repeats 1": "needs a GPU",
    "crowdmap optimize DATA --device cuda --engine local": "needs a GPU; tests/test_cuda.py does it",
    "ray start --head --port 6379 --num-cpus 16": "begins a cluster that outlives it",
    "ray start --address FIRST:6379 --num-cpus 16": "needs a cluster",
    "ray stop": "ends every cluster of the machine, ours or not",
    "pip install torch==2.13.0 --index-url https://download.pytorch.org/whl/cpu": "needs a network",
    "pip install -c constraints.txt .": "needs a network",
}
"""Commands that no test can run, and why."""
ELSEWHERE: Mapping[str, str] = {
    "python scripts/soak.py mutants --seed S --only NUMBER": "tests/soak/test_mutants.py",
    "python scripts/soak.py mutants": "tests/soak/test_mutants.py",
    "python scripts/soak.py kills": "tests/soak/test_interrupted.py",
    "crowdmap benchmark cluster --sizes 10000 100000 --repeats 1": "tests/benchmark/test_cluster.py",
    "crowdmap benchmark journey DATASET --endless 4": "tests/benchmark/test_journey.py",
    "crowdmap benchmark viewer": "tests/benchmark/test_viewer.py",
}
"""Commands that other tests run."""
STUDIES, TUTORIAL = "tests/studies/test_study.py", "tests/commands/test_convert.py"

ARGOVERSE = "argoverse2/7fab2350-7eaf-3b7e-a39d-6937a4c1bede"
PROBLEM = "problem.txt"
REAL: Mapping[str, str] = {ARGOVERSE: ARGOVERSE, PROBLEM: "bal/problem-49-7776-pre.txt"}
"""Names of real data, and where they are below the data folder."""
OLDER = """
import json, pathlib, sys
out = pathlib.Path(sys.argv[sys.argv.index("--out") + 1])
out.mkdir()
(out / "metrics.json").write_text(json.dumps({"times_s": {"single journeys": 0.1}, "survey": None}))
"""
"""The main job of an older state of the package, as far as it is measured."""
CONVERT = (
    "--from tum FILES/journey-000/drive.txt --rig FILES/rig-a --world enu --axes camera"
    " --origin 1 2 3 --out CONVERTED"
)
ERRORS = "crowdmap simulate D --world suburb --journeys 25 --length-m 500 --seed 5 --vehicles 8"
COMPLETED: Mapping[str, str] = {
    "crowdmap benchmark ladybug FILE": "crowdmap benchmark ladybug problem.txt",
    "crowdmap benchmark stages DATASET [--against CHECKOUT ...]": (
        "crowdmap benchmark stages DATA --against 0a43fbe c1332f1"
    ),
    "crowdmap calibrate": "crowdmap calibrate GARAGE/rig-a --points GARAGE/points.csv --pixels GARAGE/pixels.csv",
    "crowdmap check": "crowdmap check DATASET",
    "crowdmap convert": f"crowdmap convert {CONVERT}",
    "crowdmap convert --from": f"crowdmap convert {CONVERT}",
    "crowdmap convert --from argoverse2": f"crowdmap convert --from argoverse2 {ARGOVERSE} --out LOG",
    "crowdmap convert --from opendrive": "crowdmap convert --from opendrive crossing.xodr --out SURVEYED",
    "crowdmap evaluate": "crowdmap evaluate MAP SURVEY",
    "crowdmap export": "crowdmap export MAP --to geojson",
    "crowdmap export --to compact": "crowdmap export MAP --to compact",
    "crowdmap export --to geopackage": "crowdmap export MAP --to geopackage",
    "crowdmap export --to opendrive": "crowdmap export MAP --to opendrive",
    "crowdmap optimize": "crowdmap optimize DATASET --out RUN",
    "crowdmap optimize --bbox": "crowdmap optimize DATASET --out PART --bbox -50,-500,500,500",
    "crowdmap optimize --journeys ID,ID...": (
        "crowdmap optimize DATASET --out PART --journeys journey-000,journey-001"
    ),
    "crowdmap simulate": "crowdmap simulate SIMULATED",
    "crowdmap simulate --bias-wander-m": "crowdmap simulate SIMULATED --bias-wander-m 1",
    "crowdmap simulate --errors fleet": "crowdmap simulate SIMULATED --errors fleet",
    "crowdmap simulate --map": "crowdmap simulate SIMULATED --map MAP",
    f"{ERRORS} --errors NAME --error-factor N": f"{ERRORS} --errors mounts,clocks --error-factor 2",
    "crowdmap view": "crowdmap view RUN",
    "python docs/concepts.py DATA RUN": "python docs/concepts.py ../DATASET ../RUN",
    "crowdmap view ... --rerun FILE.rrd": "crowdmap view RUN --rerun FILE.rrd",
}
"""Where a page names a part of a command: the whole, as a reader would type it."""
SMALL = "--length-m 70 --frame-rate-hz 5 --journeys 2 --rigs 1"
SMALLER: Mapping[str, str] = {
    "crowdmap simulate DRIVES --map crossing.osm": "--frame-rate-hz 5 --journeys 1",
    "crowdmap simulate DRIVES --map LOG": "--journeys 1",
    "crowdmap simulate SIMULATED --map": "--frame-rate-hz 5 --journeys 1",
    # Four kilometres of streets would be laid out and mapped for the sake of two drives of 70 m.
    "crowdmap simulate DATA --world city": f"{SMALL} --square-m 500",
    "crowdmap simulate": SMALL,
    # One process: others would import everything once more. In few steps: whether it runs is asked, not how well it maps.
    "crowdmap optimize": "--workers 1 --config FILE",
    "crowdmap benchmark adjustment": "--workers 1",
    "crowdmap benchmark association": "--workers 1 --methods joint",
    "crowdmap benchmark stages": "--workers 1",
    "crowdmap benchmark bundle": "--sizes 2x6x4 --repeats 1 --solvers ours",
    "crowdmap benchmark ladybug": "--repeats 1 --solvers ours",
    "python scripts/soak.py mistakes": "--sets street --only w-x-y-z",
    # A street with six signs, in 13 s; ten worlds take eight minutes.
    "python scripts/soak.py worlds --wide": "--first 40 --count 1",
    "python scripts/soak.py worlds": "--first 1551 --count 1",
    # It would serve until it is ended.
    "tensorboard": "--inspect",
}
"""What is appended to commands that begin so (the first that fits), in place of the same options."""
OVERWRITE = ("simulate", "optimize", "convert", "view", "export")
"""Pages write the same names again and again; the reader of one page has them once."""


def needs(words: list[str]) -> str | None:
    """What a command needs and is not here; None: nothing."""
    for package, option in (("rerun", "--rerun"), ("pyogrio", "geopackage")):
        if option in words and find_spec(package) is None:
            return package
    for word in words:
        data = REAL.get(ARGOVERSE if word == "LOG" else word)
        if data is not None and not (data_folder() / data).exists():
            return f"real data {data}"
    return None


def without(words: list[str], others: list[str]) -> list[str]:
    """A command without the options, and their values, that others say anew: two pages' commands become one."""
    kept, is_said_anew = [], False
    for word in words:
        if word.startswith("-"):
            is_said_anew = word in others
        if not is_said_anew:
            kept.append(word)
    return kept


def whole(command: Command) -> list[str]:
    """The words of what is run for a command of a page."""
    text = COMPLETED.get(bare(command.text), command.text)
    words = words_of(text)
    said = " ".join(words)
    more = next((more.split() for start, more in SMALLER.items() if said.startswith(start)), [])
    words = [*without(words, more), *more]
    if words[0] == "crowdmap" and words[1] in OVERWRITE and "--add" not in words:
        words.append("--overwrite")
    return words


def where(command: Command) -> str | None:
    """The test that runs a command, or why none does; None: it is run here."""
    text = bare(command.text)
    if text.startswith("crowdmap study "):
        return STUDIES
    if command.page == "OWN_DATA.md" and command.is_whole:
        return TUTORIAL
    return NOT_RUN.get(text) or ELSEWHERE.get(text)


COMMANDS = [command for page in PAGES for command in said(page)]
HERE = [command for command in COMMANDS if where(command) is None]


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with everything that pages give a name to: small drives, their map, files of others, a clone."""
    desk = tmp_path_factory.mktemp("desk")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(desk)
        Path("FILE").write_text(ROUGH)
        assert (
            main(["simulate", "DATASET", "--world", "street", "--seed", "1", *SMALL.split()]) == 0
        )
        rough = ("--workers", "1", "--config", "FILE")
        assert main(["optimize", "DATASET", "--out", "RUN", *rough]) == 0
        for name in ("DATA", "D", "DRIVES", "suburb"):
            shutil.copytree("DATASET", name)
        shutil.copytree("RUN/map", "MAP")
        shutil.copytree("DATASET/survey", "SURVEY", ignore=shutil.ignore_patterns("truth"))
        ids = pq.read_table("SURVEY/signs.parquet").column("sign_id").to_pylist()
        Path("eligible.json").write_text(json.dumps({"journey-000": ids}))
        own_data.main(Path("DATASET"), Path("FILES"))
        write_garage(desk / "GARAGE")
        # As the page says where the crossing is.
        head = json.loads(Path("SURVEY/map.json").read_text())
        head["origin"] = {"lat_deg": 35.6417, "lon_deg": 139.7484, "height_m": 0.0}
        shutil.copytree("SURVEY", "CROSSING")
        Path("CROSSING/map.json").write_text(json.dumps(head))
        for form, suffix in (("lanelet2", "osm"), ("opendrive", "xodr")):
            assert main(["export", "CROSSING", "--to", form, "-o", f"crossing.{suffix}"]) == 0
    for folder in ("crowdmap_torch", "docs", "tests", "configs"):
        ignored = shutil.ignore_patterns("__pycache__", "results")
        shutil.copytree(ROOT / folder, desk / "clone" / folder, ignore=ignored)
    for commit in ("0a43fbe", "c1332f1"):
        checkout(desk / commit, OLDER)
    for name, data in REAL.items():
        if (data_folder() / data).exists():
            (desk / name).parent.mkdir(exist_ok=True)
            if name == PROBLEM:
                write_few_points(data_folder() / data, desk / name)
            else:
                (desk / name).symlink_to(data_folder() / data)
    return desk


def write_few_points(problem: Path, out: Path, count: int = 500) -> None:
    """A problem of bundle adjustment in the large with the first `count` of its points alone: all of them take a minute."""
    head, *lines = problem.read_text().splitlines()
    cameras, points, rows = (int(number) for number in head.split())
    seen = [line for line in lines[:rows] if int(line.split()[1]) < count]
    unknowns = lines[rows : rows + 9 * cameras + 3 * min(count, points)]
    head = f"{cameras} {min(count, points)} {len(seen)}"
    out.write_text("\n".join((head, *seen, *unknowns, "")))


@dataclass
class Done:
    """What was run: what several pages name is run once, unless what it made was made anew by another one since."""

    commands: set[tuple[str, ...]] = field(default_factory=set)
    made_by: dict[str, tuple[str, ...]] = field(default_factory=dict)
    """By the name of what commands make, the last one that did."""

    def is_there(self, words: list[str]) -> bool:
        """Whether a command was run, and what it made is what it left."""
        name, command = made_by(words), tuple(words)
        return command in self.commands and (name is None or self.made_by[name] == command)

    def add(self, words: list[str]) -> None:
        """Notes that a command was run."""
        name, command = made_by(words), tuple(words)
        self.commands.add(command)
        if name is not None:
            self.made_by[name] = command


def made_by(words: list[str]) -> str | None:
    """The name that a command gives to what it makes; None: it gives none."""
    if words[:2] == ["crowdmap", "simulate"]:
        return words[2]
    return words[words.index("--out") + 1] if "--out" in words else None


@pytest.fixture(scope="module")
def done() -> Done:
    """What pages before have run."""
    return Done()


def ended(words: list[str], desk: Path, capsys: pytest.CaptureFixture[str]) -> tuple[int, str]:
    """Runs a command on the desk: its exit code, and what it said."""
    if words[0] == "crowdmap":
        capsys.readouterr()
        try:
            code = main(words[1:])
        except SystemExit as exit:
            code = int(exit.code or 0)
        told = capsys.readouterr()
        return code, told.out + told.err
    clone = desk / "clone"
    if words[0] == "git":
        run = subprocess.run(words, cwd=clone, capture_output=True, text=True, check=False)
        return run.returncode, run.stdout + run.stderr
    arguments = ["-m", "tensorboard.main", *words[1:]] if words[0] == "tensorboard" else words[1:]
    if arguments[0].startswith("scripts/"):
        program = begin(*arguments)
    elif arguments[0].startswith("docs/"):
        program = begin(*arguments, cwd=clone, env={**os.environ, "PYTHONPATH": str(clone)})
    else:
        program = begin(*arguments, cwd=desk)
    out, err = program.communicate()
    return program.returncode, out + err


def test_every_command_that_is_not_run_here_is_named_by_a_page():
    texts = {bare(command.text) for command in COMMANDS}
    assert not {*NOT_RUN, *ELSEWHERE, *COMPLETED} - texts
    whole_texts = [" ".join(words_of(COMPLETED.get(text, text))) for text in texts]
    assert [s for s in SMALLER if not any(text.startswith(s) for text in whole_texts)] == []
    assert all(len(reason) > 10 for reason in NOT_RUN.values())


@pytest.mark.parametrize("text", ELSEWHERE)
def test_what_others_run_is_there(text: str):
    program, subcommand = text.split()[1:3]
    test = (ROOT / ELSEWHERE[text]).read_text("utf-8")
    assert re.search(rf'"{program}",\s*"{subcommand}"', test)


def test_all_commands_of_the_tutorial_are_run_by_its_test():
    (page,) = (page for page in PAGES if page.name == "OWN_DATA.md")
    shown = re.findall(r"^\$ (.+)$", page.read_text("utf-8"), flags=re.M)
    assert shown == [command.text for command in COMMANDS if where(command) == TUTORIAL]


PAGES_WITH_SOME = list(dict.fromkeys(command.page for command in HERE))
# Its reader begins with nothing: it comes before others make the same names anew.
PAGES_WITH_SOME.sort(key=lambda page: page != "README.md")


@pytest.mark.parametrize("page", PAGES_WITH_SOME)
def test_the_commands_of_a_page_run(
    page: str,
    desk: Path,
    done: Done,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    monkeypatch.chdir(desk)
    lacking: set[str] = set()
    failed: list[str] = []
    for command in HERE:
        if command.page != page:
            continue
        words = whole(command)
        if (lack := needs(words)) is not None:
            lacking.add(lack)
        elif not done.is_there(words):
            code, told = ended(words, desk, capsys)
            done.add(words)
            if code != 0:
                failed.append(f"{' '.join(words)}: exit code {code}\n{told}")
    assert not failed, "\n".join(failed)
    if page == "README.md":
        for path in ("RUN/report.html", "check.html", "RUN.html", "RUN/map.geojson"):
            assert Path(path).stat().st_size > 1000, path
    print(f"not run for lack of: {sorted(lacking)}")


def test_the_readmes_lines_for_a_notebook_run(desk: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(desk)
    names: dict[str, object] = {}
    for line in re.findall(r"^>>> (.+)$", (ROOT / "README.md").read_text("utf-8"), flags=re.M):
        # Drawing a map of the world in a notebook takes folium, and a network.
        if "geopandas" in line and find_spec("geopandas") is None:
            continue
        exec(line.replace(".explore()", ""), names)
    assert repr(names["hd_map"]).startswith("HdMap(") and isinstance(names["hd_map"], cm.HdMap)
