"""What all tests share: threads, type checks, random generators, and where the real data are."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
import shape_checks
import torch

if TYPE_CHECKING:
    from worlds.small_world import Builder

    from crowdmap_torch.io.truth import Truth
    from crowdmap_torch.mapper import MapResult
    from crowdmap_torch.tables import Dataset, Survey

if "OMP_NUM_THREADS" not in os.environ:
    # The tests' tensors are small: threads only wait for one another.
    torch.set_num_threads(1)

if os.environ.get("CROWDMAP_CHECK_SHAPES"):
    # Jaxtyping annotations of the package are checked at run time, as in `make test`.
    shape_checks.install("crowdmap_torch")


@pytest.fixture(scope="module", autouse=True)
def annotations_are_checked_in_every_file() -> None:
    shape_checks.begin_file()


@pytest.fixture(autouse=True)
def threads_and_cores_stay_as_they_were() -> Iterator[None]:
    """Benchmarks choose their threads and cores; with more threads than cores what follows is many times slower."""
    before, cores = torch.get_num_threads(), _cores()
    yield
    if torch.get_num_threads() != before:
        torch.set_num_threads(before)
    if _cores() != cores:
        os.sched_setaffinity(0, cores)


def _cores() -> set[int]:
    """Where this process may run; nothing where nobody can tell."""
    return os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else set()


ROOT = Path(__file__).parent.parent


def data_folder() -> Path:
    """Where the real data are: `CROWDMAP_DATA`, else `../shared/data` beside the repository."""
    return Path(os.environ.get("CROWDMAP_DATA", ROOT.parent / "shared" / "data"))


@pytest.fixture(scope="session")
def real_data() -> Callable[[str], Path]:
    """A function from a name below the data folder to its path; it skips the test where that is absent."""

    def find(name: str) -> Path:
        path = data_folder() / name
        if not path.exists():
            pytest.skip(f"real data {path} are not here; set CROWDMAP_DATA to their folder")
        return path

    return find


@pytest.fixture
def generator() -> torch.Generator:
    """The same random numbers for every test that draws some."""
    return torch.Generator().manual_seed(0)


# The package is imported where it is used: behind the hook above, and not by tests of a single piece of it.


@pytest.fixture(scope="session")
def build() -> Builder:
    """What makes tables from a few numbers."""
    from worlds.small_world import Builder

    return Builder()


@pytest.fixture
def row_of_signs() -> torch.Tensor:
    """Centres of twelve signs along a road, 20 m apart, on both sides."""
    k = torch.arange(12, dtype=torch.float64)
    return torch.stack((20 * k, 4 * (-1) ** k, 2.5 + 0.1 * k), dim=-1)


@pytest.fixture(scope="session")
def tiny_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A simulated dataset of three short journeys on disk; tests that change it copy it first."""
    from worlds.drives import write_tiny

    return write_tiny(tmp_path_factory.mktemp("tiny") / "dataset")


@pytest.fixture(scope="session")
def winding_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four drives of a winding street, without a mistake, of vehicles that are as they say."""
    from crowdmap_torch.simulate.dataset import write_dataset
    from crowdmap_torch.soak.varied import winding_street

    folder = tmp_path_factory.mktemp("winding") / "good"
    write_dataset(winding_street(), folder)
    return folder


@pytest.fixture(scope="session")
def winding_pair(winding_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two of them, one of each rig: enough for what shows in every drive."""
    journeys = sorted((winding_folder / "journeys").iterdir())[:2]
    left_out = {p.name for p in (winding_folder / "journeys").iterdir()} - {
        p.name for p in journeys
    }
    place = tmp_path_factory.mktemp("winding") / "pair"
    return Path(shutil.copytree(winding_folder, place, ignore=lambda *_: left_out))


@pytest.fixture(scope="session")
def tiny(tiny_folder: Path) -> Dataset:
    """The same dataset, loaded."""
    from crowdmap_torch.io.datasets import load_dataset

    return load_dataset(tiny_folder)


@pytest.fixture(scope="session")
def tiny_survey(tiny_folder: Path) -> Survey:
    """Its survey."""
    from crowdmap_torch.io.surveys import read_survey

    return read_survey(tiny_folder / "survey")


@pytest.fixture(scope="session")
def tiny_truth(tiny_folder: Path, tiny: Dataset, tiny_survey: Survey) -> Truth:
    """The truth of its journeys."""
    from crowdmap_torch.io.truth import read_truth

    return read_truth(tiny_folder / "survey", tiny_survey, tiny.journeys)


@pytest.fixture(scope="session")
def tiny_result(tiny: Dataset) -> MapResult:
    """Its map with the default configuration."""
    from crowdmap_torch.config import MapperConfig
    from crowdmap_torch.mapper import build_map

    return build_map(tiny, MapperConfig())
