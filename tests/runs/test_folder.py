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


def test_a_folder_with_something_in_it_is_refused(tmp_path: Path):
    (tmp_path / "old").touch()
    with pytest.raises(ValueError, match=r"exists already; give --overwrite .* or --resume"):
        RunFolder(tmp_path)
    RunFolder(tmp_path, overwrite=True)
    RunFolder(tmp_path, resume=True)


def test_an_empty_folder_or_none_will_do(tmp_path: Path):
    RunFolder(tmp_path)
    run = RunFolder(tmp_path / "some" / "where")
    assert not run.path.exists()
    run.prepare()
    assert run.path.is_dir()


@pytest.mark.parametrize("overwrite", [False, True])
def test_a_file_is_refused(tmp_path: Path, overwrite: bool):
    (tmp_path / "file").touch()
    with pytest.raises(ValueError, match="is a file; --out names a folder"):
        RunFolder(tmp_path / "file", overwrite=overwrite)


@pytest.mark.parametrize("resume", [False, True])
def test_only_a_run_that_goes_on_keeps_its_events_and_checkpoint(tmp_path: Path, resume: bool):
    kept = tmp_path / "map" / "map.json"
    for path in (kept, tmp_path / "tensorboard" / "events", tmp_path / "checkpoint.pt"):
        path.parent.mkdir(exist_ok=True)
        path.touch()
    run = RunFolder(tmp_path, overwrite=not resume, resume=resume)
    run.prepare()
    assert run.checkpoint.exists() == run.tensorboard.exists() == resume
    # An older map stays until the new one is complete.
    assert kept.exists()


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
