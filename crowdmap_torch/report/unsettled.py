"""What to say of stages that ended before they came to their tolerance."""

from __future__ import annotations

from crowdmap_torch.mapper import FirstMap
from crowdmap_torch.plausibility.finding import Finding


def unsettled_findings(first: FirstMap) -> tuple[Finding, ...]:
    """Clusterings whose eigenpairs are not exact: one finding for signs, one for lanes, in that order."""
    misses = {
        "sign": max((spectrum.miss for spectrum in first.crowd.report.spectra), default=0.0),
        "lane": max((made.miss for made in first.lane_rounds), default=0.0),
    }
    return tuple(
        Finding(
            f"unsettled-{kind}-clusters",
            f"the eigenpairs that {kind}s are clustered by have residuals up to {miss:.1e}",
            f"{kind}s of a large part of the map are hardly told apart by what is between them",
            f"map fewer journeys or a smaller area at a time, and look at {kind}s that stand close",
        )
        for kind, miss in misses.items()
        if miss
    )
