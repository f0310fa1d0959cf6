"""What all tests share: threads, type checks, random generators, and where the real data are."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from jaxtyping import install_import_hook

if "OMP_NUM_THREADS" not in os.environ:
    # The tests' tensors are small: threads only wait for one another.
    torch.set_num_threads(1)

if os.environ.get("CROWDMAP_CHECK_SHAPES"):
    # Every jaxtyping annotation of the package is checked at run time: slower, and worth a run now and then.
    install_import_hook("crowdmap_torch", "shape_checks.checked")

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
