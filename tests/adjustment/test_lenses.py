"""Lenses are exact where the points are by now, in value and derivative, whatever the detection was."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor
from torch.func import jacrev, vmap

from crowdmap_torch.adjustment.lenses import (
    SeenPoints,
    lenses_of,
    relinearised,
    rows_by_lens,
    seen_points,
)
from crowdmap_torch.geometry.camera import Camera, project, unproject
from crowdmap_torch.residuals.reprojection import pixel_error, pixel_error_jacobian
from crowdmap_torch.tables import Dataset

K = torch.tensor([[800.0, 0, 640], [0, 810, 360], [0, 0, 1]], dtype=torch.float64)
FISHEYE_K = torch.tensor([[330.0, 0, 640], [0, 330, 360], [0, 0, 1]], dtype=torch.float64)


def lens(model: str, K: Tensor, *distortion: float) -> Camera:
    return Camera(model, 1280, 720, K, torch.tensor(distortion, dtype=torch.float64))


LENSES = {
    "barrel": lens("brown_conrady", K, -0.3, 0.09, 1e-3, -5e-4),
    "rational": lens("brown_conrady", K, 0.4, 0.1, 1e-4, 2e-4, 0.01, 0.7, 0.15, 0.02),
    "fisheye": lens("kannala_brandt", FISHEYE_K, 0.08, -0.02, 0.005, -0.001),
    "pinhole": lens("brown_conrady", K),
}
NEAR = torch.tensor([[2.0, -1.0, 8.0], [-3.0, 1.5, 9.0], [0.2, 0.1, 20.0]], dtype=torch.float64)
"""Points in the camera's frame [m]."""
OFF = torch.tensor([[0.4, 0.3, -0.5], [-0.2, 0.4, 0.3], [0.8, -0.5, 1.0]], dtype=torch.float64)
"""How far they are from where they were detected: tens of pixels."""


def seen_by(camera: Camera, point: Tensor) -> SeenPoints:
    px, visible = project(camera, point)
    assert bool(visible.all())
    columns = seen_points(camera, 0, px, unproject(camera, px)[0])
    return SeenPoints(frame=torch.arange(len(px)), **columns)


def looked_at(seen: SeenPoints, camera: Camera, point: Tensor) -> SeenPoints:
    return relinearised(seen, (camera,), rows_by_lens(seen, (camera,)), point)


@pytest.mark.parametrize("name", LENSES)
def test_errors_and_derivatives_are_those_of_the_exact_lens_at_the_points_place(name: str) -> None:
    camera, point = LENSES[name], NEAR + OFF
    seen = looked_at(seen_by(camera, NEAR), camera, point)
    exact = project(camera, point)[0] - seen.px
    assert float(exact.norm(dim=1).min()) > 10
    error, by_point = pixel_error_jacobian(point.mT.contiguous(), seen.matrix.movedim(0, -1))
    torch.testing.assert_close(error.mT, exact, rtol=1e-9, atol=1e-9)
    expected = vmap(jacrev(lambda p: project(camera, p)[0]))(point)
    torch.testing.assert_close(by_point.movedim(-1, 0), expected, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("name", ["barrel", "rational", "fisheye"])
def test_a_few_pixels_on_a_step_still_errs_by_little(name: str) -> None:
    camera = LENSES[name]
    seen = looked_at(seen_by(camera, NEAR), camera, NEAR + OFF)
    moved = NEAR + OFF + torch.tensor([0.02, 0.02, 0.05], dtype=torch.float64)
    foreseen = pixel_error(moved.mT.contiguous(), seen.matrix.movedim(0, -1)).mT
    exact = project(camera, moved)[0] - seen.px
    assert float((foreseen - exact).norm(dim=1).max()) < 0.02
    around = pixel_error(moved.mT.contiguous(), seen_by(camera, NEAR).matrix.movedim(0, -1)).mT
    assert float((foreseen - exact).norm(dim=1).max()) < float((around - exact).norm(dim=1).max())


@pytest.mark.parametrize(
    "place", [(0.5, 0.2, -4.0), (0.5, 0.2, 0.0), (30.0, 0.0, 1.0)], ids=["behind", "at", "beyond"]
)
def test_where_the_lens_says_nothing_it_is_as_around_the_detection(place) -> None:
    camera = LENSES["barrel"]
    seen = seen_by(camera, NEAR)
    point = torch.tensor([place] * len(NEAR), dtype=torch.float64)
    torch.testing.assert_close(looked_at(seen, camera, point).matrix, seen.matrix)


def test_every_camera_looks_at_its_own_points() -> None:
    cameras = tuple(LENSES.values())
    parts = [replace(seen_by(c, NEAR), lens=torch.full((3,), k)) for k, c in enumerate(cameras)]
    order = torch.arange(3 * len(cameras)).view(len(cameras), 3).mT.flatten()
    columns = {
        name: torch.cat([getattr(part, name) for part in parts])[order] for name in vars(parts[0])
    }
    point = (NEAR + OFF).repeat(len(cameras), 1)[order]
    mixed = SeenPoints(**columns)
    found = relinearised(mixed, cameras, rows_by_lens(mixed, cameras), point)
    alone = torch.cat([looked_at(seen_by(c, NEAR), c, NEAR + OFF).matrix for c in cameras])[order]
    torch.testing.assert_close(found.matrix, alone, rtol=0, atol=0)


def test_cameras_that_are_alike_are_one(tiny: Dataset) -> None:
    journeys = [replace(j, rig=replace(j.rig, camera=replace(j.rig.camera))) for j in tiny.journeys]
    found, number = lenses_of(journeys)
    rigs = [journey.rig.rig_id for journey in journeys]
    assert len(found) == len(set(rigs))
    assert [rigs.index(rig) for rig in rigs] == [number.index(k) for k in number]
