"""Which tracklets of one journey show one sign: they are told by geometry, after each was fitted alone."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from crowdmap_torch.clustering.groups import group_argmin
from crowdmap_torch.clustering.neighbours import near_pairs
from crowdmap_torch.noise.positioning import PositioningNoise
from crowdmap_torch.ranges import Deviations, Factor, Length, Seconds, Settings, Share, Sigma, Speed
from crowdmap_torch.signs.views import SignFit, SignViews, distance_away
from crowdmap_torch.tables import Journey, Tracklets


@dataclass(frozen=True)
class RejoinConfig(Settings):
    """When two tracklets are one sign."""

    max_common_share: Share = 0.1
    """Tracklets with a larger share of the shorter one's frames in common are two signs: both were seen at once."""
    overlap: Share = 0.35
    """Unless they are in one place: as seen from the closest view, less than this share of the smaller side apart."""

    max_distance: Deviations = 4.0
    """Centres further apart, in standard deviations of both and of the drift between them, are two signs."""
    max_distance_m: Length = 5.0
    """As are those further apart than this."""
    max_size_ratio: Factor = 1.5
    """As are signs whose width or height differ by more; the square of it where one of them is vague."""
    min_facing: Share = 0.5
    """As are signs whose normals have a smaller scalar product, unless one of them is vague."""
    vague_sigma_m: Sigma = 0.7
    """A sign is vague if its centre has a larger standard deviation."""
    speed: Speed = 12.0
    """Turns the time between two tracklets into a way [m/s]."""
    max_gap_s: Seconds = 20.0
    """Tracklets with a longer silence between them are two passes of a sign, and poses do not come back the same."""


def rejoin(
    views: SignViews,
    t_s: Float[Tensor, " m"],
    fit: SignFit,
    shape: Int[Tensor, " n"],
    positioning: PositioningNoise,
    rules: RejoinConfig,
) -> Int[Tensor, " n"]:
    """For each tracklet the first of those that show the same sign: itself, unless geometry says otherwise."""
    n = len(shape)
    centre = fit.T_world_sign[:, :3, 3]
    pairs = near_pairs(centre, radius=rules.max_distance_m, count=8)
    a, b = pairs.unbind(-1)
    begin = torch.full_like(fit.size[:, 0], torch.inf).scatter_reduce(0, views.sign, t_s, "amin")
    end = torch.full_like(fit.size[:, 0], -torch.inf).scatter_reduce(0, views.sign, t_s, "amax")
    gap_s = torch.maximum(begin[a] - end[b], begin[b] - end[a]).clamp_min(0)
    drift = positioning.walk_m * (gap_s * rules.speed + 1).sqrt()
    eye = torch.eye(3, dtype=drift.dtype, device=drift.device)
    covariance = fit.covariance[a] + fit.covariance[b] + drift.square()[:, None, None] * eye
    offset = (centre[a] - centre[b])[..., None]
    distance_sq = (offset.mT @ torch.linalg.solve(covariance, offset))[:, 0, 0]
    facing = (fit.T_world_sign[a, :3, 2] * fit.T_world_sign[b, :3, 2]).sum(-1)
    ratio = torch.maximum(fit.size[a] / fit.size[b], fit.size[b] / fit.size[a]).amax(-1)
    # Where the place is vague, the views were few and far: then size and normal are no better known.
    sigma = torch.linalg.eigvalsh(fit.covariance)[:, -1].clamp_min(0).sqrt()
    is_vague = torch.maximum(sigma[a], sigma[b]) > rules.vague_sigma_m
    agrees = (
        (distance_sq < rules.max_distance**2)
        & (gap_s < rules.max_gap_s)
        & (shape[a] == shape[b])
        & ((facing > rules.min_facing) | is_vague)
        & (ratio < torch.where(is_vague, rules.max_size_ratio**2, rules.max_size_ratio))
    )
    order = torch.argsort(distance_sq[agrees], stable=True)
    closest = group_argmin(distance_away(views, fit), views.sign)
    ray = torch.nn.functional.normalize(centre - views.p_world_camera[closest], dim=-1)
    sideways = torch.linalg.cross(offset[..., 0], ray[a]).norm(dim=-1)
    side = torch.minimum(fit.size[a], fit.size[b]).amin(-1)
    in_one_place = sideways < rules.overlap * side
    return _exclusive_groups(
        views, pairs[agrees][order], in_one_place[agrees][order], n, rules.max_common_share
    )


def _exclusive_groups(
    views: SignViews,
    pairs: Int[Tensor, "p 2"],
    in_one_place: Bool[Tensor, " p"],
    n: int,
    max_common_share: float,
) -> Int[Tensor, " n"]:
    """Groups made by joining pairs in order, unless many frames show both: two things seen at once are two things.

    A sign that is detected twice in a frame is in two tracklets there, and in one place.
    """
    group = list(range(n))
    frames = {
        sign: set(views.frame[views.sign == sign].tolist())
        for sign in sorted(set(pairs.flatten().tolist()))
    }
    for (a, b), is_one in zip(pairs.tolist(), in_one_place.tolist(), strict=True):
        first, second = sorted((group[a], group[b]))
        if first == second:
            continue
        most = max_common_share * min(len(frames[first]), len(frames[second]))
        if not is_one and len(frames[first] & frames[second]) > most:
            continue
        frames[first] |= frames.pop(second)
        group = [first if g == second else g for g in group]
    return torch.tensor(group, dtype=torch.int64, device=views.sign.device)


def relabelled(
    tracklets: Tracklets, journey: Journey, label: Int[Tensor, " n"], group: Int[Tensor, " n"]
) -> Int[Tensor, " d"]:
    """Labels after tracklets were rejoined; in a frame that both have, the one that takes over keeps its own detection."""
    new = torch.arange(tracklets.count, device=label.device)
    new[label] = label[group]
    old = tracklets.label.clamp_min(0)
    moved = (tracklets.label >= 0) & (new[old] != old)
    # Of each frame and new label the first row counts, and rows that keep their label come first.
    order = torch.argsort(moved.long(), stable=True)
    key = (new[old] * journey.frame_count + journey.signs.frame)[order]
    by_key = torch.argsort(key, stable=True)
    repeated = torch.zeros_like(moved)
    repeated[1:] = key[by_key][1:] == key[by_key][:-1]
    second = torch.zeros_like(moved)
    second[order[by_key]] = repeated
    return torch.where(moved & ~second, new[old], tracklets.label)
