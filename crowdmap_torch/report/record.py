"""Everything that report.html tells of one run."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

from jaxtyping import Float
from torch import Tensor

from crowdmap_torch.adjustment.found_calibration import FleetCalibration
from crowdmap_torch.config import MapperConfig, dump
from crowdmap_torch.evaluation.map_figures import MapFigures
from crowdmap_torch.evaluation.signs import SignComparison
from crowdmap_torch.io.maps import certain_part
from crowdmap_torch.io.sign_outcomes import NamedOutcomes
from crowdmap_torch.io.truth import Truth
from crowdmap_torch.mapper import MapResult
from crowdmap_torch.plausibility.finding import Finding
from crowdmap_torch.report.drives import CornerResiduals, Drift, corners_of, drifts_of
from crowdmap_torch.report.iteration import Iteration
from crowdmap_torch.report.plots import Eigengap
from crowdmap_torch.report.progress import Progress
from crowdmap_torch.report.stages import eigengaps_of
from crowdmap_torch.report.summaries import (
    JourneySummary,
    OutageSummary,
    Pruned,
    counts_line,
    counts_of,
    journey_summaries,
    outages_of,
    outlier_journeys_of,
    pruned_of,
)
from crowdmap_torch.report.watch import Watch
from crowdmap_torch.tables import Dataset, HdMap, RejectedJourney, Survey
from crowdmap_torch.viewer.scene import Drive


@dataclass(frozen=True)
class RunRecord:
    """What a report holds; everything but the map may be missing."""

    title: str
    hd_map: HdMap
    facts: Mapping[str, str] = field(default_factory=dict)
    """What stands at its head, by name: data set, date, version, counts."""
    map_before: HdMap | None = None
    """The cluster heads, before bundle adjustment."""
    survey: Survey | None = None
    figures: MapFigures | None = None
    figures_before: MapFigures | None = None
    drives: tuple[Drive, ...] = ()
    """Where the cars drove, as given and after the adjustment."""
    outcomes: NamedOutcomes | None = None
    """What became of every sign detection."""
    journeys: tuple[JourneySummary, ...] = ()
    counts: Mapping[str, float | str] = field(default_factory=dict)
    """Stages' counts by name, in the order of the stages."""
    pruned: tuple[Pruned, ...] = ()
    warnings: tuple[Finding, ...] = ()
    """What looked wrong, before mapping and after."""
    rejected: tuple[RejectedJourney, ...] = ()
    """Journeys set aside at the door."""
    outlier_journeys: tuple[RejectedJourney, ...] = ()
    """Journeys that lost their weight."""
    outages: tuple[OutageSummary, ...] = ()
    """Stretches of journeys that lost theirs."""
    calibration: FleetCalibration = field(default_factory=dict)
    """What cars have wrong for good."""
    spectra: tuple[Eigengap, ...] = ()
    residual_px: Mapping[str, Float[Tensor, " n"]] = field(default_factory=dict)
    """Lengths of pixel residuals, by stage, in the order of the stages."""
    corners: CornerResiduals | None = None
    """What is left of each corner."""
    drifts: tuple[Drift, ...] = ()
    iterations: tuple[Iteration, ...] = ()
    outcome: str = ""
    """Why the bundle adjustment stopped."""
    timings_s: Mapping[str, float] = field(default_factory=dict)
    """By stage, in the order of the stages."""
    memory_gb: Mapping[str, float] = field(default_factory=dict)
    """The most that the main process held, by stage; empty where nobody tells."""
    config_yaml: str = ""

    @property
    def comparison(self) -> SignComparison | None:
        """Of the map's signs with the survey."""
        return None if self.figures is None else self.figures.comparison

    @property
    def comparison_before(self) -> SignComparison | None:
        """Of the cluster heads."""
        return None if self.figures_before is None else self.figures_before.comparison


def record_of(
    dataset: Dataset,
    result: MapResult,
    config: MapperConfig,
    watch: Watch,
    progress: Progress,
    survey: Survey | None,
    truth: Truth | None,
    figures: MapFigures | None,
    figures_before: MapFigures | None,
    warnings: Sequence[Finding] = (),
    outcomes: NamedOutcomes | None = None,
    facts: Mapping[str, str] | None = None,
) -> RunRecord:
    """What report.html is drawn from; `facts` stand at its head before the counts."""
    hd_map, before = (
        certain_part(m, config.min_confidence) for m in (result.hd_map, result.map_clusters)
    )
    summaries = journey_summaries(dataset, result, truth)
    return RunRecord(
        title=f"Map of {len(dataset.journeys)} journeys",
        facts={**(facts or {}), "from": counts_line(dataset, result, config)},
        hd_map=hd_map,
        map_before=before,
        survey=survey,
        figures=figures,
        figures_before=figures_before,
        drives=tuple(_drives(dataset, result, summaries)),
        outcomes=outcomes,
        journeys=summaries,
        counts=counts_of(dataset, result, config),
        pruned=pruned_of(dataset, result, config),
        warnings=tuple(warnings),
        calibration=result.uncertainty.calibration,
        rejected=dataset.rejected,
        outlier_journeys=outlier_journeys_of(dataset, result.first),
        outages=outages_of(dataset, result.first),
        spectra=eigengaps_of(result.first),
        residual_px=watch.residual_px,
        corners=None if outcomes is None else corners_of(dataset, result, outcomes),
        drifts=drifts_of(dataset, result),
        iterations=tuple(watch.iterations),
        outcome=result.state.reasons[0],
        timings_s=dict(progress.seconds),
        memory_gb=dict(progress.peak_gb),
        config_yaml=dump(config),
    )


def _drives(
    dataset: Dataset, result: MapResult, summaries: Sequence[JourneySummary]
) -> Iterator[Drive]:
    """Every journey's way, as given and as adjusted."""
    why = {out.journey_id: out.reason for out in outlier_journeys_of(dataset, result.first)}
    for journey, poses, summary in zip(dataset.journeys, result.poses, summaries, strict=True):
        yield Drive(
            journey_id=journey.journey_id,
            frame_number=journey.frame_number,
            t_ns=journey.t_ns,
            path_world=poses[:, :3, 3],
            given_world=journey.T_world_camera[:, :3, 3],
            vehicle=journey.vehicle,
            image=(journey.rig.camera.width, journey.rig.camera.height),
            bias=summary.bias,
            bias_sigma=summary.bias_sigma,
            remark=why.get(journey.journey_id, ""),
        )
