from __future__ import annotations

import pytest

from crowdmap_torch.subcommands import run_chosen

BENCHMARKS = {"association": "who shows what", "bundle": "adjusted"}


def chosen(*arguments: str) -> int:
    return run_chosen("script.py", "About.", "crowdmap_torch.benchmark", BENCHMARKS, arguments)


def test_wrong_input_is_one_line_and_two(capsys: pytest.CaptureFixture[str], tmp_path):
    assert chosen("association", str(tmp_path / "none")) == 2
    error = capsys.readouterr().err
    assert error.startswith("script.py: ") and error.count("\n") == 1


def test_an_unknown_name_lists_the_known(capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as stop:
        chosen("cooking")
    assert stop.value.code == 2
    assert "association" in capsys.readouterr().err


def test_options_are_those_of_the_module(capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as stop:
        chosen("association", "--help")
    assert stop.value.code == 0
    assert "--methods" in capsys.readouterr().out
