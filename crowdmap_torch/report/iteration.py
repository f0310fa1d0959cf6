"""One step of the bundle adjustment, as it is logged and drawn."""

from __future__ import annotations

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
    errors: Mapping[str, float] = field(default_factory=dict)
    """By TensorBoard tag (`evaluate.progress_scalars`)."""

    @property
    def total(self) -> float:
        """Cost of all terms."""
        return sum(self.cost.values())
