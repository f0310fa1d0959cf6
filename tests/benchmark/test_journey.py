"""The benchmark of single drives: an endless drive goes on where it ended, and its tables can be made."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from worlds.drives import write_tiny

from crowdmap_torch.benchmark import journey as benchmark
from crowdmap_torch.cli import main
from crowdmap_torch.geometry import se3
from crowdmap_torch.io.datasets import load_dataset
from crowdmap_torch.single_journey import LANE_STRETCH_FRAMES


@pytest.fixture(scope="module")
def tiny(tmp_path_factory) -> Path:
    return write_tiny(tmp_path_factory.mktemp("benchmark") / "tiny", journeys=1)


def test_a_repeated_journey_goes_on_where_it_ended(tiny):
    (journey,) = load_dataset(tiny).journeys
    n = journey.frame_count
    frames = list(benchmark.repeated(journey, 2 * n + 3))
    poses = torch.cat([frame.T_world_camera for frame in frames])
    # The next lap begins at the last pose of the one before, level with the world.
    assert float((poses[n, :3, 3] - poses[n - 1, :3, 3]).norm()) < 0.05
    ahead = poses[:, :2, 2] / poses[:, :2, 2].norm(dim=-1, keepdim=True)
    assert float((ahead[n] * ahead[n - 1]).sum()) > 1 - 1e-9
    torch.testing.assert_close(poses[n : 2 * n, 2, :3], poses[:n, 2, :3])
    within, again = (se3.inverse(poses[i : i + n - 1]) @ poses[i + 1 : i + n] for i in (0, n))
    torch.testing.assert_close(within, again)
    t_ns = torch.cat([frame.t_ns for frame in frames])
    assert bool((t_ns.diff() > 0).all())


def test_an_endless_drive_holds_no_more_than_a_stretch(tiny, capsys):
    # Several laps of the tiny street.
    laps = ["--endless", str(40 / 3600), "--rate", "8"]
    assert main(["benchmark", "journey", str(tiny), *laps]) == 0
    rows = [line.split() for line in capsys.readouterr().out.splitlines()[2:]]
    assert len(rows) >= benchmark.REPORTS
    # A stretch of lanes, and half of the one before.
    assert max(int(row[1]) for row in rows) <= 1.5 * LANE_STRETCH_FRAMES
    assert int(rows[-1][3]) > int(rows[len(rows) // 2][3]) > 0
