"""Density ridges of many noisy lines: the line that lines of several sources run along together.

A ridge of a density is where it is largest across, and points climb to it by mean shifts in that subspace alone (Ozertem
and Erdogmus, Locally Defined Principal Curves and Surfaces, 2011). Unlike there, samples have directions, and these say
what is across, not the Hessian of the density: points are shifted sideways, never along, to the nearest mode of the
samples around them. A source that is off pulls no more than one of many, and two lines half a metre apart keep apart.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree
from torch import Tensor

from crowdmap_torch.clustering.groups import group_sum
from crowdmap_torch.crowd_lanes.line_samples import (
    MAX_ANGLE_COS,
    LineSamples,
    along_axis,
    scalar_key,
)
from crowdmap_torch.processes.threads import in_order
from crowdmap_torch.tables import Rows, concatenate

_PAIRS_AT_ONCE = 100_000
"""Pairs of points and samples, about, that are held at once by a thread: they are what memory goes to."""
_SECTOR = torch.pi / 12
"""Grain of the directions of start points."""


@dataclass(frozen=True)
class RidgeConfig:
    """How samples make up a ridge."""

    bandwidth: float = 0.2
    """Sigma of the sideways kernel [m]."""
    window: float = 2.5
    """Samples this far ahead or behind take part [m]."""
    height_gate: float = 2.0
    """Samples higher or lower by more are on another road [m]."""
    other_kind: float = 0.15
    """Weight of samples of another kind: keeps a kerb and the solid line beside it apart."""
    iterations: tuple[int, int] = (3, 6)
    """Shifts of all start points, and of those that are left after non-maximum suppression."""
    cell: float = 1.5
    """Length of the cells that the start points come from [m]."""


@dataclass(frozen=True)
class RidgePoints(Rows):
    """Points on ridges, and what supports them."""

    point: Float[Tensor, "n 3"]
    direction: Float[Tensor, "n 2"]
    """An axis: the sign has no meaning."""
    slope: Float[Tensor, " n"]
    kind: Int[Tensor, " n"]
    density: Float[Tensor, " n"]
    """Number of tracks at the mode, those at its flanks counted in part."""
    owners: Int[Tensor, " n"]
    """Number of owners with a sample near the mode."""
    votes: Float[Tensor, "n kinds"]
    """Weight of the samples near the mode by kind."""


def seed_points(samples: LineSamples, config: RidgeConfig, kinds: int) -> RidgePoints:
    """Start points: the mean of the samples in each cell, by direction, and by kind where enough are of it.

    Cells are longer than wide and lie along the samples, so that lines side by side start in different ones.
    """
    angle = torch.atan2(samples.direction[:, 1], samples.direction[:, 0])
    sector = (angle / _SECTOR).round().long() % round(torch.pi / _SECTOR)
    cos, sin = (sector * _SECTOR).cos(), (sector * _SECTOR).sin()
    x, y, z = samples.point.unbind(1)
    place = torch.stack(
        (
            ((x * cos + y * sin) / config.cell).floor().long(),
            ((y * cos - x * sin) / (2.5 * config.bandwidth)).floor().long(),
            (z / 4.0).floor().long(),
            sector,
        ),
        dim=1,
    )
    place = scalar_key(place)
    _, cell_of = torch.unique(place * (kinds + 1) + samples.kind + 1, return_inverse=True)
    _, whole_of = torch.unique(place, return_inverse=True)
    count = int(cell_of.max()) + 1
    number = torch.bincount(cell_of, minlength=count).to(samples.point)
    # An axis is a direction or its opposite: doubled angles are the same for both.
    doubled = torch.stack(((2 * angle).sin(), (2 * angle).cos()), dim=1)
    sine, cosine = group_sum(doubled, cell_of, count).unbind(1)
    mean_angle = 0.5 * torch.atan2(sine, cosine)
    axis = torch.stack((mean_angle.cos(), mean_angle.sin()), dim=1)
    along = along_axis(samples.direction, axis[cell_of])
    whole = torch.zeros_like(number)
    whole[cell_of] = torch.bincount(whole_of).to(number)[whole_of]
    kind = torch.zeros(count, dtype=torch.int64, device=samples.kind.device)
    kind[cell_of] = samples.kind  # the same for all samples of a cell
    points = RidgePoints(
        point=group_sum(samples.point, cell_of, count) / number[:, None],
        direction=axis,
        slope=group_sum(samples.slope * along.sign(), cell_of, count) / number,
        kind=kind,
        density=number,
        owners=torch.zeros_like(kind),
        votes=number.new_zeros(count, kinds),
    )
    # A few samples of another kind among many are mistakes rather than another line.
    return points[number >= 0.2 * whole]


def shift_to_ridges(
    points: RidgePoints, samples: LineSamples, config: RidgeConfig, *, iterations: int
) -> RidgePoints:
    """The points, moved sideways to the mode of the samples around them, with what supports them there.

    Each track weighs about one at every place, however densely it is sampled. Points with nothing around keep their
    place with a density of zero.
    """
    if not len(points) or not len(samples):
        return replace(points, density=torch.zeros_like(points.density))
    reach = config.window + 4 * config.bandwidth
    tree = KDTree(_squeezed(samples.point, config, reach))
    place = _squeezed(points.point, config, reach)
    few = place[:: max(1, len(place) // 256)]
    crowd = tree.query_ball_point(few, reach, return_length=True).mean()
    at_once = max(1, int(_PAIRS_AT_ONCE / max(crowd, 1.0)))

    def moved(rows: Int[Tensor, " r"]) -> RidgePoints:
        pairs = _pairs(samples, tree, place[rows.cpu().numpy()], reach)
        return _shift(points[rows], samples, pairs, config, iterations)

    device = points.point.device
    lots = torch.arange(len(points), device=device).split(at_once)
    return concatenate(tuple(in_order(moved, lots, device, worth=1)))


def _squeezed(
    point: Float[Tensor, "n 3"], config: RidgeConfig, reach: float
) -> Float[np.ndarray, "n 3"]:
    """Coordinates in which a ball of radius `reach` reaches as high as the height gate."""
    scale = point.new_tensor((1.0, 1.0, reach / max(config.height_gate, reach)))
    return (point * scale).detach().cpu().numpy()


@dataclass(frozen=True)
class _Pairs:
    """Points and samples near them, sorted by point and sample."""

    i: Int[Tensor, " p"]
    k: Int[Tensor, " p"]
    track_run: Int[Tensor, " p"]
    """Numbers the (point, track) that a pair belongs to."""
    owner_run: Int[Tensor, " p"]


def _shift(
    points: RidgePoints, samples: LineSamples, pairs: _Pairs, config: RidgeConfig, iterations: int
) -> RidgePoints:
    i, k = pairs.i, pairs.k
    # Columns one by one: sums over an axis of two are slow.
    qx, qy, qz = (column[k] for column in samples.point.unbind(1))
    tx, ty = (column[k] for column in samples.direction.unbind(1))
    slope, kind = samples.slope[k], samples.kind[k]
    own = points.kind[i]
    same_kind = (own == kind) | (own < 0) | (kind < 0)
    prior = samples.weight[k] * torch.where(same_kind, 1.0, config.other_kind)
    x, y, z = points.point.unbind(1)
    ax, ay = points.direction.unbind(1)
    rise = points.slope
    n = len(points)
    tracks = int(pairs.track_run[-1]) + 1 if len(i) else 0
    iteration = 0
    while True:
        axi, ayi = ax[i], ay[i]
        dx, dy = qx - x[i], qy - y[i]
        c, s = tx * axi + ty * ayi, ty * axi - tx * ayi
        along = dx * axi + dy * ayi
        # Where the sample's own tangent passes the point: curvature and slope would blur the mode otherwise.
        back = -along / torch.where(c.abs() < 0.5, 1.0, c)
        lateral = dy * axi - dx * ayi + back * s
        height = qz - z[i] + back * slope
        inside = (
            (c.abs() > MAX_ANGLE_COS)
            & (lateral.abs() < 4 * config.bandwidth)
            & (height.abs() < config.height_gate)
        )
        window = (1 - (along / config.window).square()).clamp_min(0) * inside
        seen = _scatter(window, pairs.track_run, tracks).clamp_min(1.0)
        kernel = (-0.5 * (lateral / config.bandwidth).square()).exp()
        w = window / seen[pairs.track_run] * kernel * prior
        total = _scatter(w, i, n)
        if iteration == iterations:
            break
        iteration += 1
        scale = 1 / total.clamp_min(1e-12)
        step = _scatter(w * lateral, i, n) * scale
        x, y = x - ay * step, y + ax * step
        z = z + _scatter(w * height, i, n) * scale
        rise = _scatter(w * slope * c.sign(), i, n) * scale
        turn = 0.5 * torch.atan2(
            _scatter(w * 2 * c * s, i, n), _scatter(w * (c.square() - s.square()), i, n)
        )
        ax, ay = ax * turn.cos() - ay * turn.sin(), ax * turn.sin() + ay * turn.cos()
    moved = replace(
        points,
        point=torch.stack((x, y, z), dim=1),
        direction=torch.stack((ax, ay), dim=1),
        slope=rise,
        density=total,
    )
    near = (window > 0) & (lateral.abs() < 2 * config.bandwidth)
    return _supported(moved, samples, pairs, near, w)


def _supported(
    points: RidgePoints,
    samples: LineSamples,
    pairs: _Pairs,
    near: Bool[Tensor, " p"],
    w: Float[Tensor, " p"],
) -> RidgePoints:
    """The points with their owners and votes counted."""
    n = len(points)
    runs = int(pairs.owner_run[-1]) + 1 if len(pairs.i) else 0
    sees = torch.zeros(runs, dtype=torch.bool, device=near.device)
    sees[pairs.owner_run[near & samples.is_witness[pairs.k]]] = True
    point_of_run = torch.zeros(runs, dtype=torch.int64, device=near.device)
    point_of_run[pairs.owner_run] = pairs.i
    kinds = points.votes.shape[1]
    kind = samples.kind[pairs.k]
    known = near & (kind >= 0)
    votes = group_sum(w[known], pairs.i[known] * kinds + kind[known], n * kinds)
    return replace(
        points,
        owners=torch.bincount(point_of_run[sees], minlength=n),
        votes=votes.reshape(n, kinds),
    )


def _pairs(
    samples: LineSamples, tree: KDTree, place: Float[np.ndarray, "n 3"], reach: float
) -> _Pairs:
    device = samples.point.device
    near = KDTree(place).sparse_distance_matrix(tree, reach, output_type="ndarray")
    i, k = (torch.from_numpy(near[name].astype(np.int64)).to(device) for name in ("i", "j"))
    order = (i * len(samples) + k).argsort()
    i, k = i[order], k[order]
    return _Pairs(
        i=i, k=k, track_run=_runs(i, samples.track[k]), owner_run=_runs(i, samples.owner[k])
    )


def _runs(i: Int[Tensor, " p"], group: Int[Tensor, " p"]) -> Int[Tensor, " p"]:
    """Numbers runs of equal (i, group) in sorted pairs."""
    if not len(i):
        return i
    change = (i[1:] != i[:-1]) | (group[1:] != group[:-1])
    return torch.cat((i.new_zeros(1), change.long().cumsum(0)))


def _scatter(value: Float[Tensor, " p"], index: Int[Tensor, " p"], n: int) -> Float[Tensor, " n"]:
    return value.new_zeros(n).index_add_(0, index, value)
