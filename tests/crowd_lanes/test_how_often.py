from __future__ import annotations

import torch

from crowdmap_torch.crowd_lanes.how_often import how_often


def samples(
    rows: list[tuple[int, int, int, int, float]],
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Of every (curve, journey, first and last metre, detections a metre), a sample each two metres."""
    made = [
        (curve, s, journey, 2.0 * rate)
        for curve, journey, first, last, rate in rows
        for s in range(first, last, 2)
    ]
    curve, station, journey, detections = zip(*made, strict=True)
    return (
        torch.tensor(curve),
        torch.tensor(station, dtype=torch.float64),
        torch.tensor(journey),
        torch.tensor(detections, dtype=torch.float64),
    )


def test_what_is_seen_now_and_then_is_told_by_its_share():
    rows = [(curve, journey, 0, 200, 2.0) for curve in (0, 1) for journey in range(4)]
    rows += [(2, journey, 40, 80, 0.2) for journey in range(3)]
    share = how_often(*samples(rows), 3)
    torch.testing.assert_close(share, torch.tensor([1.0, 1.0, 0.1], dtype=torch.float64))


def test_drives_are_measured_by_what_is_usual_of_them():
    # One drives slowly and sees each metre ten times as often; what it alone saw often is no more of a marker.
    rows = [(0, 0, 0, 200, 10.0), (0, 1, 0, 200, 1.0), (1, 0, 0, 100, 5.0), (2, 1, 0, 100, 0.5)]
    share = how_often(*samples(rows), 3)
    torch.testing.assert_close(share, torch.tensor([1.0, 0.5, 0.5], dtype=torch.float64))


def test_many_lines_that_are_none_do_not_become_usual():
    rows = [(0, 0, 0, 100, 2.0), *((curve, 0, 0, 20, 0.2) for curve in range(1, 13))]
    share = how_often(*samples(rows), 13)
    assert float(share[0]) == 1.0
    assert float(share[1:].max()) < 0.11


def test_pieces_that_overlap_do_not_make_a_marker_longer():
    once, twice = samples([(0, 0, 0, 100, 1.0)]), samples([(0, 0, 0, 100, 0.5)] * 2)
    more = samples([(1, 0, 0, 100, 1.0)])
    for rows in (once, twice):
        curve, station, journey, detections = (
            torch.cat(pair) for pair in zip(rows, more, strict=True)
        )
        assert how_often(curve, station, journey, detections, 2).tolist() == [1.0, 1.0]


def test_a_curve_without_samples_is_not_accused():
    assert how_often(*samples([(1, 0, 0, 100, 1.0)]), 3).tolist() == [1.0, 1.0, 1.0]
    nothing = torch.zeros(0, dtype=torch.int64)
    none = torch.zeros(0, dtype=torch.float64)
    assert how_often(nothing, none, nothing, none, 2).tolist() == [1.0, 1.0]
