from __future__ import annotations

import torch
from torch import Tensor
from worlds.lines import straight

from crowdmap_torch.crowd_lanes.density_ridge import RidgeConfig
from crowdmap_torch.crowd_lanes.line_samples import stations
from crowdmap_torch.crowd_lanes.polyline_linking import Polylines
from crowdmap_torch.crowd_lanes.trace import (
    TraceConfig,
    bridged,
    cut_by_type,
    trace,
    without_short,
    without_weak,
)
from crowdmap_torch.tables import LANE_TYPES

F64 = torch.float64
RIDGE, CONFIG = RidgeConfig(), TraceConfig()


def along_x(*number: int) -> tuple[Polylines, Tensor]:
    """Polylines of points a metre apart along x, 100 m beside each other."""
    size = torch.tensor(number)
    line = torch.repeat_interleave(size)
    x = torch.cat([torch.arange(float(n)) for n in number]).double()
    point = torch.stack((x, 100.0 * line, 0 * x), 1)
    return Polylines(torch.arange(len(x)), line, len(number)), point


def test_markers_seen_by_two_are_traced_from_end_to_end() -> None:
    samples = straight([0.0, 0.1, 3.5, 3.45, 9.0])
    traced = trace(samples, RIDGE, CONFIG)
    point = traced.point.point[traced.polylines.node]
    assert traced.polylines.count == 2
    lines = [point[traced.polylines.line == k] for k in range(2)]
    near, far = sorted(lines, key=lambda line: float(line[0, 1]))
    for line, across in ((near, 0.05), (far, 3.475)):
        assert abs(float(line[:, 1].mean()) - across) < 0.02
        assert float(line[:, 0].min()) < 2.0 and float(line[:, 0].max()) > 38.0


def test_one_journey_is_enough_where_it_is_admitted_or_alone() -> None:
    lonely = straight([0.0, 0.1, 9.0])
    assert trace(lonely, RIDGE, CONFIG).polylines.count == 1
    assert trace(lonely, RIDGE, TraceConfig(min_journeys=1)).polylines.count == 2
    assert trace(straight([0.0]), RIDGE, CONFIG).polylines.count == 1


def test_a_gap_that_a_journey_saw_is_bridged_and_a_blind_one_is_not() -> None:
    samples = straight([0.0, 0.05, 0.1])
    x = samples.point[:, 0]
    gap = (x > 10) & (x < 28)
    for seeing, count in ((0, 1), (-1, 2)):
        seen = samples[~gap | (samples.owner == seeing)]
        traced = trace(seen, RIDGE, CONFIG)
        assert bridged(traced, seen, CONFIG).count == count


def test_weak_stretches_are_kept_between_strong_ones_alone() -> None:
    lines, point = along_x(30, 30)
    strong = torch.ones(60, dtype=torch.bool)
    strong[:5] = strong[10:18] = strong[45:] = False
    kept = without_weak(lines, point, strong, max_gap=10.0)
    assert kept.size.tolist() == [25, 15]
    assert kept.node.tolist() == [*range(5, 30), *range(30, 45)]
    assert without_weak(lines, point, strong, max_gap=8.0).size.tolist() == [5, 12, 15]
    assert without_weak(lines, point, ~(strong | True), max_gap=10.0).count == 0


def test_short_polylines_are_left_out() -> None:
    lines, point = along_x(5, 30, 9)
    kept = without_short(lines, point, 8.0)
    assert kept.size.tolist() == [30, 9]
    assert kept.line.unique().tolist() == [0, 1]


def votes_of(kind: Tensor) -> Tensor:
    return torch.nn.functional.one_hot(kind, len(LANE_TYPES)).to(F64)


def test_a_polyline_is_cut_where_its_type_changes_and_both_sides_share_the_point() -> None:
    lines, point = along_x(120, 60)
    kind = torch.where(torch.arange(180) < 50, 0, 2)
    # Some mistakes, and a run that is too short to be one.
    kind[[10, 20, 90]] = 1
    kind[100:104] = 3
    pieces, found, joints = cut_by_type(lines, point, votes_of(kind), CONFIG)
    assert found.tolist() == [0, 2, 2]
    assert joints.tolist() == [[0, 1]]
    first, last = pieces.ends.T
    assert int(pieces.node[last[0]]) == int(pieces.node[first[1]])
    # The windows of the votes see both sides of the change.
    assert abs(int(pieces.node[last[0]]) - 50) <= 5
    s, length = stations(point[pieces.node], pieces.line, pieces.count)
    assert float(length[:2].sum()) == 119.0 and len(s) == 181


def test_without_votes_types_are_unknown() -> None:
    lines, point = along_x(40)
    _, found, joints = cut_by_type(lines, point, torch.zeros(40, len(LANE_TYPES)).double(), CONFIG)
    assert found.tolist() == [-1] and len(joints) == 0
