"""Points linked to polylines: who follows whom, where polylines begin, end, part and go on after a gap."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import sparse
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import KDTree
from torch import Tensor

from crowdmap_torch.clustering.neighbours import pairs_in_radius
from crowdmap_torch.crowd_lanes.line_samples import along_axis, left_of_axis
from crowdmap_torch.geometry import spline_basis
from crowdmap_torch.ranges import Cost, Degrees, Factor, Length, Settings


@dataclass(frozen=True)
class Polylines:
    """Points in order along lines; a point is in one polyline at most."""

    node: Int[Tensor, " k"]
    """Row of the point."""
    line: Int[Tensor, " k"]
    """0 .. count - 1, not decreasing."""
    count: int

    @property
    def size(self) -> Int[Tensor, " count"]:
        """Points of each polyline."""
        return torch.bincount(self.line, minlength=self.count)

    @property
    def ends(self) -> Int[Tensor, "count 2"]:
        """Rows of the first and the last point of each polyline."""
        behind = self.size.cumsum(0)
        return torch.stack((behind - self.size, behind - 1), dim=1)


@dataclass(frozen=True)
class LinkConfig(Settings):
    """Which points may follow each other."""

    reach: Length = 4.5
    """Longest link [m]."""
    sideways: Length = 0.15
    """A follower may lie this much beside the tangent [m], ..."""
    sideways_rate: Factor = 0.12
    """... and this much more per metre of distance."""
    max_angle_deg: Degrees = 20.0
    """Between the directions of neighbours."""
    height_gate: Length = 1.0
    """Steps in height are no road [m]."""
    sideways_cost: Factor = 4.0
    """A metre beside the tangent counts like this many metres ahead."""
    weak_cost: Cost = 6.0
    """How many metres farther a point must be for a weak point to be preferred."""


def link_points(
    point: Float[Tensor, "n 3"],
    direction: Float[Tensor, "n 2"],
    is_strong: Bool[Tensor, " n"],
    config: LinkConfig,
) -> Polylines:
    """Polylines of points that choose each other as the next one along their directions (axes).

    Where a line splits, the trunk goes on into the branch that fits best and the other branch begins there.
    """
    n = len(point)
    pair = pairs_in_radius(point[:, :2], config.reach)
    pair = torch.cat((pair, pair.flip(1)))
    i, j = pair.T
    delta = point[j] - point[i]
    axis, other = direction[i], direction[j]
    a, b = along_axis(delta, axis), along_axis(delta, other)
    distance = delta[:, :2].norm(dim=1)
    limit = config.sideways + config.sideways_rate * distance
    beside, beside_back = left_of_axis(delta, axis).abs(), left_of_axis(delta, other).abs()
    fits = (
        ((axis * other).sum(1).abs() > np.cos(np.radians(config.max_angle_deg)))
        & (beside < limit)
        & (beside_back < limit)
        & (delta[:, 2].abs() < config.height_gate)
        & (a.abs() > 0.5 * distance)
        & (b.abs() > 0.5 * distance)
    )
    cost = distance + config.sideways_cost * torch.maximum(beside, beside_back)
    cost = cost + config.weak_cost * (is_strong[i] != is_strong[j]).to(cost)
    # A port is a side of a point: 2 i ahead, 2 i + 1 behind.
    port, port_back = 2 * i + (a < 0).long(), 2 * j + (b > 0).long()
    joints = _mutual(port[fits], port_back[fits], cost[fits], 2 * n)
    return _closed(_strung(joints, n), joints)


@dataclass(frozen=True)
class BridgeConfig:
    """Which ends of polylines belong together across a gap."""

    max_gap: float = 10.0
    """Longest gap that is bridged on sight [m]."""
    max_gap_seen: float = 40.0
    """Longest gap that is bridged where somebody saw a line all the way [m]."""
    sideways: float = 0.35
    """Mismatch of the two ends against an arc [m], ..."""
    sideways_rate: float = 0.02
    """... and more per metre of gap."""
    max_angle_deg: float = 25.0
    """Between an end's direction and the way across."""
    height_gate: float = 1.0


def bridge_gaps(
    polylines: Polylines,
    point: Float[Tensor, "n 3"],
    direction: Float[Tensor, "n 2"],
    witness: Float[Tensor, "w 3"],
    config: BridgeConfig,
) -> Polylines:
    """Polylines joined end to end where two ends choose each other across a gap.

    `witness` are all points where anybody saw a line: a gap with them all the way is one of support, not of the line.
    """
    ends, outward = end_points(polylines, point, direction)
    count = 2 * polylines.count
    i, j = pairs_in_radius(ends[:, :2], config.max_gap_seen).T
    # A polyline shorter than its gap is no ring.
    may_close = (i // 2 != j // 2) | (polylines.size[i // 2] > 20)
    delta = ends[j] - ends[i]
    distance = delta[:, :2].norm(dim=1)
    way = delta[:, :2] / distance.clamp_min(1e-9)[:, None]
    # On an arc the way leaves one end as much to the left as it arrives from the left at the other.
    leave, arrive = left_of_axis(way, outward[i]), left_of_axis(way, -outward[j])
    cos_max = np.cos(np.radians(config.max_angle_deg))
    near = distance < 0.5  # ends that touch have no way to speak of
    facing = (outward[i] * outward[j]).sum(1) < -np.cos(np.radians(2 * config.max_angle_deg))
    aims = ((outward[i] * way).sum(1) > cos_max) & ((outward[j] * way).sum(1) < -cos_max)
    mismatch = 0.5 * (leave + arrive).abs() * distance
    fits = (
        may_close
        & facing
        & (aims | near)
        & (mismatch < config.sideways + config.sideways_rate * distance)
        & (delta[:, 2].abs() < config.height_gate + 0.1 * distance)
    )
    i, j, cost = i[fits], j[fits], (distance + 4 * mismatch)[fits]
    is_seen = _seen_all_along(ends, outward, i, j, witness)
    short = distance[fits] < config.max_gap
    i, j = i[short | is_seen], j[short | is_seen]
    cost = (cost - 20.0 * is_seen.to(cost))[short | is_seen]
    joints = _mutual(torch.cat((i, j)), torch.cat((j, i)), torch.cat((cost, cost)), count)
    # Two polylines that close a ring are strung together at one joint only.
    _, ring = torch.unique(_pair_key(joints // 2, count), return_inverse=True)
    first = torch.full_like(ring, len(ring)).scatter_reduce(
        0, ring, torch.arange(len(ring), device=ring.device), "amin"
    )
    strung = joints[first[first < len(ring)]]
    # A polyline links its own two ports: polylines are strung together as if they were points.
    strung = strung[strung[:, 0] // 2 != strung[:, 1] // 2]
    order = _strung(strung, polylines.count)
    return _closed(_concatenated(polylines, order, strung), joints, polylines)


def _seen_all_along(
    ends: Float[Tensor, "e 3"],
    outward: Float[Tensor, "e 2"],
    i: Int[Tensor, " m"],
    j: Int[Tensor, " m"],
    witness: Float[Tensor, "w 3"],
) -> Bool[Tensor, " m"]:
    """Whether a witness is within a metre of five places on the smooth way from end i to end j."""
    t = torch.linspace(0.1, 0.9, 5).to(ends)[:, None]
    a, b = ends[i, None], ends[j, None]
    length = (b - a)[..., :2].norm(dim=2, keepdim=True)
    # Cubic Hermite: it leaves both ends in their directions.
    way = (1 - t) ** 2 * (1 + 2 * t) * a[..., :2] + t**2 * (3 - 2 * t) * b[..., :2]
    way = way + length * (t * (1 - t) ** 2 * outward[i, None] + t**2 * (1 - t) * outward[j, None])
    height = a[..., 2] + t[:, 0] * (b - a)[..., 2]
    # A metre to the side, two in height.
    place = torch.cat((way, 0.5 * height[..., None]), dim=2).detach().cpu().numpy()
    squeezed = (witness * witness.new_tensor((1.0, 1.0, 0.5))).detach().cpu().numpy()
    distance, _ = KDTree(squeezed).query(place.reshape(-1, 3), distance_upper_bound=2.0)
    near = torch.from_numpy(distance < 1.2).to(i.device)
    return near.reshape(len(i), len(t)).all(1)


def end_points(
    polylines: Polylines, point: Float[Tensor, "n 3"], direction: Float[Tensor, "n 2"]
) -> tuple[Float[Tensor, "e 3"], Float[Tensor, "e 2"]]:
    """First and last points of each polyline (rows `2 c`, `2 c + 1`) and the directions in which they leave it."""
    first, last = polylines.ends.T
    ends = polylines.ends.flatten()
    inward = torch.stack((torch.minimum(first + 3, last), torch.maximum(last - 3, first)), dim=1)
    node, inner = polylines.node[ends], polylines.node[inward.flatten()]
    # The axes of the last few points, which way out is told by the points themselves.
    out = point[node, :2] - point[inner, :2]
    here, before = (
        torch.where(along_axis(out, axis)[:, None] < 0, -axis, axis)
        for axis in (direction[node], direction[inner])
    )
    return point[node], torch.nn.functional.normalize(1.5 * here - 0.5 * before, dim=1)


def keep_rows(polylines: Polylines, keep: Bool[Tensor, " k"]) -> Polylines:
    """The rows in `keep`; rows left out cut their polyline in two."""
    line = polylines.line
    new = torch.zeros_like(keep)
    new[1:] = (line[1:] != line[:-1]) | (keep[1:] != keep[:-1])
    _, label = torch.unique_consecutive(new.long().cumsum(0)[keep], return_inverse=True)
    return Polylines(polylines.node[keep], label, int(label[-1]) + 1 if len(label) else 0)


def select_polylines(polylines: Polylines, keep: Bool[Tensor, " count"]) -> Polylines:
    """Only the polylines in `keep`, numbered anew."""
    number = keep.long().cumsum(0) - 1
    rows = keep[polylines.line]
    return Polylines(polylines.node[rows], number[polylines.line[rows]], int(keep.sum()))


def _mutual(
    port: Int[Tensor, " m"], other: Int[Tensor, " m"], cost: Float[Tensor, " m"], ports: int
) -> Int[Tensor, "l 2"]:
    """Pairs of ports that are each other's cheapest; both directions of each pair are given."""
    order = np.lexsort((other.cpu().numpy(), cost.detach().cpu().numpy(), port.cpu().numpy()))
    order = torch.from_numpy(order).to(port.device)
    port, other = port[order], other[order]
    first = torch.ones_like(port, dtype=torch.bool)
    first[1:] = port[1:] != port[:-1]
    best = torch.full((ports,), -1, dtype=torch.int64, device=port.device)
    best[port[first]] = other[first]
    p = torch.arange(ports, device=port.device)
    chosen = (best >= 0) & (best[best.clamp_min(0)] == p) & (p < best)
    return torch.stack((p[chosen], best[chosen]), dim=1)


def _strung(joints: Int[Tensor, "l 2"], n: int) -> Polylines:
    """Points (ports 2 i and 2 i + 1) strung along their joints; a ring is cut open at its first joint."""
    a, b = (joints // 2).cpu().numpy().T
    graph = sparse.coo_matrix((np.ones(len(a)), (a, b)), shape=(n, n)).tocsr()
    _, component = connected_components(graph, directed=False)
    degree = np.bincount(np.concatenate((a, b)), minlength=n)
    size = np.bincount(component)
    ends = np.bincount(component, weights=degree < 2)
    ring = (ends == 0) & (size > 1)
    if ring.any():
        # One joint of each ring is dropped.
        of_joint = component[a]
        _, first = np.unique(of_joint, return_index=True)
        drop = first[ring[of_joint[first]]]
        keep = np.ones(len(a), dtype=bool)
        keep[drop] = False
        return _strung(joints[torch.from_numpy(keep).to(joints.device)], n)
    # Hops from one end of each polyline order its points.
    is_end = np.flatnonzero(degree < 2)
    _, first = np.unique(component[is_end], return_index=True)
    hops = dijkstra(graph, directed=False, indices=is_end[first], unweighted=True, min_only=True)
    order = np.lexsort((hops, component))
    device = joints.device
    return Polylines(
        torch.from_numpy(order.astype(np.int64)).to(device),
        torch.from_numpy(component[order].astype(np.int64)).to(device),
        int(component.max()) + 1 if n else 0,
    )


def _closed(
    polylines: Polylines, joints: Int[Tensor, "l 2"], parts: Polylines | None = None
) -> Polylines:
    """The polylines, rings among them with their first point once more at their end.

    A ring is a polyline whose two ends are joined: the joint at which it was cut open. `parts` are the polylines that
    `joints` speak of, if not single points.
    """
    if not len(polylines.node):
        return polylines
    node_port = joints // 2 if parts is None else parts.node[parts.ends.flatten()[joints]]
    first, last = polylines.ends.T
    number = int(polylines.node.max()) + 1
    ends = polylines.node[polylines.ends]
    is_ring = torch.isin(_pair_key(ends, number), _pair_key(node_port, number))
    is_ring &= polylines.size > 2
    twice = torch.ones_like(polylines.node)
    twice[last[is_ring]] = 2
    row = torch.repeat_interleave(twice)
    repeated = torch.zeros_like(row, dtype=torch.bool)
    repeated[1:] = row[1:] == row[:-1]
    line = polylines.line[row]
    node = torch.where(repeated, polylines.node[first[line]], polylines.node[row])
    return Polylines(node, line, polylines.count)


def _concatenated(polylines: Polylines, order: Polylines, joints: Int[Tensor, "l 2"]) -> Polylines:
    """The points of polylines that `order` strings together, each turned round where it must be."""
    # A polyline is turned if it is entered through its last point, or, first of all, left through its first.
    partner = torch.full((2 * polylines.count,), -1, dtype=torch.int64, device=joints.device)
    partner[joints[:, 0]] = joints[:, 1]
    partner[joints[:, 1]] = joints[:, 0]
    string, member = order.line, order.node
    previous = torch.full_like(member, -1)
    following = torch.full_like(member, -1)
    same = string[1:] == string[:-1]
    previous[1:][same] = member[:-1][same]
    following[:-1][same] = member[1:][same]
    enters_last = (previous >= 0) & (partner[2 * member + 1] // 2 == previous)
    enters_first = (previous >= 0) & (partner[2 * member] // 2 == previous)
    leaves_first = (following >= 0) & (partner[2 * member] // 2 == following)
    # Two polylines joined at both ends: the joint kept is as good as the other.
    turned = torch.where(previous >= 0, enters_last & ~enters_first, leaves_first)
    length = polylines.size[member]
    row, rank = spline_basis.rows(length)
    rank = torch.where(turned[row], length[row] - 1 - rank, rank)
    first = polylines.ends[member[row], 0]
    return Polylines(polylines.node[first + rank], string[row], order.count)


def _pair_key(pair: Int[Tensor, "m 2"], count: int) -> Int[Tensor, " m"]:
    return pair.amin(1) * count + pair.amax(1)
