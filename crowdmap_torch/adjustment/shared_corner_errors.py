"""What the corners of a detection have wrong together, for a while: a detector's box that trembles.

All corners of a detection are off to one side, or all away from their middle, and still are in the next frame: views of a
sign in one drive are worth fewer than there are. How much fewer shows in the misfits of successive detections of a sign,
which noise of single corners and of single poses does not join. In the solver detections err independently; what lasts is
counted as so much variance more as the mean of many successive ones has: its spectral density at low frequencies.
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

_SHIFT_LAGS, _SIZE_LAGS = 30, 90
"""Detections of a track that are this far apart are taken to be shifted, and too large, independently: what lasts longer of
a shift poses take up."""
_LEAST = 1e-30
"""Far below any weight or square of pixels."""
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


@dataclass(frozen=True)
class Lasting:
    """Variances of the means of many successive errors of detections, times their number."""

    shift: Float[Tensor, ""]
    """To one side, in u and in v each [px^2]."""
    size: Float[Tensor, ""]
    """Of their size, as shares of it."""


def shared_errors(
    detections: CornerDetections,
    px: Float[Tensor, "m 2"],
    sigma: Float[Tensor, " m"],
    lasting: Lasting,
) -> SharedErrors:
    """How corners at `px` with a noise of `sigma` [px] each weigh together where some of what they err by lasts."""
    of, count = detections.run, detections.count[:, None].expand(-1, 2)
    about, spread = _about_middle(detections, px)
    pattern = torch.stack((count.rsqrt()[of], about * spread.clamp_min(_LEAST).rsqrt()[of]), dim=-1)
    # Size counts in u and in v by itself, as if each erred on its own: together they then tell of it what one would.
    variance = torch.stack((count * lasting.shift, 2 * spread * lasting.size), dim=-1)
    keep = (1 + variance[of] / sigma.square()[:, None, None]).rsqrt()
    return SharedErrors(of, detections.rank, detections.most, pattern, keep)


def lasting_errors(
    detections: CornerDetections,
    rows: CornerObservations,
    residual: Float[Tensor, "m 2"],
    noise: Float[Tensor, " d"],
    used: Bool[Tensor, " d"],
    shift_of_each: Float[Tensor, ""],
) -> Lasting:
    """What lasts by the errors [px] of corners; detections that are not `used` are left out.

    `noise` is what corners' own makes of the mean of a detection, `shift_of_each` the variance of a single shift, both
    [px^2]: poses hide that. Of sizes nothing lasts where that is less than noise makes of the size of one detection: it is
    told no better, and costs time and memory.
    """
    size, usual = _size_errors(detections, rows, residual, detections.count * noise, used)
    shift = _Errors(detections.mean(residual), torch.ones_like(noise))
    follower = detections.follower
    of_size = size.lasting_variance(follower, used, _SIZE_LAGS)
    return Lasting(
        shift.lasting_variance(follower, used, _SHIFT_LAGS, shift_of_each),
        torch.where(of_size > usual, of_size, 0.0),
    )


@dataclass(frozen=True)
class _Errors:
    """What each detection has wrong as a whole, and how it counts."""

    error: Float[Tensor, "d k"]
    weight: Float[Tensor, " d"]

    def lasting_variance(
        self,
        follower: Int[Tensor, " d"],
        used: Bool[Tensor, " d"],
        lags: int,
        of_each: Float[Tensor, ""] | None = None,
    ) -> Float[Tensor, ""]:
        """Variance of the mean of many successive errors, times their number, with that `of_each` alone.

        None: that is the covariance of one with the next, as noise is no part of what lasts. The sum of the covariances of
        detections ever further apart in their tracks, as long as they are positive (Geyer, Practical Markov Chain Monte
        Carlo, 1992).
        """
        counted = used & (self.weight > 0)
        if not bool(counted.any()):
            return self.weight.new_zeros(())
        weight = torch.where(counted, self.weight, 0.0)
        error = weight[:, None] * self.error
        bound = _CLIP * torch.stack([median_scale(x) for x in error[counted].unbind(1)])
        error = torch.minimum(torch.maximum(error, -bound), bound)
        total, goes_on, later = of_each, weight.new_ones(()), follower
        for _ in range(lags):
            has = later >= 0
            pairs = (weight * weight[later] * has).sum()
            together = (error * error[later]).mean(1) * has
            together = together.sum() / pairs.clamp_min(_LEAST)
            total = together if total is None else total
            goes_on = goes_on * (together > 0)
            total = total + 2 * goes_on * together
            later = torch.where(has, follower[later], -1)
        assert total is not None
        return total.clamp_min(0)


def _size_errors(
    detections: CornerDetections,
    rows: CornerObservations,
    residual: Float[Tensor, "m 2"],
    noise: Float[Tensor, " d"],
    used: Bool[Tensor, " d"],
) -> tuple[_Errors, Float[Tensor, ""]]:
    """By what share the outline of every detection is too large, and the variance that its corners' `noise` [px^2] makes.

    Beside the mean of those of its sign in its drive: what is wrong all along, as signs that are larger or nearer than they
    are taken to be, or others that are taken for them, is no trembling.
    """
    about, spread = _about_middle(detections, rows.px)
    spread = spread.sum(1)
    has_size = spread > 0
    spread = torch.where(has_size, spread, 1.0)
    own, counts = noise / spread, has_size & used
    usual = own[counts].median() if bool(counts.any()) else own.sum()
    weight = torch.where(has_size, 1 / (own + usual).clamp_min(_LEAST), 0.0)
    of_corners = (about * residual).sum(1, keepdim=True)
    share = detections.count * detections.mean(of_corners)[:, 0] / spread
    first, say = detections.first, torch.where(used, weight, 0.0)
    both = torch.stack((rows.sign[first], rows.journey[first]), dim=1)
    _, track = torch.unique(both, dim=0, return_inverse=True)
    sums = group_sum(torch.stack((say * share, say), dim=1), track, int(track.max()) + 1)
    mean = sums[:, 0] / sums[:, 1].clamp_min(_LEAST)
    return _Errors((share - mean[track])[:, None], weight), usual


def _about_middle(
    detections: CornerDetections, px: Float[Tensor, "m 2"]
) -> tuple[Float[Tensor, "m 2"], Float[Tensor, "d 2"]]:
    """Corners from the middle of their detection [px], and the sum of squares over each."""
    about = px - detections.mean(px)[detections.run]
    return about, detections.count[:, None] * detections.mean(about.square())
