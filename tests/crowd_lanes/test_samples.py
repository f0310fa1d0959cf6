from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from worlds import lane_world

from crowdmap_torch.crowd_lanes.samples import (
    LaneSamples,
    merge_overlapping,
    sample_lanes,
    stray_samples,
)
from crowdmap_torch.noise.positioning import PositioningNoise
from crowdmap_torch.tables import Lanes

NOISE = PositioningNoise()


def straight(first: float, last: float, left: float = 0.0) -> np.ndarray:
    x = np.arange(first, last + 1, 10.0)
    return np.stack((x, np.full_like(x, left), 0 * x), 1)


def lanes_of(
    rows: list[tuple[np.ndarray, int, int, int]], *, n_observations: list[int] | None = None
) -> Lanes:
    """Pieces from (control points, journey, tracklet, frame)."""
    lanes = lane_world.pieces(
        [row[0] for row in rows],
        type=[0] * len(rows),
        journey=[row[1] for row in rows],
        tracklet=[row[2] for row in rows],
        frame=[row[3] for row in rows],
    )
    if n_observations is None:
        return lanes
    return replace(lanes, n_observations=torch.tensor(n_observations))


def sampled(lanes: Lanes) -> LaneSamples:
    return sample_lanes(lanes, 2.0, NOISE, few_observations=10.0)


def test_samples_cover_every_piece_densely_and_tracks_are_adjacent() -> None:
    lanes = lanes_of(
        [(straight(0, 40), 1, 5, 3), (straight(0, 40, 3.5), 0, 5, 2), (straight(20, 60), 1, 5, 8)]
    )
    samples = sampled(lanes)
    assert torch.bincount(samples.piece).tolist() == [21, 21, 21]
    assert (samples.line.track.diff() >= 0).all() and (samples.line.owner.diff() >= 0).all()
    # Two pieces of one journey and tracklet are one track.
    assert samples.track_of_piece.tolist() == [1, 0, 1]
    assert (samples.line.owner == lanes.journey[samples.piece]).all()


def test_stations_are_the_way_along_the_journey() -> None:
    rows = [(straight(20.0 * k, 20.0 * k + 40), 0, 1, 10 * k) for k in range(4)]
    # Another marker beside it says the same.
    rows += [(straight(20.0 * k, 20.0 * k + 40, 7.0), 0, 2, 10 * k) for k in range(4)]
    samples = sampled(lanes_of(rows))
    x = samples.line.point[:, 0]
    torch.testing.assert_close(samples.station - samples.station[0], x - x[0])


def test_few_detections_and_large_sigmas_take_weight() -> None:
    pieces = [(straight(0, 40, 5.0 * k), 0, k, 0) for k in range(4)]
    lanes = lanes_of(pieces, n_observations=[10, 40, 80, 1000])
    weight = sampled(lanes).line.weight
    mean = [float(weight[sampled(lanes).piece == k].mean()) for k in range(4)]
    assert mean == sorted(mean) and 0 < mean[0] < 0.7 * mean[3] and mean[3] < 1
    sigma = torch.full_like(lanes.control.sigma, 0.5)
    vague = replace(lanes, control=replace(lanes.control, sigma=sigma))
    assert (sampled(vague).line.weight < 0.5 * weight).all()


def test_merging_makes_overlapping_pieces_one_line() -> None:
    lanes = lanes_of([(straight(0, 60), 0, 1, 0), (straight(0, 60, 0.2), 0, 1, 1)])
    samples = sampled(lanes)
    fewer, went = merge_overlapping(samples, 2.0)
    assert len(fewer) < 0.6 * len(samples)
    assert torch.equal(fewer.line.track[went], samples.line.track)
    # Both weigh the same: the line between them, at the mean of their stations.
    torch.testing.assert_close(
        fewer.line.point[:, 1], torch.full_like(fewer.station, 0.1), atol=1e-9, rtol=0
    )
    assert float((fewer.station[went] - samples.station).abs().max()) < 2.0


def test_a_piece_beside_the_others_of_its_tracklet_is_stray() -> None:
    good = [(straight(0, 60), 0, 1, 0), (straight(0, 60, 0.1), 0, 1, 1)]
    lanes = lanes_of([*good, (straight(20, 60, 2.0), 0, 1, 2)])
    samples = sampled(lanes)
    stray = stray_samples(samples, beside=(0.8, 3.8))
    assert set(samples.piece[stray].tolist()) == {2}
    assert stray[samples.piece == 2].all()
    # Of another tracklet it is another marker; of two alike nobody knows which.
    other = lanes_of([*good, (straight(20, 60, 2.0), 0, 2, 2)])
    assert not stray_samples(sampled(other), beside=(0.8, 3.8)).any()
    two = lanes_of([(straight(0, 60), 0, 1, 0), (straight(0, 60, 2.0), 0, 1, 1)])
    assert stray_samples(sampled(two), beside=(0.8, 3.8)).all()


def test_samples_move_by_rows() -> None:
    samples = sampled(lanes_of([(straight(0, 40), 0, 1, 0)]))
    offset = torch.arange(3.0).double().expand(len(samples), 3)
    assert torch.equal(samples.moved(offset).line.point, samples.line.point + offset)
    assert torch.equal(samples.moved(offset).station, samples.station)


@pytest.mark.parametrize("spacing", [2.0, 5.0])
def test_no_lanes_have_no_samples(spacing: float) -> None:
    lanes = lanes_of([(straight(0, 40), 0, 1, 0)])
    none = lanes.select(torch.zeros(0, dtype=torch.int64))
    assert len(sample_lanes(none, spacing, NOISE, few_observations=10.0)) == 0
