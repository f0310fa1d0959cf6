"""The vector on which most members of a group agree, for many groups at once."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

_ELEMENTS = 1 << 22
"""Pairs of votes compared at once."""


@dataclass(frozen=True)
class Consensus:
    """The densest place among the votes of each group."""

    vector: Float[Tensor, "g d"]
    """Zero for a group without votes."""
    support: Float[Tensor, " g"]
    """Votes that agree with it, by weight."""
    runner_up: Float[Tensor, " g"]
    """Support of the best place at least three widths away."""


def densest(
    vote: Float[Tensor, "m d"],
    weight: Float[Tensor, " m"],
    prior: Float[Tensor, " m"],
    group: Int[Tensor, " m"],
    *,
    groups: int,
    width: float,
) -> Consensus:
    """Where the votes of each group are densest under a Gaussian kernel of standard deviation `width`.

    `prior` [votes] is added to the support of a place when places compete: its logarithmic prior probability. The best
    vote is polished to the local mean by three mean-shift steps.
    """
    d = vote.shape[1]
    vector = vote.new_zeros(groups, d)
    support, runner_up = vote.new_zeros(groups), vote.new_zeros(groups)
    order = group.argsort(stable=True)
    size = torch.bincount(group, minlength=groups)
    start = size.cumsum(0) - size
    by_size = size.argsort(stable=True)
    by_size = by_size[size[by_size] > 0]
    done = 0
    while done < len(by_size):
        # Groups of about equal size share a padded batch.
        limit = int(size[by_size[done]]) * 5 // 4 + 8
        chunk = by_size[done : done + max(1, _ELEMENTS // limit**2)]
        chunk = chunk[size[chunk] <= limit]
        done += len(chunk)
        place = torch.arange(int(size[chunk].max()), device=vote.device)
        valid = place < size[chunk, None]
        rows = order[(start[chunk, None] + place).clamp_max(len(order) - 1)]
        v = vote[rows]
        w = weight[rows] * valid
        squared = (v[:, :, None] - v[:, None]).square().sum(-1)
        density = (w[:, None] * torch.exp(-0.5 * squared / width**2)).sum(-1)
        score = (density + prior[rows]).masked_fill(~valid, -torch.inf)
        best = score.argmax(-1)
        batch = torch.arange(len(chunk), device=vote.device)
        far = squared[batch, best].sqrt() > 3 * width
        second = score.masked_fill(~far, -torch.inf)
        where = second.argmax(-1)
        has_second = second[batch, where].isfinite()
        centre = v[batch, best]
        for _ in range(3):
            near = w * torch.exp(-0.5 * (v - centre[:, None]).square().sum(-1) / width**2)
            centre = (near[..., None] * v).sum(1) / near.sum(1, keepdim=True).clamp_min(1e-12)
        vector[chunk] = centre
        support[chunk] = density[batch, best]
        runner_up[chunk] = torch.where(has_second, density[batch, where], 0.0)
    return Consensus(vector=vector, support=support, runner_up=runner_up)
