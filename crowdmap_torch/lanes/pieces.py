"""IV-D: pieces of lane markers: which points belong to one, and the spline through them, all pieces in one batch."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from crowdmap_torch.clustering.groups import (
    distinct_pairs,
    group_count,
    group_median,
    group_range,
    group_sum,
)
from crowdmap_torch.geometry import spline_basis, spline_fit
from crowdmap_torch.optim.robust import Tukey

_CELL_M = 2.0
"""Places that a marker was seen from are counted over stretches of this length [m]."""
_VIEW_M = 0.5
"""Places nearer to each other are one [m]."""
_LEAST_GAP_M = 3.0
"""Points of a marker, or of a dash, are nearer to each other [m]."""
_LEAST_GAPS = 3
"""As many gaps of a marker tell how far its dashes are apart."""
_USUAL_GAP = 1.3
"""Gaps between dashes are at most so much longer than the usual one: points stop short of the ends of dashes."""
_ENDS_AND_BEND = 3
"""Control points without which a piece cannot follow a road."""
_THIN_GAP = 3.0
"""Of points strewn at random one gap in twenty is longer than so many times their mean distance."""


@dataclass(frozen=True)
class LanePieces:
    """Overlapping pieces of markers; a point may be in several of them, once a row."""

    marker: Int[Tensor, " n"]
    """The marker each piece is cut from."""
    control_count: Int[Tensor, " n"]
    piece: Int[Tensor, " r"]
    point: Int[Tensor, " r"]
    """Index of the point in the rows given."""
    t: Float[Tensor, " r"]
    """Parameter of the point on its piece, 0 .. control_count - 1."""

    def __len__(self) -> int:
        return len(self.marker)

    def select(self, kept: Bool[Tensor, " n"]) -> LanePieces:
        """Only the pieces at `kept`."""
        number = kept.cumsum(0) - 1
        rows = kept[self.piece]
        return LanePieces(
            self.marker[kept],
            self.control_count[kept],
            number[self.piece[rows]],
            self.point[rows],
            self.t[rows],
        )

    def as_stiff_as_points(self, points_of_control: int) -> LanePieces:
        """The pieces with no more control points than one for so many points, but for two ends and a bend."""
        number = torch.bincount(self.piece, minlength=len(self))
        most = (number // points_of_control).clamp_min(_ENDS_AND_BEND)
        count = torch.minimum(self.control_count, most)
        ratio = (count - 1).to(self.t) / (self.control_count - 1)
        return replace(self, control_count=count, t=self.t * ratio[self.piece])


@dataclass(frozen=True)
class LaneFit:
    """Splines through the points of pieces."""

    control: Float[Tensor, "c 3"]
    """Control points, those of one piece adjacent."""
    sigma: Float[Tensor, " c"]
    """1-sigma of them across the marker, from the points' noise as it turned out [m]."""
    miss: Float[Tensor, " r"]
    """How far each point is from its piece in the top view, positive to the right [m]."""
    expected: Float[Tensor, " r"]
    """1-sigma of that, as it was given [m]."""
    weight: Float[Tensor, " r"]
    """Share of its own weight that a point kept; 0 for outliers."""


def runs_of(
    marker: Int[Tensor, " p"], along: Float[Tensor, " p"], max_gap: float | Float[Tensor, " p"]
) -> Int[Tensor, " p"]:
    """Points of one marker numbered by runs without a gap longer than `max_gap` [m] along it."""
    order, ahead, same = _in_order(marker, along)
    most = max_gap[order][1:] if isinstance(max_gap, Tensor) else along.new_tensor(max_gap)
    new = torch.ones_like(order, dtype=torch.bool)
    new[1:] = ~same | (ahead > most)
    return torch.empty_like(order).index_put((order,), new.cumsum(0) - 1)


def runs_in_plane(
    marker: Int[Tensor, " p"],
    along: Float[Tensor, " p"],
    point: Float[Tensor, "p 2"],
    max_gap: float | Float[Tensor, " p"],
) -> Int[Tensor, " p"]:
    """Points of one marker numbered by runs without a longer gap [m] along the car's way, nor along their own axis.

    Where a car turns at a crossing its way runs across the markers of the arm ahead: along it the crossing is short.
    """
    run = runs_of(marker, along, max_gap)
    if not len(run):
        return run
    return runs_of(run, spline_fit.along_principal_axis(point, run, int(run.max()) + 1), max_gap)


def dash_gap(
    marker: Int[Tensor, " p"], along: Float[Tensor, " p"], most: float
) -> Float[Tensor, " p"]:
    """The longest gap [m] between dashes of each point's marker, `most` at most; 0 where it has no rhythm.

    An intersection is one gap among others: it does not move the usual one.
    """
    if not len(marker):
        return torch.zeros_like(along)
    order, ahead, same = _in_order(marker, along)
    is_gap, count = same & (ahead > _LEAST_GAP_M), int(marker.max()) + 1
    of = marker[order][1:][is_gap]
    longest = (_USUAL_GAP * group_median(ahead[is_gap], of, count)).clamp_max(most)
    return torch.where(group_count(of, count) >= _LEAST_GAPS, longest, 0.0)[marker]


def thin_gap(
    marker: Int[Tensor, " p"], along: Float[Tensor, " p"], most: float
) -> Float[Tensor, " p"]:
    """The longest gap [m] that chance leaves between points of each point's marker, `most` at most.

    It is short where points are many. Of a marker of which few are seen, a gap says nothing of the paint.
    """
    if not len(marker):
        return torch.zeros_like(along)
    count = int(marker.max()) + 1
    low, high = group_range(along, marker, count)
    mean = (high - low) / (group_count(marker, count) - 1).clamp_min(1)
    return (_THIN_GAP * mean).clamp_max(most)[marker]


def _in_order(
    marker: Int[Tensor, " p"], along: Float[Tensor, " p"]
) -> tuple[Int[Tensor, " p"], Float[Tensor, " s"], Bool[Tensor, " s"]]:
    """Points by marker and along it; how far each lies from the one before, and whether both are of one marker."""
    order = along.argsort()
    order = order[marker[order].argsort(stable=True)]
    of = marker[order]
    return order, along[order][1:] - along[order][:-1], of[1:] == of[:-1]


def well_seen(
    marker: Int[Tensor, " p"],
    along: Float[Tensor, " p"],
    seen_from: Float[Tensor, " p"],
    share: float,
) -> Bool[Tensor, " p"]:
    """Which points lie where their marker was seen from at least `share` of as many places as at its usual point.

    A detection that strays may run on for as far as it is long; it does so alone. `seen_from` is where on its way the
    car was [m]: one that stands sees much, from one place.
    """
    if not len(marker):
        return torch.zeros_like(marker, dtype=torch.bool)
    cell, view = (along / _CELL_M).floor().long(), (seen_from / _VIEW_M).floor().long()
    cell, view = cell - cell.min(), view - view.min()
    place = marker * (int(cell.max()) + 1) + cell
    at, _, _ = distinct_pairs(place, view)
    count = torch.bincount(at, minlength=int(place.max()) + 1)[place]
    usual = _medians(count[marker.argsort(stable=True)].to(along), torch.bincount(marker))[marker]
    return count >= share * usual


def cut_by_length(
    marker: Int[Tensor, " p"],
    run: Int[Tensor, " p"],
    along: Float[Tensor, " p"],
    *,
    length: float,
    overlap: float,
    control_points: int,
) -> LanePieces:
    """Pieces of equal length [m], a share `overlap` of it in common with the next one, for each run of a marker's points.

    A run shorter than a piece is one piece, with fewer control points at the same spacing.
    """
    if not len(marker):
        return _no_pieces(marker, along)
    runs = int(run.max()) + 1
    low, high = group_range(along, run, runs)
    extent = high - low
    count = ((extent - length) / (length * (1 - overlap))).ceil().clamp_min(0).long() + 1
    piece_length = extent.clamp_max(length).clamp_min(1e-6)
    stride = (extent - piece_length) / (count - 1).clamp_min(1)
    first = count.cumsum(0) - count
    # Every point is in the piece that began last before it, and in those before as far as they
    # reach.
    place = along - low[run]
    latest = (place / stride[run].clamp_min(1e-6)).floor().long().clamp_max(count[run] - 1)
    back = torch.arange(int(1 / (1 - overlap)) + 2, device=run.device)
    rank = latest[:, None] - back
    t = (place[:, None] - rank * stride[run, None]) / piece_length[run, None]
    inside = (rank >= 0) & (t >= 0) & (t <= 1 + 1e-9)
    point, which = inside.nonzero(as_tuple=True)
    spans = (extent * (control_points - 1) / length).round().long()
    control_count = (spans + 1).clamp(2, control_points)
    of_run = torch.repeat_interleave(torch.arange(runs, device=run.device), count)
    marker_of_run = marker.new_zeros(runs).index_put((run,), marker)
    return LanePieces(
        marker=marker_of_run[of_run],
        control_count=control_count[of_run],
        piece=(first[run, None] + rank)[point, which],
        point=point,
        t=t[point, which].clamp(0, 1) * (control_count[run[point]] - 1),
    )


def with_enough_points(
    pieces: LanePieces, *, most: int, share: float, least: int
) -> Bool[Tensor, " n"]:
    """Which pieces have `most` points, or a `share` of what is usual, if that is fewer, but `least` in any case.

    What is usual is the number in the piece of the point in the middle: however many strays a drive has, they are short.
    """
    number = torch.bincount(pieces.piece, minlength=len(pieces))
    if not len(pieces.piece):
        return number >= least
    usual = number[pieces.piece].median()
    return number >= (share * usual).clamp(min(least, most), most)


def cut_by_number(
    marker: Int[Tensor, " p"],
    frame: Int[Tensor, " p"],
    point_world: Float[Tensor, "p 3"],
    *,
    number: int,
    control_points: int,
) -> LanePieces:
    """The paper's pieces: the `number` most recent points of a marker, anew after every half of them.

    Parameters run along the principal axis of a piece.
    """
    if not len(marker):
        return _no_pieces(marker, point_world[:, 0])
    order = frame.argsort(stable=True)
    order = order[marker[order].argsort(stable=True)]
    size = torch.bincount(marker)
    start = size.cumsum(0) - size
    rank = torch.empty_like(order)
    rank[order] = torch.arange(len(order), device=order.device) - start[marker[order]]
    half = number // 2
    # The last piece ends at the last point, however few are new.
    count = ((size - number) / half).ceil().clamp_min(0).long() + 1
    count = torch.where(size > 0, count, 0)
    first = count.cumsum(0) - count
    piece = torch.repeat_interleave(torch.arange(len(size), device=rank.device), count)
    begin = (torch.arange(len(piece), device=rank.device) - first[piece]) * half
    begin = torch.minimum(begin, (size[piece] - number).clamp_min(0))
    back = torch.arange(4, device=rank.device)
    latest = (rank / half).floor().long()
    candidate = latest[:, None] - back + 1
    valid = (candidate >= 0) & (candidate < count[marker, None])
    at = (first[marker, None] + candidate).clamp(0, max(len(piece) - 1, 0))
    ahead = rank[:, None] - begin[at]
    point, which = (valid & (ahead >= 0) & (ahead < number)).nonzero(as_tuple=True)
    of_piece = at[point, which]
    control_count = torch.full_like(piece, control_points)
    t = spline_fit.principal_parameter(point_world[point], of_piece, control_count)
    return LanePieces(piece, control_count, of_piece, point, t)


def fit_pieces(
    pieces: LanePieces,
    point_world: Float[Tensor, "p 3"],
    sigma: Float[Tensor, " p"],
    *,
    smoothing: float,
    scales: tuple[float, ...],
) -> LaneFit:
    """Splines by iterated least squares (Tukey), all pieces at once.

    `sigma` is the lateral noise expected of each point [m]; `scales` are factors on it, one an
    iteration, with none of them all points count alike. `smoothing` is the price of bending in units of a piece's whole
    weight.
    """
    count = pieces.control_count
    # Those of one piece adjacent.
    order = pieces.piece.argsort(stable=True)
    piece, row = pieces.piece[order], pieces.point[order]
    size = torch.bincount(piece, minlength=len(count))
    expected = sigma[row]
    own = expected.square().reciprocal()
    kept = torch.ones_like(own)
    base = _Basis(pieces.t[order], piece, point_world[row], count)
    coefficient = base.solve(own, smoothing)
    for scale in scales:
        whitened = base.miss(coefficient) / expected
        noise = _medians(whitened.abs(), size) * 1.4826
        gate = scale * noise.clamp(0.5, 4.0)[piece]
        # Tukey alone would leave a piece whose points all disagree without any.
        kept = Tukey().weight((whitened / gate).square()).clamp_min(1e-6)
        coefficient = base.solve(own * kept, smoothing)
    miss = base.miss(coefficient)
    noise = _medians((miss / expected).abs(), size) * 1.4826
    return LaneFit(
        control=spline_basis.from_coefficients_flat(coefficient, count),
        sigma=base.control_sigma(own * kept) * noise.clamp_min(0.5)[spline_basis.rows(count)[0]],
        miss=torch.empty_like(miss).index_put((order,), miss),
        expected=sigma[pieces.point],
        weight=torch.empty_like(kept).index_put((order,), kept),
    )


class _Basis:
    """The B-splines of points at fixed parameters: what stays the same while weights change.

    The rows come last: every operation runs along them. Products are summed up by segment, the stretch of a piece between
    two knots, in which all points have the same control points around them.
    """

    def __init__(
        self,
        t: Float[Tensor, " r"],
        piece: Int[Tensor, " r"],
        point: Float[Tensor, "r 3"],
        count: Int[Tensor, " n"],
    ) -> None:
        slot, w, dw = spline_basis.window_flat(t, torch.zeros_like(piece), count[piece])
        self.count, self.longest = count, int(count.max()) if len(count) else 2
        self.w, self.dw = w.mT.contiguous(), dw.mT.contiguous()
        self.segment = piece * self.longest + slot[:, 0]
        # Of every segment the control points around it, by their place among those of the piece.
        knot = torch.arange(self.longest, device=t.device)
        place = knot[:, None] + torch.arange(4, device=t.device)
        self.place = torch.minimum(place, count[:, None, None] - 1)
        size = torch.bincount(piece, minlength=len(count)).clamp_min(1)
        self.centre = group_sum(point, piece, len(count)) / size[:, None]
        self.offset = (point - self.centre[piece]).mT.contiguous()

    def _by_segment(self, value: Float[Tensor, " r"]) -> Float[Tensor, "n k"]:
        n, k = len(self.count), self.longest
        return value.new_zeros(n * k).index_add_(0, self.segment, value).view(n, k)

    def _by_pair(self, weight: Float[Tensor, " r"]) -> Float[Tensor, "n k 4 4"]:
        """Products of the four B-splines of each segment."""
        found = weight.new_zeros(*self.place.shape, 4)
        for a, pulling in enumerate(weight * w for w in self.w):
            for b in range(a, 4):
                found[..., a, b] = found[..., b, a] = self._by_segment(pulling * self.w[b])
        return found

    def _of_pieces(self, by_pair: Float[Tensor, "n k 4 4"]) -> Float[Tensor, "n k k"]:
        """Normal equations of each piece, padded to the longest."""
        n, k = len(self.count), self.longest
        cell = self.place[..., :, None] * k + self.place[..., None, :]
        flat = by_pair.new_zeros(n, k * k)
        return flat.scatter_add_(1, cell.flatten(1), by_pair.flatten(1)).view(n, k, k)

    def solve(self, weight: Float[Tensor, " r"], smoothing: float) -> Float[Tensor, "c 3"]:
        """Coefficients of the weighted least squares fit."""
        n, k = len(self.count), self.longest
        by_pair = self._by_pair(weight)
        # B-splines sum up to one.
        by_spline = by_pair.sum(-1)
        total = by_spline.sum((1, 2)).clamp_min(1e-12)
        pull = weight.new_zeros(*self.place.shape, 3)
        for c, pulling in enumerate(weight * x for x in self.offset):
            for a, w in enumerate(self.w):
                pull[..., a, c] = self._by_segment(pulling * w)
        mean = pull.sum((1, 2)) / total[:, None]
        pull -= by_spline[..., None] * mean[:, None, None]
        A = self._of_pieces(by_pair) / total[:, None, None]
        # A trace of bending keeps coefficients that no point holds on the line of the others.
        A = A + (smoothing + 1e-9) * spline_fit.bending(self.count, k, weight)
        unused = torch.arange(k, device=weight.device) >= self.count[:, None]
        A = A + torch.diag_embed(torch.where(unused, 1.0, 1e-12).to(weight))
        at = self.place.flatten(1)[..., None].expand(-1, -1, 3)
        rhs = weight.new_zeros(n, k, 3).scatter_add_(1, at, pull.flatten(1, 2))
        solution = torch.linalg.solve(A, rhs / total[:, None, None])
        of_row, rank = spline_basis.rows(self.count)
        return solution[of_row, rank] + (mean + self.centre)[of_row]

    def miss(self, coefficient: Float[Tensor, "c 3"]) -> Float[Tensor, " r"]:
        """How far to the right of their pieces points are, in the top view [m]."""
        row = spline_basis.starts(self.count)[:, None, None] + self.place
        around = (coefficient[row] - self.centre[:, None, None])[..., :2].flatten(0, 1)
        x, y = self.offset[:2]
        ahead = right = torch.zeros_like(x)
        for k, (w, dw) in enumerate(zip(self.w, self.dw, strict=True)):
            at_x, at_y = (
                c.contiguous().index_select(0, self.segment) for c in around[:, k].unbind(-1)
            )
            x, y = x - w * at_x, y - w * at_y
            ahead, right = ahead + dw * at_y, right + dw * at_x
        return (x * ahead - y * right) / torch.hypot(ahead, right).clamp_min(1e-12)

    def control_sigma(self, weight: Float[Tensor, " r"]) -> Float[Tensor, " c"]:
        """Standard deviations of control points for points with these inverse variances."""
        count, k = self.count, self.longest
        # A control point that no point holds is unsure by metres, not by infinity.
        inside = torch.arange(k, device=weight.device) < count[:, None]
        A = self._of_pieces(self._by_pair(weight))
        A = A + torch.diag_embed(torch.where(inside, 1 / 5.0**2, 1.0).to(weight))
        covariance = torch.linalg.inv(A)
        of_row, rank = spline_basis.rows(count)
        # What takes coefficients to the point at a knot: 1/6, 4/6, 1/6, and 1 at the ends.
        last = count[of_row] - 1
        is_end = (rank == 0) | (rank == last)
        near = torch.stack(((rank - 1).clamp_min(0), rank, torch.minimum(rank + 1, last)), dim=-1)
        share = torch.where(is_end[:, None], weight.new_tensor([0.0, 1.0, 0.0]), 1 / 6)
        share = share + torch.where(is_end[:, None], 0.0, weight.new_tensor([0.0, 0.5, 0.0]))
        block = covariance[of_row[:, None, None], near[:, :, None], near[:, None, :]]
        variance = (share[:, :, None] * block * share[:, None, :]).sum((1, 2))
        return variance.clamp_min(0).sqrt()


def _medians(value: Float[Tensor, " r"], size: Int[Tensor, " n"]) -> Float[Tensor, " n"]:
    """The upper median of each group, those of one adjacent; zero of none."""
    ends = size.cumsum(0).tolist()
    flat, found = value.cpu().numpy(), np.zeros(len(ends))
    for group, (begin, end) in enumerate(pairwise((0, *ends))):
        if end > begin:
            middle = (end - begin) // 2
            found[group] = np.partition(flat[begin:end], middle)[middle]
    return torch.from_numpy(found).to(value)


def _no_pieces(marker: Tensor, like: Tensor) -> LanePieces:
    none = marker[:0]
    return LanePieces(none, none, none, none, like[:0])
