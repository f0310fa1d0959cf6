from __future__ import annotations

import math

import pytest
import torch

from crowdmap_torch.evaluation.association import evaluate_association
from crowdmap_torch.io.truth import SignAssociations, Truth


def associations(*rows: tuple[int, int, int]) -> SignAssociations:
    journey, row, landmark = torch.tensor(rows, dtype=torch.int64).reshape(-1, 3).unbind(-1)
    return SignAssociations(journey, row, landmark)


def test_pairs_over_journeys(build):
    # Sign 0 is detected in rows 0, 1 of both journeys, sign 1 in row 2 of the first; row 3 there is
    # false.
    truth = Truth(
        (
            build.drive("a", sign_rows=[(0, 0), (1, 0), (2, 1), (3, -1)]),
            build.drive("b", sign_rows=[(0, 0), (1, 0)]),
        )
    )
    # Landmark 0: three detections of sign 0, the one of sign 1 and the false one; the fourth of
    # sign 0 is lost.
    found = associations((0, 0, 0), (0, 1, 0), (0, 2, 0), (0, 3, 0), (1, 0, 0))
    figures = evaluate_association(found, truth, torch.tensor([True, False]))
    assert figures.detections == 5
    assert figures.pair_precision == pytest.approx(3 / 10)
    assert figures.pair_recall == pytest.approx(3 / 6)
    assert figures.data_loss == pytest.approx(1 / 4)


def test_a_perfect_map_loses_nothing(build):
    truth = Truth((build.drive("a", sign_rows=[(0, 1), (1, 0), (2, 1)]),))
    figures = evaluate_association(
        associations((0, 0, 7), (0, 1, 3), (0, 2, 7)), truth, torch.tensor([True, True])
    )
    assert figures.pair_precision == figures.pair_recall == 1
    assert figures.data_loss == 0


def test_no_landmark_at_all(build):
    truth = Truth((build.drive("a", sign_rows=[(0, 0), (1, 0)]),))
    figures = evaluate_association(associations(), truth, torch.tensor([True]))
    assert figures.data_loss == 1
    assert figures.pair_recall == 0
    assert math.isnan(figures.pair_precision)


def test_false_detections_of_a_road_without_signs_are_none_that_were_lost(build):
    truth = Truth((build.drive("a", sign_rows=[(0, -1), (1, -1)]),))
    figures = evaluate_association(associations(), truth, torch.zeros(0, dtype=torch.bool))
    assert figures.detections == 0
    assert math.isnan(figures.data_loss) and math.isnan(figures.pair_recall)


def test_lost_outliers_are_told_apart(build):
    drive = build.drive("a", sign_rows=[(0, 0), (1, 0)])
    drive.sign_outlier[1] = True
    figures = evaluate_association(associations((0, 0, 0)), Truth((drive,)), torch.tensor([True]))
    assert figures.data_loss == 0.5
    assert figures.data_loss_without_outliers == 0
