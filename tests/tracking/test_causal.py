"""What signs and lanes share of causal association."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from worlds.sign_drive import drive_past, signs_at, straight_poses

from crowdmap_torch.tracking.causal import (
    ActiveTracklets,
    costs_on_demand,
    rows_of_frames,
    window_costs,
)
from crowdmap_torch.tracking.sign_features import (
    SignAssociationConfig,
    SignFeatures,
    sign_features,
    sign_pair_costs,
)

CONFIG = SignAssociationConfig()
WINDOW = 3


@pytest.fixture(scope="module")
def features() -> SignFeatures:
    places = [(4.0, 60.0, 2.0), (4.0, 60.0, 2.7), (-4.0, 75.0, 2.5)]
    journey = drive_past(straight_poses(30), signs_at(places)).journey
    signs = journey.signs[torch.argsort(journey.signs.frame, stable=True)]
    return sign_features(signs, journey.T_world_camera[signs.frame], CONFIG)


def costs(a: SignFeatures, b: SignFeatures) -> torch.Tensor:
    return sign_pair_costs(a, b, CONFIG)


@pytest.mark.parametrize("chunk", [1, 7, 10_000])
def test_costs_ahead_of_the_loop_are_those_on_demand(features: SignFeatures, chunk: int):
    ahead = window_costs(features, costs, window=WINDOW, chunk=chunk)
    asked = costs_on_demand(features, costs)
    frame = features.frame.numpy()
    compared = 0
    for rows in rows_of_frames(frame):
        back = frame[rows[0]] - frame
        last = np.flatnonzero((back >= 1) & (back <= WINDOW))
        if len(last):
            at = (last[:, None], rows[None])
            # The same numbers, in batches of another size.
            np.testing.assert_allclose(ahead(*at), asked(*at), rtol=1e-12)
            compared += len(last) * len(rows)
    assert compared > 50


def test_rows_of_frames_are_all_rows_once_in_order():
    frame = np.array([0, 0, 3, 4, 4, 4, 9])
    found = list(rows_of_frames(frame))
    assert [rows.tolist() for rows in found] == [[0, 1], [2], [3, 4, 5], [6]]
    assert list(rows_of_frames(frame[:0])) == []


def test_tracklets_are_picked_and_joined_by_column():
    a = ActiveTracklets(np.array([4, 7]), np.array([10, 12]))
    b = ActiveTracklets(np.array([9]), np.array([15]))
    both = a.followed_by(b)
    assert len(both) == 3
    assert both.label.tolist() == [4, 7, 9]
    assert both[np.array([2, 0])].last.tolist() == [15, 10]
