"""Signs in the cameras that they were surveyed from."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from crowdmap_torch.evaluation.local import SurveyedFrom, local_errors, read_surveyed_from
from crowdmap_torch.geometry import se3
from crowdmap_torch.io.errors import InputError

F64 = torch.float64
FRAMES = torch.tensor([7, 8, 9])


def cameras() -> torch.Tensor:
    """Three poses along a bend."""
    turn = torch.tensor([[0.0, 0.0, 0.1], [0.0, 0.0, 0.2], [0.0, 0.0, 0.3]], dtype=F64)
    place = torch.tensor([[0.0, 0.0, 1.0], [1.0, 0.1, 1.0], [2.0, 0.3, 1.0]], dtype=F64)
    return se3.make(se3.so3_exp(turn), place)


def seen(center: torch.Tensor, frames: list[int]) -> SurveyedFrom:
    """A sign as these frames have it."""
    row = torch.tensor([FRAMES.tolist().index(frame) for frame in frames])
    p_camera = se3.transform(se3.inverse(cameras()[row]), center.expand(len(row), 3))
    return SurveyedFrom(torch.tensor(frames), p_camera)


SIGNS = torch.tensor([[10.0, 2.0, 3.0], [20.0, -2.0, 3.0]], dtype=F64)


def test_a_world_that_moved_as_a_whole_has_no_local_error():
    surveyed = {"a": seen(SIGNS[0], [7, 9]), "b": seen(SIGNS[1], [8])}
    turn = torch.tensor([0.0, 0.0, 0.4], dtype=F64)
    T = se3.make(se3.so3_exp(turn), torch.tensor([5.0, -3.0, 1.0], dtype=F64))
    found = local_errors(se3.transform(T, SIGNS), T @ cameras(), FRAMES, surveyed, gate_m=2.0)
    assert found == pytest.approx({"a": 0.0, "b": 0.0}, abs=1e-12)


def test_a_sign_that_is_off_in_the_cameras_is_off_by_that():
    off = SIGNS + torch.tensor([[0.3, 0.0, 0.4], [3.0, 0.0, 0.0]], dtype=F64)
    surveyed = {"a": seen(SIGNS[0], [7, 9]), "b": seen(SIGNS[1], [8]), "c": seen(SIGNS[0], [8])}
    surveyed["c"] = SurveyedFrom(torch.tensor([99]), surveyed["c"].p_camera)
    found = local_errors(off, cameras(), FRAMES, surveyed, gate_m=2.0)
    # Of b nothing is near, c was surveyed from another drive.
    assert found == pytest.approx({"a": 0.5})
    assert local_errors(off[:0], cameras(), FRAMES, surveyed, gate_m=2.0) == {}


def test_what_was_surveyed_is_read_by_dataset_and_sign(tmp_path: Path):
    path = tmp_path / "from.json"
    path.write_text(json.dumps({"D": {"s": [{"frame": 3, "xyz_camera": [1, 2.5, 3]}]}}))
    found = read_surveyed_from(path)["D"]["s"]
    assert found.frame_number.tolist() == [3] and found.p_camera.tolist() == [[1.0, 2.5, 3.0]]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"D": []}, "D: expected a mapping of keys"),
        ({"D": {"s": []}}, "D.s: expected a list of frames with xyz_camera"),
        ({"D": {"s": [{"frame": -1, "xyz_camera": [1, 2, 3]}]}}, "D.s.frame: expected a whole"),
        ({"D": {"s": [{"frame": 1, "xyz_camera": [1, 2]}]}}, "xyz_camera: expected a list of 3"),
        ({"D": {"s": [7]}}, "D.s: expected a list of frames with xyz_camera"),
    ],
)
def test_what_is_wrong_with_it_is_one_line(content: object, message: str, tmp_path: Path):
    path = tmp_path / "from.json"
    path.write_text(json.dumps(content))
    with pytest.raises(InputError, match=message) as error:
        read_surveyed_from(path)
    assert "\n" not in str(error.value) and str(path) in str(error.value)
