"""Which vertex of one outline is which of another: costs of all pairs of vertices, and cyclic orders (IV-A)."""

from __future__ import annotations

from itertools import combinations
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor


def vertex_costs(
    F_ab: Float[Tensor, "b 3 3"],
    p_a: Float[Tensor, "b n 2"],
    q_b: Float[Tensor, "b m 2"],
    *,
    components: Literal[2, 3] = 2,
) -> Float[Tensor, "b n m"]:
    """`epipolar.epipolar_cost` of every point of one view with every point of the other (IV-A).

    The epipolar lines are computed once for each point, not once for each pair.
    """
    p, q = (torch.nn.functional.pad(points, (0, 1), value=1.0) for points in (p_a, q_b))
    lines_a = q @ F_ab.mT
    lines_b = p @ F_ab
    value = p @ lines_a.mT
    norms_a, norms_b = (_sum_of_squares(lines, components) for lines in (lines_a, lines_b))
    norms = norms_a[:, None, :] + norms_b[:, :, None]
    return value.square() / norms.clamp_min(torch.finfo(norms.dtype).tiny)


def _sum_of_squares(vector: Float[Tensor, "b n 3"], components: int) -> Float[Tensor, "b n"]:
    """Of the first components, one by one: a reduction along so few takes three times as long."""
    x, y, z = vector.unbind(-1)
    total = x.square() + y.square()
    return total if components == 2 else total + z.square()


def rotation_compensated(
    R_a_b: Float[Tensor, "b 3 3"], p_a: Float[Tensor, "b n 2"], q_b: Float[Tensor, "b m 2"]
) -> Float[Tensor, "b n m"]:
    """Squared distances on z = 1 of every point of one view and every point of the other turned into its frame.

    Where the baseline is short this is what is left of the epipolar constraint. A point of b that the rotation takes
    behind a is infinitely far.
    """
    turned = torch.nn.functional.pad(q_b, (0, 1), value=1.0) @ R_a_b.mT
    in_front = turned[..., 2] > 1e-6
    depth = torch.where(in_front, turned[..., 2], torch.ones_like(turned[..., 2]))
    x, y = (p_a[:, :, None, k] - (turned[..., k] / depth)[:, None, :] for k in (0, 1))
    distance_sq = x.square() + y.square()
    return torch.where(in_front[:, None, :], distance_sq, torch.inf)


def cyclic_sums(cost: Float[Tensor, "b c c"]) -> Float[Tensor, "b c"]:
    """For every shift s the sum over k of `cost[k, (k + s) % c]`: the admissible assignments of clockwise polygons."""
    c = cost.shape[-1]
    k = torch.arange(c, device=cost.device)
    column = (k[None] + k[:, None]) % c
    return cost[:, k[None], column].sum(-1)


def free_assignment(cost: Float[Tensor, "b c c"]) -> Float[Tensor, " b"]:
    """The least sum over all assignments of vertices, the paper's inner bipartite matching (IV-A).

    By sets of columns, all matrices at once: the best way to give the first k rows a set of k of them is the best over
    who has the last.
    """
    c = cost.shape[-1]
    by_pair = cost.permute(1, 2, 0).contiguous()
    best = cost.new_zeros(1 << c, len(cost))
    for row in range(c):
        members = torch.tensor(list(combinations(range(c), row + 1)), device=cost.device)
        bit = 1 << members
        taken = bit.sum(-1)
        total = best[taken - bit[:, 0]] + by_pair[row, members[:, 0]]
        for k in range(1, row + 1):
            total = torch.minimum(total, best[taken - bit[:, k]] + by_pair[row, members[:, k]])
        best[taken] = total
    return best[-1]


def clearest_order(
    outline: Float[Tensor, "b 8 2"],
    reference: Float[Tensor, "b 8 2"],
    corner_count: Int[Tensor, " b"],
) -> tuple[Int[Tensor, " b"], Float[Tensor, " b"], Float[Tensor, " b"]]:
    """The shift s for which corner k of `reference` is nearest to corner `(k + s) % C` of `outline`, and two costs.

    The costs are sums of squared distances, of the best and of the second best shift: how clear the choice is.
    """
    k = torch.arange(outline.shape[-2], device=outline.device)
    C = corner_count[:, None, None]
    column = (k[None, None, :] + k[None, :, None]) % C
    shifted = torch.gather(
        outline[:, None].expand(-1, len(k), -1, -1), 2, column[..., None].expand(-1, -1, -1, 2)
    )
    distance_sq = (shifted - reference[:, None]).square().sum(-1)
    cost = (distance_sq * (k < C)).sum(-1)
    cost = torch.where(k < corner_count[:, None], cost, torch.inf)
    lowest, order = cost.topk(2, largest=False)
    return order[:, 0], lowest[:, 0], lowest[:, 1]
