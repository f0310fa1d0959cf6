"""What a map owes to each of its drives: by how much it would be another one without it.

Every drive's `JourneySystem` is what it alone says of the map where the adjustment ended. Left out of their sum, the step to
what is least then is the map without the drive, to the first order: scales, weights and matches stay as they are. Large
moves are no errors by themselves: where few drives passed each counts for much. One that moves signs by many of their
standard deviations contradicts the others, though nothing set it aside (Cook 1977).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.adjustment.bundle import Bundle
from crowdmap_torch.adjustment.convoys import Convoys
from crowdmap_torch.fleet.engine import Engine


@dataclass(frozen=True)
class Influence:
    """By journey what its leaving would do; NaN, or none, for those that had no say."""

    in_sigmas: Float[Tensor, " j"]
    """Root mean square move of the centres of signs that it and others saw, in their standard deviations along each axis."""
    farthest_m: Float[Tensor, " j"]
    """Of these the farthest move [m]."""
    farthest_sign: Int[Tensor, " j"]
    """The sign that moves so far; -1: it saw none that others saw too."""
    across_m: Float[Tensor, " j"]
    """Root mean square move across their lanes of what it and others saw of lanes [m]."""
    alone: Int[Tensor, " j"]
    """Signs that nobody else saw."""


@torch.no_grad()
def influence(
    bundle: Bundle, center_covariance: Float[Tensor, "n 3 3"], engine: Engine | None = None
) -> Influence:
    """That of every journey of an adjusted bundle, of whose signs the centres have these covariances [m^2].

    Each is a convoy of its own, wherever the engine has hosts; None: all in this process.
    """
    nodes = bundle.prior.nodes.journey
    heard = torch.unique(nodes).tolist()
    with Convoys(bundle, None, engine, [(n, n + 1) for n in heard]) as convoys:
        whole = convoys.systems()
    unknown = center_covariance.new_full((len(bundle.prior_scale),), torch.nan)
    none = nodes.new_zeros(len(unknown))
    found = Influence(unknown, unknown.clone(), none - 1, unknown.clone(), none)
    here, values = whole.step(), bundle.values()
    if here is None:
        return found
    seen_by = {
        name: _counts(nodes, [one.block[name] for one in whole.of_drives], len(values[name]))
        for name in ("sign", "lane")
    }
    whitened = torch.linalg.cholesky(center_covariance)
    for part, journey in enumerate(heard):
        own, there = whole.of_drives[part], whole.step(without=[part])
        sign, lane = (own.block[name] for name in ("sign", "lane"))
        found.alone[journey] = (seen_by["sign"][sign] == 1).sum()
        if there is None:
            continue
        sign, lane = sign[seen_by["sign"][sign] > 1], lane[seen_by["lane"][lane] > 1]
        if len(sign):
            move = (there["sign"] - here["sign"])[sign, :3]
            of_each = torch.linalg.solve_triangular(whitened[sign], move[..., None], upper=False)
            length = move.norm(dim=1)
            found.in_sigmas[journey] = of_each.square().mean().sqrt()
            found.farthest_m[journey], at = length.max(0)
            found.farthest_sign[journey] = sign[at]
        if len(lane):
            move = ((there["lane"] - here["lane"]) * bundle.lane_axes[:, :, 1])[lane].sum(1)
            found.across_m[journey] = move.square().mean().sqrt()
    return found


def _counts(like: Tensor, rows: list[Tensor], size: int) -> Int[Tensor, " n"]:
    return torch.bincount(torch.cat([like[:0], *rows]), minlength=size)
