"""Unlike the paper: which signs are one, among cluster heads (V-A.1) and in an adjusted map (V-B), and which are none.

Where rotations are off, one sign's triangulations by different drives lie metres apart, too far for one cluster. The
adjustment, which sees all rays at once, brings them to one place.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from crowdmap_torch.clustering.groups import (
    distinct_pairs,
    group_argmin,
    group_count,
    group_sum,
    pairs_within,
    rows_of_ranges,
)
from crowdmap_torch.clustering.neighbours import near_pairs
from crowdmap_torch.crowd_signs.company import CompanyConfig
from crowdmap_torch.crowd_signs.completion import CompleteTracksConfig
from crowdmap_torch.crowd_signs.distance import SimilarityConfig, appearance_distance, sign_distance
from crowdmap_torch.crowd_signs.evidence import reach_of_noise
from crowdmap_torch.crowd_signs.merge import mutual_partners
from crowdmap_torch.crowd_signs.projections import candidates_of, misfit_px, projection_errors
from crowdmap_torch.geometry import se3
from crowdmap_torch.ranges import Cost, Count, Length, RoundsOrNone, Settings, Share, Sigma
from crowdmap_torch.tables import Association, Journey, Signs


@dataclass(frozen=True)
class DuplicateSignConfig(Settings):
    """When two signs of an adjusted map are one; costs are squared standard deviations."""

    rounds: RoundsOrNone = 2
    """So many times at most the adjustment begins again with what was joined or found; 0: never. When it has begun again
    already, signs that are one are joined as they stand, the one that was seen most often stays, and those that are none
    go."""
    merge_cost: Cost = 9.0
    """Signs of one shape whose codes do not contradict each other are one if they are closer than this, ..."""
    max_distance_m: Length = 1.5
    """... no further apart than this, and no drive saw both in one frame. If it saw them in turn they are as much closer as
    it is unlikely that two signs were never in sight together."""
    overlap: Share = 0.35
    """Closer than this share of the smaller side, they are one plate detected twice, whoever saw both; and if one drive did,
    whatever their codes: no sign was put in the place of another meanwhile."""
    stray_m: Length = 5.0
    """A sign that the adjustment takes further than this from where drives agreed that it is, beside the cameras that saw
    it, is none of the map [m]."""
    hidden_m: Length = 5.0
    """A sign closer than this to one that more journeys saw, in the images of its drives on that one, is that one seen from
    afar, where rays leave open how far it is [m]."""
    least_sigma_m: Sigma = 0.02
    """1-sigma of places that covariances leave out [m]."""
    candidates: Count = 8
    """Signs that a sign is compared with, the nearest."""
    similarity: SimilarityConfig = field(default_factory=SimilarityConfig)
    """What differences of appearance cost."""
    company: CompanyConfig = field(default_factory=CompanyConfig)
    """When signs that single drives saw are one."""


def duplicate_signs(
    journeys: Sequence[Journey],
    poses: Sequence[Float[Tensor, "_ 4 4"]],
    signs: Signs,
    associations: Sequence[Association],
    config: CompleteTracksConfig,
) -> Bool[Tensor, " n"]:
    """True for signs that are another one badly placed, by what their detections show.

    A few frames from afar leave open which way a plate faces; two clusters of it are then far from each other in all
    that clustering compares, yet they look the same in every image.
    """
    n = len(signs)
    near = near_pairs(signs.center_world, radius=config.duplicate_m, count=config.candidates)
    pair = torch.cat((near, near.flip(1)))
    weaker, stronger = pair[signs.n_journeys[pair[:, 0]] <= signs.n_journeys[pair[:, 1]]].T
    order = weaker.argsort(stable=True)
    stronger = stronger[order]
    partners = group_count(weaker, n)
    start = partners.cumsum(0) - partners
    fits, total = [], torch.zeros_like(partners)
    for journey, pose, association in zip(journeys, poses, associations, strict=True):
        total = total + group_count(association.sign, n)
        rows = torch.nonzero(association.sign >= 0)[:, 0]
        shown = association.sign[rows]
        at, other = rows_of_ranges(start[shown], partners[shown])
        pairs = candidates_of(journey, pose, signs, rows[at], stronger[other])
        error = projection_errors(
            journey, pose, signs, association, pairs, window_s=config.error_window_s
        )
        misfit, _ = misfit_px(journey.signs, signs, pairs, error.offset_px)
        limit = torch.where(error.is_known, reach_of_noise(pairs, error, config), 0.0)
        limit = torch.maximum(limit, config.vote_share * pairs.size)
        inside = (misfit < limit) & ~error.is_shown
        fits.append(torch.stack((association.sign[pairs.row], pairs.sign), dim=1)[inside])
    weaker, stronger, number = distinct_pairs(*torch.cat(fits).T)
    alike = number >= config.vote_majority * total[weaker]
    weaker, stronger = weaker[alike], stronger[alike]
    # Of two that are duplicates of each other the first stays.
    is_first = (signs.n_journeys[weaker] == signs.n_journeys[stronger]) & (weaker < stronger)
    duplicate = torch.zeros(n, dtype=torch.bool, device=weaker.device)
    duplicate[weaker[~is_first]] = True
    return duplicate


def none_of_the_map(
    journeys: Sequence[Journey],
    poses: Sequence[Float[Tensor, "_ 4 4"]],
    signs: Signs,
    associations: Sequence[Association],
    before: Signs,
    begun: Sequence[Float[Tensor, "_ 6"]],
    unseen: Bool[Tensor, " n"],
    config: DuplicateSignConfig,
    completion: CompleteTracksConfig,
) -> Bool[Tensor, " n"]:
    """True for adjusted `signs` that turned out to be none: gone astray from `before`, `unseen`, or another one from afar.

    `begun` are the tangents from the given poses to those before the adjustment, which ended at `poses`. Of two that
    `may_be_one` none goes but what went astray.
    """
    moved = before, signs, journeys, associations, begun, poses
    far = replace(completion, duplicate_m=config.hidden_m)
    goes = unseen | duplicate_signs(journeys, poses, signs, associations, far)
    pair = may_be_one(signs, journeys, associations, config)
    return gone_astray(*moved, config) | goes.index_fill(0, pair.flatten(), False)


def gone_astray(
    before: Signs,
    after: Signs,
    journeys: Sequence[Journey],
    associations: Sequence[Association],
    begun: Sequence[Float[Tensor, "_ 6"]],
    poses: Sequence[Float[Tensor, "_ 4 4"]],
    config: DuplicateSignConfig,
) -> Bool[Tensor, " n"]:
    """True for signs that an adjustment took elsewhere, by their rows `before` and `after` it.

    What drives took for one sign though its rays meet nowhere, such as plates of vehicles ahead, goes where it does no
    harm: far off and up in the air. `begun` are the tangents from the given poses to those before, `poses` those after.
    """
    n, moved = len(before), after.center_world - before.center_world
    least = torch.full_like(moved[:, 0], torch.inf)
    for journey, association, old, new in zip(journeys, associations, begun, poses, strict=True):
        rows = torch.nonzero(association.sign >= 0)[:, 0]
        shown, frame = association.sign[rows], journey.signs.frame[rows]
        move = new[frame] - se3.retract(journey.T_world_camera[frame], old[frame])
        number = group_count(shown, n)
        of_cameras = group_sum(move[:, :3, 3], shown, n) / number.clamp_min(1)[:, None]
        beside = (moved - of_cameras).norm(dim=1)
        least = torch.where(number > 0, torch.minimum(least, beside), least)
    # Drives that lie far off may have moved by more: one with which it went is enough.
    return least.isfinite() & (least > config.stray_m)


def may_be_one(
    signs: Signs,
    journeys: Sequence[Journey],
    associations: Sequence[Association],
    config: DuplicateSignConfig,
) -> Int[Tensor, "p 2"]:
    """Pairs of signs that stand so near and look so much alike that they may be one, for all that frames show.

    Whether they are, their covariances say, which take long: two plates of one post need none.
    """
    pair = _alike(signs, associations, config)
    if not len(pair):
        return pair
    label = torch.arange(len(signs), device=pair.device)
    together = seen_together(journeys, associations, len(signs))
    overlaps = _overlap(signs, pair, config)
    return pair[overlaps | ~_told_apart(label, together, pair, overlaps)]


def same_sign(
    signs: Signs,
    journeys: Sequence[Journey],
    associations: Sequence[Association],
    config: DuplicateSignConfig,
    goes: Bool[Tensor, " n"] | None = None,
) -> Int[Tensor, " n"]:
    """Which of the adjusted signs each of them is: of those that are one the one with the most detections.

    Covariances are those of centres without what all positions share. What `goes` is none, -1.
    """
    label = torch.arange(len(signs), device=signs.shape.device)
    goes = torch.zeros_like(label, dtype=torch.bool) if goes is None else goes
    pair = _alike(signs, associations, config)
    pair = pair[~goes[pair].any(1)]
    if not len(pair):
        return label.masked_fill(goes, -1)
    sigma = signs.size.new_full((3,), config.least_sigma_m)
    cost = sign_distance(signs, signs, pair, config.similarity, sigma)
    overlaps = _overlap(signs, pair, config) & cost.isfinite()
    # So many frames with both were to be expected, and there is none: exp(-n), in squared standard deviations.
    cost = cost - 2 * seen_in_turn(journeys, associations, pair)
    together = seen_together(journeys, associations, len(signs))
    while True:
        # Of two groups every pair must agree: what was seen beside one of them is neither.
        told_apart = _told_apart(label, together, pair, overlaps)
        one = (label[pair[:, 0]] != label[pair[:, 1]]) & ~told_apart
        one &= overlaps | (cost < config.merge_cost)
        group = label[pair[one]]
        if not len(group):
            break
        label = mutual_partners(group, cost[one], len(signs))[label]
    number = sum((group_count(a.sign, len(signs)) for a in associations), torch.zeros_like(label))
    _, own = torch.unique(label, return_inverse=True)
    return group_argmin(-number.to(cost), own)[own].masked_fill(goes, -1)


def _alike(
    signs: Signs, associations: Sequence[Association], config: DuplicateSignConfig
) -> Int[Tensor, "p 2"]:
    """Pairs near each other that look so much alike, of one shape, whose codes contradict each other on one plate alone."""
    pair = near_pairs(signs.center_world, radius=config.max_distance_m, count=config.candidates)
    a, b = signs[pair[:, 0]], signs[pair[:, 1]]
    contradicts = (a.type >= 0) & (b.type >= 0) & (a.type != b.type)
    # Of one plate half of the detections may have another one's code.
    is_one_plate = _overlap(signs, pair, config) & _seen_by_one_drive(associations, pair)
    look = appearance_distance(a, b, config.similarity)
    is_alike = (look < config.merge_cost) & (a.shape == b.shape)
    return pair[is_alike & (~contradicts | is_one_plate)]


def _seen_by_one_drive(
    associations: Sequence[Association], pair: Int[Tensor, "p 2"]
) -> Bool[Tensor, " p"]:
    """Pairs of signs that some drive detected both, at once or one after the other."""
    found = torch.zeros_like(pair[:, 0], dtype=torch.bool)
    for association in associations:
        found |= torch.isin(pair, association.sign).all(1)
    return found


def _overlap(
    signs: Signs, pair: Int[Tensor, "p 2"], config: DuplicateSignConfig
) -> Bool[Tensor, " p"]:
    """Which pairs stand where one plate of their size has room."""
    apart = signs.center_world[pair[:, 0]] - signs.center_world[pair[:, 1]]
    return apart.norm(dim=1) < config.overlap * signs.size[pair].amin((1, 2))


def seen_together(
    journeys: Sequence[Journey], associations: Sequence[Association], count: int
) -> Int[Tensor, "p 2"]:
    """Pairs of `count` signs that some drive detected in one frame, the smaller row first."""
    found = []
    for journey, association in zip(journeys, associations, strict=True):
        shown = association.sign >= 0
        frame, sign, _ = distinct_pairs(journey.signs.frame[shown], association.sign[shown])
        beside = pairs_within(frame)
        found.append(torch.unique(sign[beside].sort(dim=1).values, dim=0))
    pair = torch.cat(found)
    key = torch.unique(pair[:, 0] * count + pair[:, 1])
    return torch.stack((key // max(count, 1), key % max(count, 1)), dim=1)


def seen_in_turn(
    journeys: Sequence[Journey], associations: Sequence[Association], pair: Int[Tensor, "p 2"]
) -> Float[Tensor, " p"]:
    """In how many frames drives would have seen both signs of each pair, had they seen either for reasons of its own.

    Counted are the frames of a drive from where it had seen both once until it did not see one of them any more.
    """
    expected = torch.zeros(len(pair), dtype=torch.float64, device=pair.device)
    for journey, association in zip(journeys, associations, strict=True):
        shown = association.sign >= 0
        sign, frame, _ = distinct_pairs(association.sign[shown], journey.signs.frame[shown])
        if not len(sign):
            continue
        span = journey.frame_count + 1
        key = sign * span + frame
        begin, end = (torch.searchsorted(key, (pair + k) * span) for k in (0, 1))
        is_seen = (begin < end).all(1)
        low = frame[begin.clamp_max(len(frame) - 1)].amax(1)
        high = frame[(end - 1).clamp_min(0)].amin(1)
        of_each = [
            torch.searchsorted(key, pair * span + bound[:, None], right=right)
            for bound, right in ((low, False), (high, True))
        ]
        number = (of_each[1] - of_each[0]).to(expected).prod(1)
        both = number / (high - low + 1).clamp_min(1)
        expected += torch.where(is_seen & (low <= high), both, 0.0)
    return expected


def _told_apart(
    label: Int[Tensor, " n"],
    together: Int[Tensor, "q 2"],
    pair: Int[Tensor, "p 2"],
    overlaps: Bool[Tensor, " p"],
) -> Bool[Tensor, " p"]:
    """Which pairs are of groups of which some drive saw two signs at once, one of each; plates that overlap do not count."""
    count = len(label)

    def key(rows: Int[Tensor, "m 2"]) -> Int[Tensor, " m"]:
        low, high = rows.sort(dim=1).values.unbind(1)
        return low * count + high

    seen = together[~torch.isin(key(together), key(pair[overlaps]))]
    return torch.isin(key(label[pair]), key(label[seen]))
