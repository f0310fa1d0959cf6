from __future__ import annotations

import numpy as np

from crowdmap_torch.io.row_order import points_by_place, rank_of_lists, rows_by_content


def test_rows_come_by_frame_then_column_by_column() -> None:
    frame = np.array([1, 0, 1, 1, 0])
    u = np.array([5.0, 9.0, 5.0, 2.0, 1.0])
    score = np.array([0.9, 0.1, np.nan, 0.1, 0.1])
    usable = np.array([True, True, True, True, False])
    assert rows_by_content(usable, frame, (u, score)).tolist() == [1, 3, 0, 2]


def test_equal_rows_stay_as_they_stood() -> None:
    ones = np.ones(4)
    assert rows_by_content(ones > 0, np.zeros(4, dtype=int), (ones, ones)).tolist() == [0, 1, 2, 3]


def test_points_run_from_the_bottom_of_the_image_up_row_by_row() -> None:
    px = np.array([[3.0, 10.0], [1.0, 40.0], [2.0, 40.0], [0.0, 5.0]])
    assert points_by_place(px, np.array([1, 1, 1, 0])).tolist() == [3, 1, 2, 0]


def test_lists_are_ranked_by_all_of_their_points() -> None:
    lists = [[1, 2, 3], [1, 2], [1, 2, 4], [1, 2, 3], [], [0, 9, 9]]
    row = np.repeat(np.arange(6), [len(one) for one in lists])
    x = np.array([x for one in lists for x in one], dtype=float)
    rank = rank_of_lists(np.stack((x, np.zeros_like(x)), axis=-1), row, 6)
    assert rank[0] == rank[3]
    assert np.argsort(rank, kind="stable").tolist() == [4, 1, 5, 0, 3, 2]


def test_no_rows_have_no_ranks() -> None:
    assert rank_of_lists(np.zeros((0, 2)), np.zeros(0, dtype=int), 0).tolist() == []
