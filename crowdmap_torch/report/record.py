"""Everything that a report tells of one run, gathered by whoever ran it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from jaxtyping import Float
from torch import Tensor

from crowdmap_torch.evaluate import MapFigures
from crowdmap_torch.evaluation.signs import SignComparison
from crowdmap_torch.tables import HdMap, RejectedJourney, Survey


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


@dataclass(frozen=True)
class Spectrum:
    """Eigenvalues of one graph Laplacian, and how many clusters its gap said."""

    title: str
    eigenvalue: tuple[float, ...]
    """Ascending, the smallest ones."""
    clusters: int
    """The chosen gap is between this many eigenvalues and the next one."""


@dataclass(frozen=True)
class JourneySummary:
    """What is told of one journey in use."""

    journey_id: str
    frames: int
    detections: int
    """Of signs."""
    used: int
    """Sign detections that are in a landmark of the map."""
    signs: int
    """Signs of its own triangulation."""
    bias: tuple[float, float, float]
    """East, north, up: adjusted minus given position, in the mean along the way [m]; NaN if it had no say."""
    bias_sigma: tuple[float, float, float] = (math.nan, math.nan, math.nan)
    heading_deg: float = math.nan
    """The same of the heading, counted from east to north."""
    heading_sigma_deg: float = math.nan
    true_bias: tuple[float, float, float] | None = None
    """The same against the true poses (simulated data only)."""


@dataclass(frozen=True)
class Pruned:
    """How many of what were left out where, and why."""

    stage: str
    reason: str
    count: int


@dataclass(frozen=True)
class RunRecord:
    """What a report holds; everything but the map may be missing."""

    title: str
    hd_map: HdMap
    subtitle: str = ""
    """Dataset, version, date: one line."""
    map_before: HdMap | None = None
    """The cluster heads, before bundle adjustment."""
    survey: Survey | None = None
    figures: MapFigures | None = None
    figures_before: MapFigures | None = None
    paths_world: Mapping[str, Float[Tensor, "f 3"]] = field(default_factory=dict)
    """Where the cars drove, by journey."""
    journeys: tuple[JourneySummary, ...] = ()
    counts: Mapping[str, float | str] = field(default_factory=dict)
    """Stages' counts by name, in the order of the stages."""
    pruned: tuple[Pruned, ...] = ()
    rejected: tuple[RejectedJourney, ...] = ()
    """Journeys set aside at the door."""
    suspects: tuple[RejectedJourney, ...] = ()
    """Journeys that lost their weight."""
    spectra: tuple[Spectrum, ...] = ()
    residual_px: Mapping[str, Float[Tensor, " n"]] = field(default_factory=dict)
    """Lengths of pixel residuals, by stage, in the order of the stages."""
    iterations: tuple[Iteration, ...] = ()
    outcome: str = ""
    """Why the bundle adjustment stopped."""
    timings_s: Mapping[str, float] = field(default_factory=dict)
    """By stage, in the order of the stages."""
    config_yaml: str = ""

    @property
    def comparison(self) -> SignComparison | None:
        """Of the map's signs with the survey."""
        return None if self.figures is None else self.figures.comparison

    @property
    def comparison_before(self) -> SignComparison | None:
        """Of the cluster heads."""
        return None if self.figures_before is None else self.figures_before.comparison
