"""The table of the map's lanes, with what stands behind each: pieces, journeys and their scatter."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.clustering.groups import distinct_pairs, group_range, group_sum
from crowdmap_torch.crowd_lanes.line_samples import points_along
from crowdmap_torch.crowd_lanes.samples import LaneSamples
from crowdmap_torch.crowd_lanes.splines import Curves, Match
from crowdmap_torch.geometry import spline_basis
from crowdmap_torch.tables import ControlPoints, Lanes, Rows


@dataclass(frozen=True)
class LaneSupport(Rows):
    """Samples of the journeys' lane pieces, and the lane of the map that clustering found them to be of."""

    point_world: Float[Tensor, "s 3"]
    """Of the piece without its journey's bias [m]."""
    journey: Int[Tensor, " s"]
    tracklet: Int[Tensor, " s"]
    """Of that journey."""
    lane: Int[Tensor, " s"]
    """-1 where the sample is of no lane of the map."""


def support_of_pieces(
    lanes: Lanes, lane_of_piece: Int[Tensor, " n"], spacing: float
) -> LaneSupport:
    """Samples of whole pieces at most `spacing` [m] apart, each piece being of one lane or none."""
    packed = lanes.select(torch.arange(len(lanes), device=lanes.journey.device))
    along = points_along(packed.control.point_world, packed.control_count, spacing)
    piece = along.spline
    return LaneSupport(
        along.point, lanes.journey[piece], lanes.tracklet[piece], lane_of_piece[piece]
    )


def lanes_table(
    curves: Curves,
    lanes: Lanes,
    samples: LaneSamples,
    matched: Match,
    *,
    offset_sigma: float,
    existence: float = 0.6,
) -> Lanes:
    """The curves as lanes of the map, with what is known of them.

    A control point's sigma is that of the mean of the journeys that saw the lane there: `offset_sigma` [m] and their
    scatter. Every journey more multiplies the doubt that a lane exists by `existence`.
    """
    n = len(curves)
    used = matched.curve >= 0
    seen, _, length = distinct_pairs(matched.curve[used], samples.line.owner[used])
    n_journeys = torch.bincount(seen[length >= 2], minlength=n)
    # Of each piece, the share that lies on the lane counts.
    lane, piece, part = distinct_pairs(matched.curve[used], samples.piece[used])
    whole = torch.bincount(samples.piece, minlength=len(lanes)).clamp_min(1)
    observations = group_sum(lanes.n_observations[piece] * part / whole[piece], lane, n)
    sigma = _control_sigma(curves, samples, matched, offset_sigma)
    none = torch.full_like(n_journeys, -1)
    return Lanes(
        type=curves.kind,
        control_start=spline_basis.starts(curves.count),
        control_count=curves.count,
        journey=none,
        tracklet=none,
        frame=none,
        n_journeys=n_journeys,
        n_observations=observations.round().long(),
        first_seen_ns=group_range(lanes.first_seen_ns[piece], lane, n)[0],
        last_seen_ns=group_range(lanes.last_seen_ns[piece], lane, n)[1],
        confidence=1 - existence ** n_journeys.to(sigma),
        control=ControlPoints(curves.control, sigma),
    )


def _control_sigma(
    curves: Curves, samples: LaneSamples, matched: Match, offset_sigma: float
) -> Float[Tensor, " c"]:
    """1-sigma of the mean of the journeys that saw each control point, from `offset_sigma` and their scatter [m]."""
    used = matched.curve >= 0
    curve, owner = matched.curve[used], samples.line.owner[used]
    owners = int(samples.line.owner.max()) + 1 if len(samples) else 1
    last = curves.count[curve] - 1
    t = matched.station[used] / curves.length[curve] * last
    knot = spline_basis.starts(curves.count)[curve] + torch.minimum(
        t.round().long().clamp_min(0), last
    )
    here, place = torch.unique(knot * owners + owner, return_inverse=True)
    number = torch.bincount(place, minlength=len(here)).clamp_min(1)
    mean = group_sum(matched.lateral[used], place, len(here)) / number
    there, controls = here // owners, len(curves.control)
    journeys = torch.bincount(there, minlength=controls).to(mean).clamp_min(1)
    scatter = group_sum(mean.square(), there, controls) / (journeys - 1).clamp_min(1)
    return ((offset_sigma**2 + scatter) / journeys).sqrt()
