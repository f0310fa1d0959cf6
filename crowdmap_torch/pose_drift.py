"""Drift of a journey's poses around a landmark: a polyline of position errors over the way, bound to be a random walk.

The landmark is placed relative to the pose at its closest view, where the drift is held at zero; towards the other
views it may grow with the square root of the distance. All of it is rows of small independent problems, one per
landmark.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from crowdmap_torch.optim.problem import CostTerm

ANCHOR_SIGMA_M = 1e-3
"""How tightly the drift is held at zero at the closest view."""


@dataclass(frozen=True)
class DriftConfig:
    """How the error of positions changes along a drive."""

    sigma_m: float = 0.029
    """Standard deviation over one metre, per axis; it grows with the square root of the way."""
    sigma_rad: float = 3.7e-4
    """The same of rotations."""
    knot_m: float = 4.0
    """Distance between the knots of the polyline."""
    max_knots: int = 20
    """Views further from the closest one than so many knots share the last."""


@dataclass(frozen=True)
class DriftKnots:
    """Knots of the drift around every landmark, those of one landmark adjacent and in order."""

    landmark: Int[Tensor, " k"]
    is_last: Bool[Tensor, " k"]
    """No further knot of the landmark follows."""
    anchor: Int[Tensor, " n"]
    """The knot at each landmark's closest view."""
    before: Int[Tensor, " m"]
    """The knot before each view; the one after it is the next."""
    share: Float[Tensor, " m"]
    """Weight of the knot after the view; the one before has the rest."""

    def at_views(self, drift: Float[Tensor, "k 3"]) -> Float[Tensor, "m 3"]:
        """The drift at every view, interpolated between knots."""
        a = self.share[:, None]
        return (1 - a) * drift[self.before] + a * drift[self.before + 1]


def signed_distance(
    p_world: Float[Tensor, "m 3"],
    away: Float[Tensor, " m"],
    frame: Int[Tensor, " m"],
    group: Int[Tensor, " m"],
) -> Float[Tensor, " m"]:
    """How far each camera is from that of the group's closest view [m]; negative in earlier frames.

    `away` is the distance of each view from the landmark. The straight line stands for the way between the two: it does
    not grow at a standstill, as the sum over noisy steps would.
    """
    closest = closest_view(away, group)[group]
    direction = torch.where(frame < frame[closest], -1.0, 1.0).to(away)
    return direction * (p_world - p_world[closest]).norm(dim=-1)


def closest_view(away: Float[Tensor, " m"], group: Int[Tensor, " m"]) -> Int[Tensor, " g"]:
    """The row with the least `away` of each group, the first of equals; every group must have a row."""
    # Sorted by group and then by distance, the first row of each group is the one.
    order = torch.argsort(away, stable=True)
    order = order[torch.argsort(group[order], stable=True)]
    count = torch.bincount(group)
    return order[count.cumsum(0) - count]


def place_knots(
    distance: Float[Tensor, " m"], landmark: Int[Tensor, " m"], config: DriftConfig
) -> DriftKnots:
    """Knots for views at signed `distance` from the closest view of their landmark; every landmark must have a view."""
    position = (distance / config.knot_m).clamp(-config.max_knots, config.max_knots)
    zero = torch.zeros_like(torch.bincount(landmark), dtype=position.dtype)
    low = zero.scatter_reduce(0, landmark, position, "amin").floor().long()
    high = zero.scatter_reduce(0, landmark, position, "amax").ceil().long()
    count = (high - low + 1).clamp_min(2)
    first = count.cumsum(0) - count
    is_last = torch.zeros(int(count.sum()), dtype=torch.bool, device=landmark.device)
    is_last[first + count - 1] = True
    rank = torch.minimum(position.floor().long() - low[landmark], count[landmark] - 2)
    return DriftKnots(
        landmark=torch.repeat_interleave(torch.arange(len(count), device=first.device), count),
        is_last=is_last,
        anchor=first - low,
        before=first[landmark] + rank,
        share=position - low[landmark] - rank,
    )


def drift_step(before: Float[Tensor, " 3"], after: Float[Tensor, " 3"]) -> Float[Tensor, " 3"]:
    """Change of the drift from one knot to the next."""
    return after - before


def drift_anchor(drift: Float[Tensor, " 3"]) -> Float[Tensor, " 3"]:
    """Drift at the closest view."""
    return drift.clone()


def drift_terms(knots: DriftKnots, config: DriftConfig) -> dict[str, CostTerm]:
    """The random walk of the variable `drift`, and its anchors."""
    before = (~knots.is_last).nonzero()[:, 0]
    step_sigma = config.sigma_m * config.knot_m**0.5

    def step_jacobian(a: Tensor, b: Tensor) -> tuple[Tensor, tuple[Tensor, Tensor]]:
        eye = torch.eye(3, dtype=a.dtype, device=a.device).expand(len(a), 3, 3)
        return b - a, (-eye, eye)

    def anchor_jacobian(a: Tensor) -> tuple[Tensor, tuple[Tensor]]:
        return a, (torch.eye(3, dtype=a.dtype, device=a.device).expand(len(a), 3, 3),)

    return {
        "drift_step": CostTerm(
            drift_step,
            (("drift", before), ("drift", before + 1)),
            weight=torch.full_like(before, 1, dtype=knots.share.dtype) / step_sigma,
            jacobian=step_jacobian,
        ),
        "drift_anchor": CostTerm(
            drift_anchor,
            (("drift", knots.anchor),),
            weight=torch.full_like(knots.anchor, 1, dtype=knots.share.dtype) / ANCHOR_SIGMA_M,
            jacobian=anchor_jacobian,
        ),
    }
