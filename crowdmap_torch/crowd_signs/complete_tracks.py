"""V-A.1: the detections of every sign of the map; what clustering set aside is given back to the signs that it shows.

Unlike the paper, which names its singletons as lost data, every detection without a landmark is compared with the
projections of the map's signs: second detections of a sign in a frame, outlines with a wrong corner or of a wrong shape,
tracklets that were too short or too uncertain to be triangulated, and signs that found no cluster.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from crowdmap_torch.clustering.assignment import match_slots
from crowdmap_torch.clustering.groups import cheapest, group_count
from crowdmap_torch.crowd_signs.company import frame_number, in_company, passing_of, placed_by
from crowdmap_torch.crowd_signs.completion import (
    AssociatedSigns,
    CompletedTracks,
    CompleteTracksConfig,
)
from crowdmap_torch.crowd_signs.duplicates import DuplicateSignConfig, duplicate_signs, same_sign
from crowdmap_torch.crowd_signs.evidence import (
    of_its_shape,
    seen_by,
    shown_by_members,
    shown_by_trusted,
    tracklet_votes,
)
from crowdmap_torch.crowd_signs.existence import existence, still_alone
from crowdmap_torch.crowd_signs.gather import signs_of_crowd
from crowdmap_torch.crowd_signs.projections import (
    Candidates,
    box,
    candidates_nearby,
    misfit_px,
    projection_errors,
)
from crowdmap_torch.crowd_signs.register import Crowd, CrowdConfig
from crowdmap_torch.geometry import polygon
from crowdmap_torch.tables import Association, Journey, Signs, Tracklets, concatenate


def associate_detections(
    journeys: Sequence[Journey],
    poses: Sequence[Float[Tensor, "_ 4 4"]],
    tracklets: Sequence[Tracklets],
    crowd: Crowd,
    config: CrowdConfig,
    completion: CompleteTracksConfig,
) -> AssociatedSigns:
    """The cluster heads with the detections of their members and, with `joint`, what else shows them in the images.

    `poses` are the journeys' with the biases of the crowd taken off. A head that is another one badly placed goes, a sign of
    one journey that others see too becomes one.
    """
    given, clusters = (journeys, poses, tracklets), (crowd.members, crowd.label, crowd.heads)
    associations = tuple(
        with_members(no_association(journey), made, *clusters, number)
        for number, (journey, made) in enumerate(zip(journeys, tracklets, strict=True))
    )
    if config.method == "paper2017":
        return AssociatedSigns(crowd.heads, crowd.tentative, associations, None)
    duplicate = duplicate_signs(journeys, poses, crowd.heads, associations, completion)
    of_heads, of_singles = crowd.report.n_passing.split([len(crowd.heads), len(crowd.tentative)])
    heads = crowd.heads[~duplicate]
    associations = without_signs(associations, duplicate)
    trusted = crowd.journey_weight > 0
    heads, completed = completed_signs(*given, heads, associations, completion, trusted=trusted)
    associations = completed.associations
    sure = existence(heads.n_journeys, of_heads[~duplicate], config.existence)
    # What a bad drive alone saw, or one where its positions were off, is nothing to look for.
    sound = trusted[crowd.tentative.journey] & ~crowd.displaced[crowd.label < 0]
    tentative, passing = crowd.tentative[sound], of_singles[sound]
    alone = still_alone(tentative, tracklets, associations)
    heads = replace(heads, confidence=sure.to(heads.size))
    found = AssociatedSigns(heads, tentative[alone], associations, completed)
    found = with_vouched(*given, found, passing[alone], config, completion, trusted=trusted)
    # In which not even the journey that saw them has any confidence.
    return replace(found, tentative=found.tentative[found.tentative.confidence > 0])


def with_vouched(
    journeys: Sequence[Journey],
    poses: Sequence[Float[Tensor, "_ 4 4"]],
    tracklets: Sequence[Tracklets],
    found: AssociatedSigns,
    passing: Int[Tensor, " n"],
    config: CrowdConfig,
    completion: CompleteTracksConfig,
    *,
    trusted: Bool[Tensor, " j"],
) -> AssociatedSigns:
    """The same with those tentative signs among the heads that detections of other drives lie on, `passing` drives by each.

    Who sees a sign from afar alone, or for a moment, makes no sign of it, but tells whether there is one where another
    drive has it.
    """
    heads, singles = found.heads, found.tentative
    if not len(singles):
        return found
    every, n = concatenate([heads, singles]), len(heads)
    row = n + torch.arange(len(singles), device=singles.shape.device)
    drives = zip(journeys, poses, tracklets, found.associations, strict=True)
    # What lies on no head was compared with all of them before.
    shown = tuple(
        _with_fitting(
            *(journey, pose, made, every),
            *(with_members(seen, made, singles, row, every, k), completion),
            first=n,
        )
        for k, (journey, pose, made, seen) in enumerate(drives)
    )
    every = with_evidence(every, journeys, shown, trusted, completion)
    # What is drawn as another shape is as likely another sign, or none, that lies before or behind it.
    alike = [of_its_shape(a, j, every) for a, j in zip(shown, journeys, strict=True)]
    _, sign_shown, journey = shown_by_trusted(alike, trusted)
    vouched = seen_by(sign_shown, journey, len(every), completion)[n:] >= config.min_journeys
    if not bool(vouched.any()):
        return found
    sure = existence(every.n_journeys[n:], passing, config.existence).to(heads.size)
    every = replace(every, confidence=torch.cat((heads.confidence, sure)))
    kept = torch.cat((vouched.new_ones(n), vouched))
    associations = without_signs(shown, ~kept)
    left = singles[~vouched]
    left = left[still_alone(left, tracklets, associations)]
    assert found.completed is not None
    more = sum(int((a.sign >= 0).sum()) for a in associations)
    more -= sum(int((a.sign >= 0).sum()) for a in found.associations)
    completed = replace(
        found.completed, associations=associations, fitting=found.completed.fitting + more
    )
    return AssociatedSigns(every[kept], left, associations, completed)


def with_members(
    association: Association,
    tracklets: Tracklets,
    members: Signs,
    label: Int[Tensor, " n"],
    heads: Signs,
    number: int,
) -> Association:
    """The association of the `number`-th journey whose detections without a sign show the head of their tracklet's sign."""
    head, shift = shown_by_members(tracklets, members, label, heads, number)
    fresh = (association.sign < 0) & (head >= 0)
    sign = torch.where(fresh, head, association.sign)
    return replace(
        association, sign=sign, sign_shift=torch.where(fresh, shift, association.sign_shift)
    )


def no_association(journey: Journey) -> Association:
    """The association of a journey whose detections show nothing."""
    none, no_lane = (torch.full_like(found.row, -1) for found in (journey.signs, journey.lanes))
    return Association(sign=none, sign_shift=torch.zeros_like(none), lane=no_lane)


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


def associated_once(
    journeys: Sequence[Journey],
    poses: Sequence[Float[Tensor, "_ 4 4"]],
    tracklets: Sequence[Tracklets],
    before: AssociatedSigns,
    config: DuplicateSignConfig,
    completion: CompleteTracksConfig,
    trusted: Bool[Tensor, " j"],
) -> AssociatedSigns | None:
    """What is `before` with those signs joined that are one, and with what else shows them by now; None if none are.

    `poses` and the heads are adjusted; the heads' covariances are those of their centres without what all positions share.
    """
    into = same_sign(before.heads, journeys, before.associations, config)
    if torch.equal(into, torch.arange(len(into), device=into.device)):
        return None
    joined = merged_signs(before.heads, before.associations, into)
    given = journeys, poses, tracklets, *joined
    return _associated_anew(*given, before.tentative, completion, trusted)


def without_strayed(
    journeys: Sequence[Journey],
    poses: Sequence[Float[Tensor, "_ 4 4"]],
    tracklets: Sequence[Tracklets],
    found: AssociatedSigns,
    goes: Bool[Tensor, " n"],
    completion: CompleteTracksConfig,
    trusted: Bool[Tensor, " j"],
) -> AssociatedSigns:
    """What is `found` without the heads that `goes`, and with what else shows the others by adjusted `poses`."""
    left = found.heads[~goes], without_signs(found.associations, goes)
    return _associated_anew(journeys, poses, tracklets, *left, found.tentative, completion, trusted)


def with_company(
    journeys: Sequence[Journey],
    poses: Sequence[Float[Tensor, "_ 4 4"]],
    tracklets: Sequence[Tracklets],
    found: AssociatedSigns,
    before: Sequence[Association],
    sure: Sequence[Signs],
    from_afar: Sequence[Signs],
    crowd: Crowd,
    config: CrowdConfig,
    rules: DuplicateSignConfig,
    completion: CompleteTracksConfig,
    trusted: Bool[Tensor, " j"],
) -> AssociatedSigns | None:
    """What is `found` with those signs of single journeys that are `in_company` by adjusted `poses`; None if there are none.

    Signs `from_afar` say that `sure` ones of other journeys are one, and are none of the map themselves. What showed a sign
    `before` that is none is not looked at again.
    """
    least, n = min(config.min_journeys, len(journeys)), len(found.heads)
    if least < 2:
        return None
    own = signs_of_crowd(sure, from_afar, least)
    sound = torch.cat(crowd.trusted_frames(journeys))[frame_number(journeys, own)]
    sound &= still_alone(own, tracklets, before) & still_alone(own, tracklets, found.associations)
    alone = own[sound]
    placed = placed_by(alone, journeys, poses)
    alone = replace(alone, T_world_sign=placed.T_world_sign)
    into = in_company(alone, placed.view_position, found.heads, least, rules.company)
    new, label = torch.unique(torch.cat((into.new_tensor([-1]), into)), return_inverse=True)
    if len(new) == 1:
        return None
    every, label = concatenate([found.heads, alone[new[1:]]]), label[1:] - 1
    label = torch.where(label < 0, label, n + label)
    drives = zip(tracklets, found.associations, strict=True)
    shown = [with_members(a, t, alone, label, every, k) for k, (t, a) in enumerate(drives)]
    given = journeys, poses, tracklets, every, shown, found.tentative, completion, trusted
    more = _associated_anew(*given)
    passed = passing_of(every[n:], crowd.members, crowd.label, crowd.report.n_passing)
    likely = existence(more.heads.n_journeys[n:], passed, config.existence).to(every.confidence)
    confidence = torch.cat((found.heads.confidence, likely))
    return replace(more, heads=replace(more.heads, confidence=confidence))


def merged_signs(
    signs: Signs, associations: Sequence[Association], into: Int[Tensor, " n"]
) -> tuple[Signs, tuple[Association, ...]]:
    """The signs but for those that go `into` another one, and which of them each detection shows; what stays is its own.

    What goes into none, -1, leaves its detections without a sign.
    """
    every = torch.arange(len(into), device=into.device)
    goes, count = into != every, polygon.corner_count(signs.shape)
    turn, _ = polygon.best_shift(signs.corners_world[into], signs.corners_world, count)
    moved = tuple(_shown_by(a, into, turn, count) for a in associations)
    heir = torch.where(into < 0, every, into)
    sure = signs.confidence.scatter_reduce(0, heir, signs.confidence, "amax")
    return replace(signs, confidence=sure)[~goes], without_signs(moved, goes)


def without_signs(
    associations: Sequence[Association], dropped: Bool[Tensor, " n"]
) -> tuple[Association, ...]:
    """The associations with the signs that are kept, numbered anew; detections of dropped ones show none."""
    number = torch.where(dropped, -1, (~dropped).cumsum(0) - 1)
    number = torch.cat((number, number.new_full((1,), -1)))  # label -1 reads the last slot
    return tuple(replace(a, sign=number[a.sign]) for a in associations)


def with_evidence(
    signs: Signs,
    journeys: Sequence[Journey],
    associations: Sequence[Association],
    trusted: Bool[Tensor, " j"],
    config: CompleteTracksConfig,
) -> Signs:
    """The signs with how often, by how many `trusted` journeys and when they were seen, from the detections of those."""
    used, shown, journey = shown_by_trusted([a.sign for a in associations], trusted)
    t_ns = torch.cat([j.t_ns[j.signs.frame] for j in journeys])[used]
    return replace(
        signs,
        n_journeys=seen_by(shown, journey, len(signs), config),
        n_observations=group_count(shown, len(signs)),
        first_seen_ns=signs.first_seen_ns.scatter_reduce(0, shown, t_ns, "amin"),
        last_seen_ns=signs.last_seen_ns.scatter_reduce(0, shown, t_ns, "amax"),
    )


def _associated_anew(
    journeys: Sequence[Journey],
    poses: Sequence[Float[Tensor, "_ 4 4"]],
    tracklets: Sequence[Tracklets],
    heads: Signs,
    associations: Sequence[Association],
    tentative: Signs,
    completion: CompleteTracksConfig,
    trusted: Bool[Tensor, " j"],
) -> AssociatedSigns:
    given = journeys, poses, tracklets, heads, associations
    heads, completed = completed_signs(*given, completion, trusted=trusted)
    alone = still_alone(tentative, tracklets, completed.associations)
    return AssociatedSigns(heads, tentative[alone], completed.associations, completed)


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


def _with_fitting(
    journey: Journey,
    pose: Float[Tensor, "f 4 4"],
    tracklets: Tracklets,
    signs: Signs,
    association: Association,
    config: CompleteTracksConfig,
    *,
    first: int = 0,
) -> Association:
    """The association with detections that lie on the projection of a sign, of those from the row `first` on."""
    reach = {"reach_m": config.reach_m, "count": config.candidates, "first": first}
    pairs = candidates_nearby(journey, pose, signs, association, **reach)
    for _ in range(config.passes):
        error = projection_errors(
            journey, pose, signs, association, pairs, window_s=config.error_window_s
        )
        misfit, shift = misfit_px(journey.signs, signs, pairs, error.offset_px)
        limit = config.known_px + config.known_share * pairs.size
        known = misfit.masked_fill(~error.is_known | (misfit > limit), torch.inf)
        _, target = cheapest(pairs.row, pairs.sign, known, len(association.sign))
        voted = tracklet_votes(tracklets, pairs, misfit, error, len(target), config)
        target = torch.where(target < 0, voted, target)
        association = _with_signs(association, target, pairs, shift)
    return association


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
