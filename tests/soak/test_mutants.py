"""Destroyed inputs: what is left is mapped, compared, set aside or refused, and nothing else happens."""

from __future__ import annotations

from pathlib import Path

from worlds.programs import begin

from crowdmap_torch.soak.attempt import KINDS


def test_destroyed_inputs_break_nothing(tmp_path: Path) -> None:
    # In a process of its own: one with threads, as this one may be, is not to be forked.
    program = begin(
        *("scripts/soak.py", "mutants", "--count", "12", "--mapped", "0.1"),
        *("--seed", "7", "--keep", str(tmp_path)),
    )
    out, err = program.communicate()
    assert program.returncode == 0, out + err
    assert "12 mutants" in out and "0 failures" in out
    assert all(f"{kind}: exit codes" in out for kind in KINDS)
