"""What detections say beside what everything else foresees of them: the test that leverage does not fool.

A detection that no other confirms draws its frame's pose to itself, and then its residual says nothing. Its innovation
does: the residual as it would be had it not been made, measured by its own covariance, which that of the pose is a part
of.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from scipy.special import chdtri
from torch import Tensor

from crowdmap_torch.optim.linearize import CHUNK_ROWS, at_once, first_blocks
from crowdmap_torch.optim.problem import CostTerm, Values, Variable
from crowdmap_torch.optim.robust import JointTukey, Quadratic
from crowdmap_torch.processes.sums import add_at


@dataclass(frozen=True)
class Innovations:
    """Of every detection."""

    squared: Float[Tensor, " n"]
    """Normalised by its covariance (NIS; Bar-Shalom, Li and Kirubarajan 2001, 5.4): at normal noise chi-squared."""
    freedom: Int[Tensor, " n"]
    """Numbers that the detection consists of."""
    weight: Float[Tensor, " n"]
    """The robust weight that it has."""

    def are_too_large(self, probability: float) -> Bool[Tensor, " n"]:
        """True where normal noise passes the innovation with less than this probability.

        The noise is scaled to what the detections that have a say show in their median, where that is more than it should.
        """
        kinds = self.freedom.unique()
        median, bound = self.squared.new_zeros(2, int(kinds.max()) + 1 if len(kinds) else 1)
        median[kinds] = median.new_tensor(chdtri(kinds.cpu().numpy(), 0.5))
        bound[kinds] = bound.new_tensor(chdtri(kinds.cpu().numpy(), probability))
        usual = (self.squared / median[self.freedom])[self.weight > 0]
        scale = usual.median().clamp_min(1.0) if len(usual) else median.new_tensor(1.0)
        return self.squared > scale * bound[self.freedom]


def innovations(
    term: CostTerm,
    variables: dict[str, Variable],
    values: Values,
    covariance: Float[Tensor, "p k k"],
) -> Innovations:
    """The innovations of the detections of a term whose loss is theirs as a whole.

    `values` are the minimum, and `covariance` is there that of the blocks of the term's first slot, of which the rows of
    a detection touch one and the same, with all else known.
    """
    loss = term.loss
    assert isinstance(loss, JointTukey)
    run = loss.run
    count = torch.bincount(run)
    n = len(count)
    plain = replace(term, loss=Quadratic())
    s, gradient, matrix = first_blocks(plain, variables, values, run, n)
    square = add_at(s.new_zeros(n), 0, run, s)
    first = count.cumsum(0) - count
    weight, block = loss.weight(s)[first], term.slots[0][1][first]
    gradient = gradient[..., None]

    def normalised(at: Int[Tensor, " m"]) -> Float[Tensor, " m"]:
        counted, of_rows, pull = weight[at, None, None], matrix[at], gradient[at]
        # Without its rows the block moves along them, and the residual with it. A block without a covariance has no
        # innovation either, and nothing is held against it.
        without = torch.linalg.inv_ex(covariance[block[at]]).inverse - counted * of_rows
        step = torch.linalg.solve_ex(without, counted * pull).result
        change = of_rows @ step
        moved = square[at] + (step * (2 * pull + change))[..., 0].sum(-1)
        pull = pull + change
        # The residual's covariance is one and what the block adds; its inverse by Woodbury's identity.
        own = (pull * torch.linalg.solve_ex(without + of_rows, pull).result)[..., 0].sum(-1)
        return moved - own

    # All at once would take as much memory as the rows themselves.
    some = torch.arange(n, device=run.device).split(at_once(CHUNK_ROWS, run.device))
    found = torch.cat([square[:0], *map(normalised, some)])
    return Innovations(found, loss.row_dim * count, weight)
