"""IV-D, unlike the paper: whether a lane piece exists, or whether points that lie anywhere would have made it too.

A-contrario (Desolneux, Moisan and Morel 2000): under the hypothesis of chance, detections that run along a piece within a
band around it lie anywhere in that band. Far more of them than chance would put there lie on a marker that is painted;
what is expected by chance among all pieces of a drive is said by Hoeffding's bound of the binomial's tail.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.clustering.groups import group_sum
from crowdmap_torch.clustering.neighbours import pairs_between
from crowdmap_torch.geometry.spline_length import sample_flat

_STEP_M = 1.0
"""Distance of the places along a piece at which points are looked for [m]."""
_MAX_ANGLE_COS = math.cos(math.radians(45.0))
"""Detections at larger angles cross a piece."""


def expected_by_chance(
    control: Float[Tensor, "c 3"],
    count: Int[Tensor, " n"],
    point: Float[Tensor, "p 2"],
    detection: Int[Tensor, " p"],
    *,
    band: float,
    near: float,
) -> Float[Tensor, " n"]:
    """How many of these pieces, or such that exist as surely, chance would make: next to zero for markers that exist.

    `point` holds the points on the road of all lane detections of the drive, of one detection adjacent, in the top view.
    A detection agrees with a piece if, in the mean of its points within `band` [m], it is within `near` [m].
    """
    n = len(count)
    if not n:
        return control.new_zeros(0)
    place, _, piece = sample_flat(control, count, _STEP_M)
    inside = piece[1:] == piece[:-1]
    begin, end, piece = place[:-1][inside, :2], place[1:][inside, :2], piece[1:][inside]
    middle, way = (begin + end) / 2, torch.nn.functional.normalize(end - begin, dim=1)
    half = (end - begin).norm(dim=1) / 2
    row, at, _ = pairs_between(point, middle, radius=math.hypot(band, _STEP_M))
    # Column by column: pairs are many.
    x, y = (p[row] - q[at] for p, q in zip(point.unbind(1), middle.unbind(1), strict=True))
    way_x, way_y = (w[at] for w in way.unbind(1))
    aside = (way_x * y - way_y * x).abs()
    first, last = _ends(detection)
    axis = torch.nn.functional.normalize(point[last] - point[first], dim=1)
    axis_x, axis_y = (a[row] for a in axis.unbind(1))
    # One point has no direction: it may run any way.
    runs = (axis_x * way_x + axis_y * way_y).abs() > _MAX_ANGLE_COS
    runs |= (first == last)[row]
    used = ((x * way_x + y * way_y).abs() <= half[at]) & (aside <= band) & runs
    aside, row, at = aside[used], row[used], at[used]
    key = piece[at] * (int(detection.max()) + 1) + detection[row]
    trial, group = torch.unique(key, return_inverse=True)
    mean = group_sum(aside, group, len(trial)) / torch.bincount(group, minlength=len(trial))
    of_piece = trial // (int(detection.max()) + 1)
    trials = torch.bincount(of_piece, minlength=n).to(control)
    agreeing = group_sum((mean <= near).to(control), of_piece, n)
    return n * torch.exp(-trials * _divergence(agreeing / trials.clamp_min(1), near / band))


def _ends(detection: Int[Tensor, " p"]) -> tuple[Int[Tensor, " p"], Int[Tensor, " p"]]:
    """For each point the first and the last one of its detection."""
    _, group, size = torch.unique_consecutive(detection, return_inverse=True, return_counts=True)
    last = size.cumsum(0) - 1
    return (last - size + 1)[group], last[group]


def _divergence(share: Float[Tensor, " n"], chance: float) -> Float[Tensor, " n"]:
    """Kullback-Leibler divergence of two coins; zero where the share is no larger than by chance."""
    lost = 1 - share
    value = torch.xlogy(share, share / chance) + torch.xlogy(lost, lost / (1 - chance))
    return torch.where(share > chance, value, 0.0)
