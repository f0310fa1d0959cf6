"""Points on curves strung together: who follows whom, where curves begin, end, part and go on after a gap."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import sparse
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import KDTree
from torch import Tensor


@dataclass(frozen=True)
class Chains:
    """Points in order along curves; a point is in one chain at most."""

    node: Int[Tensor, " k"]
    """Row of the point."""
    chain: Int[Tensor, " k"]
    """0 .. count - 1, not decreasing."""
    count: int


@dataclass(frozen=True)
class LinkConfig:
    """Which points may follow each other."""

    reach: float = 4.5
    """Longest link [m]."""
    sideways: float = 0.15
    """A follower may lie this much beside the tangent [m], ..."""
    sideways_rate: float = 0.12
    """... and this much more per metre of distance."""
    max_angle_deg: float = 20.0
    """Between the directions of neighbours."""
    height_gate: float = 1.0
    """Steps in height are no road [m]."""
    sideways_cost: float = 4.0
    """A metre beside the tangent counts like this many metres ahead."""
    weak_cost: float = 6.0
    """How many metres farther a point must be for a weak point to be preferred."""


def link(
    point: Float[Tensor, "n 3"],
    direction: Float[Tensor, "n 2"],
    is_strong: Bool[Tensor, " n"],
    config: LinkConfig,
) -> Chains:
    """Chains of points that choose each other as the next one along their directions (axes).

    Where a curve splits, the trunk goes on into the branch that fits best and the other branch begins there.
    """
    n = len(point)
    flat = point[:, :2].detach().cpu().numpy()
    found = KDTree(flat).query_pairs(config.reach, output_type="ndarray")
    pair = torch.from_numpy(found.astype(np.int64)).to(point.device)
    pair = torch.cat((pair, pair.flip(1)))
    i, j = pair.T
    delta = point[j] - point[i]
    axis, other = direction[i], direction[j]
    a = (delta[:, :2] * axis).sum(1)
    b = (delta[:, :2] * other).sum(1)
    distance = delta[:, :2].norm(dim=1)
    limit = config.sideways + config.sideways_rate * distance
    beside = _cross(delta, axis).abs()
    beside_back = _cross(delta, other).abs()
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
    return _closed(_strings(joints, n), joints)


@dataclass(frozen=True)
class BridgeConfig:
    """Which ends of chains belong together across a gap."""

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


def bridge(
    chains: Chains,
    point: Float[Tensor, "n 3"],
    direction: Float[Tensor, "n 2"],
    witness: Float[Tensor, "w 3"],
    config: BridgeConfig,
) -> Chains:
    """Chains joined end to end where two ends choose each other across a gap.

    `witness` are all points where anybody saw a line: a gap with them all the way is one of support, not of the line.
    """
    ends, outward = end_points(chains, point, direction)
    count = 2 * chains.count
    flat = ends[:, :2].detach().cpu().numpy()
    found = KDTree(flat).query_pairs(config.max_gap_seen, output_type="ndarray")
    pair = torch.from_numpy(found.astype(np.int64)).to(point.device)
    # A chain shorter than its gap is no ring.
    size = torch.bincount(chains.chain, minlength=chains.count)
    i, j = pair.T
    may_close = (i // 2 != j // 2) | (size[i // 2] > 20)
    delta = ends[j] - ends[i]
    distance = delta[:, :2].norm(dim=1)
    way = delta[:, :2] / distance.clamp_min(1e-9)[:, None]
    # On an arc the way leaves one end as much to the left as it arrives from the left at the other.
    leave, arrive = _cross_2(outward[i], way), _cross_2(-outward[j], way)
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
    # Two chains that close a ring are strung together at one joint only.
    _, ring = torch.unique(_pair_key(joints // 2, count), return_inverse=True)
    first = torch.full_like(ring, len(ring)).scatter_reduce(
        0, ring, torch.arange(len(ring), device=ring.device), "amin"
    )
    strung = joints[first[first < len(ring)]]
    # A chain is a link between its own two ports: string chains as if they were points.
    strung = strung[strung[:, 0] // 2 != strung[:, 1] // 2]
    order = _strings(strung, chains.count)
    return _closed(_concatenated(chains, order, strung), joints, chains)


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
    chains: Chains, point: Float[Tensor, "n 3"], direction: Float[Tensor, "n 2"]
) -> tuple[Float[Tensor, "e 3"], Float[Tensor, "e 2"]]:
    """First and last points of each chain (rows `2 c`, `2 c + 1`) and the directions in which they leave it."""
    size = torch.bincount(chains.chain, minlength=chains.count)
    first = size.cumsum(0) - size
    last = first + size - 1
    ends = torch.stack((first, last), dim=1).flatten()
    inward = torch.stack((torch.minimum(first + 3, last), torch.maximum(last - 3, first)), dim=1)
    node, inner = chains.node[ends], chains.node[inward.flatten()]
    # The axes of the last few points, which way out is told by the points themselves.
    out = point[node, :2] - point[inner, :2]
    axes = [direction[n] * _sign(direction[n], out)[:, None] for n in (node, inner)]
    return point[node], torch.nn.functional.normalize(1.5 * axes[0] - 0.5 * axes[1], dim=1)


def keep_rows(chains: Chains, keep: Bool[Tensor, " k"]) -> Chains:
    """The rows in `keep`; rows left out cut their chain in two."""
    new = torch.zeros_like(keep)
    new[1:] = (chains.chain[1:] != chains.chain[:-1]) | (keep[1:] != keep[:-1])
    _, label = torch.unique_consecutive(new.long().cumsum(0)[keep], return_inverse=True)
    return Chains(chains.node[keep], label, int(label[-1]) + 1 if len(label) else 0)


def select(chains: Chains, keep: Bool[Tensor, " count"]) -> Chains:
    """Only the chains in `keep`, numbered anew."""
    number = keep.long().cumsum(0) - 1
    rows = keep[chains.chain]
    return Chains(chains.node[rows], number[chains.chain[rows]], int(keep.sum()))


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


def _strings(joints: Int[Tensor, "l 2"], n: int) -> Chains:
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
        return _strings(joints[torch.from_numpy(keep).to(joints.device)], n)
    # Hops from one end of each string order its points.
    is_end = np.flatnonzero(degree < 2)
    _, first = np.unique(component[is_end], return_index=True)
    hops = dijkstra(graph, directed=False, indices=is_end[first], unweighted=True, min_only=True)
    order = np.lexsort((hops, component))
    device = joints.device
    return Chains(
        torch.from_numpy(order.astype(np.int64)).to(device),
        torch.from_numpy(component[order].astype(np.int64)).to(device),
        int(component.max()) + 1 if n else 0,
    )


def _closed(chains: Chains, joints: Int[Tensor, "l 2"], parts: Chains | None = None) -> Chains:
    """The chains, rings among them with their first point once more at their end.

    A ring is a chain whose two ends are joined: the joint at which it was cut open. `parts` are the chains that
    `joints` speak of, if not single points.
    """
    if not len(chains.node):
        return chains
    if parts is not None:
        size = torch.bincount(parts.chain, minlength=parts.count)
        first = size.cumsum(0) - size
        end = torch.stack((first, first + size - 1), dim=1).flatten()
        node_port = parts.node[end[joints]]
    else:
        node_port = joints // 2
    size = torch.bincount(chains.chain, minlength=chains.count)
    first = size.cumsum(0) - size
    last = first + size - 1
    number = int(chains.node.max()) + 1
    ends = torch.stack((chains.node[first], chains.node[last]), dim=1)
    is_ring = torch.isin(_pair_key(ends, number), _pair_key(node_port, number)) & (size > 2)
    twice = torch.ones_like(chains.node)
    twice[last[is_ring]] = 2
    row = torch.repeat_interleave(twice)
    repeated = torch.zeros_like(row, dtype=torch.bool)
    repeated[1:] = row[1:] == row[:-1]
    chain_of = chains.chain[row]
    node = torch.where(repeated, chains.node[first[chain_of]], chains.node[row])
    return Chains(node, chain_of, chains.count)


def _sign(axis: Float[Tensor, "m 2"], way: Float[Tensor, "m 2"]) -> Float[Tensor, " m"]:
    return torch.where(axis[:, 0] * way[:, 0] + axis[:, 1] * way[:, 1] < 0, -1.0, 1.0).to(axis)


def _concatenated(chains: Chains, order: Chains, joints: Int[Tensor, "l 2"]) -> Chains:
    """The points of chains that `order` strings together, chains turned round where they must be."""
    # A chain is turned if it is entered through its last point, or, first of its string, left through its first.
    partner = torch.full((2 * chains.count,), -1, dtype=torch.int64, device=joints.device)
    partner[joints[:, 0]] = joints[:, 1]
    partner[joints[:, 1]] = joints[:, 0]
    string, member = order.chain, order.node
    previous = torch.full_like(member, -1)
    following = torch.full_like(member, -1)
    same = string[1:] == string[:-1]
    previous[1:][same] = member[:-1][same]
    following[:-1][same] = member[1:][same]
    enters_last = (previous >= 0) & (partner[2 * member + 1] // 2 == previous)
    enters_first = (previous >= 0) & (partner[2 * member] // 2 == previous)
    leaves_first = (following >= 0) & (partner[2 * member] // 2 == following)
    # Two chains joined at both ends: the joint kept by the string is as good as the other.
    turned = torch.where(previous >= 0, enters_last & ~enters_first, leaves_first)
    size = torch.bincount(chains.chain, minlength=chains.count)
    first = size.cumsum(0) - size
    length = size[member]
    row = torch.repeat_interleave(torch.arange(len(member), device=member.device), length)
    rank = torch.arange(len(row), device=row.device) - (length.cumsum(0) - length)[row]
    rank = torch.where(turned[row], length[row] - 1 - rank, rank)
    return Chains(chains.node[first[member[row]] + rank], string[row], order.count)


def _pair_key(pair: Int[Tensor, "m 2"], count: int) -> Int[Tensor, " m"]:
    return pair.amin(1) * count + pair.amax(1)


def _cross(delta: Float[Tensor, "m 3"], axis: Float[Tensor, "m 2"]) -> Float[Tensor, " m"]:
    return axis[:, 0] * delta[:, 1] - axis[:, 1] * delta[:, 0]


def _cross_2(a: Float[Tensor, "m 2"], b: Float[Tensor, "m 2"]) -> Float[Tensor, " m"]:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
