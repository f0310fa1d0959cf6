"""A street whose associations are the true ones, adjusted once for all files."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from worlds.adjusted_street import Adjusted, Street

    from crowdmap_torch.io.truth import Truth
    from crowdmap_torch.mapper import MapResult
    from crowdmap_torch.tables import Dataset


@pytest.fixture(scope="session")
def street(tiny: Dataset, tiny_folder: Path, tiny_truth: Truth, tiny_result: MapResult) -> Street:
    """All that a bundle is built from; a bundle of its own is a test's to change."""
    from worlds.adjusted_street import street_of

    return street_of(tiny, tiny_folder, tiny_truth, tiny_result)


@pytest.fixture(scope="session")
def adjusted(street: Street) -> Adjusted:
    """Its bundle after the adjustment: to be looked at, or copied."""
    from worlds.adjusted_street import adjusted_of

    return adjusted_of(street)
