"""Terms on signs and lanes as they stand at the moment of a step: what an iteration holds on to, and lets go after it."""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.adjustment.config import AdjustConfig
from crowdmap_torch.optim.problem import CostTerm
from crowdmap_torch.optim.robust import Tukey
from crowdmap_torch.residuals import lane, sign_prior
from crowdmap_torch.residuals.sign_prior import SignHabit

_LOG_USUAL = 0.25
"""1-sigma of the logarithms of the width and height that are usual on a map, about those of `SignHabit`."""


def about_usual_size(term: CostTerm, size: Float[Tensor, "n 2"], habit: SignHabit) -> CostTerm:
    """`habit_term` about the sizes that are usual among the map's own signs.

    What is usual is unknown, and the same for all: of many signs their mean, of few what `habit` says. About a size that is
    given, thousands of signs that are a little larger would together be as sure of it as of a measurement, and where
    detectors may draw all outlines too large, which no image tells from large signs, the map would be scaled to it.
    """
    (_, own), *_ = term.slots
    size = size.detach()[own]
    typical = size.new_full((2,), habit.typical_size_m).log()
    among = habit.log_size**2 / max(len(own), 1)
    share = _LOG_USUAL**2 / (_LOG_USUAL**2 + among)
    usual = (typical + share * (size.log().mean(0) - typical)).exp()
    facing, before = term.constants
    return replace(term, constants=(facing, usual.expand_as(before)))


def size_class_term(size: Float[Tensor, "n 2"], config: AdjustConfig) -> dict[str, CostTerm]:
    """Draws signs to the nearest of the usual sizes, where the configuration names some."""
    size = size.detach()
    classes = size.new_tensor(config.size_classes_m)
    if not len(classes) or not len(size):
        return {}
    away = (size[:, None] / classes).log().square().sum(-1)
    term = CostTerm(
        sign_prior.size_class,
        (("size", torch.arange(len(size), device=size.device)),),
        (classes[away.argmin(1)],),
        size.new_full((len(size),), 1 / config.size_class_sigma),
        Tukey(config.tukey_c),
        takes_rows=True,
    )
    return {"size_class": term}


def slide_term(
    T_world_camera: Float[Tensor, "p 4 4"],
    control_world: Float[Tensor, "c 3"],
    beside: Int[Tensor, " c"],
    along: Float[Tensor, "c 3"],
    config: AdjustConfig,
) -> dict[str, CostTerm]:
    """Keeps lanes from sliding along themselves within a step: nothing in the images says where they are.

    Each control point is held, along its lane, to the pose `beside` it, at the place of the moment: so it is not pulled;
    the map's covariance is taken without it.
    """
    index = torch.nonzero(beside >= 0)[:, 0]
    beside, along = beside[index], along[index]
    offset = (control_world[index] - T_world_camera[beside, :3, 3]).detach()
    term = CostTerm(
        lane.lane_slide,
        (("pose", beside), ("lane", index)),
        (offset, along),
        offset.new_full((len(offset),), 1 / config.lane_slide_m),
        takes_rows=True,
    )
    return {"lane_slide": term}
