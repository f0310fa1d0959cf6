"""What stands behind the lanes of the map: pieces, tracklets and journeys, and the table of lanes with all of it."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.clustering.groups import group_mode, group_sum
from crowdmap_torch.courses.curves import Curves, Match
from crowdmap_torch.courses.samples import LaneSamples
from crowdmap_torch.geometry import spline
from crowdmap_torch.tables import ControlPoints, Lanes, Rows

_MIN_LENGTH = 4.0
"""A shorter run of a tracklet beside a lane is no support [m]."""


@dataclass(frozen=True)
class LaneSupport(Rows):
    """Which tracklets run along which lanes of the map; a tracklet may stand in several rows. Sorted by all of it."""

    journey: Int[Tensor, " r"]
    tracklet: Int[Tensor, " r"]
    lane: Int[Tensor, " r"]
    length: Float[Tensor, " r"]
    """Metres of the tracklet's pieces that lie on the lane, overlapping pieces counted each."""


def lane_support(
    lanes: Lanes, samples: LaneSamples, matched: Match, spacing: float
) -> tuple[Int[Tensor, " n"], LaneSupport]:
    """The lane of most of each piece (-1 for none), and the lanes of each tracklet."""
    weight = torch.full_like(matched.station, spacing)
    piece_lane = group_mode(matched.curve, weight, samples.piece, len(lanes))
    used = matched.curve >= 0
    count = int(matched.curve.max()) + 1 if bool(used.any()) else 1
    key, group = torch.unique(
        samples.line.track[used] * count + matched.curve[used], return_inverse=True
    )
    length = group_sum(weight[used], group, len(key))
    key, length = key[length >= _MIN_LENGTH], length[length >= _MIN_LENGTH]
    track, lane = key // count, key % count
    tracks = int(samples.track_of_piece.max()) + 1 if len(lanes) else 0
    piece_of_track = torch.zeros(tracks, dtype=torch.int64, device=lane.device)
    piece_of_track[samples.track_of_piece] = torch.arange(len(lanes), device=lane.device)
    piece = piece_of_track[track]
    return piece_lane, LaneSupport(lanes.journey[piece], lanes.tracklet[piece], lane, length)


def lanes_table(
    curves: Curves,
    lanes: Lanes,
    samples: LaneSamples,
    matched: Match,
    *,
    drift_sigma: float,
    existence: float = 0.6,
) -> Lanes:
    """The curves as lanes of the map, with what is known of them.

    A control point's sigma is that of the mean of the journeys that saw the lane there: `drift_sigma` [m] and their
    scatter. Every journey more multiplies the doubt that a lane exists by `existence`.
    """
    n = len(curves)
    device = curves.point.device
    used = matched.curve >= 0
    curve, owner = matched.curve[used], samples.line.owner[used]
    owners = int(samples.line.owner.max()) + 1 if len(samples) else 1
    # Journeys on each lane, and at each control point.
    key, group = torch.unique(curve * owners + owner, return_inverse=True)
    length = torch.bincount(group, minlength=len(key))
    seen = key[length >= 2] // owners
    n_journeys = torch.bincount(seen, minlength=n)
    first = spline.starts(curves.count)
    t = matched.station[used] / curves.length[curve] * (curves.count[curve] - 1)
    knot = first[curve] + torch.minimum(t.round().long().clamp_min(0), curves.count[curve] - 1)
    controls = len(curves.control)
    here, place = torch.unique(knot * owners + owner, return_inverse=True)
    number = torch.bincount(place, minlength=len(here)).clamp_min(1)
    mean = group_sum(matched.lateral[used], place, len(here)) / number
    there = here // owners
    journeys_here = torch.bincount(there, minlength=controls).to(mean).clamp_min(1)
    scatter = group_sum(mean.square(), there, controls) / (journeys_here - 1).clamp_min(1)
    sigma = ((drift_sigma**2 + scatter) / journeys_here).sqrt()
    # Of each piece, the share that lies on the lane counts.
    pair, group = torch.unique(curve * len(lanes) + samples.piece[used], return_inverse=True)
    part = torch.bincount(group, minlength=len(pair))
    whole = torch.bincount(samples.piece, minlength=len(lanes)).clamp_min(1)
    lane, piece = pair // len(lanes), pair % len(lanes)
    observations = group_sum(lanes.n_observations[piece] * part / whole[piece], lane, n)
    none = torch.full((n,), -1, dtype=torch.int64, device=device)
    blank = torch.zeros(n, dtype=lanes.first_seen_ns.dtype, device=device)
    return Lanes(
        type=curves.kind,
        control_start=first,
        control_count=curves.count,
        journey=none,
        tracklet=none,
        frame=none,
        n_journeys=n_journeys,
        n_observations=observations.round().long(),
        first_seen_ns=blank.scatter_reduce(
            0, lane, lanes.first_seen_ns[piece], "amin", include_self=False
        ),
        last_seen_ns=blank.scatter_reduce(
            0, lane, lanes.last_seen_ns[piece], "amax", include_self=False
        ),
        confidence=1 - existence ** n_journeys.to(sigma),
        control=ControlPoints(curves.control, sigma),
    )
