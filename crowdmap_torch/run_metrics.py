"""What a run says of itself: metrics.json, and the record that the report is drawn from."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence

from crowdmap_torch.config import MapperConfig, dump
from crowdmap_torch.evaluate import MapFigures
from crowdmap_torch.geometry import polygon
from crowdmap_torch.io.truth import Truth
from crowdmap_torch.mapper import MapResult, certain_part
from crowdmap_torch.observations import station
from crowdmap_torch.report.record import Iteration, JourneySummary, Pruned, RunRecord, Spectrum
from crowdmap_torch.report.watch import Watch
from crowdmap_torch.tables import Dataset, RejectedJourney, Survey

_SPECTRUM_LENGTH = 60
"""Eigenvalues shown of a spectrum, on either side of the gap."""


def suspects_of(dataset: Dataset, result: MapResult) -> tuple[RejectedJourney, ...]:
    """Journeys that do not fit the others, with the reason."""
    return tuple(
        RejectedJourney(dataset.journeys[found.journey].journey_id, found.reason)
        for found in result.first.crowd.report.suspects
    )


def counts_of(dataset: Dataset, result: MapResult, config: MapperConfig) -> dict[str, int]:
    """What each stage took and left, in the order of the stages."""
    maps, first = result.journey_maps, result.first
    signs = result.hd_map.signs
    return {
        "journeys": len(dataset.journeys),
        "journeys set aside": len(dataset.rejected),
        "frames": sum(j.frame_count for j in dataset.journeys),
        "sign detections": sum(len(j.signs) for j in dataset.journeys),
        "lane detections": sum(len(j.lanes) for j in dataset.journeys),
        "sign tracklets": sum(m.sign_tracklets.count for m in maps),
        "signs of single journeys": sum(len(m.signs) for m in maps),
        "lane pieces of single journeys": sum(len(m.lanes) for m in maps),
        "sign clusters": len(first.signs),
        "single signs": len(first.tentative),
        "sign detections brought back": first.harvest.fitting + first.harvest.strays
        if first.harvest
        else 0,
        "sign detections used": sum(int((a.sign >= 0).sum()) for a in result.associations),
        "lane detections used": sum(int((a.lane >= 0).sum()) for a in result.associations),
        "control points": result.control_points,
        "signs of the map": int((signs.confidence >= config.min_confidence).sum()),
        "tentative signs": int((signs.confidence < config.min_confidence).sum()),
        "lanes of the map": len(result.hd_map.lanes),
    }


def pruned_of(dataset: Dataset, result: MapResult) -> tuple[Pruned, ...]:
    """What was left out, by stage and reason."""
    totals: Counter[tuple[str, str]] = Counter()
    for journey, made in zip(dataset.journeys, result.journey_maps, strict=True):
        for reason, count in journey.dropped.items():
            totals["detections at the door", reason] += count
        for reason, count in made.sign_report.pruned.items():
            if reason != "kept":
                totals["sign tracklets", reason] += count
        for reason, count in made.lane_report.pruned.items():
            if reason != "kept":
                totals["lane tracklets", reason] += count
    totals["signs of single journeys", "seen by too few journeys"] = len(result.first.tentative)
    return tuple(Pruned(stage, why, count) for (stage, why), count in totals.items() if count)


def journey_summaries(
    dataset: Dataset, result: MapResult, truth: Truth | None = None
) -> tuple[JourneySummary, ...]:
    """One line for each journey in use."""
    summaries = []
    true: Sequence[tuple[float, float, float] | None] = [None] * len(dataset.journeys)
    if truth is not None:
        # A bias is what is to be added to the given positions.
        true = [(-x, -y, -z) for x, y, z in (t.mean_error_m.tolist() for t in truth.journeys)]
    found = result.uncertainty
    sigmas = found.bias_covariance.diagonal(dim1=1, dim2=2).sqrt()
    for journey, made, association, bias, sigma, true_bias in zip(
        dataset.journeys,
        result.journey_maps,
        result.associations,
        found.bias.tolist(),
        sigmas.tolist(),
        true,
        strict=True,
    ):
        east, north, up, heading = bias
        summaries.append(
            JourneySummary(
                journey_id=journey.journey_id,
                frames=journey.frame_count,
                detections=len(journey.signs),
                used=int((association.sign >= 0).sum()),
                signs=len(made.signs),
                bias=(east, north, up),
                bias_sigma=(sigma[0], sigma[1], sigma[2]),
                heading_deg=math.degrees(heading),
                heading_sigma_deg=math.degrees(sigma[3]),
                true_bias=true_bias,
            )
        )
    return tuple(summaries)


def corner_covariances(result: MapResult) -> list[dict[str, object]]:
    """Of every adjusted sign the covariances of its corners, nine numbers each [m^2], in the order of the map's."""
    signs, covariance = result.hd_map.signs, result.uncertainty.corner.flatten(2)
    count = polygon.corner_count(signs.shape[: len(covariance)]).tolist()
    return [
        {"sign_id": name, "covariance": of_corner[:corners]}
        for name, of_corner, corners in zip(
            result.hd_map.sign_id, covariance.tolist(), count, strict=False
        )
    ]


def metrics_of(
    dataset: Dataset,
    result: MapResult,
    config: MapperConfig,
    iterations: Sequence[Iteration],
    seconds: Mapping[str, float],
    figures: MapFigures | None,
    figures_before: MapFigures | None,
) -> dict[str, object]:
    """metrics.json (FORMAT.md)."""
    drive = {j.journey_id: float(station(j.T_world_camera)[-1]) for j in dataset.journeys}
    summaries = journey_summaries(dataset, result)
    return {
        "counts": counts_of(dataset, result, config),
        "pruned": [
            {"stage": p.stage, "reason": p.reason, "count": p.count}
            for p in pruned_of(dataset, result)
        ],
        "times_s": dict(seconds),
        "costs": [
            {"iteration": i.number, "accepted": i.accepted, "total": i.total, **i.cost}
            for i in iterations
        ],
        "outcome": result.state.reasons[0],
        "rejected_journeys": [
            {"journey_id": r.journey_id, "reason": r.reason} for r in dataset.rejected
        ],
        "suspect_journeys": [
            {"journey_id": s.journey_id, "reason": s.reason} for s in suspects_of(dataset, result)
        ],
        "journeys": [
            {
                "journey_id": s.journey_id,
                "frames": s.frames,
                "length_m": drive[s.journey_id],
                "sign_detections": s.detections,
                "sign_detections_used": s.used,
                "signs": s.signs,
                "bias_m": s.bias,
                "bias_covariance": covariance[:3, :3].flatten(),
                "heading_deg": s.heading_deg,
                "heading_sigma_deg": s.heading_sigma_deg,
                "sigma_scale": dict(zip(("bias", "drift", "rotation"), scale, strict=True)),
            }
            for s, covariance, scale in zip(
                summaries,
                result.uncertainty.bias_covariance,
                result.prior_scale.tolist(),
                strict=True,
            )
        ],
        "sign_corners": corner_covariances(result),
        "survey": None if figures is None else figures.as_dict(),
        "survey_clusters": None if figures_before is None else figures_before.as_dict(),
    }


def record_of(
    dataset: Dataset,
    result: MapResult,
    config: MapperConfig,
    watch: Watch,
    seconds: Mapping[str, float],
    survey: Survey | None,
    truth: Truth | None,
    figures: MapFigures | None,
    figures_before: MapFigures | None,
) -> RunRecord:
    """What report.html is drawn from."""
    hd_map, before = (
        certain_part(m, config.min_confidence) for m in (result.hd_map, result.map_clusters)
    )
    return RunRecord(
        title=f"Map of {len(dataset.journeys)} journeys",
        hd_map=hd_map,
        map_before=before,
        survey=survey,
        figures=figures,
        figures_before=figures_before,
        paths_world={
            journey.journey_id: poses[:, :3, 3]
            for journey, poses in zip(dataset.journeys, result.poses, strict=True)
        },
        journeys=journey_summaries(dataset, result, truth),
        counts=counts_of(dataset, result, config),
        pruned=pruned_of(dataset, result),
        rejected=dataset.rejected,
        suspects=suspects_of(dataset, result),
        spectra=tuple(
            Spectrum(
                f"signs, d_c = {s.scale:g} m",
                tuple(s.eigenvalues[: s.count + _SPECTRUM_LENGTH].tolist()),
                s.count,
            )
            for s in result.first.crowd.report.spectra
        ),
        residual_px=watch.residual_px,
        iterations=tuple(watch.iterations),
        outcome=result.state.reasons[0],
        timings_s=dict(seconds),
        config_yaml=dump(config),
    )
