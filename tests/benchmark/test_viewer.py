from __future__ import annotations

import re
from pathlib import Path

import pytest

from crowdmap_torch.benchmark.browser import NAMES, browser_path
from crowdmap_torch.cli import main


@pytest.mark.skipif(
    browser_path() is None, reason=f"no browser is installed: none of {', '.join(NAMES)}"
)
def test_ten_kilometres_open_and_are_drawn(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    assert main(["benchmark", "viewer", "--frames", "3", "--pictures", str(tmp_path)]) == 0
    told = capsys.readouterr().out
    # 100 kB a kilometre of lane are allowed beside the code.
    size, ready = (int(x) for x in re.findall(r"^(\d+) kB, open after (\d+) ms", told, re.M)[0])
    assert size < 1000 and ready < 60_000
    assert len(re.findall(r"\d+ +\d+\.\d\d$", told, re.M)) == len(list(tmp_path.glob("*.png"))) == 6


def test_without_a_browser_one_line_says_so(
    capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", "/nowhere")
    assert main(["benchmark", "viewer"]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1 and "no browser is here" in err
