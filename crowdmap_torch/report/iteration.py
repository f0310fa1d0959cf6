"""One step of the bundle adjustment, as it is logged and drawn."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Iteration:
    """One step of the bundle adjustment."""

    number: int
    cost: Mapping[str, float]
    """By term."""
    damping: float
    gain_ratio: float
    step_norm: float
    accepted: bool = True
    cost_before: float = math.nan
    """Of all terms where the step began, in the scales and matches of the step: what `total` is to be compared with."""
    cost_after: float = math.nan
    """Where it ended, in those of the next step."""
    scale: Mapping[str, float] = field(default_factory=dict)
    """What residuals are measured in from here on, by name; with `px` at the end in pixels."""
    judged: int = 0
    """How often detections had been judged when it ended."""
    errors: Mapping[str, float] = field(default_factory=dict)
    """By TensorBoard tag (`evaluate.progress_scalars`)."""

    @property
    def total(self) -> float:
        """Cost of all terms."""
        return sum(self.cost.values())
