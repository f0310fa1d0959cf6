from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from crowdmap_torch.runs.folder import RunFolder, read_survey_of, read_truth_of
from crowdmap_torch.tables import Dataset


def copy_survey(tiny_folder: Path, tmp_path: Path) -> Path:
    shutil.copytree(tiny_folder / "survey", tmp_path / "survey")
    return tmp_path


def write_older(run: Path) -> dict[str, bytes]:
    """A result as a finished run leaves it, as far as names go, with a stranger's files in it; all files."""
    for name in (
        *("map/map.json", "map/signs.parquet", "map_clusters/map.json", "metrics.json"),
        *("journeys/drive/poses.parquet", "tensorboard/events.out.tfevents.1", "report.html"),
        *("associations.parquet", "config.yaml"),
        *("notes.txt", "map/photo.jpg", "journeys/drive/notes/today.txt"),
    ):
        (run / name).parent.mkdir(parents=True, exist_ok=True)
        (run / name).write_text("older")
    return files_of(run)


def files_of(run: Path) -> dict[str, bytes]:
    """Every file by its name in the folder, but the marker and what a run goes on from."""
    files = {str(p.relative_to(run)): p.read_bytes() for p in run.rglob("*") if p.is_file()}
    return {k: v for k, v in files.items() if k != "run.json" and not k.startswith("checkpoint/")}


def write_newer(run: RunFolder, names: tuple[str, ...]) -> None:
    for name in names:
        (run.unfinished / name).parent.mkdir(parents=True, exist_ok=True)
        (run.unfinished / name).write_text("newer")


NEWER = (
    *("map/map.json", "map/lanes.parquet", "map_clusters/map.json", "metrics.json"),
    *("journeys/other/poses.parquet", "tensorboard/events.out.tfevents.2", "report.html"),
    *("associations.parquet", "config.yaml"),
)
STRANGE = {"notes.txt", "map/photo.jpg", "journeys/drive/notes/today.txt"}


def test_a_run_that_exists_is_refused(tmp_path: Path):
    write_older(tmp_path)
    with pytest.raises(ValueError, match=r"exists already; give --overwrite .* or --resume"):
        RunFolder(tmp_path)
    RunFolder(tmp_path, overwrite=True)
    RunFolder(tmp_path, resume=True)


@pytest.mark.parametrize("how", [{"overwrite": True}, {"resume": True}])
def test_a_folder_that_no_run_made_is_left_alone(tmp_path: Path, how: dict[str, bool]):
    (tmp_path / "journeys").mkdir()
    (tmp_path / "journeys" / "photo.jpg").touch()
    with pytest.raises(ValueError, match=r"files that no run made .* left alone, name another"):
        RunFolder(tmp_path, **how)
    assert (tmp_path / "journeys" / "photo.jpg").exists()


def test_an_empty_folder_or_none_will_do(tmp_path: Path):
    RunFolder(tmp_path)
    run = RunFolder(tmp_path / "some" / "where")
    assert not run.path.exists()
    with run.claimed():
        run.prepare()
    assert (run.path / "run.json").exists()
    # What a run has begun is one, whatever became of it.
    RunFolder(run.path, resume=True)


def test_a_folder_into_which_nothing_was_written_goes_again(tmp_path: Path):
    run = RunFolder(tmp_path / "some" / "where")
    with pytest.raises(ValueError, match="wrong input"), run.claimed():
        raise ValueError("wrong input")
    assert list(tmp_path.iterdir()) == [] and run.kept() == "nothing was written"


@pytest.mark.parametrize("overwrite", [False, True])
def test_a_file_is_refused(tmp_path: Path, overwrite: bool):
    (tmp_path / "file").touch()
    with pytest.raises(ValueError, match="is a file; --out names a folder"):
        RunFolder(tmp_path / "file", overwrite=overwrite)


def test_what_can_be_no_folder_is_refused_before_anything_is_read(tmp_path: Path):
    (tmp_path / "link").symlink_to(tmp_path / "nothing")
    with pytest.raises(ValueError, match="is a link to nothing"):
        RunFolder(tmp_path / "link")
    (tmp_path / "file").touch()
    for place in (tmp_path / "file" / "run", Path("/proc/run")):
        with (
            pytest.raises(
                ValueError, match=r"no folder can be made there \(.*\); name another one"
            ),
            RunFolder(place).claimed(),
        ):
            pass


def test_two_runs_do_not_write_into_one_folder(tmp_path: Path):
    first = RunFolder(tmp_path / "run")
    with first.claimed():
        first.prepare()
        second = RunFolder(tmp_path / "run", resume=True)
        with pytest.raises(ValueError, match=r"process \d+ on .* writes there"), second.claimed():
            pass
        assert (first.path / "run.lock").exists()
    assert not (first.path / "run.lock").exists()


@pytest.mark.parametrize("resume", [False, True])
def test_only_a_run_that_goes_on_keeps_its_events_and_checkpoint(tmp_path: Path, resume: bool):
    before = write_older(tmp_path)
    run = RunFolder(tmp_path, overwrite=not resume, resume=resume)
    for path in (run.tensorboard / "events", run.checkpoint / "step.pt"):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    with run.claimed():
        run.prepare()
        assert run.checkpoint.exists() == run.tensorboard.exists() == resume
        assert before.items() <= files_of(tmp_path).items()


@pytest.mark.parametrize("resume", [False, True])
def test_what_a_killed_run_left_half_written_is_in_no_result(tmp_path: Path, resume: bool):
    before = write_older(tmp_path)
    run = RunFolder(tmp_path, overwrite=not resume, resume=resume)
    half = ".0123456789ab.part"
    for path in (
        *(tmp_path / f".run.json{half}", run.checkpoint / "journeys" / f".00001.pt{half}"),
        *(run.unfinished / f".map{half}" / "a", run.unfinished / f".metrics.json{half}"),
        *(run.unfinished / "journeys" / "drive" / f".poses.parquet{half}", run.unfinished / "map"),
    ):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    with run.claimed():
        run.prepare()
        assert files_of(tmp_path).keys() == before.keys() | {"run.lock"}
        with run.publishing():
            write_newer(run, NEWER)
    assert files_of(tmp_path).keys() == {*NEWER, *STRANGE}
    assert not [p for p in run.checkpoint.rglob("*") if p.is_file()]


def test_a_new_result_takes_the_place_of_all_of_the_older_one(tmp_path: Path):
    write_older(tmp_path)
    run = RunFolder(tmp_path, overwrite=True)
    with run.claimed():
        run.prepare()
        with run.publishing():
            write_newer(run, NEWER)
    after = files_of(tmp_path)
    assert set(after) == {*NEWER, *STRANGE}
    assert all(content == (b"older" if k in STRANGE else b"newer") for k, content in after.items())
    assert not run.unfinished.exists() and run.kept() == f"the map is whole: {run.map}"


@pytest.mark.parametrize("error", [OSError("full"), KeyboardInterrupt()])
def test_a_signal_or_a_full_disk_leaves_the_older_result_as_it_was(
    tmp_path: Path, error: BaseException
):
    before = write_older(tmp_path)
    run = RunFolder(tmp_path, overwrite=True)
    with pytest.raises(type(error)), run.claimed():
        run.prepare()
        with run.publishing():
            write_newer(run, NEWER[:4])
            raise error
    assert files_of(tmp_path) == before
    assert run.kept().endswith("--resume goes on; the older result stands")


def test_what_scores_or_draws_a_map_never_costs_it(tmp_path: Path):
    write_older(tmp_path)
    run = RunFolder(tmp_path, overwrite=True)
    with pytest.raises(ZeroDivisionError), run.claimed():
        run.prepare()
        with run.publishing():
            write_newer(run, NEWER[:3])
            raise ZeroDivisionError
    after = files_of(tmp_path)
    # Figures and a report of another map would be worse than none.
    assert set(after) == {*NEWER[:3], *STRANGE} and after["map/map.json"] == b"newer"


@pytest.mark.parametrize("renames", range(1, 16))
def test_a_failure_among_the_renames_puts_the_older_result_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, renames: int
):
    before = write_older(tmp_path)
    run, rename, done = RunFolder(tmp_path, overwrite=True), Path.rename, []

    def fail_once(self: Path, target: Path) -> Path:
        done.append(self)
        if len(done) == renames:
            raise OSError("full")
        return rename(self, target)

    with pytest.raises(OSError, match="full"), run.claimed():
        run.prepare()
        monkeypatch.setattr(Path, "rename", fail_once)
        with run.publishing():
            write_newer(run, NEWER)
    events = "unfinished/tensorboard/events.out.tfevents.2"
    assert {k: v for k, v in files_of(tmp_path).items() if k != events} == before


@pytest.mark.parametrize("renames", range(1, 18, 3))
def test_a_run_that_was_killed_among_the_renames_is_completed_by_the_next(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, renames: int
):
    write_older(tmp_path)
    run, rename, done = RunFolder(tmp_path, overwrite=True), Path.rename, []

    def killed(self: Path, target: Path) -> Path:
        done.append(self)
        if len(done) > renames:
            raise SystemExit
        return rename(self, target)

    with monkeypatch.context() as patch, pytest.raises(SystemExit), run.claimed():
        run.prepare()
        patch.setattr(Path, "rename", killed)
        patch.setattr(RunFolder, "_drop_result", lambda folder: None)
        with run.publishing():
            write_newer(run, NEWER)
    with RunFolder(tmp_path, resume=True).claimed():
        after = files_of(tmp_path)
        del after["run.lock"]
    assert set(after) == {*NEWER, *STRANGE} and after["map/map.json"] == b"newer"


def test_a_folder_that_is_deleted_under_a_run_is_an_error(tmp_path: Path):
    run = RunFolder(tmp_path / "run")
    with pytest.raises(OSError, match="was deleted or replaced"), run.claimed():
        run.prepare()
        shutil.rmtree(run.path)
        with run.publishing():
            pass
    assert run.kept() == "nothing is left of the run"


def test_a_dataset_without_survey_has_none(tmp_path: Path, tiny: Dataset):
    assert read_survey_of(tmp_path, tiny.origin) is None
    assert read_truth_of(tmp_path, tiny, None) is None


def test_a_survey_of_another_place_is_refused(tiny_folder: Path, tmp_path: Path, tiny: Dataset):
    folder = copy_survey(tiny_folder, tmp_path)
    head = json.loads((folder / "survey" / "map.json").read_text())
    head["origin"]["lat_deg"] += 0.01
    (folder / "survey" / "map.json").write_text(json.dumps(head))
    with pytest.raises(ValueError, match="expected one origin"):
        read_survey_of(folder, tiny.origin)


def test_a_truth_that_cannot_be_read_is_refused_and_a_missing_one_is_none(
    tiny_folder: Path, tmp_path: Path, tiny: Dataset
):
    folder = copy_survey(tiny_folder, tmp_path)
    survey = read_survey_of(folder, tiny.origin)
    assert read_truth_of(folder, tiny, survey) is not None
    truth = folder / "survey" / "truth"
    (truth / tiny.journeys[0].journey_id / "signs.parquet").write_bytes(b"nonsense")
    with pytest.raises(ValueError, match=r"signs\.parquet: cannot be read"):
        read_truth_of(folder, tiny, survey)
    shutil.rmtree(truth)
    assert read_truth_of(folder, tiny, survey) is None
