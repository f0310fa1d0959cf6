"""Lane pieces of many journeys as samples with a direction (V-A.2)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from crowdmap_torch.clustering.groups import group_sum
from crowdmap_torch.clustering.neighbours import layered, pairs_in_radius
from crowdmap_torch.crowd_lanes.line_samples import (
    LineSamples,
    along_axis,
    left_of_axis,
    merge_in_cells,
    points_along,
)
from crowdmap_torch.geometry import spline_basis
from crowdmap_torch.noise.positioning import PositioningNoise
from crowdmap_torch.processes.sums import running_sum
from crowdmap_torch.tables import Lanes


@dataclass(frozen=True)
class LaneSamples:
    """Samples of lane pieces, those of one (journey, tracklet) adjacent."""

    line: LineSamples
    """Tracks are (journey, tracklet) pairs, owners journeys; directions are those in which the pieces' points run."""
    piece: Int[Tensor, " s"]
    """Row of the piece; one of several where samples were merged."""
    station: Float[Tensor, " s"]
    """How far along its journey the sample lies [m], up to a constant of the journey."""
    track_of_piece: Int[Tensor, " n"]

    def __len__(self) -> int:
        return len(self.piece)

    def __getitem__(self, index: Tensor) -> LaneSamples:
        """The samples at `index`."""
        return replace(
            self, line=self.line[index], piece=self.piece[index], station=self.station[index]
        )

    def moved(self, offset: Float[Tensor, "s 3"]) -> LaneSamples:
        """The samples, each moved by its row of `offset`."""
        return replace(self, line=replace(self.line, point=self.line.point + offset))


def sample_lanes(
    lanes: Lanes, spacing: float, positioning: PositioningNoise, *, few_observations: float
) -> LaneSamples:
    """Samples of all pieces at most `spacing` [m] apart.

    A sample's own error comes on top of its journey's drift: better samples than that hardly help.

    A piece made from as few detections as `few_observations`, or a quarter of the median, weighs half.
    """
    packed = lanes.select(torch.arange(len(lanes), device=lanes.journey.device))
    control, count = packed.control.point_world, packed.control_count
    along = points_along(control, count, spacing)
    piece = along.spline
    first = spline_basis.starts(count)[piece]
    below = torch.minimum(along.t.floor().long(), count[piece] - 2)
    share = along.t - below
    sigma = packed.control.sigma
    sigma = (1 - share) * sigma[first + below] + share * sigma[first + below + 1]
    drift_sq = positioning.drift_sigma_m**2
    track = _tracks(lanes)
    station = _stations(lanes, along.point, along.direction, piece)
    line = LineSamples(
        point=along.point,
        direction=along.direction,
        slope=along.slope,
        kind=lanes.type[piece],
        track=track[piece],
        owner=lanes.journey[piece],
        weight=_evidence(lanes, few_observations)[piece] * (drift_sq / (drift_sq + sigma.square())),
    )
    order = track[piece].argsort(stable=True)
    return LaneSamples(
        line=line[order], piece=piece[order], station=station[order], track_of_piece=track
    )


def merge_overlapping(samples: LaneSamples, cell: float) -> tuple[LaneSamples, Int[Tensor, " s"]]:
    """Samples of one track in the same cell of a grid made one, and where each went: overlapping pieces become one."""
    line, cell_of = merge_in_cells(samples.line, cell)
    last = torch.zeros(len(line), dtype=torch.int64, device=cell_of.device)
    last[cell_of] = torch.arange(len(cell_of), device=cell_of.device)
    number = torch.bincount(cell_of, minlength=len(line))
    result = LaneSamples(
        line=line,
        piece=samples.piece[last],
        station=group_sum(samples.station, cell_of, len(line)) / number,
        track_of_piece=samples.track_of_piece,
    )
    return result, cell_of


def stray_samples(samples: LaneSamples, *, beside: tuple[float, float]) -> Bool[Tensor, " s"]:
    """Samples of pieces that stray: another piece of the same tracklet runs beside them.

    A tracklet is one marker. Where two of its pieces lie `beside` (least and largest distance [m]) each other one of
    them is wrong, and that is the one more of whose length is at odds with others; both, if they are alike.
    """
    line = samples.line
    least, largest = beside
    reach = (largest**2 + 1.5**2) ** 0.5
    i, j = pairs_in_radius(layered(line.point, line.track, reach), reach).T
    delta = line.point[j] - line.point[i]
    axis = line.direction[i]
    along, across = along_axis(delta, axis).abs(), left_of_axis(delta, axis).abs()
    at_odds = (
        (samples.piece[i] != samples.piece[j])
        & (along < 1.5)
        & (across > least)
        & (across < largest)
    )
    i, j = i[at_odds], j[at_odds]
    doubtful = torch.zeros(len(samples), dtype=torch.bool, device=i.device)
    doubtful[i] = doubtful[j] = True
    pieces = len(samples.track_of_piece)
    number = torch.bincount(samples.piece, minlength=pieces).clamp_min(1)
    share = torch.bincount(samples.piece[doubtful], minlength=pieces) / number
    a, b = share[samples.piece[i]], share[samples.piece[j]]
    stray = torch.zeros_like(doubtful)
    stray[i[a >= b]] = True
    stray[j[b >= a]] = True
    # Where nothing runs beside a piece that strays elsewhere, it is no better.
    share = torch.bincount(samples.piece[stray], minlength=pieces) / number
    return (share > 0.3)[samples.piece] | stray


def _evidence(lanes: Lanes, few: float) -> Float[Tensor, " n"]:
    """How far pieces are to be believed, 0 to 1: false detections seldom make long tracklets."""
    number = lanes.n_observations.to(lanes.confidence).clamp_min(1)
    if not len(number):
        return number
    few_sq = (0.25 * number.median()).clamp_max(few).square()
    return number.square() / (number.square() + few_sq)


def _tracks(lanes: Lanes) -> Int[Tensor, " n"]:
    """Number of each piece's (journey, tracklet), ascending with the journey."""
    if not len(lanes):
        return lanes.journey
    tracklet = lanes.tracklet - lanes.tracklet.min()
    key = lanes.journey * (tracklet.max() + 1) + tracklet
    return torch.unique(key, return_inverse=True)[1]


def _stations(
    lanes: Lanes,
    point: Float[Tensor, "s 3"],
    direction: Float[Tensor, "s 2"],
    piece: Int[Tensor, " s"],
) -> Float[Tensor, " s"]:
    """How far along its journey each sample lies: frames tell the order, the pieces the way.

    Of the pieces of one frame, the mean place and direction are taken; steps between frames count along the direction
    only, as a marker farther to the left is no way that was driven.
    """
    if not len(lanes):
        return point.new_zeros(0)
    frame = lanes.frame - lanes.frame.min()
    key = lanes.journey * (frame.max() + 1) + frame
    stops, stop = torch.unique(key, return_inverse=True)
    journey = stops // (frame.max() + 1)
    n = len(stops)
    stop_of_sample = stop[piece]
    number = torch.bincount(stop_of_sample, minlength=n).clamp_min(1).to(point)
    middle = group_sum(point[:, :2], stop_of_sample, n) / number[:, None]
    way = torch.nn.functional.normalize(group_sum(direction, stop_of_sample, n), dim=1)
    mean_way = torch.nn.functional.normalize(way[1:] + way[:-1], dim=1)
    step = ((middle[1:] - middle[:-1]) * mean_way).sum(1)
    step = torch.where(journey[1:] == journey[:-1], step, torch.zeros_like(step))
    station = running_sum(torch.cat((step.new_zeros(1), step)))
    ahead = ((point[:, :2] - middle[stop_of_sample]) * way[stop_of_sample]).sum(1)
    return station[stop_of_sample] + ahead
