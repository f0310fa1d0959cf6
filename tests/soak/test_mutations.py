"""What is destroyed hangs on the seed alone."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np

from crowdmap_torch.soak.mutations import destroy
from crowdmap_torch.soak.verdict import digest


def test_the_same_seed_destroys_the_same(street: Path, tmp_path: Path) -> None:
    seen = []
    for attempt in range(2):
        # One name for both: links and hashes have it in them.
        folder = tmp_path / "data"
        shutil.copytree(street, folder)
        done = [destroy(folder, np.random.default_rng([3, k])) for k in range(6)]
        seen.append((done, digest(folder)))
        folder.rename(tmp_path / f"{attempt}")
    assert seen[0] == seen[1]
    assert seen[0][1] != digest(street)
