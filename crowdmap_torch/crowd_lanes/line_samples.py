"""Lines of several sources as samples with a direction, in the plane with a height (V-A.2).

Directions are axes where lines are compared: lines that run against each other are the same line.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from crowdmap_torch.clustering.groups import distinct_pairs, group_sum
from crowdmap_torch.clustering.neighbours import pairs_between
from crowdmap_torch.geometry import spline_basis
from crowdmap_torch.processes.sums import running_sum
from crowdmap_torch.tables import Rows

_WITNESS_WEIGHT = 0.25
"""Samples of less weight do not say that a line exists."""
MAX_ANGLE_COS = 0.94
"""Cosine of the largest angle (20 degrees) between the directions of lines that are one."""


@dataclass(frozen=True)
class LineSamples(Rows):
    """Samples of lines, those of one track adjacent and tracks of one owner adjacent."""

    point: Float[Tensor, "n 3"]
    direction: Float[Tensor, "n 2"]
    """Unit vector in the plane."""
    slope: Float[Tensor, " n"]
    """Rise along the direction."""
    kind: Int[Tensor, " n"]
    """-1 unknown."""
    track: Int[Tensor, " n"]
    """Line that the sample belongs to, not decreasing."""
    owner: Int[Tensor, " n"]
    """Source of the track, not decreasing."""
    weight: Float[Tensor, " n"]
    """0 to 1: how far a sample is to be believed."""

    @property
    def is_witness(self) -> Bool[Tensor, " n"]:
        """True for the samples that are believed enough to say that a line exists."""
        return self.weight >= _WITNESS_WEIGHT


def merge_in_cells(samples: LineSamples, cell: float) -> tuple[LineSamples, Int[Tensor, " n"]]:
    """One sample for all samples of a track in a cell of a grid, and which one each sample went to."""
    angle = torch.atan2(samples.direction[:, 1], samples.direction[:, 0])
    key = torch.stack(
        (
            samples.track,
            (samples.point[:, 0] / cell).floor().long(),
            (samples.point[:, 1] / cell).floor().long(),
            (samples.point[:, 2] / 4.0).floor().long(),
            (angle / (torch.pi / 4)).round().long() % 8,
            samples.kind,
        ),
        dim=1,
    )
    _, cell_of = torch.unique(scalar_key(key), return_inverse=True)
    count = int(cell_of.max()) + 1 if len(cell_of) else 0
    total = group_sum(samples.weight, cell_of, count)
    share = samples.weight / total[cell_of]
    first = torch.zeros(count, dtype=torch.int64, device=cell_of.device)
    first[cell_of] = torch.arange(len(cell_of), device=cell_of.device)
    sums = group_sum(
        share[:, None]
        * torch.cat((samples.point, samples.direction, samples.slope[:, None]), dim=1),
        cell_of,
        count,
    )
    number = torch.bincount(cell_of, minlength=count).to(total)
    result = LineSamples(
        point=sums[:, :3],
        direction=torch.nn.functional.normalize(sums[:, 3:5], dim=1),
        slope=sums[:, 5],
        kind=samples.kind[first],
        track=samples.track[first],
        owner=samples.owner[first],
        weight=total / number,
    )
    return result, cell_of


def owners_around(
    point: Float[Tensor, "n 3"], samples: LineSamples, radius: float
) -> Int[Tensor, " n"]:
    """How many owners have samples within about `radius` of each point: who could have supported it [m]."""
    key = torch.stack(
        (
            samples.owner,
            (samples.point[:, 0] / radius).floor().long(),
            (samples.point[:, 1] / radius).floor().long(),
        ),
        dim=1,
    )
    _, cell_of = torch.unique(scalar_key(key), return_inverse=True)
    count = int(cell_of.max()) + 1
    number = torch.bincount(cell_of, minlength=count)
    centre = group_sum(samples.point[:, :2], cell_of, count) / number[:, None]
    owner = torch.zeros(count, dtype=torch.int64, device=number.device)
    owner[cell_of] = samples.owner
    i, k, _ = pairs_between(point[:, :2], centre, radius=radius)
    return torch.bincount(distinct_pairs(i, owner[k])[0], minlength=len(point))


def scalar_key(key: Int[Tensor, "n k"]) -> Int[Tensor, " n"]:
    """One number per row that is equal only for equal rows."""
    low = key.amin(0)
    size = key.amax(0) - low + 1
    result = torch.zeros_like(key[:, 0])
    for column in range(key.shape[1]):
        result = result * size[column] + key[:, column] - low[column]
    return result


def along_axis(delta: Float[Tensor, "n _"], axis: Float[Tensor, "n 2"]) -> Float[Tensor, " n"]:
    """How far each row of `delta` leads along its axis, in the plane."""
    return delta[:, 0] * axis[:, 0] + delta[:, 1] * axis[:, 1]


def left_of_axis(delta: Float[Tensor, "n _"], axis: Float[Tensor, "n 2"]) -> Float[Tensor, " n"]:
    """How far each row of `delta` leads to the left of its axis, in the plane."""
    return axis[:, 0] * delta[:, 1] - axis[:, 1] * delta[:, 0]


def runs_along(
    delta: Float[Tensor, "n 3"],
    axis: Float[Tensor, "n 2"],
    other: Float[Tensor, "n 2"],
    *,
    within: float,
    along: float,
    height: float,
) -> Bool[Tensor, " n"]:
    """Which points, `delta` [m] from one of a line with this axis, are of one with the axis `other` that runs along it."""
    return (
        (left_of_axis(delta, axis).abs() < within)
        & (along_axis(delta, axis).abs() < along)
        & (along_axis(other, axis).abs() > MAX_ANGLE_COS)
        & (delta[:, 2].abs() < height)
    )


def stations(
    point: Float[Tensor, "k 3"], polyline: Int[Tensor, " k"], count: int
) -> tuple[Float[Tensor, " k"], Float[Tensor, " n"]]:
    """Horizontal distance of each point from the start of its polyline, and the polylines' lengths [m]."""
    if not len(polyline):
        return point.new_zeros(0), point.new_zeros(count)
    step = (point[1:, :2] - point[:-1, :2]).norm(dim=1)
    step = torch.where(polyline[1:] == polyline[:-1], step, torch.zeros_like(step))
    s = torch.cat((step.new_zeros(1), running_sum(step)))
    size = torch.bincount(polyline, minlength=count)
    first = spline_basis.starts(size)
    return s - s[first][polyline], s[first + size - 1] - s[first]


@dataclass(frozen=True)
class SplinePoints(Rows):
    """Points along splines, those of one spline adjacent and in order."""

    spline: Int[Tensor, " m"]
    t: Float[Tensor, " m"]
    """Parameter of the point."""
    point: Float[Tensor, "m 3"]
    direction: Float[Tensor, "m 2"]
    """Unit vector in the plane."""
    slope: Float[Tensor, " m"]


def points_along(
    control: Float[Tensor, "c 3"], count: Int[Tensor, " n"], spacing: float
) -> SplinePoints:
    """Points of packed splines about `spacing` [m] apart, even in the parameter, both ends included."""
    owner, rank = spline_basis.rows(count)
    chord = (control[1:, :2] - control[:-1, :2]).norm(dim=1)
    length = group_sum(chord * (rank[1:] > 0), owner[1:], len(count))
    number = (length / spacing).ceil().long().clamp_min(1) + 1
    owner, rank = spline_basis.rows(number)
    t = rank.to(control) * (count[owner] - 1) / (number[owner] - 1)
    index, weight, d_weight = spline_basis.window_flat(
        t, spline_basis.starts(count)[owner], count[owner]
    )
    near = spline_basis.to_coefficients_flat(control, count)[index]
    point = (weight[:, None] @ near)[:, 0]
    tangent = (d_weight[:, None] @ near)[:, 0]
    run = tangent[:, :2].norm(dim=1).clamp_min(1e-9)
    return SplinePoints(owner, t, point, tangent[:, :2] / run[:, None], tangent[:, 2] / run)
