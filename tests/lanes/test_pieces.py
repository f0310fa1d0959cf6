from __future__ import annotations

import math

import pytest
import torch

from crowdmap_torch.geometry import spline_fit
from crowdmap_torch.lanes.pieces import (
    LanePieces,
    cut_by_length,
    cut_by_number,
    dash_gap,
    fit_pieces,
    runs_in_plane,
    runs_of,
    thin_gap,
    well_seen,
    with_enough_points,
)

F64 = torch.float64
PLAIN = {"smoothing": 0.0, "scales": (4.0, 1.0)}


def test_runs_end_at_gaps_and_at_markers() -> None:
    along = torch.tensor([0.0, 30, 5, 12, 0, 55, 41], dtype=F64)
    marker = torch.tensor([0, 0, 0, 0, 1, 0, 0])
    run = runs_of(marker, along, 15.0)
    assert run.tolist() == [0, 1, 0, 0, 3, 2, 1] or len(set(run.tolist())) == 3
    assert run[0] == run[2] == run[3]
    assert run[1] == run[6] == run[5]
    assert len({int(run[0]), int(run[1]), int(run[4])}) == 3


@pytest.mark.parametrize("turn", [0.0, 0.7, 2.0])
def test_a_gap_is_as_long_as_on_the_road_where_the_car_turns(turn: float) -> None:
    """Of a crossing of twenty metres only eight lie along the way of a car that turns into it."""
    x = torch.cat((torch.arange(0, 20, 0.5), torch.arange(40, 60, 0.5))).double()
    along = torch.where(x < 20, x, 20 + 0.4 * (x - 20))
    marker = torch.zeros(len(x), dtype=torch.int64)
    beside = 0.1 * (7 * x).sin()
    way, left = (torch.tensor([math.cos(a), math.sin(a)]) for a in (turn, turn + math.pi / 2))
    point = x[:, None] * way.double() + beside[:, None] * left.double()
    assert int(runs_of(marker, along, 12.0).max()) == 0
    run = runs_in_plane(marker, along, point, 12.0)
    assert len(run[x < 20].unique()) == len(run[x > 20].unique()) == 1
    assert len(run.unique()) == 2
    # A gap of dashes that is shorter stays bridged.
    dashed = torch.where(x < 20, x, x - 11)[:, None] * way.double()
    assert int(runs_in_plane(marker, along, dashed, 12.0).max()) == 0


@pytest.mark.parametrize(("dash", "gap"), [(3.0, 9.15), (6.0, 12.0), (8.0, 12.0)])
def test_dashes_of_a_motorway_are_one_run_and_crossings_are_not(
    dash: float, gap: float, generator: torch.Generator
) -> None:
    """Dashes and gaps of the USA, Germany and Japan; points stop short of the ends of dashes."""
    first = torch.arange(10, dtype=F64)[:, None] * (dash + gap)
    along = first + dash * torch.rand(10, 30, dtype=F64, generator=generator)
    crossing = 2.0 * gap
    along = torch.cat((along.flatten(), along.flatten() + first[-1] + dash + crossing))
    marker = torch.zeros(len(along), dtype=torch.int64)
    max_gap = dash_gap(marker, along, 20.0).clamp_min(12.0)
    run = runs_in_plane(marker, along, torch.stack((along, 0 * along), dim=1), max_gap)
    assert len(run.unique()) == 2
    assert len(run[:300].unique()) == len(run[300:].unique()) == 1


def test_only_gaps_that_come_again_are_between_dashes() -> None:
    solid = torch.arange(0, 40, 0.5).double()
    twice = torch.cat((solid, solid + 55, solid + 110))
    marker = torch.tensor([1, 3]).repeat_interleave(torch.tensor([len(twice), 5]))
    along = torch.cat((twice, torch.arange(5) * 40.0))
    longest = dash_gap(marker, along, 20.0)
    assert not bool(longest[: len(twice)].any())
    # However alike, gaps of forty metres are none between dashes.
    assert longest[len(twice) :].tolist() == [20.0] * 5
    assert len(dash_gap(marker[:0], along[:0], 20.0)) == 0


def test_gaps_between_few_points_are_bridged_and_those_between_many_are_not(
    generator: torch.Generator,
) -> None:
    thin = 200.0 * torch.rand(25, generator=generator, dtype=F64)
    dense = torch.cat((torch.arange(0, 90, 0.5), torch.arange(110, 200, 0.5))).double()
    along = torch.cat((thin, dense))
    marker = torch.cat((torch.zeros(len(thin)), torch.ones(len(dense)))).long()
    longest = thin_gap(marker, along, 20.0)
    assert bool((longest[: len(thin)] == 20.0).all())
    assert bool((longest[len(thin) :] < 3.0).all())
    assert len(thin_gap(marker[:0], along[:0], 20.0)) == 0


def _evenly(numbers: list[int]) -> LanePieces:
    """Whole pieces of six control points with so many points each."""
    number = torch.tensor(numbers)
    piece = torch.repeat_interleave(torch.arange(len(number)), number)
    t = torch.cat([torch.linspace(0, 5, n, dtype=F64) for n in numbers])
    count = torch.full_like(number, 6)
    return LanePieces(torch.arange(len(number)), count, piece, torch.arange(len(piece)), t)


@pytest.mark.parametrize(
    ("numbers", "enough"),
    [
        ([200, 300, 12, 11, 4], [True, True, True, False, False]),
        ([24, 24, 6, 5], [True, True, True, False]),
        ([5, 4, 6, 3], [True, True, True, False]),
        # However many strays: they hold few of the points.
        ([100, 100, *[3] * 20], [True, True, *[False] * 20]),
        ([], []),
    ],
)
def test_few_points_make_a_piece_where_few_are_usual(
    numbers: list[int], enough: list[bool]
) -> None:
    pieces = _evenly(numbers) if numbers else _evenly([1]).select(torch.tensor([False]))
    assert with_enough_points(pieces, most=12, share=0.25, least=4).tolist() == enough


def test_pieces_of_few_points_are_stiff_and_reach_as_far() -> None:
    pieces = _evenly([4, 9, 12, 80])
    stiff = pieces.as_stiff_as_points(2)
    assert stiff.control_count.tolist() == [3, 4, 6, 6]
    last = stiff.piece.diff(append=stiff.piece.new_tensor([4])) > 0
    assert stiff.t[last].tolist() == [2.0, 3.0, 5.0, 5.0]
    line = torch.stack((torch.arange(len(pieces.point)), 0 * pieces.t, 0 * pieces.t), dim=1)
    sigma = torch.full_like(pieces.t, 0.1)
    assert fit_pieces(stiff, line.double(), sigma, **PLAIN).miss.abs().max() < 1e-9


def test_what_one_detection_of_many_shows_is_not_well_seen() -> None:
    own = torch.arange(0, 40, 2.0).double()
    stray = torch.arange(30, 70, 2.0).double()
    along = torch.cat((own.repeat(20), stray, stray))
    detection = torch.cat(
        (torch.arange(20).repeat_interleave(len(own)), torch.tensor([20, 21]).repeat_interleave(20))
    )
    # The second marker is seen by one detection throughout: there is no other place to compare with.
    marker = (detection == 21).long()
    driven = well_seen(marker, along, detection.double(), 0.15)
    assert torch.equal(driven, (marker == 1) | (along < 40))
    # From a car that stands all of them are one view, as good as any.
    assert bool(well_seen(marker, along, torch.full_like(along, 3.3), 0.15).all())


def test_pieces_have_one_length_cover_all_and_overlap(generator: torch.Generator) -> None:
    along = 130 * torch.rand(2000, dtype=F64, generator=generator)
    marker = torch.zeros(2000, dtype=torch.int64)
    pieces = cut_by_length(
        marker, runs_of(marker, along, 15.0), along, length=40, overlap=0.5, control_points=6
    )
    assert len(set(pieces.point.tolist())) == 2000
    for k in range(len(pieces)):
        own = along[pieces.point[pieces.piece == k]]
        assert 39 < own.max() - own.min() <= 40 + 1e-6
    starts = torch.stack([along[pieces.point[pieces.piece == k]].min() for k in range(len(pieces))])
    assert bool((starts.diff() > 10).all() and (starts.diff() < 20.5).all())
    assert bool((pieces.control_count == 6).all())
    assert bool(((pieces.t >= 0) & (pieces.t <= 5)).all())


def test_short_runs_get_fewer_control_points() -> None:
    along = torch.linspace(0, 17, 50, dtype=F64)
    marker = torch.zeros(50, dtype=torch.int64)
    pieces = cut_by_length(
        marker, runs_of(marker, along, 15.0), along, length=40, overlap=0.5, control_points=6
    )
    assert pieces.control_count.tolist() == [3]
    assert len(pieces.piece) == 50


def test_recent_points_come_in_overlapping_pieces_of_one_size() -> None:
    marker = torch.tensor([0] * 230 + [1] * 40)
    frame = torch.arange(270) // 5
    point = torch.stack((torch.arange(270), torch.zeros(270), torch.zeros(270)), -1).to(F64)
    pieces = cut_by_number(marker, frame, point, number=100, control_points=6)
    size = torch.bincount(pieces.piece)
    assert size[pieces.marker == 0].tolist() == [100] * 4
    assert size[pieces.marker == 1].tolist() == [40]
    assert set(pieces.point[pieces.marker[pieces.piece] == 0].tolist()) == set(range(230))
    assert bool((marker[pieces.point] == pieces.marker[pieces.piece]).all())


def test_fit_agrees_with_the_spline_of_geometry(generator: torch.Generator) -> None:
    along = 75 * torch.rand(400, dtype=F64, generator=generator)
    noise = 0.01 * torch.randn(400, dtype=F64, generator=generator)
    point = torch.stack((along, 3 * torch.sin(along / 15) + noise, along / 20), dim=-1)
    marker = torch.zeros(400, dtype=torch.int64)
    pieces = cut_by_length(
        marker, runs_of(marker, along, 15.0), along, length=40, overlap=0.5, control_points=6
    )
    fit = fit_pieces(pieces, point, torch.full((400,), 1.0, dtype=F64), smoothing=0.0, scales=())
    expected = spline_fit.fit_flat(
        point[pieces.point], pieces.piece, pieces.t, pieces.control_count
    )
    torch.testing.assert_close(fit.control, expected, atol=1e-6, rtol=0)


def test_dear_bending_makes_pieces_straight(generator: torch.Generator) -> None:
    along = 40 * torch.rand(100, dtype=F64, generator=generator)
    point = torch.stack((along, 3 * torch.sin(along / 5), along / 20), dim=-1)
    marker, sigma = torch.zeros(100, dtype=torch.int64), torch.ones(100, dtype=F64)
    pieces = cut_by_length(
        marker, runs_of(marker, along, 15.0), along, length=40, overlap=0.5, control_points=6
    )
    fit = fit_pieces(pieces, point, sigma, smoothing=1e6, scales=())
    assert len(pieces) == 1
    assert fit.control.diff(n=2, dim=0).abs().max() < 1e-5


def test_outliers_do_not_move_a_fit(generator: torch.Generator) -> None:
    along = torch.linspace(0, 40, 200, dtype=F64)
    lateral = 0.05 * torch.randn(200, dtype=F64, generator=generator)
    lateral[::8] += 3.5
    point = torch.stack((along, lateral, torch.zeros_like(along)), dim=-1)
    marker = torch.zeros(200, dtype=torch.int64)
    pieces = cut_by_length(
        marker, runs_of(marker, along, 15.0), along, length=40, overlap=0.5, control_points=6
    )
    fit = fit_pieces(
        pieces,
        point,
        torch.full((200,), 0.05, dtype=F64),
        smoothing=1e-4,
        scales=(8.0, 4.0, 2.0, 1.0),
    )
    assert fit.control[:, 1].abs().max() < 0.06
    assert bool((fit.weight[pieces.point % 8 == 0] < 0.01).all())


def test_sigma_is_the_scatter_of_fits(generator: torch.Generator) -> None:
    trials = 300
    along = torch.linspace(0, 40, 120, dtype=F64).repeat(trials)
    marker = torch.arange(trials).repeat_interleave(120)
    lateral = 0.1 * torch.randn(len(along), dtype=F64, generator=generator)
    point = torch.stack((along, lateral, torch.zeros_like(along)), dim=-1)
    pieces = cut_by_length(
        marker, runs_of(marker, along, 15.0), along, length=40, overlap=0.5, control_points=6
    )
    # The noise is not what was expected, and is found out.
    fit = fit_pieces(pieces, point, torch.full_like(along, 0.05), **PLAIN)
    scatter = fit.control[:, 1].reshape(trials, 6).square().mean(0).sqrt()
    sigma = fit.sigma.reshape(trials, 6).mean(0)
    torch.testing.assert_close(sigma, scatter, rtol=0.3, atol=0)


def test_no_points_give_no_pieces() -> None:
    none, real = torch.zeros(0, dtype=torch.int64), torch.zeros(0, dtype=F64)
    for pieces in (
        cut_by_length(none, none, real, length=40, overlap=0.5, control_points=6),
        cut_by_number(none, none, real.reshape(0, 3), number=100, control_points=6),
    ):
        fit = fit_pieces(pieces, real.reshape(0, 3), real, **PLAIN)
        assert len(pieces) == 0 and len(fit.control) == 0
