"""What the corners of a detection have wrong together, for a while: a detector's box that trembles.

All corners of a detection are off to one side, and still are in the next frame: views of a sign in one drive are worth
fewer than there are. How much fewer shows in the misfits of successive detections of a sign, which noise of single corners
and of single poses does not join. In the solver detections err independently; what lasts is counted as so much variance
more as the mean of many successive ones has: its spectral density at low frequencies.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from crowdmap_torch.adjustment.observations import CornerObservations
from crowdmap_torch.clustering.groups import group_sum
from crowdmap_torch.optim.robust import median_scale
from crowdmap_torch.optim.shared_errors import SharedErrors

_MOST_LAGS = 30
"""Detections of a track that are this far apart are taken to err independently."""
_CLIP = 3.0
"""Standard deviations at which misfits are clipped before they are compared."""


@dataclass(frozen=True)
class CornerDetections:
    """The detections of corner rows, and which follow each other as views of a sign in one drive."""

    run: Int[Tensor, " m"]
    """Detection of each row, counted up by one along the rows."""
    rank: Int[Tensor, " m"]
    """Place of each row in its detection."""
    most: int
    """Rows of the detection that has most."""
    count: Float[Tensor, " d"]
    """Rows of each detection."""
    first: Int[Tensor, " d"]
    """Its first row."""
    follower: Int[Tensor, " d"]
    """The next detection of each one's sign in its journey; -1: there is none."""

    def have(self, counted: Bool[Tensor, " m"]) -> Bool[Tensor, " d"]:
        """The detections of which all rows are counted."""
        return self.mean(counted.double()[:, None])[:, 0] == 1

    def mean(self, residual: Float[Tensor, "m k"]) -> Float[Tensor, "d k"]:
        """What the rows of each detection have in common."""
        return group_sum(residual, self.run, len(self.count)) / self.count[:, None]


class KeptDetections:
    """The detections of corner rows, told apart anew where the rows are others."""

    def __init__(self) -> None:
        self._rows: Int[Tensor, " m"] | None = None
        self._found: CornerDetections | None = None

    def of(self, rows: CornerObservations) -> CornerDetections:
        """Those of `rows`."""
        if self._found is None or self._rows is not rows.detection:
            self._rows, self._found = rows.detection, corner_detections(rows)
        return self._found


def corner_detections(rows: CornerObservations) -> CornerDetections:
    """Those of corner rows, of which those of a detection are adjacent."""
    _, run, count = torch.unique_consecutive(
        rows.detection, return_inverse=True, return_counts=True
    )
    first = count.cumsum(0) - count
    rank = torch.arange(len(run), device=run.device) - first[run]
    # Frames are counted over all journeys: those of a sign's views in one journey lie between two others'. The centre of
    # a box is a detection beside that of its corners.
    kind, journey, sign = rows.detection[first] % 2, rows.journey[first], rows.sign[first]
    order = torch.argsort(rows.frame[first], stable=True)
    for key in (kind, sign):
        order = order[torch.argsort(key[order], stable=True)]
    before, after = order[:-1], order[1:]
    same = (kind[before] == kind[after]) & (sign[before] == sign[after])
    same &= journey[before] == journey[after]
    follower = torch.full_like(order, -1)
    follower[before] = torch.where(same, after, -1)
    most = int(count.max()) if len(count) else 0
    return CornerDetections(run, rank, most, count.to(rows.px), first, follower)


def shared_errors(
    detections: CornerDetections, sigma: Float[Tensor, " m"], lasting: Float[Tensor, ""]
) -> SharedErrors:
    """How corners with a noise of `sigma` [px] each weigh together where shifts of `lasting` variance [px^2] last."""
    of, count = detections.run, detections.count
    pattern = count.rsqrt()[of].expand(2, 1, -1).movedim(-1, 0)
    keep = (1 + count[of] * lasting / sigma.square()).rsqrt().expand(2, 1, -1).movedim(-1, 0)
    return SharedErrors(of, detections.rank, detections.most, pattern, keep)


def lasting_variance(
    detections: CornerDetections,
    residual: Float[Tensor, "m 2"],
    used: Bool[Tensor, " d"],
    of_each: Float[Tensor, ""],
) -> Float[Tensor, ""]:
    """Variance of the mean of many successive shifts, times their number [px^2], with that `of_each` alone.

    Of pixel errors; detections that are not `used` are left out. The sum of the covariances of detections ever further
    apart in their tracks, as long as they are positive (Geyer, Practical Markov Chain Monte Carlo, 1992).
    """
    shift = detections.mean(residual)
    if not bool(used.any()):
        return torch.zeros_like(of_each)
    bound = _CLIP * torch.stack([median_scale(x) for x in shift[used].unbind(1)])
    shift = torch.where(used[:, None], torch.minimum(torch.maximum(shift, -bound), bound), 0.0)
    total, goes_on = of_each, torch.ones_like(of_each)
    later = detections.follower
    for _ in range(_MOST_LAGS):
        pairs = (later >= 0) & used & used[later]
        together = (shift * shift[later] * pairs[:, None]).sum() / (2 * pairs.sum()).clamp_min(1)
        goes_on = goes_on * (together > 0)
        total = total + 2 * goes_on * together
        later = torch.where(later >= 0, detections.follower[later], -1)
    return total.clamp_min(0)
