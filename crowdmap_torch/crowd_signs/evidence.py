"""V-A.1, unlike the paper: who saw the signs of a map, by the detections that show them."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from crowdmap_torch.clustering.groups import cheapest, distinct_pairs, group_count
from crowdmap_torch.crowd_signs.completion import CompleteTracksConfig
from crowdmap_torch.crowd_signs.projections import Candidates, ProjectionErrors
from crowdmap_torch.geometry import polygon
from crowdmap_torch.tables import Association, Journey, Signs, Tracklets

_USUAL = 2.0
"""Hardly any detection is farther off its sign than so many times what half of them are."""


def seen_by(
    shown: Int[Tensor, " u"], journey: Int[Tensor, " u"], count: int, config: CompleteTracksConfig
) -> Int[Tensor, " n"]:
    """How many journeys saw each of `count` signs, by the sign that each detection shows and its journey."""
    owner, _, views = distinct_pairs(shown, journey)
    return group_count(owner[views >= config.evidence], count)


def of_its_shape(association: Association, journey: Journey, signs: Signs) -> Int[Tensor, " d"]:
    """The sign that each detection of a journey shows if it has that sign's shape; -1: it shows none, or as another one."""
    shown = association.sign
    alike = journey.signs.shape == signs.shape[shown.clamp_min(0)]
    return shown.masked_fill(~alike, -1)


def shown_by_members(
    tracklets: Tracklets, members: Signs, label: Int[Tensor, " n"], heads: Signs, number: int
) -> tuple[Int[Tensor, " d"], Int[Tensor, " d"]]:
    """The head that every detection of the `number`-th journey shows, -1: none, and how its corners are turned against it.

    It is the one of the `heads` that the sign of its tracklet, one of the `members`, has for its `label`.
    """
    mine = torch.nonzero(members.journey == number)[:, 0]
    row_of_tracklet = torch.full((tracklets.count + 1,), -1, device=mine.device)
    row_of_tracklet[members.tracklet[mine]] = mine
    member = row_of_tracklet[tracklets.label]  # label -1 reads the last slot, which stays -1
    found = member >= 0
    head = member.masked_scatter(found, label[member[found]])
    used = torch.nonzero(head >= 0)[:, 0]
    of_member, of_head = members[member[used]], heads[head[used]]
    count = polygon.corner_count(of_head.shape)
    turn, _ = polygon.best_shift(of_head.corners_world, of_member.corners_world, count)
    assert tracklets.shift is not None
    shift = torch.zeros_like(head).index_put((used,), (turn + tracklets.shift[used]) % count)
    return head, shift


def shown_by_trusted(
    label: Sequence[Int[Tensor, " _"]], trusted: Bool[Tensor, " j"]
) -> tuple[Int[Tensor, " u"], Int[Tensor, " u"], Int[Tensor, " u"]]:
    """Rows, of all journeys' detections, that show a sign and are of trusted journeys; that sign, and the journey.

    `label`: by journey the sign that each detection shows, -1 is none.
    """
    size = torch.tensor([len(own) for own in label], device=trusted.device)
    journey = torch.repeat_interleave(torch.arange(len(label), device=trusted.device), size)
    shown = torch.cat([*label])
    used = torch.nonzero((shown >= 0) & trusted[journey])[:, 0]
    return used, shown[used], journey[used]


def reach_of_noise(
    pairs: Candidates, error: ProjectionErrors, config: CompleteTracksConfig
) -> Float[Tensor, " p"]:
    """How far [px] most corners of a detection may be off its sign where it is known how projections err.

    Where images are noisy most are farther off than `known_px`.
    """
    known_px = (_USUAL * error.usual_px).clamp_min(config.known_px)
    return known_px + config.known_share * pairs.size


def tracklet_votes(
    tracklets: Tracklets,
    pairs: Candidates,
    misfit: Float[Tensor, " p"],
    error: ProjectionErrors,
    rows: int,
    config: CompleteTracksConfig,
) -> Int[Tensor, " d"]:
    """The sign that most detections of a tracklet lie on, for those that do; -1 for the others."""
    limit = config.vote_share * pairs.size
    limit = torch.where(error.is_known, reach_of_noise(pairs, error, config), limit)
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
