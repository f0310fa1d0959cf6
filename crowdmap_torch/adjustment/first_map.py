"""V-B: what bundle adjustment starts from, the map of the cluster heads, or that of an adjustment before."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from crowdmap_torch.adjustment.footing import Footing
from crowdmap_torch.crowd_lanes.cluster import LaneRound
from crowdmap_torch.crowd_lanes.table import LaneSupport
from crowdmap_torch.crowd_lanes.tie_groups import GroupTies
from crowdmap_torch.crowd_signs.completion import CompletedTracks
from crowdmap_torch.crowd_signs.register import Crowd
from crowdmap_torch.tables import Association, Lanes, Signs


@dataclass(frozen=True)
class FirstMap:
    """The map of the cluster heads, and all that bundle adjustment starts from (section V)."""

    signs: Signs
    lanes: Lanes
    lane_support: LaneSupport
    """Which lane each place of the journeys' own lane pieces is of."""
    tentative: Signs
    lane_rounds: tuple[LaneRound, ...]
    """Clusterings of the journeys' lane pieces (`paper2017`; else none)."""
    crowd: Crowd
    associations: tuple[Association, ...]
    drifts: tuple[Float[Tensor, "_ 6"], ...]
    """Per journey the tangents from the given poses to those that lane pieces were joined by."""
    completed: CompletedTracks | None
    """What clustering had set aside and was brought back; None with `paper2017`, which does not."""
    ties: GroupTies | None = None
    """How drives that no sign ties to others were placed by lanes; None with `paper2017`, which does not."""
    anew: int = 0
    """How often it was made anew of an adjusted map."""
    joined: int = 0
    """Signs that went into others then, or astray."""
    found_later: int = 0
    """Signs that came to the map then."""
    before: FirstMap | None = None
    """That of the clusters, before any adjustment, where it was made anew."""
    footing: Footing | None = None
    """Where the adjustment of which it was made stood."""
