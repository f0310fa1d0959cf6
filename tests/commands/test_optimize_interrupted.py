"""Runs that something stops: what is left of them, what a reader of the older result sees, and how they go on."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from worlds.runs import ROUGH, Said, journeys_of
from worlds.split_landmarks import with_a_split_sign

from crowdmap_torch import mapper
from crowdmap_torch.adjustment import adjust
from crowdmap_torch.cli import main
from crowdmap_torch.commands import optimize as optimize_command
from crowdmap_torch.config import load_config
from crowdmap_torch.io.datasets import load_dataset
from crowdmap_torch.mapper import map_journey
from crowdmap_torch.soak.interrupted import differences


@pytest.fixture
def optimize(
    optimize: Callable[..., Said], patched: pytest.MonkeyPatch, rough: Path
) -> Callable[..., Said]:
    """The same with that configuration, unless another is named."""
    return lambda dataset, out, *more: optimize(dataset, out, "--config", str(rough), *more)


@pytest.fixture(scope="module")
def maps(small: Path, rough: Path) -> tuple[mapper.JourneyMap, ...]:
    """What each journey shows by itself."""
    return mapper.map_journeys(load_dataset(small).journeys, load_config(rough))


@pytest.fixture(scope="module")
def patched(maps: tuple[mapper.JourneyMap, ...]) -> Iterator[pytest.MonkeyPatch]:
    """Each journey's own map is in memory, and no report is drawn: what follows and precedes them is the tests'."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mapper, "map_journey", lambda journey, number, *_: maps[number])
        patch.setattr(optimize_command, "write_report", lambda path, record: path.touch())
        yield patch


@pytest.fixture(scope="module")
def run(
    patched: pytest.MonkeyPatch, small: Path, rough: Path, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """A finished run that nothing stopped."""
    out = tmp_path_factory.mktemp("run") / "run"
    options = ("--out", str(out), "--config", str(rough), "--workers", "1")
    assert main(["optimize", str(small), *options]) == 0
    return out


@pytest.fixture
def copy(small: Path, tmp_path: Path) -> Path:
    """The dataset, to be spoilt."""
    return Path(shutil.copytree(small, tmp_path / "dataset"))


# Runs that exist.


def test_a_run_that_exists_is_refused_and_left_alone(optimize, run: Path, small: Path):
    before = (run / "map" / "map.json").read_bytes()
    said = optimize(small, run)
    assert said.code == 2 and "--overwrite" in said.err and said.err.count("\n") == 1
    assert (run / "map" / "map.json").read_bytes() == before


class Interruption(Exception):
    """What stops a run in the middle."""


class Cuts:
    """Counts the calls of the stages, and ends a run before one of them."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.calls: Counter[str] = Counter()
        self.cut: tuple[str, int] | None = None
        for place, name in (
            (mapper, "map_journey"),
            (mapper, "first_map"),
            (adjust, "adjust_step"),
            (mapper, "finish_map"),
            (optimize_command, "metrics_of"),
        ):
            monkeypatch.setattr(place, name, partial(self._call, name, getattr(place, name)))

    def _call(self, name: str, stage: Callable, *arguments, **options):
        if self.cut == (name, self.calls[name]):
            raise Interruption
        self.calls[name] += 1
        return stage(*arguments, **options)


@pytest.fixture
def cuts(patched: pytest.MonkeyPatch, monkeypatch: pytest.MonkeyPatch) -> Cuts:
    return Cuts(monkeypatch)


def same_map(one: Path, other: Path) -> bool:
    """Whether two runs are the same to the last bit, but for their times."""
    return not differences(one, other)


def assert_board_shows_all_once(folder: Path, *, journeys: int, steps: int) -> None:
    """Every stage is there, whichever of the runs made it, and none twice."""
    board = EventAccumulator(str(folder), size_guidance={"scalars": 0}).Reload()
    for tag in board.Tags()["scalars"]:
        logged = [event.step for event in board.Scalars(tag)]
        assert len(set(logged)) == len(logged), tag
    # A run cut after its last stage draws the finished map anew, and logs it once.
    images = [event.step for event in board.Images("map/after")]
    assert images == [steps]
    assert len(board.Images("map/before")) == 1
    assert len(board.Tensors("config/text_summary")) == 1
    assert len(board.Scalars("association/sign_tracklets")) == journeys
    assert len(board.Scalars("bias/up_m")) == journeys
    assert len(board.Scalars("cost/total")) == steps


def test_a_run_cut_again_and_again_repeats_nothing_and_ends_with_the_same_bits(
    optimize, cuts: Cuts, small: Path, tmp_path: Path, run: Path
):
    out, steps = tmp_path / "run", len(json.loads((run / "metrics.json").read_text())["costs"])
    for cut, found in (
        (("map_journey", 1), None),
        (("first_map", 0), "1 of 3 journeys"),
        (("adjust_step", 0), "3 of 3 journeys"),
        (("adjust_step", 2), "3 of 3 journeys, clusters and biases"),
        (("adjust_step", steps - 1), "3 of 3 journeys, clusters and biases, step 2"),
        (("finish_map", 0), f"3 of 3 journeys, clusters and biases, step {steps - 1}"),
        # The map is there, but not the run.
        (("metrics_of", 0), f"3 of 3 journeys, clusters and biases, step {steps}"),
        (None, f"3 of 3 journeys, clusters and biases, step {steps}"),
    ):
        cuts.cut = cut
        options = () if found is None else ("--resume",)
        if cut is not None:
            with pytest.raises(Interruption):
                optimize(small, out, *options)
            assert (out / "checkpoint" / "inputs.json").exists()
            if cut[0] == "metrics_of":
                assert_board_shows_all_once(out / "tensorboard", journeys=3, steps=steps)
            continue
        said = optimize(small, out, *options)
        assert said.code == 0 and f"resuming: {found}\n" in said.err
    assert cuts.calls == {
        **{"map_journey": 3, "first_map": 1, "adjust_step": steps},
        # Begun again by the last one, which did not know that it was finished.
        **{"finish_map": 2, "metrics_of": 1},
    }
    assert same_map(out, run)
    assert_board_shows_all_once(out / "tensorboard", journeys=3, steps=steps)
    resumed, whole = (json.loads((r / "metrics.json").read_text()) for r in (out, run))
    for name in ("costs", "outcome", "counts", "journeys", "survey"):
        assert resumed[name] == whole[name]
    # What is left is small, and says that there is nothing more to do; also where the end was a kill amid clearing away.
    assert [p.name for p in (out / "checkpoint").rglob("*")] == ["inputs.json"]
    (out / "checkpoint" / "step.pt").touch()
    said = optimize(small, out, "--resume")
    assert said.code == 0 and said.out == f"finished already: {out / 'map'}\n"
    assert [p.name for p in (out / "checkpoint").rglob("*")] == ["inputs.json"]


@pytest.fixture
def torn(cuts: Cuts, monkeypatch: pytest.MonkeyPatch) -> None:
    """Clusters in which the first drive's detections of one sign are a sign of their own."""
    first_map = mapper.first_map

    def of_two(*arguments, **options) -> mapper.FirstMap:
        first = first_map(*arguments, **options)
        count, most = len(first.signs), first.associations[0].sign.mode().values
        rows = torch.cat((torch.arange(count), most[None]))
        own = first.associations[0]
        own = replace(own, sign=torch.where(own.sign == most, count, own.sign))
        return replace(first, signs=first.signs[rows], associations=(own, *first.associations[1:]))

    monkeypatch.setattr(mapper, "first_map", of_two)


def test_a_run_that_begins_its_adjustment_again_goes_on_there(
    optimize, cuts: Cuts, torn: None, small: Path, tmp_path: Path, run: Path
):
    whole, out = tmp_path / "whole", tmp_path / "run"
    assert optimize(small, whole).code == 0
    once = cuts.calls["adjust_step"]
    steps = json.loads((whole / "metrics.json").read_text())["costs"]
    assert [step["iteration"] for step in steps] == [*range(1, once + 1)]
    # What was torn is whole, as if it had been so from the beginning.
    signs, others = (pq.read_table(r / "map" / "signs.parquet") for r in (whole, run))
    assert signs["sign_id"].to_pylist() == others["sign_id"].to_pylist()
    before = pq.read_table(whole / "map_clusters" / "signs.parquet")
    assert len(before) == len(signs) + 1
    for number in range(1, once + 1):
        cuts.calls.clear()
        cuts.cut = ("adjust_step", 1)
        try:
            optimize(small, out, *(() if number == 1 else ("--resume",)))
        except Interruption:
            continue
        break
    cuts.cut = None
    if not (out / "map").exists():
        assert optimize(small, out, "--resume").code == 0
    assert same_map(out, whole)
    resumed = json.loads((out / "metrics.json").read_text())
    assert resumed["costs"] == steps
    assert [p.name for p in (out / "checkpoint").rglob("*")] == ["inputs.json"]


def test_a_run_does_not_go_on_with_something_else(
    optimize, cuts: Cuts, copy: Path, tmp_path: Path, capsys: pytest.CaptureFixture
):
    out, other = tmp_path / "run", tmp_path / "other.yaml"
    cuts.cut = ("adjust_step", 1)
    with pytest.raises(Interruption):
        optimize(copy, out)
    before, cuts.cut = dict(cuts.calls), None
    capsys.readouterr()
    files = {p: p.read_bytes() for p in out.rglob("*") if p.is_file()}

    other.write_text(ROUGH.replace("adjust: {", "adjust: {tukey_c: 4.0, "))
    said = optimize(copy, out, "--resume", "--config", str(other))
    assert said.code == 2 and len(said.err.splitlines()) == 1
    assert "configuration adjust.tukey_c was 4.685, is 4.0" in said.err
    assert "--overwrite" in said.err

    path = journeys_of(copy)[1] / "poses.parquet"
    table = pq.read_table(path)
    x = table["x"].to_numpy().copy()
    x[3] += 1e-9
    pq.write_table(table.set_column(table.column_names.index("x"), "x", pa.array(x)), path)
    said = optimize(copy, out, "--resume")
    assert said.code == 2 and len(said.err.splitlines()) == 1
    assert "journey journey-001 has changed" in said.err

    shutil.rmtree(journeys_of(copy)[1])
    said = optimize(copy, out, "--resume")
    assert said.code == 2 and "journey journey-001 is not there any more" in said.err

    # All before any work, and nothing was touched.
    assert cuts.calls == before
    assert {p: p.read_bytes() for p in out.rglob("*") if p.is_file()} == files


def test_a_part_of_the_dataset_is_mapped_gone_on_with_and_judged_as_a_whole_one(
    optimize, cuts: Cuts, small: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    # Of the 60 m of street the southern half.
    out, area = tmp_path / "run", ("--bbox", "-200,-200,200,-60")
    chosen = ("--journeys", "journey-00[01]")
    monkeypatch.setattr(mapper, "map_journey", map_journey)
    cuts.cut = ("adjust_step", 0)
    with pytest.raises(Interruption):
        optimize(small, out, *chosen, *area)
    cuts.cut = None
    said = optimize(small, out, "--resume", *chosen, "--bbox", "-200,-200,200,-58")
    assert said.code == 2 and "bbox was [-200.0, -200.0, 200.0, -60.0], is [-200" in said.err
    said = optimize(small, out, "--resume", *area)
    assert said.code == 2 and "journey journey-002 is new" in said.err

    said = optimize(small, out, "--resume", *chosen, *area, "-q")
    assert said.code == 0 and "resuming: 2 of 2 journeys" in said.err and "bundle" not in said.err
    first, *_, counts, _, _ = said.out.splitlines()
    assert first.startswith("area -200,-200,200,-60 and 50 m around it: 2 of 2 journeys, ")
    assert "lane pieces from 2 journeys" in counts
    provenance = json.loads((out / "map" / "map.json").read_text())["provenance"]
    assert provenance["bbox"] == [-200, -200, 200, -60]
    assert provenance["journeys"] == ["journey-000", "journey-001"]
    left = json.loads((out / "metrics.json").read_text())["area"]
    assert left["frames_outside"] > 0 and left["journeys_outside"] == 0
    # `crowdmap evaluate` finds the same figures, and every row of the files has its line.
    assert main(["evaluate", str(out / "map"), str(small / "survey"), "--json", f"{out}.json"]) == 0
    again = json.loads(Path(f"{out}.json").read_text())
    assert again == json.loads((out / "metrics.json").read_text())["survey"]
    rows = [
        pq.read_metadata(journey / f"{kind}.parquet").num_rows
        for journey in journeys_of(small)[:2]
        for kind in ("signs", "lanes")
    ]
    assert pq.read_metadata(out / "associations.parquet").num_rows == sum(rows)


def test_a_run_whose_adjustment_began_again_goes_on_to_the_same_bits(
    optimize, cuts: Cuts, monkeypatch: pytest.MonkeyPatch, small: Path, tmp_path: Path
):
    """A sign that clustering took for two is joined after the adjustment, which takes some steps more."""
    clusters = mapper.first_map
    monkeypatch.setattr(mapper, "first_map", lambda *of: with_a_split_sign(clusters(*of)))
    whole, out = tmp_path / "whole", tmp_path / "run"
    assert optimize(small, whole).code == 0
    metrics = json.loads((whole / "metrics.json").read_text())
    assert metrics["counts"]["signs joined or gone after the adjustment"] == 1
    steps = len(metrics["costs"])
    for begun, cut in pairwise((0, 2, steps - 2, steps - 1)):
        cuts.calls.clear()
        cuts.cut = ("adjust_step", cut - begun)
        with pytest.raises(Interruption):
            optimize(small, out, *(("--resume",) if begun else ()))
    cuts.cut = None
    assert (out / "checkpoint" / "anew.pt").exists()
    said = optimize(small, out, "--resume")
    assert said.code == 0 and f"clusters and biases, step {steps - 1}" in said.err
    assert same_map(out, whole)


def test_a_term_that_is_switched_off_is_off_in_what_is_resumed(
    optimize, small: Path, tmp_path: Path
):
    off, out = tmp_path / "off.yaml", tmp_path / "run"
    off.write_text("adjust: {lane_height_sigma_m: .inf}\n")
    assert optimize(small, out, "--config", str(off)).code == 0
    said = optimize(small, out, "--config", str(off), "--resume")
    assert said.code == 0 and "finished already" in said.out
    said = optimize(small, out, "--resume")
    assert said.code == 2 and "adjust.lane_height_sigma_m was .inf, is 0.05" in said.err


def test_a_damaged_stage_is_made_anew(optimize, cuts: Cuts, small: Path, tmp_path: Path, run: Path):
    out = tmp_path / "run"
    cuts.cut = ("finish_map", 0)
    with pytest.raises(Interruption):
        optimize(small, out)
    cuts.cut = None
    damaged = [out / "checkpoint" / "journeys" / "00002.pt", out / "checkpoint" / "first_map.pt"]
    for path in damaged:
        path.write_bytes(path.read_bytes()[:-7])
    said = optimize(small, out, "--resume")
    assert said.code == 0 and cuts.calls["map_journey"] == 4 and cuts.calls["first_map"] == 2
    for path in damaged:
        assert f"resuming: {path}: is cut off" in said.err
    assert "resuming: 2 of 3 journeys, step " in said.err
    assert same_map(out, run)


def test_overwrite_replaces_a_run(optimize, run: Path, copy: Path, tmp_path: Path):
    out = Path(shutil.copytree(run, tmp_path / "run"))
    shutil.rmtree(journeys_of(copy)[-1])
    shutil.rmtree(copy / "survey")
    said = optimize(copy, out, "--overwrite")
    assert said.code == 0
    listed = json.loads((out / "map" / "map.json").read_text())["provenance"]["journeys"]
    assert listed == ["journey-000", "journey-001"]
    assert [p.name for p in journeys_of(out)] == listed
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["survey"] is None and metrics["counts"]["journeys"] == 2
    assert len(list((out / "tensorboard").iterdir())) == 1


def test_an_older_map_stays_while_the_new_one_is_not_complete(
    optimize, cuts: Cuts, run: Path, small: Path, tmp_path: Path
):
    out = Path(shutil.copytree(run, tmp_path / "run"))
    before = {p: p.read_bytes() for p in (out / "map").iterdir()}
    cuts.cut = ("adjust_step", 1)
    with pytest.raises(Interruption):
        optimize(small, out, "--overwrite")
    assert {p: p.read_bytes() for p in (out / "map").iterdir()} == before


# What stops a run.


def test_a_full_disk_is_one_line_and_leaves_the_older_map(
    optimize, run: Path, small: Path, tmp_path: Path, monkeypatch
):
    out = Path(shutil.copytree(run, tmp_path / "run"))
    before = {p: p.read_bytes() for p in out.rglob("*") if p.is_file()}
    # What a run goes on from is not part of its result.
    del before[out / "checkpoint" / "inputs.json"]

    def full(path: Path, record: object) -> None:
        raise OSError(28, "No space left on device", str(path))

    monkeypatch.setattr(optimize_command, "write_report", full)
    said = optimize(small, out, "--overwrite")
    assert said.code == 1
    assert said.err.splitlines()[-1] == (
        f"crowdmap optimize: {out}/unfinished/report.html: No space left on device; what was finished is kept: "
        "the same command with --resume goes on; the older result stands"
    )
    assert {p: p.read_bytes() for p in before} == before
    assert {p.name for p in (out / "unfinished").iterdir()} == {"tensorboard"}


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Callable[[str], Path]]:
    """Gives a small disk options such as its size; only some may mount."""
    place = tmp_path / "disk"
    place.mkdir()
    mount = ["mount", "-t", "tmpfs", "tmpfs", str(place)]
    if (
        os.geteuid() != 0
        or shutil.which("mount") is None
        or subprocess.run(mount, check=False, capture_output=True).returncode
    ):
        pytest.skip("nobody may mount")

    def remount(options: str) -> Path:
        subprocess.run(["mount", "-o", f"remount,{options}", str(place)], check=True)
        return place

    yield remount
    subprocess.run(["umount", str(place)], check=True)


@pytest.mark.parametrize("kilobytes", [16, 200])
def test_a_small_disk_is_one_line_and_a_larger_one_takes_the_rest(
    optimize, small: Path, run: Path, disk: Callable[[str], Path], kilobytes: int
):
    out = disk(f"size={kilobytes}k") / "run"
    said = optimize(small, out)
    last = said.err.splitlines()[-1]
    assert said.code == 1 and "Traceback" not in said.err
    assert last.startswith(f"crowdmap optimize: {out}/") and "No space left on device" in last
    disk("size=64m")
    assert optimize(small, out, "--resume").code == 0
    assert same_map(out, run)


def test_a_disk_that_may_only_be_read_is_one_line(
    optimize, run: Path, small: Path, disk: Callable[[str], Path]
):
    out = Path(shutil.copytree(run, disk("rw") / "run"))
    disk("ro")
    for place, options in ((out, ["--overwrite"]), (out, ["--resume"]), (out.parent / "new", [])):
        said = optimize(small, place, *options)
        assert said.code == 1 and said.err.count("\n") == 1
        assert said.err.startswith(f"crowdmap optimize: {place}")
        assert "Read-only file system" in said.err
    assert same_map(out, run)
