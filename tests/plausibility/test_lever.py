"""Levers between the camera and the place that positions are of: what shows them, and how surely."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor
from worlds.winding import winding_drive

from crowdmap_torch.geometry import se3
from crowdmap_torch.noise.positioning import PositioningNoise
from crowdmap_torch.plausibility.lever import (
    Lever,
    LeverLimits,
    Said,
    _together,
    hidden_lever,
    lever_findings,
    lever_of,
    said_of_lever,
)
from crowdmap_torch.tables import Journey, Tracklets

NOISE = PositioningNoise()
LIMITS = LeverLimits()


def lever(drives: list[tuple[Journey, Tracklets]]) -> Lever | None:
    return lever_of([said_of_lever(journey, tracks, NOISE) for journey, tracks in drives])


def drifting(
    sigma: float, length_m: float, step_m: float, count: int, g: torch.Generator
) -> Tensor:
    """An Ornstein-Uhlenbeck process."""
    keep = math.exp(-step_m / length_m)
    rows = [sigma * torch.randn(3, generator=g, dtype=torch.float64)]
    for _ in range(count - 1):
        fresh = sigma * math.sqrt(1 - keep**2) * torch.randn(3, generator=g, dtype=torch.float64)
        rows.append(keep * rows[-1] + fresh)
    return torch.stack(rows)


def spoiled(drive: tuple[Journey, Tracklets], seed: int) -> tuple[Journey, Tracklets]:
    """The drive with positions and rotations that drift as positioning is thought to."""
    journey, tracks = drive
    g = torch.Generator().manual_seed(seed)
    n = journey.frame_count
    place = drifting(NOISE.drift_sigma_m, NOISE.drift_length_m, 0.8, n, g)
    turn = drifting(NOISE.rotation_sigma_rad, NOISE.rotation_length_m, 0.8, n, g)
    T = journey.T_world_camera
    R = T[:, :3, :3] @ se3.exp(torch.cat((torch.zeros_like(turn), turn), dim=-1))[:, :3, :3]
    return replace(journey, T_world_camera=se3.make(R, T[:, :3, 3] + place)), tracks


def test_exact_drives_show_no_lever() -> None:
    found = lever([winding_drive(seed) for seed in range(5)])
    # Signs are seen without noise: what is left is how far chords of 20 m of this road are from its tangents.
    assert found is not None
    assert abs(found.ahead_m) < 0.05
    assert lever_findings(found) == []


def test_a_lever_arm_is_named_with_its_length() -> None:
    arm = torch.tensor([0.2, -0.5, -1.5]).double()
    (finding,) = lever_findings(lever([winding_drive(seed, lever=arm) for seed in range(5)]))
    assert finding.kind == "lever-arm"
    assert "1.5 m behind" in finding.evidence


@pytest.mark.parametrize("bend", [0.5, 0.01])
def test_sigma_is_how_far_drift_takes_a_lever_from_the_truth(bend: float) -> None:
    off = []
    for trial in range(12):
        arm = torch.tensor([0.0, 0.0, -1.2]).double()
        drives = [winding_drive(seed, lever=arm, bend=bend) for seed in range(4)]
        found = lever([spoiled(d, 100 * trial + k) for k, d in enumerate(drives)])
        assert found is not None
        off.append((found.ahead_m + 1.2) / found.sigma_m)
    # Of twelve trials the root mean square is known to a fifth, the mean to 0.3. Headings by the rotations, whose errors
    # are those of the rays, would all be off to one side.
    rms = math.sqrt(sum(x * x for x in off) / len(off))
    assert rms < 1.5
    assert abs(sum(off) / len(off)) < 0.9


def test_the_straighter_the_road_the_less_is_known_and_it_is_said() -> None:
    sigma = []
    for bend in (0.5, 0.1, 0.02):
        found = lever([spoiled(winding_drive(seed, bend=bend), seed) for seed in range(4)])
        assert found is not None
        sigma.append(found.sigma_m)
    assert sigma[0] < sigma[1] < sigma[2]
    assert Lever(-1.2, sigma[2]).shortest_m(LIMITS) > 1.2
    assert lever_findings(Lever(-1.2, sigma[2])) == []
    (note,) = hidden_lever(Lever(-1.2, sigma[2]))
    assert f"{3 * sigma[2]:.1f} m or more" in note.evidence
    assert hidden_lever(Lever(0.0, sigma[0])) == []


def test_drives_that_contradict_each_other_show_no_lever_arm() -> None:
    # Of six drives of a street, whose positions are of the camera: four of them nearly agree.
    places = [0.94, -1.37, -1.80, -1.82, -0.15, 1.43]
    known = 1 / 0.3**2
    for shift in (0.0, -0.6):
        said = [Said(known * (place + shift), known, known) for place in places]
        assert lever_findings(_together(said, LIMITS)) == []
    said = [Said(known * (place / 10 - 1.2), known, known) for place in places]
    (finding,) = lever_findings(_together(said, LIMITS))
    assert "1.2 m behind" in finding.evidence


def test_a_long_drive_says_stretch_by_stretch_what_it_says_as_a_whole() -> None:
    arm = torch.tensor([0.2, -0.5, -1.5]).double()
    drives = [spoiled(winding_drive(seed, lever=arm), seed) for seed in range(5)]
    short = replace(LIMITS, at_once=40)
    whole = lever(drives)
    cut = lever_of([said_of_lever(journey, tracks, NOISE, short) for journey, tracks in drives])
    assert whole is not None and cut is not None
    assert abs(cut.ahead_m - whole.ahead_m) < whole.sigma_m
    assert cut.sigma_m == pytest.approx(whole.sigma_m, rel=0.3)


def test_few_drives_do_not_show_a_lever_arm() -> None:
    arm = torch.tensor([0.0, 0.0, -1.5]).double()
    few = LIMITS.least_journeys - 1
    assert lever([winding_drive(seed, lever=arm) for seed in range(few)]) is None
    assert lever_findings(None) == []


def test_drives_without_tracked_signs_tell_no_lever() -> None:
    drives = [winding_drive(seed) for seed in range(5)]
    assert lever([(j, replace(t, label=torch.full_like(t.label, -1))) for j, t in drives]) is None


def test_cars_that_stand_and_drive_back_are_not_asked_where_they_head() -> None:
    journey, tracks = winding_drive(0)
    T = journey.T_world_camera
    stands = replace(journey, T_world_camera=T[:1].expand_as(T).contiguous())
    back = replace(journey, T_world_camera=torch.cat((T[:80], T[:80].flip(0))))
    found = lever([(stands, tracks)] + [winding_drive(seed) for seed in range(1, 5)])
    assert found is not None
    assert abs(found.ahead_m) < 0.05
    lever([(back, tracks)] * 4)
