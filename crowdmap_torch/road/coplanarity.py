"""The paper's online adjustment of the road normal: the one that makes the road most nearly a plane (IV-C, eq:rne).

With the points `w = c_n + R_n v_i(n)` of the paper, v_i the fixed rays cut at the candidate plane,
the scatter matrix of a segment needs the mean and the second moments of the v_i only: the fixed
points never meet the poses one by one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from crowdmap_torch.geometry.plane import harmonic_mean_singular_value, smallest_singular_value
from crowdmap_torch.ranges import FILLED, Count, Place, Rounds, Settings, Spacing
from crowdmap_torch.road.ego_motion import EgoMotion
from crowdmap_torch.tables import Rows

NO_STEP = 1e-7
"""Newton steps below this end the search [rad]."""
COSTS = {
    "smallest_singular_value": smallest_singular_value,
    "harmonic_mean": harmonic_mean_singular_value,
}


@dataclass(frozen=True)
class CoplanarityConfig(Settings):
    """The online adjustment exactly as in the paper (IV-C, eq:rne)."""

    cost: str = "smallest_singular_value"
    """Of a segment's scatter matrix; or `harmonic_mean` of the singular values, the cheaper
    surrogate."""
    segment_m: Spacing = 20.0
    """Length of the segments over which the road counts as planar."""
    segments: Count = 10
    """Most recent segments in the sum."""
    min_segments: Count = 3
    """Fewer than these do not start an adjustment."""
    poses: Count = 16
    """Poses of a segment, equally spaced."""
    update_m: Spacing = 30.0
    """The normal is estimated anew after so much travel."""
    points_right: Annotated[tuple[Place, ...], FILLED] = (-0.5, -0.25, 0.0, 0.25, 0.5)
    """Fixed points below the horizon: on the plane z = 1 of the calibrated road frame, to the
    right."""
    points_down: Annotated[tuple[Place, ...], FILLED] = (0.1, 0.15, 0.225, 0.35)
    """Likewise, below the calibrated horizon."""
    iterations: Rounds = 12
    """Most damped Newton steps."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.cost not in COSTS:
            raise ValueError(f"cost: expected one of {', '.join(COSTS)}, found {self.cost!r}")


@dataclass(frozen=True)
class PoseNodes(Rows):
    """Poses picked at equal distances along the way, at most one for each cell of it."""

    cell: Int[Tensor, " n"]
    """Increasing; `poses` cells make up a segment."""
    R_world_road: Float[Tensor, "n 3 3"]
    position: Float[Tensor, "n 3"]


@dataclass(frozen=True)
class NormalUpdates:
    """Normals estimated along a drive."""

    frame: Int[Tensor, " u"]
    """Frame from which on each of them is known."""
    alpha: Float[Tensor, " u"]
    beta: Float[Tensor, " u"]
    sigma: Float[Tensor, " u"]
    """1-sigma of the normal's angle, from the curvature of the cost [rad]; infinite where the cost
    does not decide."""


def pick_nodes(
    motion: EgoMotion, station: Float[Tensor, " stations"], config: CoplanarityConfig
) -> PoseNodes:
    """The first pose in each cell that frames newly enter.

    `station` holds that of the frame before them, too.
    """
    cell = (station * (config.poses / config.segment_m)).floor().long()
    enters = cell[1:] > cell[:-1]
    return PoseNodes(cell[1:][enters], motion.R_world_road[enters], motion.position[enters])


def coplanar_normals(
    nodes: PoseNodes,
    frame: Int[Tensor, " u"],
    station: Float[Tensor, " u"],
    height: float,
    start: Float[Tensor, " 2"],
    config: CoplanarityConfig,
) -> NormalUpdates:
    """The normals at frames with given stations, each from the segments before it (eq:rne).

    The search begins at pitch and roll `start`: near the last normal found it ends after a step or two.
    """
    last = (station / config.segment_m).floor().long()
    slot = torch.arange(config.segments, device=frame.device)
    segment = last[:, None] - 1 - slot
    index, present = _rows(nodes, segment, config.poses)
    # A segment with few poses (the first after a gap in the frames) says nothing about a plane.
    present = present & (present.sum(-1, keepdim=True) >= config.poses // 2)
    complete = present.any(-1)
    enough = complete.sum(-1) >= config.min_segments
    frame, index, present = frame[enough], index[enough], present[enough]
    if not len(frame):
        none = nodes.position[:0, 0]
        return NormalUpdates(frame, none, none, none)
    segments = _Segments(nodes.R_world_road[index], nodes.position[index], present, height, config)
    tilt, cost, H = _minimise(segments.costs, start.expand(len(frame), 2), config.iterations)
    # The points of one pose are all wrong together: poses count, not points.
    freedom = (present.sum((-1, -2)) - 4 * complete[enough].sum(-1)).clamp_min(1)
    eigenvalue, V = torch.linalg.eigh(H)
    inverse = V @ ((1 / eigenvalue.clamp_min(1e-12))[..., None] * V.mT)
    # Rounding can leave an exact plane a cost below zero.
    variance = 2 * (cost.clamp_min(1e-12) / freedom)[:, None, None] * inverse
    sigma = variance.diagonal(dim1=-2, dim2=-1).sum(-1).sqrt()
    sigma = torch.where(eigenvalue[:, 0] > 0, sigma, torch.inf)
    return NormalUpdates(frame, tilt[:, 0], tilt[:, 1], sigma)


class _Segments:
    """The scatter of a road's fixed points over the segments before each update (eq:rne)."""

    def __init__(
        self,
        R_world_road: Float[Tensor, "u g p 3 3"],
        position: Float[Tensor, "u g p 3"],
        present: Bool[Tensor, "u g p"],
        height: float,
        config: CoplanarityConfig,
    ) -> None:
        self.R, self.height, self.singular = R_world_road, height, COSTS[config.cost]
        self.there = present.any(-1)
        self.weight = present.to(position)
        self.number = self.weight.sum(-1)[..., None, None].clamp_min(1)
        centre = (self.weight[..., None] * position).sum(-2, keepdim=True) / self.number
        self.c = position - centre
        right, down = (position.new_tensor(v) for v in (config.points_right, config.points_down))
        rays = torch.cartesian_prod(right, down)
        self.rays = torch.cat((rays, torch.ones_like(rays[:, :1])), dim=-1)

    def costs(self, tilt: Float[Tensor, "u 2"]) -> Float[Tensor, " u"]:
        """The sum over segments of how far points are from a plane, for the normals of pitch and roll `tilt`."""
        n = torch.nn.functional.normalize(
            torch.stack((tilt[:, 1], torch.ones_like(tilt[:, 0]), tilt[:, 0]), dim=-1), dim=-1
        )
        v = self.rays * (self.height / (n @ self.rays.T))[..., None]
        mean, square = v.mean(1), (v[..., :, None] * v[..., None, :]).mean(1)
        seen = self.c + (self.R @ mean[:, None, None, :, None])[..., 0]
        spread = self.R @ (square - mean[:, :, None] * mean[:, None, :])[:, None, None] @ self.R.mT
        centre = (self.weight[..., None] * seen).sum(-2, keepdim=True) / self.number
        off = seen - centre
        between = off[..., :, None] * off[..., None, :]
        S = (self.weight[..., None, None] * (between + spread)).sum(-3) * len(self.rays)
        # Where there is no segment, three distinct values: those of a zero matrix have no derivative.
        S = torch.where(self.there[..., None, None], S, torch.diag(S.new_tensor([1.0, 2.0, 3.0])))
        return torch.where(self.there, self.singular(S), 0.0).sum(-1)


def _rows(
    nodes: PoseNodes, segment: Int[Tensor, "u g"], poses: int
) -> tuple[Int[Tensor, "u g p"], Tensor]:
    """Row of the node in each cell of segments, and which of them there are."""
    cell = segment[..., None] * poses + torch.arange(poses, device=segment.device)
    row = torch.searchsorted(nodes.cell, cell).clamp_max(max(len(nodes.cell) - 1, 0))
    return row, (nodes.cell[row] == cell) & (cell >= 0)


def _minimise(
    costs: Callable[[Tensor], Tensor], start: Float[Tensor, "u 2"], iterations: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Minima of independent functions of two variables (damped Newton), values and Hessians there."""

    def slope_and_curvature(x: Tensor) -> tuple[Float[Tensor, "u 2"], Float[Tensor, "u 2 2"]]:
        with torch.enable_grad():
            x = x.detach().requires_grad_()
            (slope,) = torch.autograd.grad(costs(x).sum(), x, create_graph=True)
            # One function each: the Hessian of their sum falls into blocks.
            rows = [
                torch.autograd.grad(slope[:, k].sum(), x, retain_graph=True)[0] for k in range(2)
            ]
        H = torch.stack(rows, dim=-1)
        return slope.detach(), 0.5 * (H + H.mT)

    x, value = start, costs(start)
    g, H = slope_and_curvature(x)
    damping = torch.full_like(value, 1e-3)
    for _ in range(iterations):
        eigenvalue, V = torch.linalg.eigh(H)
        # Uphill curvature is walked down all the same; the damping is relative to the larger of the
        # two.
        bounded = eigenvalue.abs() + damping[:, None] * eigenvalue.abs().amax(-1, keepdim=True)
        step = -(V @ ((V.mT @ g[..., None])[..., 0] / bounded.clamp_min(1e-12))[..., None])[..., 0]
        step = step * (0.02 / step.norm(dim=-1, keepdim=True).clamp_min(0.02))
        if bool((step.norm(dim=-1) < NO_STEP).all()):
            break
        new = costs(x + step)
        better = new < value
        x = torch.where(better[:, None], x + step, x)
        value = torch.where(better, new, value)
        damping = torch.where(better, damping / 4, damping * 8).clamp(1e-9, 1e6)
        g, H = slope_and_curvature(x)
    return x, value, H
