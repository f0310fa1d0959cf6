from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest

from crowdmap_torch.simulate.sign_detections import (
    DAY,
    NIGHT,
    SignRows,
    all_codes,
    concatenate_rows,
    corner_sigma,
)


def rows(count: int, first: int = 0) -> SignRows:
    columns = {f.name: first + np.arange(count) for f in fields(SignRows)}
    score = np.linspace(0, 1, count)
    return SignRows(
        **columns
        | {"corners_px": np.zeros((count, 8, 2)), "score": score, "is_outlier": score > 0.5}
    )


def test_noise_grows_as_boxes_shrink_down_to_that_of_large_ones():
    sigma = corner_sigma(np.array([DAY.small_box_px, 1e6]), DAY)
    assert sigma == pytest.approx(DAY.pixel_noise_px * np.array([np.sqrt(2), 1.0]))
    assert (np.diff(corner_sigma(np.linspace(5, 200, 50), DAY)) < 0).all()


def test_the_night_is_worse_than_the_day_in_all_that_differs():
    worse = [f.name for f in fields(DAY) if getattr(NIGHT, f.name) != getattr(DAY, f.name)]
    assert "missed" in worse
    assert all(getattr(NIGHT, name) > getattr(DAY, name) for name in worse)


def test_rows_are_chosen_and_joined_in_all_columns_alike():
    joined = concatenate_rows((rows(3), rows(2, first=10)))
    assert len(joined) == 5
    chosen = joined[np.array([4, 0])]
    for column in ("frame", "sign", "track"):
        assert getattr(chosen, column).tolist() == [11, 0]


def test_codes_are_known_once_each():
    assert len(set(all_codes())) == len(all_codes()) > 10
