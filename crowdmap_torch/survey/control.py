"""Control signs: surveyed signs that pin a map (FORMAT.md, METRICS.md `control`)."""

from __future__ import annotations

from dataclasses import dataclass, field

from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.ranges import Length, Settings
from crowdmap_torch.survey.matching import SurveyMatchConfig, match_to_survey
from crowdmap_torch.tables import Rows, Signs, SurveySigns


@dataclass(frozen=True)
class ControlSigns(Rows):
    """Signs of the map whose centre was surveyed."""

    sign: Int[Tensor, " n"]
    """Row of the map's sign."""
    center_world: Float[Tensor, "n 3"]
    sigma: Float[Tensor, " n"]
    """1-sigma of the centre per axis [m]."""


@dataclass(frozen=True)
class ControlConfig(Settings):
    """Which sign of the map a surveyed one is."""

    match: SurveyMatchConfig = field(default_factory=SurveyMatchConfig)
    """Optimal assignment to the cluster heads, as in METRICS.md."""
    agreement_m: Length = 1.0
    """A match further than this from where the others put it is none."""


def find_control_signs(signs: Signs, surveyed: SurveySigns, config: ControlConfig) -> ControlSigns:
    """The surveyed signs found among `signs`; the common shift of an unpinned map is no obstacle.

    The centre alone is taken: the corners of one surveyed sign err together, and its shape is seen in the images.
    """
    match = match_to_survey(signs, surveyed, config.match)
    offset = signs.center_world[match.map_row] - surveyed.center_world[match.true_row]
    agrees = (offset - match.shift).norm(dim=-1) <= config.agreement_m
    row = match.true_row[agrees]
    return ControlSigns(
        sign=match.map_row[agrees],
        center_world=surveyed.center_world[row],
        sigma=surveyed.sigma[row],
    )
