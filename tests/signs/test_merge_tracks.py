"""Tracklets of one sign are put together, those of two are not, whatever their order."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from worlds.sign_drive import F64, signs_at

from crowdmap_torch.geometry import polygon
from crowdmap_torch.noise.positioning import PositioningNoise
from crowdmap_torch.signs.merge_tracks import RejoinConfig, rejoin
from crowdmap_torch.signs.views import SignFit, SignViews

NOISE = PositioningNoise()


def fragments(gap_frames: int, offset_m: float, *, sigma_m: float = 0.05) -> list[int]:
    """The groups of two tracklets of five frames each, one `gap_frames` after the other and so far beside it."""
    frame = torch.cat((torch.arange(5), torch.arange(5) + 5 + gap_frames))
    sign = torch.arange(2).repeat_interleave(5)
    T = torch.eye(4, dtype=F64).repeat(10, 1, 1)
    T[:, 1, 3] = frame.to(F64)
    corners = torch.zeros(10, polygon.MAX_CORNERS, 2, dtype=F64)
    observation = torch.zeros(10, polygon.MAX_CORNERS, 3, 3, dtype=F64)
    views = SignViews(sign, frame, corners, corners, observation, T)
    fit = SignFit(
        T_world_sign=signs_at([(4.0, 60.0, 2.5), (4.0 + offset_m, 60.0, 2.5)]),
        size=torch.full((2, 2), 0.7, dtype=F64),
        frame=torch.tensor([4, int(frame[-1])]),
        covariance=sigma_m**2 * torch.eye(3, dtype=F64).expand(2, 3, 3),
        error_sq=torch.ones(10, dtype=F64),
        drift_scale=1.0,
    )
    shape = torch.full((2,), polygon.RECTANGLE)
    return rejoin(views, frame.to(F64) / 10, fit, shape, NOISE, RejoinConfig()).tolist()


@pytest.mark.parametrize(("offset_m", "group"), [(0.1, [0, 0]), (1.5, [0, 1])])
def test_tracklets_in_one_place_are_one_sign(offset_m: float, group: list[int]):
    assert fragments(10, offset_m) == group


def test_what_positions_drift_in_a_gap_lets_tracklets_lie_apart():
    # 0.5 m is 7 standard deviations of two centres; after 15 s, 180 m, positions have drifted by 0.39 m.
    assert fragments(0, 0.5) == [0, 1]
    assert fragments(150, 0.5) == [0, 0]


def test_two_passes_of_a_sign_are_two():
    assert fragments(250, 0.1) == [0, 1]


def test_an_exact_positioning_lets_nothing_lie_apart(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(f"{__name__}.NOISE", replace(NOISE, drift_sigma_m=1e-6))
    assert fragments(150, 0.5) == [0, 1]
