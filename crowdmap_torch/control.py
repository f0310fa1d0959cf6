"""Control points: surveyed signs that pin a map (FORMAT.md, METRICS.md `control`)."""

from __future__ import annotations

from dataclasses import dataclass, field

from crowdmap_torch.evaluation.matching import SignMatchConfig, match_signs
from crowdmap_torch.observations import ControlPoints
from crowdmap_torch.tables import Signs, SurveySigns


@dataclass(frozen=True)
class ControlConfig:
    """Which sign of the map a control point is."""

    match: SignMatchConfig = field(default_factory=SignMatchConfig)
    """Optimal assignment to the cluster heads, as in METRICS.md."""
    agreement_m: float = 1.0
    """A match further than this from where the others put it is none."""


def find_control_points(
    signs: Signs, surveyed: SurveySigns, config: ControlConfig
) -> ControlPoints:
    """The surveyed signs found among `signs`; the common shift of an unpinned map is no obstacle.

    The centre alone is taken: the corners of one surveyed sign err together, and its shape is seen in the images.
    """
    match = match_signs(signs, surveyed, config.match)
    offset = signs.center_world[match.map_row] - surveyed.center_world[match.true_row]
    agrees = (offset - match.shift).norm(dim=-1) <= config.agreement_m
    row = match.true_row[agrees]
    return ControlPoints(
        sign=match.map_row[agrees],
        center_world=surveyed.center_world[row],
        sigma=surveyed.sigma[row],
    )
