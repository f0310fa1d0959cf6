from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor
from worlds.drives import make_journey

from crowdmap_torch.geometry import polygon, se3
from crowdmap_torch.geometry.camera import Camera, project, unproject
from crowdmap_torch.plausibility.consistency import (
    ConsistencyLimits,
    _Lever,
    _lever_findings,
    consistency_findings,
)
from crowdmap_torch.tables import Journey, Rig, SignDetections, Tracklets

K = torch.tensor([[800.0, 0, 639.5], [0, 800, 399.5], [0, 0, 1]]).double()
LENS = torch.tensor([-0.3, 0.09, 1e-4, -2e-4]).double()
CAMERA = Camera("brown_conrady", 1280, 800, K, LENS)
RIG = Rig("rig", CAMERA, torch.eye(4).double(), torch.tensor([0.0, 1, 0]).double(), 1.4)


def drive(seed: int, *, lever: Tensor | None = None, late: int = 0) -> tuple[Journey, Tracklets]:
    """A winding drive past signs, seen without noise; positions `lever` off the camera, frames numbered `late`."""
    generator = torch.Generator().manual_seed(seed)
    t = torch.arange(160).double()
    heading = 0.5 * torch.sin(t / 18 + seed)
    ahead = torch.stack((heading.cos(), heading.sin(), torch.zeros_like(t)), dim=-1)
    down = torch.tensor([0.0, 0.0, -1.0]).double().expand_as(ahead)
    R = torch.stack((torch.linalg.cross(down, ahead), down, ahead), dim=-1)
    T = se3.make(R, (0.8 * ahead).cumsum(0))
    along = torch.randint(30, 150, (12,), generator=generator)
    aside = torch.stack((-ahead[:, 1], ahead[:, 0], torch.zeros_like(t)), dim=-1)[along]
    side = torch.where(torch.rand(12, 1, generator=generator) < 0.5, 4.0, -4.0)
    centre = T[along, :3, 3] + side * aside + torch.tensor([0.0, 0.0, 1.2]).double()
    in_camera = se3.transform(se3.inverse(T)[:, None], centre[None])
    px, visible = project(CAMERA, in_camera)
    visible &= in_camera[..., 2] < 40
    frame, sign = visible.nonzero(as_tuple=True)
    corners = (
        px[frame, sign][:, None] + torch.tensor([[-5.0, -5], [5, -5], [5, 5], [-5, 5]]).double()
    )
    corners = torch.cat((corners, corners[:, -1:].expand(-1, polygon.MAX_CORNERS - 4, 2)), dim=1)
    ideal, _ = unproject(CAMERA, corners)
    row = torch.arange(len(frame))
    seen = SignDetections(
        row, (frame + late).clamp_max(159), torch.full_like(row, 2), corners, ideal,
        torch.full_like(row, -1), torch.ones(len(row)).double(), torch.full_like(row, -1),
    )  # fmt: skip
    if lever is not None:
        T = T @ se3.make(torch.eye(3).double(), lever)
    return make_journey(RIG, T, signs=seen), Tracklets(sign, 12)


def found(drives: list[tuple[Journey, Tracklets]]):
    return consistency_findings([j for j, _ in drives], [t for _, t in drives])


def test_rays_of_exact_drives_meet() -> None:
    assert found([drive(seed) for seed in range(5)]) == []


@pytest.mark.parametrize("late", [-2, 1, 3])
def test_frames_that_are_numbered_late_are_named_with_how_many(late: int) -> None:
    (finding,) = found([drive(seed, late=late) for seed in range(5)])
    assert finding.kind == "frame-offset"
    assert f"{abs(late)} frames {'earlier' if late > 0 else 'later'}" in finding.evidence


def test_a_lever_arm_is_named_with_its_length() -> None:
    lever = torch.tensor([0.2, -0.5, -1.5]).double()
    (finding,) = found([drive(seed, lever=lever) for seed in range(5)])
    assert finding.kind == "lever-arm"
    assert "1.5 m behind" in finding.evidence


def test_drives_that_contradict_each_other_show_no_lever_arm() -> None:
    # Of six drives of a street, whose positions are of the camera: four of them nearly agree.
    places = [0.94, -1.37, -1.80, -1.82, -0.15, 1.43]
    known = torch.eye(3, dtype=torch.float64) / 0.3**2
    scattered = [_Lever(known.new_tensor([0.0, 0.0, place]), known) for place in places]
    assert _lever_findings(scattered, ConsistencyLimits()) == []
    moved = [
        replace(one, place=one.place / 10 - known.new_tensor([0, 0, 1.2])) for one in scattered
    ]
    (finding,) = _lever_findings(moved, ConsistencyLimits())
    assert "1.2 m behind" in finding.evidence


def test_few_drives_do_not_show_a_lever_arm() -> None:
    lever = torch.tensor([0.0, 0.0, -1.5]).double()
    few = ConsistencyLimits().least_journeys - 1
    assert found([drive(seed, lever=lever) for seed in range(few)]) == []


def test_drives_without_tracked_signs_say_nothing() -> None:
    journey, tracks = drive(0)
    nothing = replace(tracks, label=torch.full_like(tracks.label, -1))
    assert consistency_findings([journey], [nothing]) == []
