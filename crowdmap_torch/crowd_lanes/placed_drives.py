"""Drives that signs have placed, looked at once more by lane markers where signs leave it open (V-A, V-B)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from crowdmap_torch.crowd_lanes.join import unbiased_pieces
from crowdmap_torch.crowd_lanes.tie_groups import GroupTieConfig, GroupTies, tie_groups
from crowdmap_torch.crowd_signs.groups import groups_of, other_places
from crowdmap_torch.crowd_signs.journey_bias import without_bias
from crowdmap_torch.crowd_signs.match import HeadMatchConfig
from crowdmap_torch.crowd_signs.register import Crowd
from crowdmap_torch.crowd_signs.stretches import FirstBiases
from crowdmap_torch.noise.positioning import PositioningNoise
from crowdmap_torch.tables import Journey, Lanes


@dataclass(frozen=True)
class PlacedDrives:
    """What journeys saw without their biases."""

    ties: GroupTies
    poses: list[Float[Tensor, "_ 4 4"]]
    drifts: tuple[Float[Tensor, "_ 6"], ...]
    """Per journey the tangents from the given poses to those without bias."""
    better: FirstBiases | None
    """Biases to tell signs apart by once more, as drives were matched with signs that only look like theirs; None: lanes
    do not say so."""


def place_drives(
    journeys: Sequence[Journey],
    made: Sequence[Lanes],
    crowd: Crowd,
    bias_sigma: Float[Tensor, "j 3"],
    positioning: PositioningNoise,
    match: HeadMatchConfig,
    config: GroupTieConfig,
    *,
    doubt: bool = True,
) -> PlacedDrives:
    """Drives moved by lanes where no sign ties them, and, with `doubt`, where signs fit at several places.

    `made` are the journeys' lane pieces; `bias_sigma` [m] and `positioning` say how uncertain their biases were at first.
    """
    given, trusted = [j.T_world_camera for j in journeys], crowd.trusted_frames(journeys)
    poses, drifts = without_bias(given, crowd.bias)
    pieces = unbiased_pieces(made, drifts, trusted)
    reach = {"nearest": config.rival_m, "farthest": config.reach_m}
    others = other_places(crowd, match, **reach) if doubt else None
    nobody = crowd.journey_weight < 0
    loosely = nobody if others is None else others.loosely()
    group = groups_of(crowd, loosely)
    told = group, bias_sigma, crowd.positioning, config
    ties = tie_groups(pieces, poses, *told, others=others)
    better = None
    if bool(ties.move.any()):
        bias = crowd.moved(ties.move).bias
        poses, drifts = without_bias(given, bias)
        if bool((loosely & ties.is_shifted[group]).any()):
            larger = torch.tensor(crowd.positioning.bias_sigma_m).to(bias_sigma)
            better = bias, larger / larger.new_tensor(positioning.bias_sigma_m)
    return PlacedDrives(ties, poses, drifts, better)
