"""Good inputs that the tests of the soak destroy."""

from __future__ import annotations

from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def street(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data set of a few metres; tests that change it copy it first."""
    from crowdmap_torch.soak.good import write_street

    folder = tmp_path_factory.mktemp("soak") / "street"
    write_street(folder, length_m=50.0, frame_rate_hz=2.0, seed=2)
    return folder
