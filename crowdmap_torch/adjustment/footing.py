"""What an adjustment found beside its landmarks, for another one of the same drives to begin with (V-B).

Where signs turn out to be one, adjustment begins again with fewer of them. What it found of the poses' errors, of cars and
of noise still holds: begun there, it has a few steps to take, where from wide scales and unknown cars it takes them all.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from crowdmap_torch.adjustment.bundle import Bundle
from crowdmap_torch.adjustment.course import states_at_cuts

_SCALES = (
    *("scale", "small_box", "lasting", "lasting_each", "share_there"),
    *("prior_scale", "drift_told", "white_scale", "calibration_scale", "calibration_far"),
)
"""What a bundle keeps of noise: of pixels, of poses and of cars."""
_BY_KIND = ("prior_scale", "drift_told")
"""Of these what has a column for each kind of error that poses have."""


@dataclass(frozen=True)
class Footing:
    """What does not depend on which landmarks there are."""

    frame: Int[Tensor, " n"]
    """The first frame of each stretch of drift, counted over all journeys."""
    journey: Int[Tensor, " n"]
    drift: Float[Tensor, "n k"]
    steady: Mapping[str, Tensor]
    """Unknowns of journeys and of cars, by name."""
    scales: Mapping[str, Tensor]
    """By name in the bundle."""
    judged: bool
    """Whether detections were judged by everything else."""
    given_up: Bool[Tensor, " d"]
    """Detections, by number, that had no say then."""
    seen: Bool[Tensor, " d"]
    """Those that there were."""


@torch.no_grad()
def footing_of(bundle: Bundle) -> Footing:
    """Where a bundle stands, copied."""
    values, nodes = bundle.values(), bundle.prior.nodes
    return Footing(
        bundle.frame[nodes.first],
        nodes.journey,
        values["drift"],
        {name: values[name] for name in ("bias", "stance", *bundle.fleet.start)},
        {name: getattr(bundle, name).clone() for name in _SCALES},
        int(bundle.judged) > 0,
        bundle.given_up.clone(),
        _seen(bundle),
    )


def _seen(bundle: Bundle) -> Bool[Tensor, " d"]:
    """The detections of corners that a bundle has, by number."""
    seen = torch.zeros_like(bundle.given_up)
    seen[bundle.corners.detection] = True
    return seen


@torch.no_grad()
def stand_on(bundle: Bundle, footing: Footing) -> None:
    """Puts a bundle of the same journeys, not yet adjusted, there.

    A stretch of drift that was none before has that of the one before it in its journey, or of the one behind it. Where
    biases turned out to wander in one of both alone, what is known of all others holds. Detections that had no say have
    none until they are judged once more; until then those that were not there tell nothing of what lasts. Lenses follow as
    the adjustment starts.
    """
    values, nodes = bundle.values(), bundle.prior.nodes
    values |= footing.steady
    if len(footing.frame):
        at = torch.searchsorted(footing.frame, bundle.frame[nodes.first], right=True) - 1
        before, behind = at.clamp_min(0), (at + 1).clamp_max(len(footing.frame) - 1)
        row = torch.where(footing.journey[before] == nodes.journey, before, behind)
        known = (footing.journey[row] == nodes.journey)[:, None]
        wide = min(values["drift"].shape[1], footing.drift.shape[1])
        values["drift"][:, :wide] = torch.where(
            known, footing.drift[row, :wide], values["drift"][:, :wide]
        )
        of_drives = values["drift"], values["stance"]
        values["cut"] = states_at_cuts(bundle.prior, bundle.course, *of_drives)
    for name, there in footing.scales.items():
        here = getattr(bundle, name)
        if name in _BY_KIND:
            here = here[:, : there.shape[1]]
            there = there[:, : here.shape[1]]
        here.copy_(there)
    bundle.judged.fill_(footing.judged)
    bundle.steps_judged.fill_(footing.judged)
    both = min(len(bundle.given_up), len(footing.given_up))
    bundle.given_up[:both] = footing.given_up[:both]
    if footing.judged:
        new = _seen(bundle)
        new[:both] &= ~footing.seen[:both]
        bundle.unjudged.copy_(new)
    bundle.fold(values)
