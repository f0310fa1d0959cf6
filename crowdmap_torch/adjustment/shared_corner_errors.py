"""What the corners of a detection have wrong together, for a while: a detector's box that trembles.

All corners of a detection are off to one side, or all away from their middle, and still are in the next frame: views of a
sign in one drive are worth fewer than there are. How much fewer shows in the misfits of successive detections of a sign,
which noise of single corners and of single poses does not join.

In the solver detections err independently. Each counts for so much as it does in the mean of its track, weighed by all
covariances: those in between say what the mean of many successive ones does, by the spectral density at low frequencies,
and the first and the last ones far more, as nothing beyond them errs alike. It is the last view of a sign, from near, that
tells most of where it is.
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
from crowdmap_torch.optim.tridiagonal import solve_tridiagonal

_SHIFT_LAGS, _SIZE_LAGS = 30, 90
"""Detections of a track that are this far apart are taken to be shifted, and too large, independently: what lasts longer of
a shift poses take up."""
_LONGER = 2**0.5
"""By this factor strides grow until they are half of the way."""
_RESTS = 0.2
"""The variance of a detection's shift that would change by less than this share is at rest."""
_SHARE_RESTS = 0.2
"""The share of poses' errors that is there is at rest where it changes by less than this: by as much of a small pull."""
_LEAST = 1e-30
"""Far below any weight or square of pixels."""
_LEAST_OF_MANY = 1 / (1 + 2 * _SHIFT_LAGS)
"""Share of the variance of many that a single one's is, at least: as if all whose covariances count erred alike."""
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
    frame: Int[Tensor, " d"]
    """Where its camera is."""
    order: Int[Tensor, " d"]
    """All detections, those of a track one after the other."""
    track: Int[Tensor, " d"]
    """Track of each detection, counted up by one along `order`: views of a sign in one drive."""
    follower: Int[Tensor, " d"]
    """The next detection of each one's track; -1: there is none."""

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
    track = torch.zeros_like(order)
    track[after] = (~same).cumsum(0)
    most = int(count.max()) if len(count) else 0
    return CornerDetections(
        run, rank, most, count.to(rows.px), first, rows.frame[first], order, track, follower
    )


@dataclass(frozen=True)
class Lasting:
    """What detections have wrong as a whole: shifts to one side, in u and in v each [px^2], and of size, as shares of it."""

    of_many: Float[Tensor, " 2"]
    """Variances of the means of many successive errors, times their number."""
    of_each: Float[Tensor, " 2"]
    """Variances of single errors; never more than those."""


@dataclass(frozen=True)
class Followed:
    """What detections have wrong together and what poses have, as far as that has been followed."""

    lasting: Lasting
    share: Float[Tensor, ""]
    """Share of the variances of poses' errors that is there; one before the first time."""
    stride: Float[Tensor, " 2"]
    """By which shares of their ways shifts and that share went the last time, with the signs of the ways; zero before."""

    def toward(
        self,
        found: Lasting,
        share: Float[Tensor, ""],
        noise: Float[Tensor, ""],
        sizes_are_told: Bool[Tensor, ""],
    ) -> tuple[Followed, Bool[Tensor, " 2"]]:
        """On the way to what was `found`, and whether what lasts and the `share` rest; sizes go all of it if they go.

        The first time the others do, then half of it; where they turn back half as far as the last time, and from there on
        ever further again: what they are found by follows them, and may jump. They rest where half of the way, or less if
        that is as far as they go, is little. `noise` is what corners' own makes of the mean of a detection [px^2].
        """
        little = torch.stack(
            (_RESTS * (found.of_many[0] + noise), torch.full_like(share, _SHARE_RESTS))
        )
        way = torch.stack((found.of_many[0] - self.lasting.of_many[0], share - self.share))
        turns = (way * self.stride < 0) & (way.abs() > little)
        far = torch.where(self.stride == 0, 0.5, self.stride.abs())
        far = torch.where(turns, far / 2, far)
        rest = 2 * far * way.abs() <= little
        far = torch.where(turns | rest, far, _LONGER * far).clamp_max(0.5)
        is_first = self.share == 1
        stride = torch.where(is_first, 0.0, far.copysign(way))
        far = torch.where(is_first, 1.0, far)
        before, change = self.lasting, (found.of_many - self.lasting.of_many).abs()
        goes = torch.stack(
            (torch.where(rest[0], 0.0, far[0]), torch.where(sizes_are_told, 0.0, 1.0).to(far))
        )
        lasting = Lasting(
            torch.lerp(before.of_many, found.of_many, goes),
            torch.lerp(before.of_each, found.of_each, goes),
        )
        lasting_rests = ((goes == 0) | (change == 0)).all()
        now = Followed(lasting, torch.lerp(self.share, share, far[1]), stride)
        return now, torch.stack((lasting_rests, rest[1]))


def shared_errors(
    detections: CornerDetections,
    px: Float[Tensor, "m 2"],
    sigma: Float[Tensor, " m"],
    lasting: Lasting,
    counted: Bool[Tensor, " m"],
) -> SharedErrors | None:
    """How corners at `px` with a noise of `sigma` [px] each weigh together where some of what they err by lasts.

    None: nothing does. Detections all of whose corners are `counted` alone have a say.
    """
    # One number from where they are.
    last = lasting.of_many > 0
    kinds = int(last[0] + 2 * last[1])
    if not kinds:
        return None
    shifts, sizes = bool(kinds & 1), bool(kinds & 2)
    patterns, known = [], []
    of, count = detections.run, detections.count[:, None]
    precision = 1 / detections.mean(sigma.square()[:, None])
    if shifts:
        patterns.append(count.rsqrt()[of].expand(-1, 2))
        known.append((count * precision).expand(-1, 2))
    if sizes:
        about, spread = _about_middle(detections, px)
        patterns.append(about * spread.clamp_min(_LEAST).rsqrt()[of])
        # Size counts in u and in v by itself, as if each erred on its own: together they then tell of it what one would.
        known.append(2 * spread * precision)
    of_kind = slice(0 if shifts else 1, 2 if sizes else 1)
    lasts = Lasting(lasting.of_many[of_kind], lasting.of_each[of_kind])
    say = detections.have(counted)
    kept = kept_in_tracks(detections, torch.stack(known, dim=-1), lasts, say)
    return SharedErrors(
        of, detections.rank, detections.most, torch.stack(patterns, dim=-1), kept.sqrt()[of]
    )


def kept_in_tracks(
    detections: CornerDetections,
    precision: Float[Tensor, "d n k"],
    lasting: Lasting,
    counted: Bool[Tensor, " d"],
) -> Float[Tensor, "d n k"]:
    """What is left of the `precision` of errors of k kinds, where they last as their `lasting` says.

    Errors of a track are a Gauss-Markov process with these two variances, by frames, beside white noise of that precision.
    Of a number that all of them show, with covariances R, the best estimate weighs them by R^-1 1: so does, each for itself,
    a share of their precision. It is never less than half of what is left among many others, nor more than if it was alone.
    """
    share = (lasting.of_each / lasting.of_many.clamp_min(_LEAST)).clamp(_LEAST_OF_MANY, 1.0)
    alone = share * lasting.of_many * precision
    least = 1 / (1 + lasting.of_many * precision)
    order = detections.order[counted[detections.order]]
    if not len(order):
        return least
    before, after = order[:-1], order[1:]
    track, frame = detections.track[after], detections.frame
    apart = (frame[after] - frame[before]).clamp_min(1)
    follows = (detections.track[before] == track) & (apart <= _SHIFT_LAGS)
    # What lasts is told from one detection to the next, however often a detector misses a sign.
    ones = torch.stack((follows * apart, follows.long()), dim=1).to(precision)
    usual = group_sum(ones, track, int(detections.track.max()) + 1)
    usual = (usual[:, 0] / usual[:, 1].clamp_min(1))[track]
    lasts = ((1 - share) / (1 + share)) ** (apart / usual.clamp_min(1))[:, None]
    lasts = torch.where(follows[:, None], lasts, 0.0)[:, None]
    # In the inverse of the process's correlations neighbours alone are joined.
    more, zero = lasts.square() / (1 - lasts.square()), lasts.new_zeros(1, 1, lasts.shape[-1])
    diagonal = 1 + torch.cat((zero, more)) + torch.cat((more, zero))
    beside = torch.cat((-lasts / (1 - lasts.square()), zero))
    _, length = detections.track[order].unique_consecutive(return_counts=True)
    own = alone[order]
    process = solve_tridiagonal(diagonal + own, beside.expand_as(own), own, int(length.max()))
    kept = least.clone()
    kept[order] = torch.maximum(least[order] / 2, torch.minimum(1 - process, 1 / (1 + own)))
    return kept


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
    of_shift = shift.lasting_variance(follower, used, _SHIFT_LAGS, shift_of_each)
    of_size = size.lasting_variance(follower, used, _SIZE_LAGS)
    of_size = torch.where(of_size[0] > usual, of_size, 0.0)
    return Lasting(*torch.stack((of_shift, of_size), dim=1).unbind())


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
    ) -> Float[Tensor, " 2"]:
        """Variance of the mean of many successive errors, times their number, with that `of_each` alone; and that.

        None: that is the covariance of one with the next, as noise is no part of what lasts. The sum of the covariances of
        detections ever further apart in their tracks, as long as they are positive (Geyer, Practical Markov Chain Monte
        Carlo, 1992).
        """
        counted = used & (self.weight > 0)
        if not bool(counted.any()):
            return self.weight.new_zeros(2)
        weight = torch.where(counted, self.weight, 0.0)
        error = weight[:, None] * self.error
        bound = _CLIP * torch.stack([median_scale(x) for x in error[counted].unbind(1)])
        error = torch.minimum(torch.maximum(error, -bound), bound)
        each = total = of_each
        goes_on, later = weight.new_ones(()), follower
        for _ in range(lags):
            has = later >= 0
            pairs = (weight * weight[later] * has).sum()
            together = (error * error[later]).mean(1) * has
            together = together.sum() / pairs.clamp_min(_LEAST)
            if each is None or total is None:
                each = total = together
            goes_on = goes_on * (together > 0)
            total = total + 2 * goes_on * together
            later = torch.where(has, follower[later], -1)
        assert each is not None and total is not None
        return torch.stack((total, each)).clamp_min(0)


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
    say, track = torch.where(used, weight, 0.0), detections.track
    sums = group_sum(torch.stack((say * share, say), dim=1), track, int(track.max()) + 1)
    mean = sums[:, 0] / sums[:, 1].clamp_min(_LEAST)
    return _Errors((share - mean[track])[:, None], weight), usual


def _about_middle(
    detections: CornerDetections, px: Float[Tensor, "m 2"]
) -> tuple[Float[Tensor, "m 2"], Float[Tensor, "d 2"]]:
    """Corners from the middle of their detection [px], and the sum of squares over each."""
    about = px - detections.mean(px)[detections.run]
    return about, detections.count[:, None] * detections.mean(about.square())
