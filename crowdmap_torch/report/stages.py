"""What is watched before the adjustment: each journey by itself (section IV), then clusters and biases (V-A)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Int
from torch import Tensor

from crowdmap_torch.clustering.groups import group_count
from crowdmap_torch.mapper import FirstMap, JourneyMap, KeepCall
from crowdmap_torch.report.plots import Eigengap, plot_eigengaps
from crowdmap_torch.report.summaries import outages_of, outlier_journeys_of
from crowdmap_torch.report.tensorboard import TensorBoardLog
from crowdmap_torch.tables import Dataset, Journey, Tracklets

_EIGENVALUES_SHOWN = 60
"""Beyond a gap."""


def keep_and_log(keep: KeepCall, log: TensorBoardLog, journeys: Sequence[Journey]) -> KeepCall:
    """`keep`, and then the events of the journey: what is kept already, a run that goes on does not log again."""

    def keep_then_log(number: int, made: JourneyMap) -> None:
        keep(number, made)
        log_journey(log, journeys[number], number, made)

    return keep_then_log


@torch.no_grad()
def log_journey(log: TensorBoardLog, journey: Journey, number: int, made: JourneyMap) -> None:
    """What one journey shows by itself; its number is the step: association, triangulation, road, lanes."""
    scalars: dict[str, float] = {}
    for kind, tracklets in (("sign", made.sign_tracklets), ("lane", made.lane_tracklets)):
        scalars[f"association/{kind}_tracklets"] = tracklets.count
        scalars[f"association/{kind}_detections_in_no_track"] = int((tracklets.label < 0).sum())
        log.log_histogram(
            f"association/detections_of_a_{kind}_tracklet", _lengths(tracklets).double(), number
        )
    scalars |= _by_reason("triangulation", made.sign_report.pruned)
    scalars |= _by_reason("lanes", made.lane_report.pruned)
    cosine = (made.road.normal_camera @ journey.rig.road_normal_camera).clamp(-1, 1)
    scalars["road/angle_to_calibration_deg"] = float(cosine.acos().rad2deg().mean())
    scalars["road/height_m"] = float(made.road.height.mean())
    log.log_scalars(scalars, number)


@torch.no_grad()
def log_crowd(log: TensorBoardLog, dataset: Dataset, first: FirstMap) -> None:
    """Rounds of clustering, spectra and sizes of clusters, the biases by journey, and bad drives with their reasons."""
    report = first.crowd.report
    for number, made in enumerate(report.rounds):
        scalars = {
            "clusters/sign_clusters": made.clusters,
            "clusters/single_signs": made.singles,
            "clusters/changed": made.changed,
            "clusters/shift_sigma_m": made.shift_sigma,
        }
        log.log_scalars(scalars, number)
    for number, spectrum in enumerate(report.spectra):
        log.log_histogram("clusters/eigenvalues", spectrum.eigenvalues, number)
    if report.spectra:
        log.log_figure("clusters/eigengaps", plot_eigengaps(eigengaps_of(first)), 0)
    size = group_count(first.crowd.label, len(first.crowd.heads))
    log.log_histogram("clusters/signs_of_a_cluster", size.double(), 0)
    for number, drift in enumerate(first.drifts):
        # As in metrics.json: what is to be added to the given positions, in the mean along the way.
        bias = dict(zip(("east", "north", "up"), drift[:, :3].mean(0).tolist(), strict=True))
        log.log_scalars({f"bias/{axis}_m": value for axis, value in bias.items()}, number)
    log.log_scalars({"bias/wander_length_m": first.crowd.positioning.wander_length_m}, 0)
    bad = (*dataset.rejected, *outlier_journeys_of(dataset, first), *outages_of(dataset, first))
    log.log_text("bad_drives", "\n".join(f"{j.journey_id}: {j.reason}" for j in bad) or "none")


def eigengaps_of(first: FirstMap) -> tuple[Eigengap, ...]:
    """The low ends of the spectra that signs were clustered by."""
    return tuple(
        Eigengap(
            f"signs, d_c = {s.scale:g} m",
            tuple(s.eigenvalues[: s.count + _EIGENVALUES_SHOWN].tolist()),
            s.count,
        )
        for s in first.crowd.report.spectra
    )


def _lengths(tracklets: Tracklets) -> Int[Tensor, " count"]:
    return group_count(tracklets.label, tracklets.count)


def _by_reason(stage: str, pruned: Mapping[str, int]) -> dict[str, float]:
    """What a stage kept and pruned, by tag."""
    return {f"{stage}/{reason.replace(' ', '_')}": count for reason, count in pruned.items()}
