"""V-A.1, unlike the paper: detections that clustering set aside are given back to the signs that they show (harvest).

The paper names its singletons as lost data. Here every detection without a landmark is compared with the projections of
the map's signs: second detections of a sign in a frame, outlines with a wrong corner or of a wrong shape, tracklets that
were too short or too uncertain to be triangulated, and signs that found no cluster.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from crowdmap_torch.clustering.groups import cheapest, distinct_pairs, group_count
from crowdmap_torch.clustering.matching import match_slots
from crowdmap_torch.clustering.neighbours import cross_pairs, near_pairs
from crowdmap_torch.geometry import camera, polygon, se3
from crowdmap_torch.tables import Association, Journey, SignDetections, Signs, Tracklets


@dataclass(frozen=True)
class HarvestConfig:
    """When a detection without a landmark shows a sign of the map."""

    reach_m: float = 120.0
    """Signs further from the camera are not looked for [m]."""
    candidates: int = 48
    """Signs that a detection is compared with, the nearest to its camera."""
    guide_s: float = 1.0
    """For so long before and after, a detection of a sign tells how its projection errs [s]."""
    guided_px: float = 3.0
    """Where that is known, most corners are within so many pixels ..."""
    guided_share: float = 0.1
    """... and this share of the outline's larger side of the projection."""
    free_share: float = 0.35
    """Where it is not, most corners are within this share, ..."""
    free_clear: float = 2.0
    """... other signs so many times as far, ..."""
    free_majority: float = 0.6
    """... and so is this share of the detections of the tracklet, ..."""
    free_detections: int = 3
    """... which has at least so many."""
    stray_px: float = 45.0
    """An outline this far off may be the only one missing in its frame of a sign that is seen before and after, ..."""
    stray_size: float = 0.2
    """... if its sides differ by no more than this share."""
    copy_m: float = 1.5
    """A sign this close to one that more journeys saw is a copy of it, if `free_majority` of its detections lie on the
    other's projection and nothing else in their frames shows the other [m]."""
    passes: int = 2
    """What was found tells how the projections of other detections err."""
    evidence: int = 3
    """Journeys with so many detections of a sign have seen it."""


@dataclass(frozen=True)
class Harvest:
    """The associations with what was brought back, and how much that is."""

    associations: tuple[Association, ...]
    fitting: int
    """Detections that lie on the projection of their sign."""
    strays: int
    """Detections of the right size and shape beside it, while nothing else shows it."""


def harvest_signs(
    journeys: Sequence[Journey],
    poses: Sequence[Float[Tensor, "f 4 4"]],
    tracklets: Sequence[Tracklets],
    signs: Signs,
    associations: Sequence[Association],
    config: HarvestConfig,
) -> Harvest:
    """The associations with the sign of the map that each detection without one shows, where one fits.

    `poses` are the cameras' in the frame of `signs`. What has a landmark keeps it.
    """
    found = []
    fitting = strays = 0
    for journey, pose, made, association in zip(
        journeys, poses, tracklets, associations, strict=True
    ):
        before = int((association.sign >= 0).sum())
        association = _fitted(journey, pose, made, signs, association, config)
        between = int((association.sign >= 0).sum())
        association = _with_strays(journey, pose, signs, association, config)
        found.append(association)
        fitting += between - before
        strays += int((association.sign >= 0).sum()) - between
    return Harvest(tuple(found), fitting, strays)


def copies(
    journeys: Sequence[Journey],
    poses: Sequence[Float[Tensor, "f 4 4"]],
    signs: Signs,
    associations: Sequence[Association],
    config: HarvestConfig,
) -> Bool[Tensor, " n"]:
    """True for signs that are another one badly placed, by what their detections show.

    A few frames from afar leave open which way a plate faces; two clusters of it are then far from each other in all
    that clustering compares, yet they look the same in every image.
    """
    n = len(signs)
    near = near_pairs(signs.center_world, radius=config.copy_m, count=config.candidates)
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
        number = partners[association.sign[rows]]
        rows = torch.repeat_interleave(rows, number)
        rank = torch.arange(len(rows), device=rows.device)
        rank = rank - torch.repeat_interleave(number.cumsum(0) - number, number)
        sights = _sights(journey, pose, signs, rows, stronger[start[association.sign[rows]] + rank])
        guide = _guide(journey, pose, signs, association, sights, config)
        misfit, _ = _misfit(journey.signs, signs, sights, guide.offset_px)
        inside = (misfit < config.free_share * sights.size) & ~guide.is_shown
        fits.append(torch.stack((association.sign[sights.row], sights.sign), dim=1)[inside])
    weaker, stronger, number = distinct_pairs(*torch.cat(fits).T)
    alike = number >= config.free_majority * total[weaker]
    weaker, stronger = weaker[alike], stronger[alike]
    # Of two that are copies of each other the first stays.
    is_first = (signs.n_journeys[weaker] == signs.n_journeys[stronger]) & (weaker < stronger)
    copy = torch.zeros(n, dtype=torch.bool, device=weaker.device)
    copy[weaker[~is_first]] = True
    return copy


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
    config: HarvestConfig,
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


def still_alone(
    singles: Signs, tracklets: Sequence[Tracklets], associations: Sequence[Association]
) -> Bool[Tensor, " n"]:
    """True for the signs of single journeys of whose detections less than half show a sign of the map."""
    alone = torch.ones(len(singles), dtype=torch.bool, device=singles.shape.device)
    for number in singles.journey.unique().tolist():
        label, count = tracklets[number].label, tracklets[number].count
        shown = group_count(label.masked_fill(associations[number].sign < 0, -1), count)
        rows = torch.nonzero(singles.journey == number)[:, 0]
        own = singles.tracklet[rows]
        alone[rows] = 2 * shown[own] < group_count(label, count)[own]
    return alone


@dataclass(frozen=True)
class _Sights:
    """Pairs of a detection and a sign that its camera may see."""

    row: Int[Tensor, " p"]
    """Detection of the journey."""
    sign: Int[Tensor, " p"]
    px: Float[Tensor, "p 8 2"]
    """Projected corners."""
    size: Float[Tensor, " p"]
    """Larger side of their box [px]."""

    def __getitem__(self, index: Tensor) -> _Sights:
        return _Sights(self.row[index], self.sign[index], self.px[index], self.size[index])


@dataclass(frozen=True)
class _Guide:
    """How the projections of signs err, from detections nearby in time."""

    offset_px: Float[Tensor, "p 2"]
    """Of the detections from the projection; zero where nothing tells."""
    is_known: Bool[Tensor, " p"]
    is_between: Bool[Tensor, " p"]
    """The sign is seen before and after."""
    is_shown: Bool[Tensor, " p"]
    """Another detection of the frame shows the sign."""


def _fitted(
    journey: Journey,
    pose: Float[Tensor, "f 4 4"],
    tracklets: Tracklets,
    signs: Signs,
    association: Association,
    config: HarvestConfig,
) -> Association:
    """The association with detections that lie on the projection of a sign."""
    sights = _sights_without_sign(journey, pose, signs, association, config)
    for _ in range(config.passes):
        guide = _guide(journey, pose, signs, association, sights, config)
        misfit, shift = _misfit(journey.signs, signs, sights, guide.offset_px)
        limit = config.guided_px + config.guided_share * sights.size
        guided = misfit.masked_fill(~guide.is_known | (misfit > limit), torch.inf)
        _, target = cheapest(sights.row, sights.sign, guided, len(association.sign))
        free = _free_votes(tracklets, sights, misfit, guide, len(target), config)
        target = torch.where(target < 0, free, target)
        association = _joined(association, target, sights, shift)
    return association


def _free_votes(
    tracklets: Tracklets,
    sights: _Sights,
    misfit: Float[Tensor, " p"],
    guide: _Guide,
    rows: int,
    config: HarvestConfig,
) -> Int[Tensor, " d"]:
    """The sign that most detections of a tracklet lie on, for those that do; -1 for the others."""
    limit = config.free_share * sights.size
    limit = torch.where(guide.is_known, config.guided_px + config.guided_share * sights.size, limit)
    best, sign = cheapest(sights.row, sights.sign, misfit, rows)
    other = sights.sign != sign[sights.row]
    second, _ = cheapest(sights.row[other], sights.sign[other], misfit[other], rows)
    chosen = sights.sign == sign[sights.row]
    inside = torch.zeros(rows, dtype=torch.bool, device=sign.device)
    inside[sights.row[chosen & (misfit < limit)]] = True
    inside &= config.free_clear * best < second
    label = tracklets.label
    voting = inside & (label >= 0)
    owner, target, votes = distinct_pairs(label[voting], sign[voting])
    size = group_count(label, tracklets.count)[owner]
    wins = (votes >= config.free_majority * size) & (votes >= config.free_detections)
    of_tracklet = torch.full((tracklets.count + 1,), -1, dtype=label.dtype, device=label.device)
    of_tracklet[owner[wins]] = target[wins]
    winner = of_tracklet[label]  # label -1 reads the last slot, which stays -1
    return torch.where(inside & (sign == winner), sign, -1)


def _with_strays(
    journey: Journey,
    pose: Float[Tensor, "f 4 4"],
    signs: Signs,
    association: Association,
    config: HarvestConfig,
) -> Association:
    """The association with outlines that are off as a whole, where just that sign is missing in their frame."""
    detections = journey.signs
    sights = _sights_without_sign(journey, pose, signs, association, config)
    guide = _guide(journey, pose, signs, association, sights, config)
    alike = detections.shape[sights.row] == signs.shape[sights.sign]
    rows = torch.nonzero(guide.is_between & ~guide.is_shown & alike)[:, 0]
    sights, offset = sights[rows], guide.offset_px[rows]
    seen, extent = _box(detections.corners_px[sights.row])
    expected, size = _box(sights.px)
    way = (seen - expected - offset).norm(dim=1)
    stretch = (extent / size.clamp_min(1e-6)).clamp_min(1e-6).log().abs().amax(1)
    # A small outline's sides are known to a pixel or two.
    allowed = config.stray_size + config.guided_px / sights.size
    cost = way / config.stray_px + stretch / allowed
    cost = cost.masked_fill((way > config.stray_px) | (stretch > allowed), torch.inf)
    slot = detections.frame[sights.row] * len(signs) + sights.sign
    chosen = match_slots(sights.row, slot, cost, rows=len(detections), unmatched_cost=2.0)
    target = torch.where(chosen < 0, chosen, chosen % max(len(signs), 1))
    _, shift = _misfit(detections, signs, sights, seen - expected)
    return _joined(association, target, sights, shift)


def _sights(
    journey: Journey,
    pose: Float[Tensor, "f 4 4"],
    signs: Signs,
    row: Int[Tensor, " q"],
    sign: Int[Tensor, " q"],
) -> _Sights:
    """Of pairs of a detection and a sign, those whose sign faces the camera and projects into its image."""
    T = pose[journey.signs.frame[row]]
    ray = signs.center_world[sign] - T[:, :3, 3]
    faces = (ray * signs.normal_world[sign]).sum(1) < 0
    row, sign = row[faces], sign[faces]
    px, is_seen = _projected(journey, T[faces], signs, sign)
    _, extent = _box(px)
    return _Sights(row, sign, px, extent.amax(1))[is_seen]


def _sights_without_sign(
    journey: Journey,
    pose: Float[Tensor, "f 4 4"],
    signs: Signs,
    association: Association,
    config: HarvestConfig,
) -> _Sights:
    """Detections that show no sign yet, each with the signs around its camera."""
    rows = torch.nonzero(association.sign < 0)[:, 0]
    position = pose[journey.signs.frame[rows], :3, 3]
    at, sign = cross_pairs(
        position, signs.center_world, radius=config.reach_m, count=config.candidates
    ).T
    return _sights(journey, pose, signs, rows[at], sign)


def _projected(
    journey: Journey, T_world_camera: Float[Tensor, "p 4 4"], signs: Signs, sign: Int[Tensor, " p"]
) -> tuple[Float[Tensor, "p 8 2"], Bool[Tensor, " p"]]:
    """Corners of signs in the image, and whether the camera sees most of them."""
    corner = signs.corners_world[sign]
    px, visible = camera.project(
        journey.rig.camera, se3.transform(se3.inverse(T_world_camera)[:, None], corner)
    )
    return px, visible.sum(1) > visible.shape[1] // 2


def _guide(
    journey: Journey,
    pose: Float[Tensor, "f 4 4"],
    signs: Signs,
    association: Association,
    sights: _Sights,
    config: HarvestConfig,
) -> _Guide:
    """How the projection of each sight errs, between the nearest detections of its sign before and after."""
    detections = journey.signs
    rows = torch.nonzero(association.sign >= 0)[:, 0]
    rows = rows[detections.shape[rows] == signs.shape[association.sign[rows]]]
    sign = association.sign[rows]
    px, _ = _projected(journey, pose[detections.frame[rows]], signs, sign)
    count = polygon.corner_count(signs.shape[sign])
    corners = polygon.roll(detections.corners_px[rows], association.sign_shift[rows], count)
    # Padded slots repeat the last corner, which hardly moves the median.
    error = (corners - px).median(1).values

    t = journey.t_ns - journey.t_ns[:1]
    window = round(1e9 * config.guide_s)
    span = int(t[-1:].sum()) + 2 * window + 1  # signs are further apart than any window
    key = sign * span + t[detections.frame[rows]]
    asked = sights.sign * span + t[detections.frame[sights.row]]
    order = key.argsort(stable=True)
    # A guide before and one behind all others, too far from anything to tell.
    beyond = key.new_tensor([-1 - window, len(signs) * span + window])
    key = torch.cat((beyond[:1], key[order], beyond[1:]))
    error = torch.nn.functional.pad(error[order], (0, 0, 1, 1))
    after = torch.searchsorted(key, asked)
    before = torch.searchsorted(key, asked, right=True) - 1
    way_after, way_before = key[after] - asked, asked - key[before]
    has_after, has_before = way_after <= window, way_before <= window
    between = way_before / (way_before + way_after).clamp_min(1)
    share = torch.where(has_after & has_before, between, has_after.to(error))
    offset = torch.lerp(error[before], error[after], share[:, None].to(error))
    is_known = has_after | has_before
    return _Guide(
        offset_px=torch.where(is_known[:, None], offset, 0.0),
        is_known=is_known,
        is_between=has_after & has_before,
        is_shown=way_after == 0,
    )


def _misfit(
    detections: SignDetections, signs: Signs, sights: _Sights, offset_px: Float[Tensor, "p 2"]
) -> tuple[Float[Tensor, " p"], Int[Tensor, " p"]]:
    """Distance within which most corners lie of the projected ones [px], and the shift of the corners that brings them.

    Outlines of different shapes are compared by their boxes.
    """
    shape = signs.shape[sights.sign]
    seen, expected = detections.corners_px[sights.row], sights.px + offset_px[:, None]
    count = polygon.corner_count(shape)
    rank = torch.arange(polygon.MAX_CORNERS, device=count.device)
    misfits = []
    for shift in rank:
        way = (polygon.roll(seen, shift.expand_as(count), count) - expected).norm(dim=2)
        way = way.masked_fill(rank >= count[:, None], torch.inf).sort(1).values
        most = way.gather(1, count[:, None] // 2)[:, 0]
        misfits.append(most.masked_fill(shift >= count, torch.inf))
    misfit, shift = torch.stack(misfits, dim=1).min(1)
    (centre, extent), (other_centre, other_extent) = _box(seen), _box(expected)
    by_box = torch.maximum(
        (centre - other_centre).norm(dim=1), (extent - other_extent).abs().amax(1) / 2
    )
    alike = detections.shape[sights.row] == shape
    return torch.where(alike, misfit, by_box), shift.masked_fill(~alike, 0)


def _box(px: Float[Tensor, "p 8 2"]) -> tuple[Float[Tensor, "p 2"], Float[Tensor, "p 2"]]:
    """Centre and extent of the box around each outline [px]; padded slots repeat a corner."""
    low, high = px.amin(1), px.amax(1)
    return (low + high) / 2, high - low


def _joined(
    association: Association,
    target: Int[Tensor, " d"],
    sights: _Sights,
    shift: Int[Tensor, " p"],
) -> Association:
    """The association in which detections without a sign show their target."""
    fresh = (association.sign < 0) & (target >= 0)
    chosen = fresh[sights.row] & (sights.sign == target[sights.row])
    sign_shift = association.sign_shift.clone()
    sign_shift[sights.row[chosen]] = shift[chosen]
    sign = torch.where(fresh, target, association.sign)
    return replace(association, sign=sign, sign_shift=sign_shift)
