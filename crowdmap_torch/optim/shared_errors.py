"""Errors that adjacent rows of a term have in common, as the corners of one detection have: how they weigh together.

Rows of one run err by white noise, each for itself, and by some patterns together: all to one side, all away from their
middle. Along a pattern they say less than so many rows would; across it as much as ever.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor


@dataclass(frozen=True)
class SharedErrors:
    """Patterns of errors that the rows of a run share, and what of the rows' say is left along each.

    Whitened by it, the numbers r of a run are `r - sum_k (1 - keep_k) b_k (b_k . r)`: the inverse root of their covariance
    `1 + sum_k (1 / keep_k^2 - 1) b_k b_k^T`, in units of their white noise.
    """

    run: Int[Tensor, " m"]
    """The run of each row, counted up by one along the rows."""
    rank: Int[Tensor, " m"]
    """Place of each row in its run, from 0 on."""
    most: int
    """Rows of the longest run."""
    pattern: Float[Tensor, "m d k"]
    """By number of the residual, patterns b of that number alone: over a run they are of length one and at right angles."""
    keep: Float[Tensor, "m d k"]
    """Root of the share that white noise has of the variance along each pattern, the same for all rows of a run."""

    def of_rows(self, index: slice | Tensor) -> SharedErrors:
        """Those of some whole runs."""
        run = self.run[index]
        if isinstance(index, Tensor):
            _, run = torch.unique_consecutive(run, return_inverse=True)
        return replace(
            self, run=run, rank=self.rank[index], pattern=self.pattern[index], keep=self.keep[index]
        )

    def cut(self, start: int, stop: int) -> int:
        """Where a piece from `start`, where rows may be parted, may end: at most at `stop`, if any place is there."""
        return cut_between_runs(self.run, start, stop)

    def whiten(self, numbers: Float[Tensor, "d *k m"]) -> Float[Tensor, "d *k m"]:
        """Residuals, or their derivatives, as they count together; the rows are the last axis."""
        if not len(self.run):
            return numbers
        pattern, lost = self.pattern.movedim(0, -1), (1 - self.keep).movedim(0, -1)
        flat = numbers.flatten(1, -2) if numbers.ndim > 2 else numbers[:, None]
        whitened = flat.clone()
        for b, away in zip(pattern.unbind(1), lost.unbind(1), strict=True):
            along = self._over_run(flat * b[:, None])
            whitened.addcmul_((b * away)[:, None], along, value=-1)
        return whitened.view(numbers.shape)

    def _over_run(self, numbers: Float[Tensor, "d k m"]) -> Float[Tensor, "d k m"]:
        """Sums over runs, at every row."""
        total, reach = numbers, 1
        # From each row to the end of its run, by doubling; the first row then has the whole.
        while reach < min(self.most, len(self.run)):
            same = (self.run[reach:] == self.run[:-reach]).to(numbers)
            longer = total.clone()
            longer[..., :-reach].addcmul_(total[..., reach:], same)
            total, reach = longer, 2 * reach
        return total.index_select(
            -1, torch.arange(len(self.run), device=self.run.device) - self.rank
        )


def cut_between_runs(run: Int[Tensor, " m"], start: int, stop: int) -> int:
    """The last beginning of a run behind `start` and up to `stop`, or else the first behind that."""
    if stop >= len(run):
        return len(run)
    begins = int(torch.searchsorted(run, run[stop]))
    if begins > start:
        return begins
    return int(torch.searchsorted(run, run[stop], right=True))
