"""Datasets by URL are what they are in a folder: no more is fetched than is read, and what is wrong names the URL."""

from __future__ import annotations

import os
import pickle
import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from worlds.drives import write_tiny
from worlds.object_store import object_store

from crowdmap_torch.io.budget import ReadingBudget, reading
from crowdmap_torch.io.datasets import NoJourneyLeft, load_dataset
from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.remote import Url, at_hand, place_of
from crowdmap_torch.io.stored_drives import stored_drives
from crowdmap_torch.io.trees import digest


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("bucket") / "cities" / "dataset"
    return write_tiny(place, frame_rate_hz=3.0, length_m=60)


@pytest.fixture
def spoilt(folder: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(folder, tmp_path / "spoilt"))


@pytest.fixture(scope="module")
def store(folder: Path) -> Iterator[tuple[str, list[str]]]:
    with object_store(folder.parent.parent) as found:
        yield found


def url_of(folder: Path) -> str:
    return f"local://{folder}"


def test_a_path_is_a_path_and_a_url_keeps_its_keys_to_itself(tmp_path: Path):
    assert place_of("runs/today") == Path("runs/today")
    assert place_of(tmp_path) == tmp_path
    assert place_of("file:///data/a%20city") == Path("/data/a city")
    url = place_of("s3://someone:secret@bucket/city/?endpoint_override=host&scheme=http")
    assert isinstance(url, Url) and url.name == "city"
    assert str(url) == "s3://bucket/city" and "secret" not in repr(url)
    assert str(place_of("memory://")) == "memory://"
    assert pickle.loads(pickle.dumps(url)).text == url.text


def test_the_same_drives_are_read(folder: Path):
    assert digest(load_dataset(url_of(folder))) == digest(load_dataset(folder))


def test_an_object_store_is_asked_for_no_more_than_is_read(
    folder: Path, store: tuple[str, list[str]]
):
    url, asked = store[0].format("cities/dataset"), store[1]
    (folder / "journeys" / "journey-000" / "front.png").write_bytes(b"a picture")
    assert digest(load_dataset(url)) == digest(load_dataset(folder))
    got = [line.removeprefix("GET ") for line in asked if line.startswith("GET ")]
    assert "cities/dataset/journeys/journey-002/poses.parquet" in got
    assert not [key for key in got if "survey" in key or key.endswith(".png")]
    asked.clear()
    one = load_dataset(url, journeys=["*-001"])
    assert [journey.journey_id for journey in one.journeys] == ["journey-001"]
    fetched = {
        line.split("/")[3] for line in asked if line.startswith("GET ") and "journeys" in line
    }
    assert fetched == {"journey-001"}


def test_a_mount_may_have_any_name(spoilt: Path):
    rig = next((spoilt / "rigs").glob("*/rig.urdf")).parent
    text = (rig / "rig.yaml").read_text()
    assert "urdf: rig.urdf" in text
    (rig / "rig.yaml").write_text(text.replace("urdf: rig.urdf", "urdf: chains/mount"))
    (rig / "chains").mkdir()
    (rig / "rig.urdf").rename(rig / "chains" / "mount")
    assert digest(load_dataset(url_of(spoilt))) == digest(load_dataset(spoilt))


def test_a_copy_has_the_survey_and_goes_when_it_was_read(folder: Path):
    with at_hand(place_of(url_of(folder))) as here:
        assert here.name == "dataset" and here != folder
        truth = Path("survey") / "truth" / "journey-000" / "signs.parquet"
        assert (here / truth).read_bytes() == (folder / truth).read_bytes()
    assert not here.exists()
    with at_hand(folder) as here:
        assert here == folder
    assert folder.exists()


def test_a_worker_reads_its_own_drive(folder: Path, store: tuple[str, list[str]]):
    url, asked = store[0].format("cities/dataset"), store[1]
    dataset = load_dataset(folder)
    digests = {journey.journey_id: digest(journey) for journey in dataset.journeys}
    drives = stored_drives(place_of(url), dataset, digests, ReadingBudget())
    asked.clear()
    assert digest(drives[1].read()) == digests["journey-001"]
    assert not [line for line in asked if "GET" in line and "journey-002" in line]
    changed = stored_drives(
        place_of(url_of(folder)), dataset, dict.fromkeys(digests, "another"), ReadingBudget()
    )
    with pytest.raises(
        InputError, match=rf"^local://{folder}/journeys/journey-000: has changed since"
    ):
        changed[0].read()


def test_what_is_wrong_names_the_url(spoilt: Path):
    (spoilt / "journeys" / "journey-001" / "poses.parquet").write_bytes(b"none")
    found = load_dataset(url_of(spoilt))
    (aside,) = found.rejected
    wrong = f"local://{spoilt}/journeys/journey-001/poses.parquet: cannot be read as Parquet"
    assert aside.reason.startswith(wrong)
    with pytest.raises(InputError, match=rf"^local://{spoilt}/journeys: no journey is called 'x'"):
        load_dataset(url_of(spoilt), journeys=["x"])
    with pytest.raises(NoJourneyLeft) as error:
        load_dataset(url_of(spoilt), journeys=["journey-001"])
    assert error.value.rejected == found.rejected
    (spoilt / "dataset.json").unlink()
    with pytest.raises(InputError, match=rf"^local://{spoilt}/dataset.json: the file is missing"):
        load_dataset(url_of(spoilt))


def test_files_that_are_too_large_stay_where_they_are(folder: Path, store: tuple[str, list[str]]):
    url, asked = store[0].format("cities/dataset"), store[1]
    asked.clear()
    budget = ReadingBudget(table_bytes=1000)
    with reading(budget), pytest.raises(NoJourneyLeft) as error:
        load_dataset(url)
    size = (folder / "journeys" / "journey-000" / "poses.parquet").stat().st_size
    assert f"has {size} bytes; expected 1000 at most" in error.value.rejected[0].reason
    assert not [line for line in asked if line.startswith("GET ") and ".parquet" in line]


@pytest.mark.parametrize(
    ("url", "told"),
    [
        ("local:///nowhere/at-all", r"^local:///nowhere/at-all: the dataset's folder is missing"),
        ("nosuch://bucket/x", r"^nosuch://bucket/x: no file system .*Protocol not known"),
        ("https://host/x", r"^https://host/x: "),
        ("s3://someone:secret@b\x00ad/x", r"^s3://"),
    ],
)
def test_what_cannot_be_read_is_one_line(url: str, told: str):
    with pytest.raises(InputError, match=told) as error:
        load_dataset(url)
    assert "\n" not in str(error.value) and "secret" not in str(error.value)


def test_what_a_store_refuses_is_told_without_keys(store: tuple[str, list[str]]):
    port = re.search(r":(\d+)$", store[0])
    assert port is not None
    missing = store[0].format("cities/another")
    with pytest.raises(InputError, match=r"^s3://maps/cities/another: the dataset's folder is m"):
        load_dataset(missing)
    nobody = missing.replace(port.group(1), "1")
    with pytest.raises(InputError, match=r"^s3://maps/cities/another: cannot be read") as error:
        load_dataset(nobody)
    assert "secret" not in str(error.value) and "\n" not in str(error.value)


def test_a_name_that_leads_out_of_the_dataset_is_refused():
    import fsspec

    memory = fsspec.filesystem("memory")
    memory.store["/evil/dataset.json"] = memory_file(memory, "/evil/dataset.json")
    memory.store["/evil/rigs/../../../out.yaml"] = memory_file(memory, "/evil/rigs/../out.yaml")
    try:
        with pytest.raises(InputError, match="a name that leads out of the dataset"):
            load_dataset("memory://evil")
    finally:
        memory.store.clear()
    assert not os.path.lexists("out.yaml")


def memory_file(memory, path: str):
    from fsspec.implementations.memory import MemoryFile

    return MemoryFile(memory, path, b"{}")
