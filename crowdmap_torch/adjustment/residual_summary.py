"""What residuals look like term by term, in summaries that are made where the drives are: for those who watch."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from crowdmap_torch.adjustment.bundle import Bundle
from crowdmap_torch.optim.linearize import residuals

_MOST_ROWS = 1 << 17
"""Rows of a term that one summary shows."""


@dataclass(frozen=True)
class TermSummary:
    """The residuals of one term, in units of their sigmas."""

    cost: float
    """Of all rows."""
    rows: int
    down_weighted: int
    """How many have less than half of their weight."""
    squared: Float[Tensor, " k"]
    """Squared length of evenly many of the rows."""
    weight: Float[Tensor, " k"]
    """What the loss leaves them."""

    @property
    def down_weighted_share(self) -> float:
        """Of all rows."""
        return self.down_weighted / max(self.rows, 1)


@torch.no_grad()
def residual_summary(bundle: Bundle) -> dict[str, TermSummary]:
    """Of every term of a bundle where it is, in its scales."""
    problem, values = bundle.problem(), bundle.values()
    found = {}
    for name, term in problem.terms.items():
        squared = residuals(term, values).square().sum(-1)
        weight = term.loss.weight(squared)
        every = slice(None, None, max(-(-len(squared) // _MOST_ROWS), 1))
        found[name] = TermSummary(
            float(term.loss.rho(squared).sum() / 2),
            *(len(squared), int((weight < 0.5).sum())),
            *(squared[every].clone(), weight[every].clone()),
        )
    return found


def joined(parts: Iterable[dict[str, TermSummary]]) -> dict[str, TermSummary]:
    """Of all that the parts are of."""
    by_term: dict[str, list[TermSummary]] = {}
    for part in parts:
        for name, one in part.items():
            by_term.setdefault(name, []).append(one)
    return {
        name: TermSummary(
            sum(one.cost for one in every),
            sum(one.rows for one in every),
            sum(one.down_weighted for one in every),
            torch.cat([one.squared for one in every]),
            torch.cat([one.weight for one in every]),
        )
        for name, every in by_term.items()
    }
