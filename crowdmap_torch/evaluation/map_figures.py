"""The figures of a map against its survey, as METRICS.md groups them."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

from crowdmap_torch.evaluation.association import AssociationFigures
from crowdmap_torch.evaluation.lanes import LaneFigures
from crowdmap_torch.evaluation.signs import SignComparison, SignFigures
from crowdmap_torch.evaluation.single_journey import SingleJourneyFigures
from crowdmap_torch.evaluation.statistics import PositionFigures
from crowdmap_torch.evaluation.uncertainty import UncertaintyFigures
from crowdmap_torch.io.documents import plain


@dataclass(frozen=True)
class MapFigures:
    """All figures of a map; None where the survey or the dataset cannot say."""

    signs: SignFigures
    oracle: PositionFigures | None = None
    """Of corners (simulated data only)."""
    oracle_center: PositionFigures | None = None
    absolute_over_oracle: float = math.nan
    """Mean absolute corner error in units of the oracle's."""
    lanes: LaneFigures | None = None
    association: AssociationFigures | None = None
    single_journey: SingleJourneyFigures | None = None
    uncertainty: UncertaintyFigures | None = None
    control_signs: int = 0
    """Left out of every figure."""
    gate_m: float = 3.0
    notes: tuple[str, ...] = field(default_factory=tuple)
    """What could not be evaluated, and why."""
    comparison: SignComparison | None = field(default=None, repr=False)
    """Each matched sign of the map beside its surveyed one: what the figures of signs are taken from."""

    def as_dict(self) -> dict[str, Any]:
        """Nested dicts of numbers, without the comparison; null for what is unknown, ready for JSON."""
        figures = plain(replace(self, comparison=None))
        del figures["comparison"]
        return figures
