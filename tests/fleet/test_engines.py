"""Engines give the same results to the last bit, do again what a killed worker lost, and what is wrong is said once."""

from __future__ import annotations

import logging
import math
import operator
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import fields, replace
from importlib.util import find_spec
from pathlib import Path

import pytest
from worlds.drives import write_tiny
from worlds.mortal import MortalDrive, dies_at_first, dies_when_asked

from crowdmap_torch.config import MapperConfig
from crowdmap_torch.fleet.choice import engine_of
from crowdmap_torch.fleet.engine import ATTEMPTS, Engine
from crowdmap_torch.io.budget import ReadingBudget
from crowdmap_torch.io.datasets import load_dataset
from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.remote import place_of
from crowdmap_torch.io.stored_drives import StoredDrive, stored_drives
from crowdmap_torch.io.trees import digest
from crowdmap_torch.mapper import map_journeys
from crowdmap_torch.plausibility.dataset import look_over
from crowdmap_torch.tables import Dataset
from crowdmap_torch.tracking.signs import associate_signs

CONFIG = MapperConfig()
PAIR = CONFIG.positioning, CONFIG.sign_association
needs_ray = pytest.mark.skipif(find_spec("ray") is None, reason="Ray is not here: extra `ray`")
BESIDE = ["processes", pytest.param("ray", marks=needs_ray)]
"""Engines whose workers can be killed."""
MOST = ["local", pytest.param("ray", marks=needs_ray)]
"""What tests of the pool of processes do not tell."""

Begin = Callable[[str, int], Engine]


@pytest.fixture
def begin() -> Iterator[Begin]:
    """Begins an engine that ends with the test."""
    with ExitStack() as stack:
        yield lambda name, workers: stack.enter_context(engine_of(name, workers=workers))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three drives that are mapped in a second."""
    place = tmp_path_factory.mktemp("small") / "dataset"
    return write_tiny(place, frame_rate_hz=3.0, length_m=60)


@pytest.fixture(scope="module")
def dataset(folder: Path) -> Dataset:
    return load_dataset(folder)


@pytest.fixture(scope="module")
def stored(folder: Path, dataset: Dataset) -> Sequence[StoredDrive]:
    digests = {journey.journey_id: digest(journey) for journey in dataset.journeys}
    return stored_drives(folder, dataset, digests, ReadingBudget())


@pytest.fixture(scope="module")
def made(dataset: Dataset) -> str:
    """A hash of what each drive shows by itself, found in this process."""
    maps = map_journeys(dataset.journeys, CONFIG)
    assert all(len(one.signs) and len(one.lanes) for one in maps)
    return digest(maps)


def mortal(drive: StoredDrive, marker: Path) -> MortalDrive:
    of_drive = {field.name: getattr(drive, field.name) for field in fields(StoredDrive)}
    return MortalDrive(**of_drive, marker=marker)


@pytest.mark.parametrize(
    ("name", "workers"),
    [("local", 1), ("processes", 2)]
    + [pytest.param("ray", workers, marks=needs_ray) for workers in (1, 2, 4)],
)
def test_workers_that_read_drives_themselves_give_the_same_bits_and_so_does_a_second_attempt(
    begin: Begin,
    dataset: Dataset,
    stored: Sequence[StoredDrive],
    made: str,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
    name: str,
    workers: int,
):
    engine = begin(name, workers)
    # The worker that reads the second drive is killed there, once.
    drives = [stored[0], mortal(stored[1], tmp_path / "was here"), *stored[2:]]
    with caplog.at_level(logging.WARNING):
        maps = map_journeys(dataset.journeys, CONFIG, engine=engine, stored=drives)
    assert digest(maps) == made
    killed = int(name != "local")
    assert engine.spent.again == killed == len(caplog.messages) == len(list(tmp_path.iterdir()))
    assert all("journey-001" in said and "done again" in said for said in caplog.messages)
    assert engine.spent.tasks == 3 and engine.spent.seconds > 0


@pytest.mark.parametrize("name", ["processes", pytest.param("ray", marks=needs_ray)])
def test_workers_read_drives_by_url(
    begin: Begin, folder: Path, dataset: Dataset, made: str, name: str
):
    digests = {journey.journey_id: digest(journey) for journey in dataset.journeys}
    place = place_of(f"local://{folder}")
    drives = stored_drives(place, dataset, digests, ReadingBudget())
    assert (
        digest(map_journeys(dataset.journeys, CONFIG, engine=begin(name, 2), stored=drives)) == made
    )


@pytest.mark.parametrize("stated", [False, True])
def test_workers_tell_signs_apart_for_the_look_as_mapping_does(
    begin: Begin,
    folder: Path,
    dataset: Dataset,
    stored: Sequence[StoredDrive],
    made: str,
    stated: bool,
):
    engine = begin("processes", 2)
    drives = stored if stated else None
    look = look_over(folder, dataset, *PAIR, engine=engine, stored=drives)
    alone = look_over(folder, dataset, *PAIR)
    assert look.by_journey == alone.by_journey
    assert len(look.tracklets) == len(dataset.journeys)
    assert digest(look.tracklets[1]) == digest(associate_signs(dataset.journeys[1], *PAIR))
    maps = map_journeys(dataset.journeys, CONFIG, engine=engine, tracklets=look.tracklets)
    assert digest(maps) == made


@pytest.mark.parametrize("name", MOST)
def test_every_call_is_done_once(begin: Begin, name: str):
    calls = [(f"{n} + 1", operator.add, (n, 1)) for n in range(7)]
    assert dict(begin(name, 2).each(calls)) == {n: n + 1 for n in range(7)}


@pytest.mark.parametrize("name", MOST)
def test_what_a_task_raises_is_raised_at_once(begin: Begin, name: str):
    engine = begin(name, 1)
    with pytest.raises(ValueError, match="math domain error"):
        list(engine.each([("root", math.sqrt, (-1.0,))]))
    assert engine.spent.again == 0


@pytest.mark.parametrize("name", BESIDE)
def test_a_task_that_kills_every_worker_is_given_up_by_name(
    begin: Begin, tmp_path: Path, name: str
):
    engine = begin(name, 1)
    calls = [("journey-7", dies_when_asked, (tmp_path,))]
    with pytest.raises(ChildProcessError, match=rf"^journey-7: .*, {ATTEMPTS} times; given up$"):
        list(engine.each(calls))
    assert len(list(tmp_path.iterdir())) == ATTEMPTS


@pytest.mark.parametrize("name", BESIDE)
def test_several_that_lose_their_workers_at_once_are_all_done(
    begin: Begin, tmp_path: Path, name: str
):
    calls = [(f"task {n}", dies_at_first, (tmp_path / str(n), n)) for n in range(2)]
    engine = begin(name, 2)
    assert dict(engine.each(calls)) == {n: n for n in range(2)}
    assert engine.spent.again == 2 and engine.spent.tasks == 2


def test_a_drive_that_has_changed_or_gone_since_is_one_line(
    folder: Path, stored: Sequence[StoredDrive]
):
    changed = replace(stored[0], digest=stored[1].digest)
    with pytest.raises(InputError, match=r"journey-000: has changed since the run was started"):
        changed.read()
    with pytest.raises(InputError, match="needs the dataset at the same place"):
        replace(stored[0], dataset=folder / "elsewhere").read()


def test_a_drive_is_cut_where_it_is_read(folder: Path, stored: Sequence[StoredDrive]):
    with pytest.raises(InputError, match="has changed"):
        replace(stored[0], bbox=(-200.0, -200.0, 200.0, -60.0)).read()


def test_an_engine_is_chosen_by_name_and_by_how_many_workers_there_are():
    assert engine_of(None, workers=1).name == "local"
    assert engine_of(None, workers=2).name == "processes"
    assert engine_of("processes", workers=3).free == 3
    with pytest.raises(ValueError, match="add --engine ray"):
        engine_of("processes", workers=2, address="head:6379")
    with pytest.raises(ValueError, match="expected one of local, processes, ray"):
        engine_of("spark", workers=2)


@needs_ray
@pytest.mark.parametrize("address", ["127.0.0.1:1", "nonsense"])
def test_where_no_cluster_answers_is_said_at_once(address: str):
    with (
        pytest.raises(ConnectionError, match=f"^--address {address}: no Ray cluster can be used"),
        engine_of("ray", address=address),
    ):
        pass
