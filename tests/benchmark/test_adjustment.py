"""The benchmark of the adjustment on two devices."""

from __future__ import annotations

import argparse
from pathlib import Path

import pytest
from worlds.drives import write_tiny

from crowdmap_torch.benchmark import adjustment, devices
from crowdmap_torch.io.errors import InputError


def test_two_devices_are_compared_and_one_that_is_not_there_is_said_not_to_be(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    parser = argparse.ArgumentParser()
    adjustment.add_arguments(parser)
    tiny = str(write_tiny(tmp_path / "tiny", journeys=2))
    adjustment.run(parser.parse_args([tiny, "--device", "cpu", "--workers", "1"]))
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    (journeys, *_), _, one, other, _, *differences = lines
    assert journeys == "2"
    assert one[0] == other[0] == "cpu" and one[3] == other[3] and one[-1] == other[-1]
    assert {name for name, _ in differences} >= {"pose", "sign", "drift"}
    assert all(float(most) == 0 for _, most in differences)

    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    assert devices.there("cuda") is None
    with pytest.raises(InputError, match="--device abacus: expected cpu or cuda"):
        devices.there("abacus")
