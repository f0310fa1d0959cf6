from __future__ import annotations

import numpy as np
import pytest
from worlds.marked_roads import bend, line, two_way_road

from crowdmap_torch.io.formats.exporters.carriageways import Carriageways, carriageways
from crowdmap_torch.io.formats.exporters.features import lane_points


def pairs(ways: Carriageways) -> set[tuple[int, int]]:
    """Pieces on the left and right of lanes."""
    return {(ways.borders[c.left].piece, ways.borders[c.right].piece) for c in ways.cells}


def cell_axis(ways: Carriageways, number: int) -> np.ndarray:
    cell = ways.cells[number]
    left = ways.points(cell.left, cell.is_left_reversed)
    return left[-1] - left[0]


def test_lanes_run_with_the_line_at_their_edge():
    ways = carriageways(lane_points(two_way_road().lanes))
    assert pairs(ways) == {(1, 0), (2, 0), (1, 3), (2, 3), (3, 4)}
    for number, cell in enumerate(ways.cells):
        assert not cell.is_two_way
        is_back = ways.borders[cell.right].piece == 0
        assert (cell_axis(ways, number)[0] < 0) == is_back


def test_the_left_border_is_on_the_left():
    for pieces in (lane_points(two_way_road().lanes), [bend(40, 170, a) for a in (0, 3.2, -3.2)]):
        ways = carriageways(pieces)
        assert ways.cells
        for number, cell in enumerate(ways.cells):
            left = ways.points(cell.left, cell.is_left_reversed)
            right = ways.points(cell.right, cell.is_right_reversed)
            direction = np.diff(left[:, :2], axis=0)[len(left) // 2]
            nearest = right[
                np.argmin(np.linalg.norm(right[:, :2] - left[len(left) // 2, :2], axis=1))
            ]
            across = nearest[:2] - left[len(left) // 2, :2]
            assert direction[0] * across[1] - direction[1] * across[0] < 0, number


def test_lanes_follow_one_another_without_a_gap():
    ways = carriageways(lane_points(two_way_road().lanes))
    ends = {
        (ways.nodes(c.left, c.is_left_reversed)[k], ways.nodes(c.right, c.is_right_reversed)[k])
        for c in ways.cells
        for k in (0, -1)
    }
    # Four edges of lanes across the road where it is cut in the middle and at its two ends: three lanes each.
    assert len(ends) == 3 * (len({c.row for c in ways.cells}) + 1)


def test_cells_beside_one_another_are_one_row():
    ways = carriageways(lane_points(two_way_road().lanes))
    rows = [c.row for c in ways.cells]
    assert all(rows.count(row) == 3 for row in rows)


def test_borders_cover_every_marker_once():
    pieces = lane_points(two_way_road().lanes)
    ways = carriageways(pieces)
    links = [
        tuple(sorted(link))
        for row in range(len(ways.borders))
        for link in zip(ways.nodes(row)[:-1].tolist(), ways.nodes(row)[1:].tolist(), strict=True)
    ]
    assert len(links) == len({*links})
    # The second half of the middle line begins with the point that the first ends with.
    twice = len(pieces[0]) + len(pieces[1])
    assert {n for link in links for n in link} == {*range(sum(map(len, pieces)))} - {twice}


@pytest.mark.parametrize(
    "others",
    [
        [line((0, 1.2), (80, 1.2))],
        [line((0, 9), (80, 9))],
        [line((0, 3.5), (80, 3.5), z=5.0)],
        [line((40, -40), (40, 40))],
    ],
    ids=["too near", "too far", "bridge", "across"],
)
def test_what_lies_otherwise_is_no_lane(others: list[np.ndarray]):
    assert carriageways([line((0, 0), (80, 0)), *others]).cells == []


def test_what_lies_between_two_carriageways_is_no_lane():
    ways = carriageways(
        [
            line((0, 0), (80, 0)),
            line((0, -3.5), (80, -3.5)),
            line((80, 4), (0, 4)),
            line((80, 7.5), (0, 7.5)),
        ]
    )
    assert pairs(ways) == {(0, 1), (2, 3)}


def test_lines_that_run_against_one_another_bound_a_lane_for_both_ways():
    ways = carriageways([line((0, 0), (80, 0)), line((80, 3), (0, 3))])
    assert [cell.is_two_way for cell in ways.cells] == [True]


def test_a_lane_that_joins_cuts_those_beside_it():
    ways = carriageways(
        [line((0, 0), (90, 0)), line((0, 3.5), (90, 3.5)), line((30, -3.5), (60, -3.5))]
    )
    counts = sorted([c.row for c in ways.cells].count(row) for row in {c.row for c in ways.cells})
    assert counts == [1, 1, 2]


def test_long_lanes_are_cut():
    ways = carriageways([line((0, 0), (500, 0)), line((0, 3.5), (500, 3.5))], longest=100)
    lengths = [len(ways.nodes(c.left)) - 1 for c in ways.cells]
    assert sum(lengths) == 500 and max(lengths) <= 100


def test_no_markers_are_no_lanes():
    ways = carriageways([])
    assert ways.borders == [] and ways.cells == []
