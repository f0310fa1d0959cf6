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


def test_what_a_mutation_left_is_destroyed_once_more(tmp_path: Path) -> None:
    # Text that Python's own readers cannot read: a level within a level, five thousand times.
    for seed in range(5):
        folder = tmp_path / f"{seed}"
        folder.mkdir()
        (folder / "config.yaml").write_text("[" * 5000)
        (done,) = destroy(folder, np.random.default_rng(seed))[:1]
        assert done.startswith("config.yaml: ")
