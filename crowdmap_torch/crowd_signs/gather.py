"""The signs of a crowd: every journey's own triangulations in one table, with when and from where each was seen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from crowdmap_torch.clustering.groups import distinct_pairs, pairs_within
from crowdmap_torch.geometry.trajectory import station as along_track
from crowdmap_torch.noise.leaps import largest_leap
from crowdmap_torch.noise.stated_sigmas import stated_sigmas
from crowdmap_torch.optim.robust import median_along
from crowdmap_torch.tables import Journey, Signs, Tracklets, concatenate

_SOME_CONFIDENCE = 1e-9
"""Least confidence of a sign that is not doubtful: detectors may give all scores as zero."""
_ONE_PLACE = 0.5
"""Detections nearer to each other in the image than this share of the smaller one show one sign."""


@dataclass(frozen=True)
class CrowdSigns:
    """The signs of all journeys, and what is known about when each was seen."""

    signs: Signs
    """Each journey's own triangulations, as measured."""
    station: Float[Tensor, " n"]
    """Distance driven to where the sign was closest [m]."""
    view_position: Float[Tensor, "n 3"]
    """The camera where the sign was closest, as measured [m]."""
    view_direction: Float[Tensor, "n 3"]
    """Where it looked."""
    seen_together: Int[Tensor, "p 2"]
    """Pairs of signs of one journey that were seen beside each other in a frame: never one sign."""
    leap: Float[Tensor, " j"]
    """Largest step between two frames of each journey beyond what a car can drive [m]."""
    bias_sigma: Float[Tensor, "j 3"]
    """Prior 1-sigma of each journey's bias, east north up [m]."""
    path_journey: Int[Tensor, " q"]
    """Journey of each sample of the paths driven."""
    path_position: Float[Tensor, "q 3"]
    """Camera positions every few metres, as measured [m]."""
    path_direction: Float[Tensor, "q 3"]
    """Where the camera looked."""

    @property
    def journeys(self) -> int:
        """How many journeys there are."""
        return len(self.bias_sigma)

    @property
    def doubtful(self) -> Bool[Tensor, " n"]:
        """True for signs that their own journeys alone take for none (`signs_of_crowd`)."""
        return self.signs.confidence == 0

    @property
    def viewing_axes(self) -> Float[Tensor, "n 3 3"]:
        """Columns: horizontally along the camera's axis where each sign was closest, across it, and up."""
        level = self.view_direction * self.view_direction.new_tensor([1.0, 1.0, 0.0])
        along = torch.nn.functional.normalize(level, dim=1)
        up = torch.zeros_like(along)
        up[:, 2] = 1
        return torch.stack((along, torch.linalg.cross(up, along), up), dim=2)


def signs_of_crowd(signs: Sequence[Signs], doubtful: Sequence[Signs], min_journeys: int) -> Signs:
    """The signs of all journeys, and behind them the `doubtful` ones, by journey.

    Two journeys that show such a sign at one place vouch for each other. Where signs of one journey are to be in the map
    nobody vouches for them, and they are left out. They have no confidence; all others have some, whatever their scores.
    """
    sure = concatenate(list(signs))
    if min(min_journeys, len(signs)) < 2:
        return sure
    sure = replace(sure, confidence=sure.confidence.clamp_min(_SOME_CONFIDENCE))
    numbered = (
        replace(
            made,
            journey=torch.full_like(made.journey, number),
            confidence=torch.zeros_like(made.confidence),
        )
        for number, made in enumerate(doubtful)
    )
    return concatenate([sure, *numbered])


def gather_signs(
    journeys: Sequence[Journey],
    tracklets: Sequence[Tracklets],
    signs: Signs,
    *,
    bias_sigma_m: tuple[float, float, float],
    path_step_m: float = 4.0,
) -> CrowdSigns:
    """The signs of all journeys with when each was seen.

    `signs.journey` and `signs.tracklet` index the two sequences. `bias_sigma_m` is the prior 1-sigma of a bias, east
    north up [m], where the poses of a journey do not say.
    """
    frame_offset = 0
    station = signs.confidence.new_zeros(len(signs))
    view = signs.T_world_sign.new_zeros(len(signs), 4, 4)
    frame_key, seen_sign, middle, extent = [], [], [], []
    leap = station.new_zeros(len(journeys))
    sigma = station.new_tensor(bias_sigma_m).repeat(len(journeys), 1)
    path: list[tuple[Tensor, Tensor, Tensor]] = []
    for j, (journey, found) in enumerate(zip(journeys, tracklets, strict=True)):
        rows = torch.nonzero(signs.journey == j)[:, 0]
        distance = along_track(journey.T_world_camera)
        leap[j] = largest_leap(journey.T_world_camera[:, :3, 3], journey.t_ns)
        frame = signs.frame[rows]
        station[rows] = distance[frame]
        view[rows] = journey.T_world_camera[frame]
        row_of = torch.full((max(found.count, 1),), -1, dtype=rows.dtype, device=rows.device)
        row_of[signs.tracklet[rows]] = rows
        seen = torch.where(found.label >= 0, row_of[found.label.clamp_min(0)], -1)
        shown = journey.signs[seen >= 0]
        corners = shown.corners_ideal
        frame_key.append(frame_offset + shown.frame)
        seen_sign.append(seen[seen >= 0])
        middle.append((corners.amin(1) + corners.amax(1)) / 2)
        extent.append((corners.amax(1) - corners.amin(1)).amax(1))
        frame_offset += journey.frame_count
        stated, _ = stated_sigmas(journey)
        if stated is not None:
            sigma[j] = stated.clamp_min(0.05)
        if journey.frame_count:
            step = (distance / path_step_m).floor()
            sampled = torch.cat((step.new_ones(1, dtype=torch.bool), step.diff() > 0))
            T = journey.T_world_camera[sampled]
            owner = torch.full((len(T),), j, dtype=rows.dtype, device=rows.device)
            path.append((owner, T[:, :3, 3], T[:, :3, 2]))
    owner, position, direction = (torch.cat(c) for c in zip(*path, strict=True))
    return CrowdSigns(
        signs=signs,
        station=station,
        view_position=view[:, :3, 3],
        view_direction=view[:, :3, 2],
        seen_together=pairs_seen_together(
            torch.cat(seen_sign),
            torch.cat(frame_key),
            torch.cat(middle),
            torch.cat(extent),
            len(signs),
        ),
        leap=leap,
        bias_sigma=sigma,
        path_journey=owner,
        path_position=position,
        path_direction=direction,
    )


def pairs_seen_together(
    sign: Int[Tensor, " d"],
    frame: Int[Tensor, " d"],
    middle: Float[Tensor, "d 2"],
    extent: Float[Tensor, " d"],
    n: int,
) -> Int[Tensor, "p 2"]:
    """Pairs of the `n` signs that were seen beside each other in a frame, from detections with their `middle` and size.

    `frame` numbers the frames of all journeys on. Detections on top of each other are one sign detected twice: they do
    not tell two signs apart.
    """
    first, second = pairs_within(frame).T
    distance = (middle[first] - middle[second]).norm(dim=1)
    beside = distance > _ONE_PLACE * torch.minimum(extent[first], extent[second])
    a, b = sign[first[beside]], sign[second[beside]]
    low, high, _ = distinct_pairs(torch.minimum(a, b), torch.maximum(a, b))
    pairs = torch.stack((low, high), dim=1)
    return pairs[low != high]


def with_covariance(signs: Signs, extra: Float[Tensor, "n 3 3"]) -> Signs:
    """The same signs, `extra` [m^2] less certain."""
    return replace(signs, covariance=signs.covariance + extra)


def unexplained_covariance(crowd: CrowdSigns, sigma: Float[Tensor, " 3"]) -> Float[Tensor, "n 3 3"]:
    """What is missing from the covariance of each sign for 1-sigmas of `sigma` [m] along its viewing axes."""
    axes = crowd.viewing_axes
    own = (axes.mT @ crowd.signs.covariance @ axes).diagonal(dim1=1, dim2=2)
    missing = (sigma.square() - own).clamp_min(0)
    return axes @ torch.diag_embed(missing) @ axes.mT


def miss_sigma(
    crowd: CrowdSigns, unbiased: Signs, label: Int[Tensor, " n"], heads: Signs
) -> Float[Tensor, " 3"]:
    """Robust 1-sigma of what signs miss their clusters by along their viewing axes [m]; zero if there are none."""
    used = label >= 0
    miss = unbiased.center_world[used] - heads.center_world[label[used]]
    if not len(miss):
        return miss.new_zeros(3)
    along = (crowd.viewing_axes[used].mT @ miss[..., None])[..., 0]
    return 1.4826 * median_along(along.abs(), 0)


def enough_to_tell(
    signs: Signs, *, most: int, cell_m: float, generator: torch.Generator
) -> Bool[Tensor, " n"]:
    """True for the signs of at most `most` journeys in each cell of `cell_m` [m], chosen at random."""
    if not len(signs):
        return torch.zeros(0, dtype=torch.bool, device=signs.journey.device)
    cell = (signs.center_world[:, :2] / cell_m).floor().long()
    cell = cell - cell.amin(0)
    place = cell[:, 0] * (int(cell[:, 1].max()) + 1) + cell[:, 1]
    span = int(signs.journey.max()) + 1
    visits, visit = torch.unique(place * span + signs.journey, return_inverse=True)
    order = torch.rand(len(visits), generator=generator, dtype=torch.float64).argsort()
    order = order.to(visits.device)
    order = order[(visits[order] // span).argsort(stable=True)]
    _, size = torch.unique_consecutive(visits[order] // span, return_counts=True)
    rank = torch.empty_like(order)
    start = torch.repeat_interleave(size.cumsum(0) - size, size)
    rank[order] = torch.arange(len(order), device=order.device) - start
    return rank[visit] < most
