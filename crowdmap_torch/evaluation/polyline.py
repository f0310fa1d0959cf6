"""Lines as flat tables of points: samples by arc length, crossings of normal planes."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.clustering.groups import group_argmin
from crowdmap_torch.clustering.neighbours import pairs_between
from crowdmap_torch.geometry import spline_basis
from crowdmap_torch.processes.sums import running_sum
from crowdmap_torch.tables import Lanes, Rows

_TOUCH_M = 1e-3
"""A line that ends this far before a normal plane still reaches it: two pieces that meet leave no
gap."""


@dataclass(frozen=True)
class Samples(Rows):
    """Points along lines, those of one line adjacent and in order."""

    line: Int[Tensor, " p"]
    point_world: Float[Tensor, "p 3"]
    along: Float[Tensor, "p 2"]
    """Horizontal unit direction of the line there; zero where it runs straight up."""
    sigma: Float[Tensor, " p"]
    """1-sigma of the lateral position [m]; NaN where unknown."""


@dataclass(frozen=True)
class Crossings(Rows):
    """Where lines pass through the vertical normal planes of points."""

    point: Int[Tensor, " c"]
    """Row of the sampled point, not decreasing."""
    line: Int[Tensor, " c"]
    """The line that passes; one row for each line and point, the nearest of its passages."""
    lateral: Float[Tensor, " c"]
    """Signed distance along the point's horizontal normal, positive to the left of its line [m]."""
    vertical: Float[Tensor, " c"]
    """Height above the point [m]."""
    sigma: Float[Tensor, " c"]


def sample_polylines(
    line: Int[Tensor, " p"],
    point_world: Float[Tensor, "p 3"],
    step_m: float,
    sigma: Float[Tensor, " p"] | None = None,
) -> Samples:
    """Points every `step_m` along each line from its first point on, and its last point.

    Lines with a single point have no length and no samples.
    """
    sigma = torch.full_like(point_world[:, 0], torch.nan) if sigma is None else sigma
    same = line[1:] == line[:-1]
    step = point_world[1:] - point_world[:-1]
    length = torch.where(same, step.norm(dim=-1), 0.0)
    # Repeated points have no direction and would be divided by below.
    keep = torch.cat((torch.ones_like(same[:1]), ~same | (length > 1e-9)))[: len(line)]
    if not bool(keep.all()):
        return sample_polylines(line[keep], point_world[keep], step_m, sigma[keep])
    if len(line) == 0:
        return Samples(line, point_world, point_world[:, :2], sigma)
    lines, count = torch.unique_consecutive(line, return_counts=True)
    last = count.cumsum(0) - 1
    first = last - count + 1
    # One arc length through all lines, standing still between one line's end and the next one's
    # start.
    s = torch.cat((length.new_zeros(1), running_sum(length)))
    total = s[last] - s[first]
    inner = (total / step_m * (1 - 1e-12)).floor().long() + 1
    number = torch.where(total > 0, inner + 1, 0)
    owner = torch.repeat_interleave(torch.arange(len(lines), device=line.device), number)
    rank = torch.arange(len(owner), device=line.device) - (number.cumsum(0) - number)[owner]
    position = torch.where(rank < inner[owner], rank * step_m, total[owner])
    segment = torch.searchsorted(s, s[first[owner]] + position, right=True) - 1
    segment = torch.minimum(torch.maximum(segment, first[owner]), last[owner] - 1)
    fraction = (s[first[owner]] + position - s[segment]) / length[segment]
    fraction = fraction.clamp(0, 1)
    direction = torch.nn.functional.normalize(step[segment, :2], dim=-1)
    return Samples(
        line=lines[owner],
        point_world=torch.lerp(
            point_world[segment], point_world[segment + 1], fraction[:, None].expand(-1, 3)
        ),
        along=direction,
        sigma=torch.lerp(sigma[segment], sigma[segment + 1], fraction),
    )


def lane_samples(lanes: Lanes, step_m: float) -> Samples:
    """Points every `step_m` along the splines of lane pieces, sigma interpolated."""
    packed = lanes.select(torch.arange(len(lanes), device=lanes.control_count.device))
    count, start = packed.control_count, packed.control_start
    control, sigma = packed.control.point_world, packed.control.sigma
    # Every interval between two control points is cut into chords of half a step.
    edge = (control[1:] - control[:-1]).norm(dim=-1)
    inside = torch.ones_like(control[:, 0]).long()
    inside[:-1] = (2 * edge / step_m).ceil().long().clamp(4, 256)
    last = start + count - 1
    inside[last] = 1
    row = torch.repeat_interleave(torch.arange(len(control), device=count.device), inside)
    rank = torch.arange(len(row), device=count.device) - (inside.cumsum(0) - inside)[row]
    fraction = rank.to(control) / inside[row]
    piece = packed.piece_of_control[row]
    t = (row - start[piece]).to(control) + fraction
    point = spline_basis.evaluate_flat(control, count, t, piece)
    following = torch.minimum(row + 1, last[piece])
    return sample_polylines(
        piece, point, step_m, torch.lerp(sigma[row], sigma[following], fraction)
    )


def crossings(
    at: Samples,
    lines: Samples,
    *,
    lateral_m: float,
    vertical_m: float,
    offset_m: Tensor | None = None,
) -> Crossings:
    """Where `lines` pass within a lateral and a vertical gate of points.

    A line passes where it crosses the vertical plane through a point and its horizontal normal.
    With `offset_m` (one number for each point, positive to the left) the gate is around the
    place that far beside the point.
    """
    offset = torch.zeros_like(at.point_world[:, 0]) if offset_m is None else offset_m
    left = torch.stack((-at.along[:, 1], at.along[:, 0]), dim=-1)
    centre = at.point_world[:, :2] + offset[:, None] * left
    joined = lines.line[1:] == lines.line[:-1]
    start = joined.nonzero()[:, 0]
    a, b = lines.point_world[start], lines.point_world[start + 1]
    half = float((b - a)[:, :2].norm(dim=-1).max()) / 2 if len(start) else 0.0
    radius = (lateral_m**2 + (half + _TOUCH_M) ** 2) ** 0.5
    point, segment, _ = pairs_between(centre, (a + b)[:, :2] / 2, radius=radius)
    from_a, from_b = (p[segment] - at.point_world[point] for p in (a, b))
    ahead_a, ahead_b = ((v[:, :2] * at.along[point]).sum(-1) for v in (from_a, from_b))
    span = ahead_b - ahead_a
    passes = (torch.minimum(ahead_a, ahead_b) <= _TOUCH_M) & (
        torch.maximum(ahead_a, ahead_b) >= -_TOUCH_M
    )
    # A segment inside the normal plane has no single crossing; its start stands for it.
    flat = span.abs() < 1e-12
    fraction = torch.where(flat, 0.0, -ahead_a / torch.where(flat, 1.0, span)).clamp(0, 1)
    at_crossing = torch.lerp(from_a, from_b, fraction[:, None].expand(-1, 3))
    lateral = (at_crossing[:, :2] * left[point]).sum(-1)
    vertical = at_crossing[:, 2]
    within = passes & ((lateral - offset[point]).abs() <= lateral_m)
    within &= (vertical.abs() <= vertical_m) & (at.along[point].norm(dim=-1) > 0.5)
    index = start[segment]
    sigma = torch.lerp(lines.sigma[index], lines.sigma[index + 1], fraction)
    found = Crossings(point, lines.line[index], lateral, vertical, sigma)[within]
    return _nearest_of_each_line(found, offset)


def nearest(found: Crossings, offset_m: Tensor | None = None) -> Crossings:
    """Of the crossings of each point the one with the smallest lateral distance (to the offset)."""
    distance = found.lateral if offset_m is None else found.lateral - offset_m[found.point]
    _, group = found.point.unique(return_inverse=True)
    return found[group_argmin(distance.abs(), group)]


def _nearest_of_each_line(found: Crossings, offset: Tensor) -> Crossings:
    lines = int(found.line.max()) + 1 if len(found.line) else 1
    _, group = (found.point * lines + found.line).unique(return_inverse=True)
    return found[group_argmin((found.lateral - offset[found.point]).abs(), group)]
