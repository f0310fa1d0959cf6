"""The benchmark of the main job: what a run says of itself and what its processes hold, beside each other."""

from __future__ import annotations

import argparse
from pathlib import Path

import pytest
from worlds.programs import checkout

from crowdmap_torch.benchmark import stages
from crowdmap_torch.io.errors import InputError

MAIN = """
import json, pathlib, subprocess, sys, time
out = pathlib.Path(sys.argv[sys.argv.index("--out") + 1])
hold = "held = bytearray(200_000_000); import time; time.sleep(0.6)"
child = subprocess.Popen([sys.executable, "-c", hold])
held = bytearray(100_000_000)
child.wait()
out.mkdir()
found = {"signs": {"relative": {"total": {"mean": ERROR}}}}
(out / "metrics.json").write_text(json.dumps({"times_s": {"mapping": 0.25}, "memory_gb": {"mapping": 0.1}, "survey": found}))
"""


@pytest.mark.skipif(not Path("/proc/self/smaps_rollup").exists(), reason="memory is read in /proc")
def test_a_run_is_measured_with_all_that_it_began(tmp_path: Path):
    other = checkout(tmp_path / "other", MAIN.replace("ERROR", "0.03"))
    found = stages.measured(other, tmp_path, 2)
    assert found.stages["mapping"] == 0.25 and found.relative_m == 0.03
    assert found.main_gb == {"mapping": 0.1}
    assert found.wall_s > 0.6 and sum(found.stages.values()) == pytest.approx(found.wall_s)
    # The process and its child together, neither alone.
    assert 0.3 < found.peak_gb < 0.5


def test_states_stand_beside_each_other_with_their_medians(tmp_path: Path):
    def took(seconds: float, error: float | None) -> stages.Measured:
        return stages.Measured(
            {"mapping": seconds}, 2 * seconds, 3 * seconds, 1.5, {"mapping": seconds / 10}, error
        )

    lines = stages.table(
        ["this one", "old"], [[took(1, 0.02), took(9, 0.04), took(2, 0.03)], [took(5, 0.05)]]
    )
    rows = {line.split("  ")[0]: line.split()[-2:] for line in lines}
    assert rows["mapping [s]"] == ["2.0", "5.0"]
    assert rows["files to map [s]"] == ["4.0", "10.0"]
    assert rows["of the main one, mapping [GB]"] == ["0.20", "0.50"]
    assert rows["relative error [m]"] == ["0.0300", "0.0500"]
    without = stages.table(["this one"], [[took(1, None)]])
    assert not any("relative" in line for line in without)


def test_a_run_that_fails_is_one_line_with_its_reason(tmp_path: Path):
    other = checkout(tmp_path / "other", "raise SystemExit('no such dataset')")
    with pytest.raises(InputError, match="other: no such dataset"):
        stages.measured(other, tmp_path, 1)


def test_what_is_no_checkout_is_refused_before_anything_runs(tmp_path: Path):
    parser = argparse.ArgumentParser()
    stages.add_arguments(parser)
    options = parser.parse_args([str(tmp_path), "--against", str(tmp_path / "nothing")])
    with pytest.raises(InputError, match="expected a checkout"):
        stages.run(options)
