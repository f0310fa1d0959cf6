"""V-A.1: the detections of every sign of the map; what clustering set aside is given back to the signs that it shows.

Unlike the paper, which names its singletons as lost data, every detection without a landmark is compared with the
projections of the map's signs: second detections of a sign in a frame, outlines with a wrong corner or of a wrong shape,
tracklets that were too short or too uncertain to be triangulated, and signs that found no cluster.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from crowdmap_torch.clustering.assignment import match_slots
from crowdmap_torch.clustering.groups import cheapest, distinct_pairs, group_count, rows_of_ranges
from crowdmap_torch.clustering.neighbours import near_pairs
from crowdmap_torch.crowd_signs.duplicates import DuplicateSignConfig, same_sign
from crowdmap_torch.crowd_signs.existence import existence, still_alone
from crowdmap_torch.crowd_signs.projections import (
    Candidates,
    ProjectionErrors,
    box,
    candidates_nearby,
    candidates_of,
    misfit_px,
    projection_errors,
)
from crowdmap_torch.crowd_signs.register import Crowd, CrowdConfig
from crowdmap_torch.geometry import polygon
from crowdmap_torch.ranges import (
    Count,
    Factor,
    Length,
    LengthOrNone,
    Pixels,
    Rounds,
    Seconds,
    Settings,
    Share,
)
from crowdmap_torch.tables import Association, Journey, Signs, Tracklets

_USUAL = 2.0
"""Hardly any detection is farther off its sign than so many times what half of them are."""


@dataclass(frozen=True)
class CompleteTracksConfig(Settings):
    """When a detection without a landmark shows a sign of the map."""

    reach_m: LengthOrNone = 120.0
    """Signs further from the camera are not looked for [m]."""
    candidates: Count = 48
    """Signs that a detection is compared with, the nearest to its camera."""
    error_window_s: Seconds = 1.0
    """For so long before and after, a detection of a sign tells how its projection errs [s]."""
    known_px: Pixels = 3.0
    """Where that is known, most corners are within so many pixels, or within twice what is usual of the drive, ..."""
    known_share: Share = 0.1
    """... and this share of the outline's larger side of the projection."""
    vote_share: Share = 0.35
    """Where it is not, most corners are within this share, ..."""
    vote_clear: Factor = 2.0
    """... other signs so many times as far, ..."""
    vote_majority: Share = 0.6
    """... and so is this share of the detections of the tracklet, ..."""
    vote_detections: Count = 1
    """... which has at least so many."""
    displaced_px: Pixels = 45.0
    """An outline this far off may be the only one missing in its frame of a sign that is seen before and after, ..."""
    displaced_size: Share = 0.2
    """... if its sides differ by no more than this share."""
    duplicate_m: Length = 1.5
    """A sign this close to one that more journeys saw is a duplicate, if `vote_majority` of its detections lie on the
    other's projection and nothing else in their frames shows the other [m]."""
    passes: Rounds = 2
    """What was found tells how the projections of other detections err."""
    evidence: Count = 3
    """Journeys with so many detections of a sign have seen it."""


@dataclass(frozen=True)
class CompletedTracks:
    """The associations with what was brought back, and how much that is."""

    associations: tuple[Association, ...]
    fitting: int
    """Detections that lie on the projection of their sign."""
    displaced: int
    """Detections of the right size and shape beside it, while nothing else shows it."""


@dataclass(frozen=True)
class AssociatedSigns:
    """The signs of the first map, and which of them each detection shows."""

    heads: Signs
    tentative: Signs
    """Signs that too few journeys saw."""
    associations: tuple[Association, ...]
    completed: CompletedTracks | None
    """What clustering had set aside and was given back; None with `paper2017`, which does not."""


def associate_detections(
    journeys: Sequence[Journey],
    poses: Sequence[Float[Tensor, "_ 4 4"]],
    tracklets: Sequence[Tracklets],
    crowd: Crowd,
    config: CrowdConfig,
    completion: CompleteTracksConfig,
) -> AssociatedSigns:
    """The cluster heads with the detections of their members and, with `joint`, what else shows them in the images.

    `poses` are the journeys' with the biases of the crowd taken off. A head that is another one badly placed goes.
    """
    associations = tuple(
        member_association(journey, made, crowd, number)
        for number, (journey, made) in enumerate(zip(journeys, tracklets, strict=True))
    )
    if config.method == "paper2017":
        return AssociatedSigns(crowd.heads, crowd.tentative, associations, None)
    duplicate = duplicate_signs(journeys, poses, crowd.heads, associations, completion)
    heads, passing = crowd.heads[~duplicate], crowd.report.n_passing[~duplicate]
    associations = without_signs(associations, duplicate)
    trusted = crowd.journey_weight > 0
    heads, completed = completed_signs(
        journeys, poses, tracklets, heads, associations, completion, trusted=trusted
    )
    associations = completed.associations
    sure = existence(heads.n_journeys, passing, config.existence)
    # What a bad drive alone saw, or one where its positions were off, is nothing to look for.
    sound = trusted[crowd.tentative.journey] & ~crowd.displaced[crowd.label < 0]
    tentative = crowd.tentative[sound]
    tentative = tentative[still_alone(tentative, tracklets, associations)]
    heads = replace(heads, confidence=sure.to(heads.size))
    return AssociatedSigns(heads, tentative, associations, completed)


def member_association(
    journey: Journey, tracklets: Tracklets, crowd: Crowd, number: int
) -> Association:
    """The head that every sign detection of the `number`-th journey shows, and how its corners are turned against it.

    Detections show the head of the cluster that the sign of their tracklet is in.
    """
    assert tracklets.shift is not None
    mine = torch.nonzero(crowd.members.journey == number)[:, 0]
    row_of_tracklet = torch.full((tracklets.count + 1,), -1, device=mine.device)
    row_of_tracklet[crowd.members.tracklet[mine]] = mine
    # Label -1 reads the last slot, which stays -1.
    member = row_of_tracklet[tracklets.label]
    found = member >= 0
    head = member.masked_scatter(found, crowd.label[member[found]])
    used = torch.nonzero(head >= 0)[:, 0]
    shift = torch.zeros_like(head)
    of_member, of_head = crowd.members[member[used]], crowd.heads[head[used]]
    count = polygon.corner_count(of_head.shape)
    turn, _ = polygon.best_shift(of_head.corners_world, of_member.corners_world, count)
    shift[used] = (turn + tracklets.shift[used]) % count
    return Association(sign=head, sign_shift=shift, lane=torch.full_like(journey.lanes.row, -1))


def complete_tracks(
    journeys: Sequence[Journey],
    poses: Sequence[Float[Tensor, "_ 4 4"]],
    tracklets: Sequence[Tracklets],
    signs: Signs,
    associations: Sequence[Association],
    config: CompleteTracksConfig,
) -> CompletedTracks:
    """The associations with the sign of the map that each detection without one shows, where one fits.

    `poses` are the cameras' in the frame of `signs`. What has a landmark keeps it.
    """
    found = []
    fitting = displaced = 0
    for journey, pose, made, association in zip(
        journeys, poses, tracklets, associations, strict=True
    ):
        before = int((association.sign >= 0).sum())
        association = _with_fitting(journey, pose, made, signs, association, config)
        between = int((association.sign >= 0).sum())
        association = _with_displaced(journey, pose, signs, association, config)
        found.append(association)
        fitting += between - before
        displaced += int((association.sign >= 0).sum()) - between
    return CompletedTracks(tuple(found), fitting, displaced)


def completed_signs(
    journeys: Sequence[Journey],
    poses: Sequence[Float[Tensor, "_ 4 4"]],
    tracklets: Sequence[Tracklets],
    signs: Signs,
    associations: Sequence[Association],
    config: CompleteTracksConfig,
    *,
    trusted: Bool[Tensor, " j"],
) -> tuple[Signs, CompletedTracks]:
    """The associations of `complete_tracks`, and the signs with their evidence by them, of `trusted` journeys."""
    completed = complete_tracks(journeys, poses, tracklets, signs, associations, config)
    signs = with_evidence(signs, journeys, completed.associations, trusted, config)
    return signs, completed


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
        inside = (misfit < config.vote_share * pairs.size) & ~error.is_shown
        fits.append(torch.stack((association.sign[pairs.row], pairs.sign), dim=1)[inside])
    weaker, stronger, number = distinct_pairs(*torch.cat(fits).T)
    alike = number >= config.vote_majority * total[weaker]
    weaker, stronger = weaker[alike], stronger[alike]
    # Of two that are duplicates of each other the first stays.
    is_first = (signs.n_journeys[weaker] == signs.n_journeys[stronger]) & (weaker < stronger)
    duplicate = torch.zeros(n, dtype=torch.bool, device=weaker.device)
    duplicate[weaker[~is_first]] = True
    return duplicate


def associated_once(
    journeys: Sequence[Journey],
    poses: Sequence[Float[Tensor, "_ 4 4"]],
    tracklets: Sequence[Tracklets],
    before: AssociatedSigns,
    config: DuplicateSignConfig,
    completion: CompleteTracksConfig,
    *,
    trusted: Bool[Tensor, " j"],
) -> AssociatedSigns | None:
    """What is `before` with those signs joined that are one, and with what else shows them by now; None if none are.

    `poses` and the heads are adjusted; the heads' covariances are those of their centres without what all positions share.
    """
    joined = join_duplicates(before.heads, journeys, before.associations, config)
    if joined is None:
        return None
    given = journeys, poses, tracklets
    heads, completed = completed_signs(*given, *joined, completion, trusted=trusted)
    alone = still_alone(before.tentative, tracklets, completed.associations)
    return AssociatedSigns(heads, before.tentative[alone], completed.associations, completed)


def join_duplicates(
    signs: Signs,
    journeys: Sequence[Journey],
    associations: Sequence[Association],
    config: DuplicateSignConfig,
) -> tuple[Signs, tuple[Association, ...]] | None:
    """The signs without those that are another one, and which of them each detection shows; None if all are their own."""
    into = same_sign(signs, journeys, associations, config)
    goes = into != torch.arange(len(into), device=into.device)
    if not bool(goes.any()):
        return None
    count = polygon.corner_count(signs.shape)
    turn, _ = polygon.best_shift(signs.corners_world[into], signs.corners_world, count)
    moved = tuple(_shown_by(a, into, turn, count) for a in associations)
    sure = signs.confidence.scatter_reduce(0, into, signs.confidence, "amax")
    return replace(signs, confidence=sure)[~goes], without_signs(moved, goes)


def without_signs(
    associations: Sequence[Association], dropped: Bool[Tensor, " n"]
) -> tuple[Association, ...]:
    """The associations with the signs that are kept, numbered anew; detections of dropped ones show none."""
    number = torch.where(dropped, -1, (~dropped).cumsum(0) - 1)
    number = torch.cat((number, number.new_full((1,), -1)))  # label -1 reads the last slot
    return tuple(replace(a, sign=number[a.sign]) for a in associations)


def _shown_by(
    association: Association,
    into: Int[Tensor, " n"],
    turn: Int[Tensor, " n"],
    count: Int[Tensor, " n"],
) -> Association:
    """The association with the signs that others went into, its corners turned against those."""
    rows = torch.nonzero(association.sign >= 0)[:, 0]
    sign, shift = association.sign.clone(), association.sign_shift.clone()
    before = sign[rows]
    sign[rows] = into[before]
    shift[rows] = (turn[before] + shift[rows]) % count[before]
    return replace(association, sign=sign, sign_shift=shift)


def with_evidence(
    signs: Signs,
    journeys: Sequence[Journey],
    associations: Sequence[Association],
    trusted: Bool[Tensor, " j"],
    config: CompleteTracksConfig,
) -> Signs:
    """The signs with how often, by how many journeys and when they were seen, from the detections that show them.

    Only journeys that are `trusted` count.
    """
    number = torch.arange(len(journeys), device=signs.shape.device)
    size = torch.tensor([len(a.sign) for a in associations], device=number.device)
    journey = torch.repeat_interleave(number, size)
    label = torch.cat([a.sign for a in associations])
    t_ns = torch.cat([j.t_ns[j.signs.frame] for j in journeys])
    used = (label >= 0) & trusted[journey]
    label, t_ns = label[used], t_ns[used]
    owner, _, views = distinct_pairs(label, journey[used])
    return replace(
        signs,
        n_journeys=group_count(owner[views >= config.evidence], len(signs)),
        n_observations=group_count(label, len(signs)),
        first_seen_ns=signs.first_seen_ns.scatter_reduce(0, label, t_ns, "amin"),
        last_seen_ns=signs.last_seen_ns.scatter_reduce(0, label, t_ns, "amax"),
    )


def _with_fitting(
    journey: Journey,
    pose: Float[Tensor, "f 4 4"],
    tracklets: Tracklets,
    signs: Signs,
    association: Association,
    config: CompleteTracksConfig,
) -> Association:
    """The association with detections that lie on the projection of a sign."""
    pairs = candidates_nearby(
        journey, pose, signs, association, reach_m=config.reach_m, count=config.candidates
    )
    for _ in range(config.passes):
        error = projection_errors(
            journey, pose, signs, association, pairs, window_s=config.error_window_s
        )
        misfit, shift = misfit_px(journey.signs, signs, pairs, error.offset_px)
        limit = config.known_px + config.known_share * pairs.size
        known = misfit.masked_fill(~error.is_known | (misfit > limit), torch.inf)
        _, target = cheapest(pairs.row, pairs.sign, known, len(association.sign))
        voted = _tracklet_votes(tracklets, pairs, misfit, error, len(target), config)
        target = torch.where(target < 0, voted, target)
        association = _with_signs(association, target, pairs, shift)
    return association


def _tracklet_votes(
    tracklets: Tracklets,
    pairs: Candidates,
    misfit: Float[Tensor, " p"],
    error: ProjectionErrors,
    rows: int,
    config: CompleteTracksConfig,
) -> Int[Tensor, " d"]:
    """The sign that most detections of a tracklet lie on, for those that do; -1 for the others."""
    # Where images are noisy most are farther off than `known_px`.
    known_px = (_USUAL * error.usual_px).clamp_min(config.known_px)
    limit = config.vote_share * pairs.size
    limit = torch.where(error.is_known, known_px + config.known_share * pairs.size, limit)
    best, sign = cheapest(pairs.row, pairs.sign, misfit, rows)
    other = pairs.sign != sign[pairs.row]
    second, _ = cheapest(pairs.row[other], pairs.sign[other], misfit[other], rows)
    chosen = pairs.sign == sign[pairs.row]
    inside = torch.zeros(rows, dtype=torch.bool, device=sign.device)
    inside[pairs.row[chosen & (misfit < limit)]] = True
    inside &= config.vote_clear * best < second
    label = tracklets.label
    voting = inside & (label >= 0)
    owner, target, votes = distinct_pairs(label[voting], sign[voting])
    size = group_count(label, tracklets.count)[owner]
    wins = (votes >= config.vote_majority * size) & (votes >= config.vote_detections)
    of_tracklet = torch.full((tracklets.count + 1,), -1, dtype=label.dtype, device=label.device)
    of_tracklet[owner[wins]] = target[wins]
    winner = of_tracklet[label]  # label -1 reads the last slot, which stays -1
    return torch.where(inside & (sign == winner), sign, -1)


def _with_displaced(
    journey: Journey,
    pose: Float[Tensor, "f 4 4"],
    signs: Signs,
    association: Association,
    config: CompleteTracksConfig,
) -> Association:
    """The association with outlines that are off as a whole, where just that sign is missing in their frame."""
    detections = journey.signs
    pairs = candidates_nearby(
        journey, pose, signs, association, reach_m=config.reach_m, count=config.candidates
    )
    error = projection_errors(
        journey, pose, signs, association, pairs, window_s=config.error_window_s
    )
    alike = detections.shape[pairs.row] == signs.shape[pairs.sign]
    rows = torch.nonzero(error.is_between & ~error.is_shown & alike)[:, 0]
    pairs, offset = pairs[rows], error.offset_px[rows]
    seen, extent = box(detections.corners_px[pairs.row])
    expected, size = box(pairs.px)
    way = (seen - expected - offset).norm(dim=1)
    stretch = (extent / size.clamp_min(1e-6)).clamp_min(1e-6).log().abs().amax(1)
    # A small outline's sides are known to a pixel or two.
    allowed = config.displaced_size + config.known_px / pairs.size
    cost = way / config.displaced_px + stretch / allowed
    cost = cost.masked_fill((way > config.displaced_px) | (stretch > allowed), torch.inf)
    slot = detections.frame[pairs.row] * len(signs) + pairs.sign
    chosen = match_slots(pairs.row, slot, cost, rows=len(detections), unmatched_cost=2.0)
    target = torch.where(chosen < 0, chosen, chosen % max(len(signs), 1))
    _, shift = misfit_px(detections, signs, pairs, seen - expected)
    return _with_signs(association, target, pairs, shift)


def _with_signs(
    association: Association, target: Int[Tensor, " d"], pairs: Candidates, shift: Int[Tensor, " p"]
) -> Association:
    """The association in which detections without a sign show their target."""
    fresh = (association.sign < 0) & (target >= 0)
    chosen = fresh[pairs.row] & (pairs.sign == target[pairs.row])
    sign_shift = association.sign_shift.clone()
    sign_shift[pairs.row[chosen]] = shift[chosen]
    sign = torch.where(fresh, target, association.sign)
    return replace(association, sign=sign, sign_shift=sign_shift)
