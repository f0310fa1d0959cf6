from __future__ import annotations

import torch
from torch import Tensor
from worlds.lines import arc, curves_of_points, samples_of

from crowdmap_torch.crowd_lanes.duplicates import covered_twice, crosses_longer
from crowdmap_torch.crowd_lanes.line_samples import LineSamples
from crowdmap_torch.crowd_lanes.splines import Curves, Match, match
from crowdmap_torch.tables import concatenate

F64 = torch.float64


def line(first: float, last: float, *, left: float = 0.0, up: float = 0.0) -> Tensor:
    point, _ = arc(1e9, last - first)
    return point + torch.tensor([first, left, up], dtype=F64)


def seen(lines: list[tuple[Tensor, int]]) -> LineSamples:
    """Samples of lines, each of an owner; owners ascend."""
    east = torch.tensor([[1.0, 0.0]], dtype=F64)
    return concatenate(
        [
            samples_of(point, east.expand(len(point), 2), owner=owner, track=track)
            for track, (point, owner) in enumerate(lines)
        ]
    )


def dropped_of(curves: Curves, samples: LineSamples, matched: Match | None = None) -> Tensor:
    """How many points of each curve are dropped."""
    matched = match(samples, curves, gate=0.7) if matched is None else matched
    twice = covered_twice(curves, samples, matched, gate=0.45, min_seen_together=0.3)
    return torch.bincount(curves.curve[twice], minlength=len(curves))


def test_the_less_supported_of_two_curves_is_dropped_all_along() -> None:
    lines = [line(0, 60), line(0, 60, left=0.3)]
    curves = curves_of_points(*lines)
    # Each journey has seen one of them.
    points = torch.bincount(curves.curve).tolist()
    few_first = seen([(lines[0], 0), (lines[1], 1), (lines[1], 2)])
    assert dropped_of(curves, few_first).tolist() == [points[0], 0]
    few_second = seen([(lines[0], 0), (lines[0], 1), (lines[1], 2)])
    assert dropped_of(curves, few_second).tolist() == [0, points[1]]


def test_two_curves_that_journeys_saw_at_once_are_two_markers() -> None:
    lines = [line(0, 60), line(0, 60, left=0.4)]
    curves = curves_of_points(*lines)
    both = seen([(lines[0], 0), (lines[1], 0), (lines[0], 1), (lines[1], 1), (lines[1], 2)])
    assert dropped_of(curves, both).tolist() == [0, 0]


def test_a_branch_that_ends_beside_a_trunk_gives_way_though_seen_by_more() -> None:
    trunk, branch = line(0, 100), line(40, 60, left=0.3)
    curves = curves_of_points(trunk, branch)
    samples = seen([(trunk, 0), (branch, 1), (branch, 2), (branch, 3)])
    assert dropped_of(curves, samples).tolist() == [0, 21]


def test_curves_apart_or_above_each_other_stay() -> None:
    for other in (line(0, 60, left=0.6), line(0, 60, up=3.0)):
        curves = curves_of_points(line(0, 60), other)
        samples = seen([(line(0, 60), 0), (other, 1)])
        assert dropped_of(curves, samples).tolist() == [0, 0]


def test_a_short_curve_from_side_to_side_of_a_long_one_crosses_it() -> None:
    way = torch.linspace(-10, 10, 21, dtype=F64)
    slanted = torch.stack((50 + way, 0.1 * way, 0 * way), 1)
    curves = curves_of_points(line(0, 100), slanted, line(0, 100, left=8.0))
    assert crosses_longer(curves).tolist() == [False, True, False]
    # Half as long is the most, another level is another road, and beside is not across.
    assert not crosses_longer(curves_of_points(line(30, 65), slanted)).any()
    above = slanted + torch.tensor([0.0, 0.0, 5.0], dtype=F64)
    assert not crosses_longer(curves_of_points(line(0, 100), above)).any()
    beside = slanted + torch.tensor([0.0, 1.5, 0.0], dtype=F64)
    assert not crosses_longer(curves_of_points(line(0, 100), beside)).any()
