"""Drives that no sign ties to others for certain, placed by the lane markers that both have seen (V-A.2, V-B).

Whoever drives the other way sees other signs. The biases of two such groups of drives are known among themselves alone,
and between them a metre or more may be left, which is another marker's place. One marker cannot tell; the whole pattern of
a road's markers can, and where roads turn it tells both axes. A sample of one group, moved by a shift, speaks against it
where the other drives would have seen it and saw no parallel marker there; what lies farther beside their ways than they
see says nothing, as whoever drives the other way may see one marker of three. Along a straight road every shift is as
likely, and the prior decides. A road over another one, further up than biases reach, has nothing to do with it. What signs
tie loosely is placed by both: where markers fit and signs like its own are.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from crowdmap_torch.clustering.neighbours import cross_pairs, pairs_between
from crowdmap_torch.crowd_lanes.line_samples import (
    MAX_ANGLE_COS,
    LineSamples,
    along_axis,
    left_of_axis,
)
from crowdmap_torch.crowd_lanes.samples import sample_lanes
from crowdmap_torch.crowd_lanes.shift_prior import ShiftPrior
from crowdmap_torch.crowd_signs.groups import OtherPlaces
from crowdmap_torch.geometry.trajectory import station
from crowdmap_torch.noise.positioning import PositioningNoise
from crowdmap_torch.optim.robust import median_along
from crowdmap_torch.ranges import Count, Deviations, Factor, Length, Settings, Share, Spacing
from crowdmap_torch.tables import Lanes


@dataclass(frozen=True)
class GroupTieConfig(Settings):
    """How groups of drives that no sign ties are placed beside each other."""

    sample_spacing_m: Spacing = 4.0
    """Pieces are sampled this densely."""
    few_observations: Factor = 10.0
    """Pieces made from fewer detections (or a quarter of the usual number, if that is less) are hardly believed."""
    most_samples: Count = 400
    """Most samples of a group that are looked at."""
    most_drives: Count = 4
    """Most drives of a group that are looked at: those that saw the most, there."""
    noise_m: Length = 0.3
    """1-sigma of what a marker's places in two groups are apart, their shift and the drift of both taken off."""
    missed: Share = 0.1
    """Likelihood of a sample that no marker of the other group is near, relative to one that is met."""
    alike_m: Length = 150.0
    """Way of marker that errs alike, as drift does: its samples together count as one."""
    reach: Deviations = 4.0
    """Shifts up to this many of their standard deviations are tried along each axis, or ..."""
    reach_m: Length = 4.0
    """... up to this, if that is more: how large biases are is known by few drives. What is further up or down is another
    road."""
    step_m: Spacing = 0.4
    """Between shifts that are tried."""
    least_m: Length = 0.5
    """Smaller shifts are left to the adjustment, which finds the way by itself."""
    surer: Factor = 3.0
    """A shift counts that is likelier than none by more than this in the logarithm."""
    rival_m: Length = 1.0
    """Another one this far away that is as likely, but for `surer`, leaves it open which is right."""
    sign_noise_m: Length = 0.5
    """1-sigma of what is between a sign of a drive that signs tie loosely and another one that it may be."""
    sign_missed: Share = 0.02
    """Likelihood of a sign that none like it is near, relative to one that is met."""


@dataclass(frozen=True)
class GroupTies:
    """How groups of drives lie beside each other."""

    move: Float[Tensor, "j 3"]
    """By journey, what is to be added to its places [m]; weighted by what is known of biases, it is zero in the mean."""
    group: Int[Tensor, " j"]
    """The group of each journey."""
    rival: Float[Tensor, "g 3"]
    """By group another place that the lanes fit about as well, seen from where it is put [m]; zero: there is none."""
    is_shifted: Bool[Tensor, " g"]
    """Groups that lanes moved against those that they were put beside."""

    @property
    def open_groups(self) -> list[int]:
        """Groups of which the lanes do not tell how they lie beside the others."""
        return torch.nonzero(self.rival.abs().sum(1) > 0)[:, 0].tolist()


def tie_groups(
    lanes: Lanes,
    ways: Sequence[Float[Tensor, "_ 4 4"]],
    group: Int[Tensor, " j"],
    bias_sigma: Float[Tensor, "j 3"],
    positioning: PositioningNoise,
    config: GroupTieConfig,
    others: OtherPlaces | None = None,
) -> GroupTies:
    """How far groups of drives are to be moved for their lane markers to be one pattern.

    `group` says of each journey which others its signs tie it to, `bias_sigma` [m] how uncertain its bias was at first,
    `others` where else drives fit that signs tie loosely: those are groups of their own. The pieces and the poses, `ways`,
    have what is known of the biases taken off. The largest group comes first, then group by group that has lanes beside
    those that are placed already.
    """
    groups = int(group.max()) + 1 if len(group) else 0
    move = bias_sigma.new_zeros(len(group), 3)
    nothing = bias_sigma.new_zeros(groups, 3)
    ties = GroupTies(move, group, nothing, nothing[:, 0] > 0)
    if groups < 2 or not len(lanes):
        return ties
    samples = sample_lanes(
        *(lanes, config.sample_spacing_m, positioning), few_observations=config.few_observations
    ).line
    samples = samples[samples.is_witness]
    noise = math.hypot(config.noise_m, math.sqrt(2) * positioning.drift_sigma_m)
    drifting = replace(config, noise_m=noise)
    of_sample = group[samples.owner]
    size = torch.bincount(of_sample, minlength=groups)
    first, *left = torch.argsort(size, descending=True, stable=True).tolist()
    placed, found = group == first, True
    while left and found:
        found = False
        for one in list(left):
            own = group == one
            loose = None if others is None else others.of(own, placed)
            if loose is not None:
                move[own] = loose.followed(move)
            of_own, of_placed = (_variance_of_mean(bias_sigma, some) for some in (own, placed))
            prior = ShiftPrior((of_own + of_placed).sqrt(), loose, move)
            reach = (config.reach * prior.sigma).clamp_min(config.reach_m)
            moved = replace(samples, point=samples.point + move[samples.owner])
            seen = partial(_Seen.of, ways=ways, move=move, level=float(reach[2]), config=config)
            of_one = seen(moved[of_sample == one])
            there = seen(moved[placed[samples.owner]], beside=of_one.way)
            best = _best_shift(of_one, there, prior, reach, drifting)
            if best is None:
                continue
            shift, ties.rival[one] = best
            ties.is_shifted[one] = bool(shift.any())
            share = of_placed / (of_own + of_placed)
            move[own] += (1 - share) * shift
            move[placed] -= share * shift
            placed, found = placed | own, True
            left.remove(one)
    for one in left:
        loose = None if others is None else others.of(group == one, placed)
        if loose is not None:
            move[group == one] = loose.followed(move)
    return ties


def _variance_of_mean(
    bias_sigma: Float[Tensor, "j 3"], some: Bool[Tensor, " j"]
) -> Float[Tensor, " 3"]:
    """Of the weighted mean of some drives' biases [m^2]."""
    return 1 / bias_sigma[some].square().reciprocal().sum(0)


@dataclass(frozen=True)
class _Seen:
    """What some drives saw, and how far beside their ways."""

    line: LineSamples
    way: Float[Tensor, "w 3"]
    """Places on their ways, on the road."""
    beside: float
    """Nearly all that they saw is at most so far beside these [m]."""
    level: float
    """What is further up or down is of another road [m]."""

    @classmethod
    def of(
        cls,
        line: LineSamples,
        ways: Sequence[Float[Tensor, "_ 4 4"]],
        move: Float[Tensor, "j 3"],
        level: float,
        config: GroupTieConfig,
        *,
        beside: Float[Tensor, "w 3"] | None = None,
    ) -> _Seen:
        """Of drives that are moved, those that saw the most; of what lies `beside` another way, if there is one."""
        near = line if beside is None else line[_nearest(line.point, beside, level)[0]]
        count = torch.bincount(near.owner, minlength=len(move))
        most = torch.argsort(count, descending=True, stable=True)[: config.most_drives]
        drives = most[count[most] > 0].tolist()
        line = line[torch.isin(line.owner, most)]
        places = [_thinned(ways[n], config.sample_spacing_m) + move[n] for n in drives]
        way = torch.cat((move.new_zeros(0, 3), *places))
        i, j = _nearest(line.point, way, level)
        if not len(i):
            return cls(line, way, 0.0, level)
        away = line.point[i] - way[j]
        # Cameras are above the road.
        way[:, 2] += median_along(away[:, 2], 0)
        beside_way = left_of_axis(away[:, :2], line.direction[i]).abs()
        return cls(line, way, float(beside_way.quantile(_NEARLY_ALL)), level)


def _thinned(way: Float[Tensor, "f 4 4"], spacing: float) -> Float[Tensor, "k 3"]:
    """Places along a way, about so far apart."""
    cell = (station(way) / spacing).floor()
    return way[torch.cat((cell[:1] >= 0, cell[1:] > cell[:-1])), :3, 3]


def _nearest(
    place: Float[Tensor, "n 3"], way: Float[Tensor, "w 3"], level: float
) -> tuple[Int[Tensor, " p"], Int[Tensor, " p"]]:
    """Rows of places that a way passes by on their level, and the row of the nearest place on it."""
    squash = place.new_tensor((1.0, 1.0, _FAR_M / level))
    pairs = cross_pairs(place * squash, way * squash, radius=_FAR_M, count=1)
    return pairs[:, 0], pairs[:, 1]


_FAR_M = 30.0
"""Farther beside a way no lane marker is seen."""
_NEARLY_ALL = 0.95


def _best_shift(
    own: _Seen, others: _Seen, prior: ShiftPrior, reach: Float[Tensor, " 3"], config: GroupTieConfig
) -> tuple[Float[Tensor, " 3"], Float[Tensor, " 3"]] | None:
    """The likeliest shift of a group onto others, and from there to a rival, zero where none is; None: nothing is near.

    Shifts are tried as far as they `reach` along each axis.
    """
    none = torch.zeros_like(reach)
    steps = (reach[:2] / config.step_m).ceil().long().clamp_min(1)
    axes = [config.step_m * torch.arange(-int(n), int(n) + 1).to(reach) for n in steps]
    grid = torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1)
    here, there = _Said.of(own, others, grid, config), _Said.of(others, own, -grid, config)
    if here is None or there is None:
        return None
    known = prior.logs(grid, sign_noise_m=config.sign_noise_m, sign_missed=config.sign_missed)
    logs = (here.logs + there.logs) / 2 + known
    told = _Told(logs, grid, axes, config)
    best, other, mean = told.best, told.rival(), told.mean()
    shift = torch.cat((mean, _height_between(here.pairs, mean, config)[None]))
    surely = logs.amax() - told.at(none[:2]) > config.surer
    # Where none is out of the question the best guess is better, whether there is another one or not.
    is_moved = surely & (shift.norm() > config.least_m)
    farther = torch.where(best.norm() > other.norm(), best, other)
    away = torch.where(is_moved, other - best, farther)
    is_open = other.any() & (away.norm() > config.rival_m)
    return shift.where(is_moved, none), torch.cat((away.where(is_open, none[:2]), none[:1]))


@dataclass(frozen=True)
class _Said:
    """What some drives' markers say of how they are to be moved."""

    logs: Float[Tensor, "x y"]
    """By shift the log-likelihood that others saw what they saw."""
    pairs: _Pairs

    @classmethod
    def of(
        cls, own: _Seen, others: _Seen, grid: Float[Tensor, "x y 2"], config: GroupTieConfig
    ) -> _Said | None:
        """Of shifts on a grid; None: hardly anything is near."""
        here, passed = _nearest(own.line.point, others.way, others.level)
        count = len(here)
        some = torch.linspace(0, count - 1, min(count, config.most_samples)).round().long()
        some = some.to(here)
        line, way = own.line[here[some]], others.way[passed[some], :2]
        # What the drives of one group have in common says the same of the shift.
        alike = config.alike_m * len(some) * len(torch.unique(own.line.owner[here]))
        each = config.sample_spacing_m * count / max(alike, 1)
        reach = float(grid[-1, -1].norm()) + config.sample_spacing_m
        i, j, _ = pairs_between(line.point[:, :2], others.line.point[:, :2], radius=reach)
        beside = (line.direction[i] * others.line.direction[j]).sum(1).abs() > MAX_ANGLE_COS
        beside &= (others.line.point[j, 2] - line.point[i, 2]).abs() < others.level
        pairs = _Pairs.of(line, others.line, i[beside], j[beside])
        if len(torch.unique(pairs.row)) * each < 1:
            return None
        fits = torch.stack([_fits(pairs, len(line), shifts, config) for shifts in grid], dim=1)
        offset = left_of_axis(line.point[:, :2] - way, line.direction)[:, None, None]
        seen = others.beside + 2 * config.noise_m
        is_seen = (offset + _across(line.direction, grid)).abs() <= seen
        # What would not be seen is as likely as what is off by its sigma, not as what fits by chance.
        logs = torch.log(config.missed + torch.where(is_seen, fits, math.exp(-0.5)))
        return cls(each * (line.weight[:, None, None] * logs).sum(0), pairs)


def _across(axis: Float[Tensor, "n 2"], shift: Float[Tensor, "*s 2"]) -> Float[Tensor, "n ..."]:
    """How far to the left of each axis shifts lead."""
    return _along(torch.stack((-axis[:, 1], axis[:, 0]), dim=1), shift)


def _along(axis: Float[Tensor, "n 2"], shift: Float[Tensor, "*s 2"]) -> Float[Tensor, "n ..."]:
    """How far along each axis shifts lead."""
    return (axis @ shift.reshape(-1, 2).mT).view(len(axis), *shift.shape[:-1])


@dataclass(frozen=True)
class _Pairs:
    """Samples of a group with parallel ones of others."""

    row: Int[Tensor, " p"]
    axis: Float[Tensor, "p 2"]
    across: Float[Tensor, " p"]
    """How far to the left the other one is, seen along the axis."""
    ahead: Float[Tensor, " p"]
    above: Float[Tensor, " p"]

    @classmethod
    def of(
        cls, own: LineSamples, others: LineSamples, i: Int[Tensor, " p"], j: Int[Tensor, " p"]
    ) -> _Pairs:
        """Of rows of both."""
        delta, axis = others.point[j] - own.point[i], others.direction[j]
        across, ahead = left_of_axis(delta[:, :2], axis), along_axis(delta[:, :2], axis)
        return cls(i, axis, across, ahead, delta[:, 2])

    def left(self, shift: Float[Tensor, "*s 2"]) -> tuple[Tensor, Tensor]:
        """What is left across and ahead when the group has been moved, by pair and shift."""
        gap = (1,) * (shift.ndim - 1)
        beside = self.across.view(-1, *gap) - _across(self.axis, shift)
        beyond = self.ahead.view(-1, *gap) - _along(self.axis, shift)
        return beside, beyond


def _fits(
    pairs: _Pairs, rows: int, shifts: Float[Tensor, "s 2"], config: GroupTieConfig
) -> Float[Tensor, "n s"]:
    """By sample and shift how well the sample meets a marker of the others, 0 to 1."""
    beside, beyond = pairs.left(shifts)
    fit = torch.exp(-(beside / config.noise_m).square() / 2)
    fit = fit.where(beyond.abs() < config.sample_spacing_m, 0)
    best = fit.new_zeros(rows, len(shifts))
    return best.scatter_reduce_(0, pairs.row[:, None].expand_as(fit), fit, "amax")


def _height_between(
    pairs: _Pairs, shift: Float[Tensor, " 2"], config: GroupTieConfig
) -> Float[Tensor, ""]:
    """How far above a group's markers those of the others are that they meet [m]."""
    beside, beyond = pairs.left(shift)
    meets = (beside.abs() < 2 * config.noise_m) & (beyond.abs() < config.sample_spacing_m)
    if not bool(meets.any()):
        return shift.new_zeros(())
    return median_along(pairs.above[meets], 0)


@dataclass(frozen=True)
class _Told:
    """What lanes and priors tell of a group's shift."""

    logs: Float[Tensor, "x y"]
    """By shift its log-likelihood."""
    grid: Float[Tensor, "x y 2"]
    axes: list[Tensor]
    """The shifts that are tried, and those along each axis [m]."""
    config: GroupTieConfig

    @cached_property
    def best(self) -> Float[Tensor, " 2"]:
        """The likeliest shift, between those of the grid by parabolas."""
        at = torch.unravel_index(self.logs.argmax(), self.logs.shape)
        places = []
        for k, axis in enumerate(self.axes):
            line, i = self.logs.select(1 - k, int(at[1 - k])), int(at[k])
            step, beyond = axis[1] - axis[0], axis.new_zeros(())
            if 0 < i < len(axis) - 1:
                bend = line[i - 1] - 2 * line[i] + line[i + 1]
                beyond = (line[i - 1] - line[i + 1]) / (2 * bend.clamp_max(-1e-12))
            places.append(axis[i] + step * beyond.clamp(-0.5, 0.5))
        return torch.stack(places)

    def at(self, shift: Float[Tensor, "*n 2"]) -> Float[Tensor, "*n"]:
        """The log-likelihoods of shifts on the grid, or beside it of the nearest one there."""
        places = (
            ((shift[..., k] - axis[0]) / (axis[1] - axis[0])).round().long().clamp(0, len(axis) - 1)
            for k, axis in enumerate(self.axes)
        )
        return self.logs[tuple(places)]

    def rival(self) -> Float[Tensor, " 2"]:
        """The likeliest shift far from the best one that is about as likely, and what lies between less so; zero: none."""
        others, likely = self.grid.view(-1, 2), self.logs.flatten()
        is_other = (likely > likely.amax() - self.config.surer) & (
            (others - self.best).norm(dim=1) > self.config.rival_m
        )
        others, likely = others[is_other], likely[is_other]
        apart = self._is_apart(others, likely)
        if not bool(apart.any()):
            return torch.zeros_like(self.best)
        return others[apart][likely[apart].argmax()]

    def mean(self) -> Float[Tensor, " 2"]:
        """The mean of the shifts around the best one, by likelihood: along a road that hardly bends it errs by less."""
        shifts, logs = self.grid.view(-1, 2), self.logs.flatten()
        weight = (logs - logs.amax()).exp().where(~self._is_apart(shifts, logs), 0)
        return (weight[:, None] * shifts).sum(0) / weight.sum()

    def _is_apart(
        self, others: Float[Tensor, "n 2"], likely: Float[Tensor, " n"]
    ) -> Bool[Tensor, " n"]:
        """Whether something between the best shift and each of others is less likely than it.

        Along a straight road shifts run into each other: those are one.
        """
        share = torch.linspace(0, 1, 17).to(self.best)[:, None, None]
        between = self.at(torch.lerp(self.best.expand_as(others), others, share)).amin(0)
        return between < likely - self.config.surer
