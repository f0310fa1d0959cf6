"""Which signs of single drives are one, by adjusted poses."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor
from worlds.crowd_world import signs_at

from crowdmap_torch.crowd_signs.company import CompanyConfig, in_company, passing_of, placed_by
from crowdmap_torch.geometry import polygon, se3
from crowdmap_torch.tables import Signs

CONFIG = CompanyConfig()
NEAR = (100.0, 0.0, 2.0)
"""Where one drive has a sign, well placed."""


def crowd_of(
    *afar: tuple[float, float, float], journey: list[int] | None = None
) -> tuple[Signs, Tensor]:
    """That sign, and others that later drives see from afar on a way to the east, with the cameras that saw them."""
    n = 1 + len(afar)
    signs = signs_at([NEAR, *afar], journey or list(range(n)))
    along, across = torch.full((n,), 3.0), torch.full((n,), 0.1)
    along[0] = 0.2
    sigma = torch.stack((along, across, across), dim=1).double()
    confidence = torch.zeros(n, dtype=torch.float64)
    confidence[0] = 0.9
    view = signs.center_world.clone()
    view[:, 0] -= 85.0
    view[0, 0] += 75.0
    sure = replace(signs, covariance=torch.diag_embed(sigma.square()), confidence=confidence)
    return sure, view


def company(
    signs: Signs, view: Tensor, *, heads: Signs | None = None, min_journeys: int = 2
) -> list[int]:
    none = signs[:0] if heads is None else heads
    return in_company(signs, view, none, min_journeys, CONFIG).tolist()


def test_a_sign_that_others_see_from_afar_is_one():
    # 4 m before it and 6 m behind it along their sight, half a metre beside it.
    assert company(*crowd_of((96.0, 0.5, 2.1), (106.0, -0.3, 1.8))) == [0, 0, 0]


@pytest.mark.parametrize("fault", ["beside", "above", "shape", "facing", "one drive", "glance"])
def test_what_others_see_elsewhere_or_otherwise_is_another_sign(fault: str):
    place = {"beside": (96.0, 3.0, 2.0), "above": (96.0, 0.0, 4.5)}.get(fault, (96.0, 0.5, 2.1))
    signs, view = crowd_of(place, journey=[0, 0] if fault == "one drive" else None)
    if fault == "shape":
        signs = replace(signs, shape=torch.tensor([polygon.OCTAGON, polygon.DIAMOND]))
    if fault == "facing":
        T = signs.T_world_sign.clone()
        T[1] = T[1] @ torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0])).double()
        signs = replace(signs, T_world_sign=T)
    if fault == "glance":
        signs = replace(signs, confidence=torch.zeros(2, dtype=torch.float64))
    assert company(signs, view) == [-1, -1]


def test_so_many_drives_must_see_it_as_a_map_asks_for():
    crowd = crowd_of((96.0, 0.5, 2.1))
    assert company(*crowd, min_journeys=3) == [-1, -1]
    assert company(*crowd_of((96.0, 0.5, 2.1), (97.0, 0.1, 2.0)), min_journeys=3) == [0, 0, 0]


def test_of_one_drive_one_sign_is_another_one_the_nearest():
    signs, view = crowd_of((96.0, 0.9, 2.1), (96.0, 0.1, 2.0), journey=[0, 1, 1])
    assert company(signs, view) == [0, -1, 0]


def test_what_lies_nearer_to_a_sign_of_the_map_shows_that_one():
    signs, view = crowd_of((96.0, 0.5, 2.1))
    head = signs_at([(96.2, 0.5, 2.1)], [-1])
    assert company(signs, view, heads=head) == [-1, -1]
    # One beside the sight of the other drive is of no account.
    assert company(signs, view, heads=signs_at([(96.2, 4.0, 2.1)], [-1])) == [0, 0]


def test_of_signs_that_are_one_the_best_placed_is_the_one():
    signs, view = crowd_of((100.1, 0.1, 2.0), (96.0, 0.2, 2.1))
    covariance = signs.covariance.clone()
    covariance[1] = 0.05 * torch.eye(3)
    signs = replace(signs, covariance=covariance, confidence=torch.tensor([0.9, 0.8, 0.0]).double())
    assert company(signs, view) == [0, 0, 0]
    # Whichever comes first in the table.
    order = torch.tensor([2, 1, 0])
    assert company(signs[order], view[order]) == [2, 2, 2]


def test_no_signs_and_one_are_in_no_company():
    signs, view = crowd_of()
    assert company(signs, view) == [-1]
    assert company(signs[:0], view[:0]) == []


def test_signs_lie_as_far_off_as_their_cameras_do(tiny):
    journey = tiny.journeys[1]
    own = replace(signs_at([NEAR, (20.0, 5.0, 1.0)], [0, 1]), frame=torch.tensor([3, 8]))
    moved = journey.T_world_camera.clone()
    moved[:, 0, 3] += 2.0
    turned = moved @ se3.make(
        se3.so3_exp(torch.tensor([0.0, 0.1, 0.0]).double()), torch.zeros(3).double()
    )
    journeys = [journey, journey]
    placed = placed_by(own, journeys, [moved, turned])
    shift = placed.T_world_sign[0, :3, 3] - own.center_world[0]
    assert torch.allclose(shift, torch.tensor([2.0, 0.0, 0.0]).double())
    assert torch.equal(placed.view_position[1], turned[8, :3, 3])
    # As each camera sees it, its sign is where it was.
    for sign, pose in enumerate((moved, turned)):
        frame = int(own.frame[sign])
        seen = se3.inverse(journey.T_world_camera[frame]) @ own.T_world_sign[sign]
        now = se3.inverse(pose[frame]) @ placed.T_world_sign[sign]
        assert torch.allclose(seen, now)


def test_who_passed_a_sign_is_known_of_clusters_and_of_singles():
    members = signs_at([NEAR] * 4, [0, 0, 1, 2])
    members = replace(members, tracklet=torch.tensor([5, 2, 5, 0]))
    label, passing = torch.tensor([-1, 1, 0, -1]), torch.tensor([10, 11, 12, 13])
    rows = torch.tensor([3, 1, 0, 2])
    assert passing_of(members[rows], members, label, passing).tolist() == [13, 11, 12, 10]
    assert passing_of(members[:0], members, label, passing).tolist() == []
