from __future__ import annotations

import torch
from torch import Tensor

from crowdmap_torch.crowd_lanes.polyline_linking import (
    BridgeConfig,
    LinkConfig,
    Polylines,
    bridge_gaps,
    end_points,
    keep_rows,
    link_points,
    select_polylines,
)


def points(*lines: Tensor) -> tuple[Tensor, Tensor]:
    """Points [n, 3] and axes of polylines [k, 2]."""
    place = torch.cat(lines)
    axis = torch.cat([torch.gradient(line, dim=0)[0] for line in lines])
    axis = torch.nn.functional.normalize(axis, dim=1)
    return torch.cat((place, torch.zeros(len(place), 1, dtype=place.dtype)), 1), axis


def line(first: float, last: float, y: float = 0.0, slope: float = 0.0) -> Tensor:
    x = torch.arange(first, last + 0.1, 1.0, dtype=torch.float64)
    return torch.stack((x, y + slope * (x - first)), 1)


def linked(place: Tensor, axis: Tensor) -> Polylines:
    return link_points(place, axis, torch.ones(len(place), dtype=torch.bool), LinkConfig())


def members(lines: Polylines) -> list[set[int]]:
    return [set(lines.node[lines.line == c].tolist()) for c in range(lines.count)]


def test_shuffled_points_come_in_order(generator: torch.Generator) -> None:
    place, axis = points(line(0, 30))
    order = torch.randperm(len(place), generator=generator)
    flip = torch.where(torch.rand(len(place), generator=generator) < 0.5, -1.0, 1.0)
    lines = linked(place[order], axis[order] * flip[:, None])
    x = place[order][lines.node, 0]
    assert lines.count == 1
    assert (x.diff().abs() - 1).abs().max() < 1e-12


def test_parallel_lines_are_not_linked() -> None:
    lines = linked(*points(line(0, 30), line(0, 30, y=2.5)))
    assert lines.count == 2
    assert {len(m) for m in members(lines)} == {31}


def test_a_split_is_a_trunk_and_a_branch() -> None:
    lines = linked(*points(line(0, 60), line(31, 60, y=0.6, slope=0.1)))
    assert lines.count == 2
    assert {frozenset(m) for m in members(lines)} == {
        frozenset(range(61)),
        frozenset(range(61, 91)),
    }


def test_a_ring_ends_where_it_begins() -> None:
    angle = torch.linspace(0, 2 * torch.pi, 101, dtype=torch.float64)[:-1]
    place = 20 * torch.stack((angle.cos(), angle.sin(), 0 * angle), 1)
    axis = torch.stack((-angle.sin(), angle.cos()), 1)
    lines = linked(place, axis)
    assert lines.count == 1
    assert len(lines.node) == 101
    assert int(lines.node[0]) == int(lines.node[-1])


def bridged(place: Tensor, axis: Tensor, witness: Tensor | None = None) -> Polylines:
    nobody = torch.zeros(0, 3, dtype=torch.float64) if witness is None else witness
    return bridge_gaps(linked(place, axis), place, axis, nobody, BridgeConfig())


def test_short_gaps_are_bridged_whichever_way_polylines_run() -> None:
    place, axis = points(line(0, 20), line(28, 50), line(57, 70))
    for turned in range(8):
        sign = torch.cat(
            [torch.full((n,), -1.0 if turned >> k & 1 else 1.0) for k, n in enumerate((21, 23, 14))]
        )
        lines = bridged(place, axis * sign[:, None])
        assert lines.count == 1
        step = place[lines.node, 0].diff()
        assert (step > 0).all() or (step < 0).all()


def test_long_gaps_need_witnesses() -> None:
    place, axis = points(line(0, 30), line(55, 90))
    assert bridged(place, axis).count == 2
    seen, _ = points(line(30, 55, y=0.3))
    assert bridged(place, axis, seen).count == 1


def test_ends_that_miss_each_other_are_not_bridged() -> None:
    assert bridged(*points(line(0, 30), line(36, 60, y=2.0))).count == 2


def test_a_gap_on_an_arc_is_bridged() -> None:
    angle = torch.cat((torch.linspace(0, 1, 26), torch.linspace(1.3, 2.3, 26))).double()
    place = 25 * torch.stack((angle.cos(), angle.sin(), 0 * angle), 1)
    axis = torch.stack((-angle.sin(), angle.cos()), 1)
    assert linked(place, axis).count == 2
    assert bridged(place, axis).count == 1


def test_rows_left_out_cut_a_polyline() -> None:
    lines = Polylines(torch.arange(10), torch.zeros(10, dtype=torch.int64), 1)
    keep = torch.ones(10, dtype=torch.bool)
    keep[[0, 4, 5]] = False
    kept = keep_rows(lines, keep)
    assert kept.count == 2
    assert members(kept) == [{1, 2, 3}, {6, 7, 8, 9}]


def test_ends_leave_their_polyline(generator: torch.Generator) -> None:
    place, axis = points(line(0, 20, slope=0.5), line(0, 10, y=9.0))
    flip = torch.where(torch.rand(len(place), generator=generator) < 0.5, -1.0, 1.0)
    lines = linked(place, axis * flip[:, None])
    ends, outward = end_points(lines, place, axis * flip[:, None])
    assert torch.equal(ends, place[lines.node[lines.ends.flatten()]])
    middle = ends.reshape(-1, 2, 3).mean(1).repeat_interleave(2, 0)
    away = torch.nn.functional.normalize((ends - middle)[:, :2], dim=1)
    torch.testing.assert_close(outward, away, atol=1e-12, rtol=0)


def test_selected_polylines_are_numbered_anew() -> None:
    lines = linked(*points(line(0, 9), line(0, 9, y=5.0), line(0, 9, y=10.0)))
    kept = select_polylines(lines, torch.tensor([True, False, True]))
    assert kept.count == 2 and kept.size.tolist() == [10, 10]
    assert members(kept) == [members(lines)[0], members(lines)[2]]


def test_no_points_make_no_polylines() -> None:
    place, axis = torch.zeros(0, 3, dtype=torch.float64), torch.zeros(0, 2, dtype=torch.float64)
    assert linked(place, axis).count == 0
    assert bridged(place, axis).count == 0
