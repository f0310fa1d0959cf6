from __future__ import annotations

import numpy as np
import pytest
import torch

from crowdmap_torch.geometry.camera import Camera, unproject
from crowdmap_torch.plausibility.detections import Outlines, detection_findings
from crowdmap_torch.tables import Rig

K = torch.tensor([[1000.0, 0, 639.5], [0, 1000, 399.5], [0, 0, 1]]).double()
RIG = Rig(
    "front",
    Camera("brown_conrady", 1280, 800, K, torch.zeros(0).double()),
    torch.eye(4).double(),
    torch.tensor([0.0, 1.0, 0.0]).double(),
    1.45,
)
NONE = Outlines(np.zeros((0, 2)), np.zeros(0, dtype=int))


def squares(seed: int = 0, rows: int = 60) -> Outlines:
    """Clockwise squares on the right half of the image."""
    rng = np.random.default_rng(seed)
    corner = rng.uniform((640, 100), (1200, 380), (rows, 1, 2))
    side = rng.uniform(10, 60, (rows, 1, 1))
    px = corner + side * np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    return Outlines(px.reshape(-1, 2), np.full(rows, 4))


def markers(rows: int = 60) -> Outlines:
    """Lane points on the road ahead, left and right."""
    depth = np.linspace(5, 25, 6)
    side = np.where(np.arange(rows) % 2, 1.7, -1.7)[:, None]
    u = 639.5 + 1000 * side / depth
    v = np.broadcast_to(399.5 + 1450 / depth, u.shape)
    return Outlines(np.stack((u, v), axis=-1).reshape(-1, 2), np.full(rows, 6))


def kinds(signs: Outlines, lanes: Outlines) -> list[str]:
    return [finding.kind for finding in detection_findings(signs, lanes, RIG)]


def changed(rows: Outlines, matrix: list[list[float]]) -> Outlines:
    return Outlines(rows.px @ np.array(matrix), rows.count)


def test_sound_detections_are_sound_with_either_kind_missing() -> None:
    for signs, lanes in (
        (squares(), markers()),
        (squares(), NONE),
        (NONE, markers()),
        (NONE, NONE),
    ):
        assert kinds(signs, lanes) == []


def test_points_that_are_known_without_the_lens_are_judged_alike() -> None:
    high = markers()
    high = Outlines(high.px - [0.0, 200.0], high.count)
    for lanes in (markers(), high):
        ideal, _ = unproject(RIG.camera, torch.from_numpy(lanes.px))
        known = Outlines(lanes.px, lanes.count, ideal)
        told, same = (list(detection_findings(NONE, rows, RIG)) for rows in (lanes, known))
        assert told == same
    assert told != []


def test_few_rows_say_nothing() -> None:
    few = squares(rows=10)
    assert kinds(Outlines(few.px[::-1].copy(), few.count), NONE) == []


def test_anticlockwise_corners_are_told_from_swapped_coordinates() -> None:
    signs, lanes = squares(), markers()
    backwards = Outlines(signs.px.reshape(-1, 4, 2)[:, ::-1].reshape(-1, 2), signs.count)
    assert kinds(backwards, lanes) == ["anticlockwise"]
    swap = [[0.0, 1.0], [1.0, 0.0]]
    assert kinds(changed(signs, swap), changed(lanes, swap)) == ["swapped-pixels"]


def test_pixels_of_another_image_are_named_with_its_size() -> None:
    half = [[0.5, 0.0], [0.0, 0.5]]
    (found,) = detection_findings(changed(squares(), half), changed(markers(), half), RIG)
    assert (found.kind, "640 x 400" in found.cause) == ("image-size", True)


@pytest.mark.parametrize("scale", [0.25, 0.4, 0.5, 2 / 3, 1.5, 2.0, 3.0])
def test_the_size_of_the_image_is_told_from_others_by_markers_that_are_parallel(scale: float):
    signs, lanes = (Outlines((r.px + 0.5) * scale - 0.5, r.count) for r in (squares(), markers()))
    (found,) = detection_findings(signs, lanes, RIG)
    assert found.repair is not None
    assert found.repair.numbers[0] == pytest.approx(1 / scale, rel=1e-6)


def test_corners_row_by_row_are_told_from_other_orders() -> None:
    signs = squares()
    rows = Outlines(signs.px.reshape(-1, 4, 2)[:, [0, 1, 3, 2]].reshape(-1, 2), signs.count)
    for lanes in (markers(), NONE):
        assert kinds(rows, lanes) == ["crossed-corners"]


def test_shares_of_the_image_are_named() -> None:
    unit = [[1 / 1280, 0.0], [0.0, 1 / 800]]
    assert kinds(changed(squares(), unit), changed(markers(), unit)) == ["unit-pixels"]


def test_what_nothing_explains_is_named_without_a_cause() -> None:
    scattered = Outlines(squares().px * -1, squares().count)
    assert kinds(scattered, NONE) == ["detections"]
