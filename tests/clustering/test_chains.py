from __future__ import annotations

import torch
from torch import Tensor

from crowdmap_torch.clustering import chain
from crowdmap_torch.clustering.chain import BridgeConfig, Chains, LinkConfig


def points(*lines: Tensor) -> tuple[Tensor, Tensor]:
    """Points [n, 3] and axes of polylines [k, 2]."""
    place = torch.cat(lines)
    axis = torch.cat([torch.gradient(line, dim=0)[0] for line in lines])
    axis = torch.nn.functional.normalize(axis, dim=1)
    return torch.cat((place, torch.zeros(len(place), 1, dtype=place.dtype)), 1), axis


def line(first: float, last: float, y: float = 0.0, slope: float = 0.0) -> Tensor:
    x = torch.arange(first, last + 0.1, 1.0, dtype=torch.float64)
    return torch.stack((x, y + slope * (x - first)), 1)


def linked(place: Tensor, axis: Tensor) -> Chains:
    return chain.link(place, axis, torch.ones(len(place), dtype=torch.bool), LinkConfig())


def members(chains: Chains) -> list[set[int]]:
    return [set(chains.node[chains.chain == c].tolist()) for c in range(chains.count)]


def test_shuffled_points_come_in_order(generator: torch.Generator) -> None:
    place, axis = points(line(0, 30))
    order = torch.randperm(len(place), generator=generator)
    flip = torch.where(torch.rand(len(place), generator=generator) < 0.5, -1.0, 1.0)
    chains = linked(place[order], axis[order] * flip[:, None])
    x = place[order][chains.node, 0]
    assert chains.count == 1
    assert (x.diff().abs() - 1).abs().max() < 1e-12


def test_parallel_lines_are_not_linked() -> None:
    chains = linked(*points(line(0, 30), line(0, 30, y=2.5)))
    assert chains.count == 2
    assert {len(m) for m in members(chains)} == {31}


def test_a_split_is_a_trunk_and_a_branch() -> None:
    chains = linked(*points(line(0, 60), line(31, 60, y=0.6, slope=0.1)))
    assert chains.count == 2
    assert {frozenset(m) for m in members(chains)} == {
        frozenset(range(61)),
        frozenset(range(61, 91)),
    }


def test_a_ring_ends_where_it_begins() -> None:
    angle = torch.linspace(0, 2 * torch.pi, 101, dtype=torch.float64)[:-1]
    place = 20 * torch.stack((angle.cos(), angle.sin(), 0 * angle), 1)
    axis = torch.stack((-angle.sin(), angle.cos()), 1)
    chains = linked(place, axis)
    assert chains.count == 1
    assert len(chains.node) == 101
    assert int(chains.node[0]) == int(chains.node[-1])


def bridged(place: Tensor, axis: Tensor, witness: Tensor | None = None) -> Chains:
    nobody = torch.zeros(0, 3, dtype=torch.float64) if witness is None else witness
    return chain.bridge(linked(place, axis), place, axis, nobody, BridgeConfig())


def test_short_gaps_are_bridged_whichever_way_chains_run() -> None:
    place, axis = points(line(0, 20), line(28, 50), line(57, 70))
    for turned in range(8):
        sign = torch.cat(
            [torch.full((n,), -1.0 if turned >> k & 1 else 1.0) for k, n in enumerate((21, 23, 14))]
        )
        chains = bridged(place, axis * sign[:, None])
        assert chains.count == 1
        step = place[chains.node, 0].diff()
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


def test_rows_left_out_cut_a_chain() -> None:
    chains = Chains(torch.arange(10), torch.zeros(10, dtype=torch.int64), 1)
    keep = torch.ones(10, dtype=torch.bool)
    keep[[0, 4, 5]] = False
    kept = chain.keep_rows(chains, keep)
    assert kept.count == 2
    assert members(kept) == [{1, 2, 3}, {6, 7, 8, 9}]
