"""The table of the map's lanes, with what stands behind each: pieces, journeys and their scatter."""

from __future__ import annotations

import torch

from crowdmap_torch.clustering.groups import group_sum
from crowdmap_torch.courses.curves import Curves, Match
from crowdmap_torch.courses.samples import LaneSamples
from crowdmap_torch.geometry import spline
from crowdmap_torch.tables import ControlPoints, Lanes


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
