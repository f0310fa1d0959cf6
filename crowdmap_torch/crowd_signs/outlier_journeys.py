"""V-B, unlike the paper: drives that do not fit the crowd, by wrong calibration, heading or position."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from crowdmap_torch.clustering.groups import distinct_pairs, group_count, group_median
from crowdmap_torch.optim.robust import median_along, median_scale
from crowdmap_torch.ranges import Count, Degrees, Deviations, Length, Settings, Share
from crowdmap_torch.tables import Signs


@dataclass(frozen=True)
class OutlierJourneyConfig(Settings):
    """When a journey is taken for a bad drive. Limits are in the crowd's own robust spread where they say so."""

    min_signs: Count = 4
    """Journeys with fewer signs are not judged, and not by what others saw unless as many stand where others passed by."""
    spread: Deviations = 6.0
    """Figures further from the crowd's median than this many robust standard deviations are suspicious."""
    min_matched: Share = 0.5
    """Least share of a journey's signs that others saw too where they passed, relative to the median journey's."""
    min_bias_m: Length = 4.0
    """Biases below this are never suspicious [m]."""
    min_scatter_m: Length = 0.7
    """Median miss of its signs, bias and drift taken off, that is never suspicious below [m]."""
    min_turn_deg: Degrees = 2.0
    """Median turn of its signs against the crowd's that is never suspicious below [deg]."""
    min_roll_deg: Degrees = 1.5
    """Median roll of its signs in their planes against the crowd's that is never suspicious below [deg]."""
    min_stretch: Share = 0.035
    """Median relative size against the crowd's that is never suspicious below."""
    min_drift_m: Length = 1.25
    """Largest drift along a journey that is never suspicious below [m]."""
    max_leap_m: Length = 4.0
    """Largest step between two frames beyond what a car can drive [m]."""


_LEAST_JOURNEYS = 3
"""Of two that differ nobody can say which is wrong."""
_OF_MEDIAN = 1.2533
"""Standard error of a median over that of a mean."""
_BY_CHANCE = 3.0
"""Standard errors that a median of a journey's signs may be off by."""
_LEAST_COMMON = 3
"""Signs that a journey has in common with others at least before their median says how they differ."""


@dataclass(frozen=True)
class OutlierJourney:
    """A journey that does not fit the others, and why."""

    journey: int
    reason: str


@dataclass(frozen=True)
class JourneyStatistics:
    """How each journey fits the crowd; NaN where it has no sign, or too few in common with others, to tell."""

    signs: Int[Tensor, " j"]
    """Signs triangulated."""
    checked: Int[Tensor, " j"]
    """Those of them that others passed by: two or more, or one that saw the sign too."""
    matched: Float[Tensor, " j"]
    """Share of them that other journeys saw too, of those that others passed by."""
    bias: Float[Tensor, " j"]
    """Length of the bias against the crowd's median [m]."""
    scatter: Float[Tensor, " j"]
    """Median distance of its signs from the clusters, bias and drift taken off [m]."""
    turn: Float[Tensor, " j"]
    """Median turn of its signs about the up axis against their clusters [rad]."""
    roll: Float[Tensor, " j"]
    """Median turn of its signs in their planes against their clusters [rad]."""
    stretch: Float[Tensor, " j"]
    """Median logarithm of the size of its signs against their clusters'."""
    drift: Float[Tensor, " j"]
    """Largest drift along it [m]."""
    leap: Float[Tensor, " j"]
    """Largest step between two frames beyond what a car can drive [m]."""
    turn_error: Float[Tensor, " j"]
    """What is left to chance in `turn`, as few signs say little of it (1-sigma) [rad]."""
    roll_error: Float[Tensor, " j"]
    stretch_error: Float[Tensor, " j"]


def journey_statistics(
    signs: Signs,
    label: Int[Tensor, " n"],
    heads: Signs,
    company: Bool[Tensor, " n"],
    translation: Float[Tensor, "j 3"],
    drift: Float[Tensor, " j"],
    leap: Float[Tensor, " j"],
) -> JourneyStatistics:
    """How each journey fits the crowd.

    `signs` have their bias taken off, `company` says of each whether others passed by, `heads` are the clusters',
    `translation` and `drift` [m] what was taken off, `leap` [m] the largest step of the positions no car can drive.
    """
    journeys = len(translation)
    used = label >= 0
    member, head = signs[used], heads[label[used]]
    number = group_count(signs.journey, journeys)
    # What nobody else saw is its own head.
    of, _, _ = distinct_pairs(label[used], member.journey)
    common = (group_count(of, len(heads)) > 1)[label[used]]
    # Who saw a sign has passed by it, be it the only one.
    passed = company.index_fill(0, torch.nonzero(used)[:, 0][common], True)
    checked = group_count(signs.journey[passed], journeys)
    matched = group_count(signs.journey[passed & used], journeys) / checked.clamp_min(1)
    of_common = member.journey[common]
    count = group_count(of_common, journeys)

    def median(of_each: Float[Tensor, " m"]) -> Float[Tensor, " j"]:
        found = group_median(of_each[common], of_common, journeys)
        return torch.where(count >= _LEAST_COMMON, found, torch.nan)

    def error(of_each: Float[Tensor, " m"]) -> Float[Tensor, " j"]:
        off = (of_each[common] - median(of_each)[of_common]).abs()
        return _OF_MEDIAN * median_scale(off[off.isfinite()]) / (count - 1).clamp_min(1).sqrt()

    miss = (member.center_world - head.center_world).norm(dim=1)
    a, b = member.normal_world, head.normal_world
    turn = torch.atan2(b[:, 0] * a[:, 1] - b[:, 1] * a[:, 0], (a[:, :2] * b[:, :2]).sum(1))
    R, axes = member.T_world_sign[:, :3, :3], head.T_world_sign[:, :3, :3]
    along = (axes.mT @ R[:, :, :1])[..., 0]
    roll = torch.atan2(along[:, 1], along[:, 0])
    stretch = (member.size.log() - head.size.log()).mean(1)
    centre = median_along(translation, 0) if journeys else translation.sum(0)
    return JourneyStatistics(
        signs=number,
        checked=checked,
        matched=torch.where(checked > 0, matched, torch.nan),
        bias=(translation - centre).norm(dim=1),
        scatter=median(miss),
        turn=median(turn),
        roll=median(roll),
        stretch=median(stretch),
        drift=drift,
        leap=leap,
        turn_error=error(turn),
        roll_error=error(roll),
        stretch_error=error(stretch),
    )


def find_outlier_journeys(
    statistics: JourneyStatistics, config: OutlierJourneyConfig
) -> tuple[OutlierJourney, ...]:
    """Journeys that do not fit, each with its reasons; with fewer than three journeys only a leap can tell."""
    judged = statistics.signs >= config.min_signs
    if int(judged.sum()) < _LEAST_JOURNEYS:
        judged = torch.zeros_like(judged)
    usual = statistics.matched[judged].nanmedian()
    # Who meets others only where their ways cross was seen to be wrong by nobody.
    few = judged & (statistics.checked >= config.min_signs)
    few &= statistics.matched < config.min_matched * usual
    s, radian = statistics, torch.pi / 180
    outlying = partial(_outlying, judged=judged, spread=config.spread)
    checks = (
        (few, s.matched, "only {:.0%} of its signs were seen by others too"),
        (outlying(s.bias, config.min_bias_m), s.bias, "its position is off by {:.1f} m"),
        (
            outlying(s.scatter, config.min_scatter_m),
            s.scatter,
            "its signs miss the others' by {:.2f} m after its bias is taken off",
        ),
        (
            outlying(s.turn, radian * config.min_turn_deg, error=s.turn_error),
            torch.rad2deg(s.turn),
            "its signs are turned by {:.1f} degrees against the others'",
        ),
        (
            outlying(s.roll, radian * config.min_roll_deg, error=s.roll_error),
            torch.rad2deg(s.roll),
            "its signs are rolled by {:.1f} degrees against the others'",
        ),
        (
            outlying(s.stretch, config.min_stretch, error=s.stretch_error),
            s.stretch.exp(),
            "its signs are {:.2f} times the size the others see",
        ),
        (
            outlying(s.drift, config.min_drift_m),
            s.drift,
            "its position drifts by {:.1f} m along the way",
        ),
        (s.leap > config.max_leap_m, s.leap, "its position leaps by {:.1f} m between two frames"),
    )
    reasons: dict[int, list[str]] = {}
    for flagged, value, text in checks:
        for j in torch.nonzero(flagged)[:, 0].tolist():
            reasons.setdefault(j, []).append(text.format(float(value[j])))
    return tuple(OutlierJourney(j, "; ".join(reasons[j])) for j in sorted(reasons))


def _outlying(
    value: Float[Tensor, " j"],
    floor: float,
    *,
    judged: Bool[Tensor, " j"],
    spread: float,
    error: Float[Tensor, " j"] | None = None,
) -> Bool[Tensor, " j"]:
    """True where a figure is above `floor` and far from those of the crowd, by their spread and its own `error`."""
    known = value[judged & value.isfinite()]
    if len(known) < _LEAST_JOURNEYS:
        return torch.zeros_like(judged)
    centre = known.median()
    usual = (spread * median_scale(known - centre)).expand_as(value)
    if error is not None:
        usual = (usual.square() + (_BY_CHANCE * error).square()).sqrt()
    return judged & ((value - centre).abs() > usual) & (value.abs() > floor)
