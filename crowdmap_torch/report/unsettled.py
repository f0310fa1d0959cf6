"""What to say of stages that ended before they came to their tolerance, or did not tell."""

from __future__ import annotations

from crowdmap_torch.mapper import FirstMap
from crowdmap_torch.plausibility.finding import Finding
from crowdmap_torch.tables import Dataset


def unsettled_findings(dataset: Dataset, first: FirstMap) -> tuple[Finding, ...]:
    """Clusterings that are not exact, signs before lanes, and groups of drives that nothing ties for certain."""
    return *_of_clusters(first), *_of_ties(dataset, first)


def _of_clusters(first: FirstMap) -> tuple[Finding, ...]:
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


def _of_ties(dataset: Dataset, first: FirstMap) -> tuple[Finding, ...]:
    """Drives that neither signs nor lane markers tie to the others for certain: one finding for each group of them."""
    ties = first.ties
    if ties is None:
        return ()
    group = ties.group.tolist()
    return tuple(
        Finding(
            "untied-drives",
            "no sign ties these drives to the others for certain, and their lane markers fit theirs about as well "
            f"{float(ties.rival[one].norm()):.1f} m beside where they are",
            "they drove the other way, or another road for most of it, or saw signs alone that others like them stand "
            "beside, and biases of positioning are metres",
            "trust distances between what they saw and what the others saw to that; add drives that see signs of both, "
            "or pin signs of both by --control",
            tuple(
                j.journey_id for j, own in zip(dataset.journeys, group, strict=True) if own == one
            ),
        )
        for one in ties.open_groups
    )
