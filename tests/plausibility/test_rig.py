from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from crowdmap_torch.geometry.camera import Camera
from crowdmap_torch.plausibility.rig import rig_findings
from crowdmap_torch.tables import Rig

LENS = torch.tensor([-0.3, 0.1, 1e-4, -2e-4, -0.01]).double()
K = torch.tensor([[1000.0, 0, 639.5], [0, 1000, 399.5], [0, 0, 1]]).double()
RIG = Rig(
    "front",
    Camera("brown_conrady", 1280, 800, K, LENS),
    torch.eye(4).double(),
    torch.tensor([0.01, 0.999, 0.02]).double(),
    1.45,
)


def kinds(rig: Rig) -> list[str]:
    return [finding.kind for finding in rig_findings(rig)]


def test_a_front_camera_is_sound() -> None:
    assert kinds(RIG) == []


@pytest.mark.parametrize(("height", "unit"), [(145.0, "centimetres"), (1450.0, "millimetres")])
def test_a_height_in_another_unit_is_named_with_it(height: float, unit: str) -> None:
    (found,) = rig_findings(replace(RIG, camera_height=height))
    assert (found.kind, unit in found.cause) == ("camera-height", True)


def test_a_road_normal_upwards_is_told_from_one_in_another_frame() -> None:
    up = replace(RIG, road_normal_camera=-RIG.road_normal_camera)
    world = replace(RIG, road_normal_camera=torch.tensor([0.0, 0.0, 1.0]).double())
    causes = [next(rig_findings(rig)).cause for rig in (up, world)]
    assert "upwards" in causes[0] and "camera's frame" in causes[1]


def test_intrinsics_of_a_smaller_image_are_named() -> None:
    camera = replace(RIG.camera, width=3840, height=2400)
    assert kinds(replace(RIG, camera=camera)) == ["intrinsics"]


def test_coefficients_in_another_order_are_named() -> None:
    camera = replace(RIG.camera, distortion=LENS[[0, 1, 4, 2, 3]] * 10)
    assert kinds(replace(RIG, camera=camera)) == ["coefficient-order"]


@pytest.mark.parametrize("order", [[0, 2, 3, 1, 4], [2, 3, 0, 1, 4]])
def test_the_order_of_coefficients_is_told_where_one_only_is_a_lens(order: list[int]) -> None:
    camera = replace(RIG.camera, distortion=LENS[order])
    (found,) = rig_findings(replace(RIG, camera=camera))
    assert found.repair is not None
    given = [float(LENS[order][round(k)]) for k in found.repair.numbers]
    assert given == LENS.tolist()
