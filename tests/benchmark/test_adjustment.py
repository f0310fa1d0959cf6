"""The benchmark of the adjustment on two devices."""

from __future__ import annotations

import argparse
from pathlib import Path

import pytest
from worlds.drives import write_tiny

from crowdmap_torch.benchmark import adjustment


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tiny(tmp_path_factory.mktemp("benchmark") / "tiny", journeys=2)


def printed(tiny: Path, device: str, capsys: pytest.CaptureFixture[str]) -> list[list[str]]:
    parser = argparse.ArgumentParser()
    adjustment.add_arguments(parser)
    adjustment.run(parser.parse_args([str(tiny), "--device", device, "--workers", "1"]))
    return [line.split() for line in capsys.readouterr().out.splitlines()]


def test_a_device_and_itself_end_at_the_same_values(tiny: Path, capsys):
    (journeys, *_), _, one, other, _, *differences = printed(tiny, "cpu", capsys)
    assert journeys == "2"
    assert one[0] == other[0] == "cpu" and one[3] == other[3] and one[-1] == other[-1]
    assert {name for name, _ in differences} >= {"pose", "sign", "drift"}
    assert all(float(most) == 0 for _, most in differences)


def test_a_device_that_is_not_there_is_said_not_to_be(tiny: Path, capsys, monkeypatch):
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    assert printed(tiny, "cuda", capsys)[-1] == ["cuda", "not", "there"]
