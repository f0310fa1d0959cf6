"""Whatever is forbidden is seen: in how a command ended, beside its outputs, and in them."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from crowdmap_torch.geometry.camera import Camera
from crowdmap_torch.io.found_calibration import write_calibration
from crowdmap_torch.io.rigs import rig_yaml
from crowdmap_torch.soak import child, verdict
from crowdmap_torch.soak.child import Outcome, run_apart
from crowdmap_torch.soak.verdict import (
    digest,
    problems_of_calibration,
    problems_of_figures,
    problems_of_limits,
    problems_of_outcome,
    problems_of_place,
)


@pytest.fixture(autouse=True)
def unlimited(monkeypatch: pytest.MonkeyPatch) -> None:
    """The tests' own process may have mapped more than a soak's has."""
    monkeypatch.setattr(child, "_mapped_bytes", lambda: 2**40)


def ended(main: Callable[[], int], place: Path, **limits: float) -> list[str]:
    outcome = run_apart(main, place, **limits)
    return [*problems_of_outcome(outcome, "optimize"), *problems_of_limits(outcome)]


def refuses() -> int:
    os.write(2, b"crowdmap optimize: a: is no such thing\n")
    return 2


def test_a_refusal_in_one_line_is_no_problem(tmp_path: Path) -> None:
    assert ended(refuses, tmp_path) == []


def test_tracebacks_time_and_memory_are_seen(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert any("traceback: ZeroDivisionError" in p for p in ended(lambda: 1 // 0, tmp_path))
    late = ended(lambda: time.sleep(60) or 0, tmp_path, seconds=0.2)
    assert any("exit code -9" in problem for problem in late)
    # What it did not get to run for, because others did, is not its own.
    monkeypatch.setattr(child, "_waited_for_processor", lambda pid: 1000.0)
    assert run_apart(lambda: time.sleep(0.4) or 0, tmp_path, seconds=0.2).seconds < 0
    monkeypatch.setattr(verdict, "RESIDENT_BYTES", 1)
    assert any(problem.endswith(" MB") for problem in ended(refuses, tmp_path))


@pytest.mark.parametrize(
    ("code", "err", "problem"),
    [
        (0, "single journeys 3/3\nlooks wrong: a\nset aside b: c\n", None),
        (0, "RuntimeWarning: overflow\n", "an unknown line on stderr: 'RuntimeWarning: overflow'"),
        (2, "", "exit code 2 with 0 lines of reason"),
        (2, "crowdmap optimize: a\ncrowdmap optimize: b\n", "exit code 2 with 2 lines of reason"),
        (3, "looks wrong: a\nlooks wrong: b\n", None),
        (3, "", "exit code 3 with 0 lines of reason"),
        (0, "crowdmap optimize: a\n", "exit code 0 with 1 lines of reason"),
        (139, "crowdmap optimize: a\n", "exit code 139"),
    ],
)
def test_what_is_said_fits_the_exit_code(code: int, err: str, problem: str | None) -> None:
    found = list(problems_of_outcome(Outcome(code, 1.0, 1, "", err), "optimize"))
    assert found == ([] if problem is None else [problem])


def test_what_is_written_elsewhere_is_seen(tmp_path: Path) -> None:
    place, inputs = tmp_path, tmp_path / "inputs"
    inputs.mkdir()
    (inputs / "a").write_text("a")
    before = digest(inputs)
    assert run_apart(refuses, place).code == 2
    assert list(problems_of_place(place, before)) == []

    def writes() -> int:
        for path in ("stray", place / "beside", inputs / "a"):
            Path(path).write_text("here")
        return 0

    assert run_apart(writes, place).code == 0
    assert list(problems_of_place(place, before)) == [
        "the inputs were changed",
        "written beside the outputs: ['beside', 'stray']",
    ]


def test_figures_that_are_no_numbers_or_of_other_signs_are_seen(
    street: Path, tmp_path: Path
) -> None:
    survey, path = street / "survey", tmp_path / "figures.json"
    count = verdict.pq.read_metadata(survey / "signs.parquet").num_rows
    good = {"signs": {"map_signs": count, "true_signs": count}, "control_signs": 0, "oracle": None}
    for wrong, problem in (
        ({}, None),
        ({"oracle": float("nan")}, "figures: ['oracle'] are not finite"),
        ({"control_signs": 1}, f"figures: true_signs counts {count + 1} of {count}"),
    ):
        path.write_text(json.dumps({**good, **wrong}))
        found = list(problems_of_figures(path, survey, survey))
        assert found == ([] if problem is None else [problem])


def test_what_was_found_of_cars_has_to_be_read_and_used(tmp_path: Path) -> None:
    path, rig = tmp_path / "calibration.json", tmp_path / "rigs" / "a"
    assert list(problems_of_calibration(tmp_path)) == []
    focal = {"estimate": [0.001], "sigma": [1e-4]}
    write_calibration(path, {"a": {"parameters": {"focal": focal}}})
    assert "rig's folder is missing" in next(iter(problems_of_calibration(tmp_path)))
    rig.mkdir(parents=True)
    K = torch.tensor([[1000.0, 0, 640], [0, 1000, 400], [0, 0, 1]])
    camera = Camera("brown_conrady", 1280, 800, K, torch.zeros(4))
    (rig / "rig.yaml").write_text(rig_yaml(camera, (0.0, 1.0, 0.0), 1.4))
    assert list(problems_of_calibration(tmp_path)) == []
    (rig / "rig.yaml").write_text(rig_yaml(camera, (0.0, 1.0, 0.0), -1.4))
    assert "road.height_m" in next(iter(problems_of_calibration(tmp_path)))
