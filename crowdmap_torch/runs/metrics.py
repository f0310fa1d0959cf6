"""metrics.json: what a run says of itself in numbers (FORMAT.md)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from crowdmap_torch.config import MapperConfig
from crowdmap_torch.evaluation.map_figures import MapFigures
from crowdmap_torch.geometry import polygon
from crowdmap_torch.geometry.trajectory import station
from crowdmap_torch.io.documents import plain
from crowdmap_torch.mapper import MapResult
from crowdmap_torch.noise.pooled_scales import LEAST_SCALE, MOST_SCALE
from crowdmap_torch.noise.pose_evidence import white_scales_of_kinds
from crowdmap_torch.report.iteration import Iteration
from crowdmap_torch.report.progress import Progress
from crowdmap_torch.report.summaries import (
    counts_of,
    journey_summaries,
    outages_of,
    outlier_journeys_of,
    pruned_of,
)
from crowdmap_torch.tables import Dataset


def metrics_of(
    dataset: Dataset,
    result: MapResult,
    config: MapperConfig,
    iterations: Sequence[Iteration],
    progress: Progress,
    workers: Mapping[str, object],
    figures: MapFigures | None,
    figures_before: MapFigures | None,
) -> dict[str, object]:
    """metrics.json (FORMAT.md); `workers` is what the engine tells."""
    drive = {j.journey_id: float(station(j.T_world_camera)[-1]) for j in dataset.journeys}
    summaries = journey_summaries(dataset, result)
    return {
        "counts": counts_of(dataset, result, config),
        "pruned": plain(pruned_of(dataset, result, config)),
        "times_s": dict(progress.seconds),
        "memory_gb": dict(progress.peak_gb),
        "workers": dict(workers),
        "costs": [
            {
                **{"iteration": i.number, "accepted": i.accepted, "judged": i.judged},
                **{"before": i.cost_before, "total": i.total, **i.cost},
                "scale": dict(i.scale),
            }
            for i in iterations
        ],
        "outcome": result.state.reasons[0],
        "rejected_journeys": plain(dataset.rejected),
        "suspect_journeys": plain(outlier_journeys_of(dataset, result.first)),
        "outages": plain(outages_of(dataset, result.first)),
        "wander_length_m": result.first.crowd.positioning.wander_length_m,
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
                "sigma_scale": _named_scales(of_prior, of_noise, kinds),
                **({} if s.without_it is None else {"without_it": plain(s.without_it)}),
            }
            for s, covariance, of_prior, of_noise, kinds in zip(
                summaries,
                result.uncertainty.bias_covariance,
                result.prior_scale.tolist(),
                result.white_scale.tolist(),
                white_scales_of_kinds(result.white_scale).tolist(),
                strict=True,
            )
        ],
        "sign_corners": _corner_covariances(result),
        "survey": None if figures is None else figures.as_dict(),
        "survey_clusters": None if figures_before is None else figures_before.as_dict(),
    }


def _named_scales(
    of_prior: Sequence[float], of_noise: Sequence[float], kinds: Sequence[float]
) -> dict[str, object]:
    """What the sigmas of a journey's errors were multiplied by, by name; and which of these could not go further.

    `kinds` are root mean squares of scales `of_noise`.
    """
    slow = dict(zip(("bias", "drift", "rotation", "wander"), of_prior, strict=False))
    noise = dict(zip(("noise", "rotation_noise"), kinds, strict=True))
    at_bound = [name for name, found in slow.items() if found <= LEAST_SCALE * (1 + 1e-6)]
    largest = {**slow, "noise": max(of_noise[:3]), "rotation_noise": max(of_noise[3:])}
    at_bound += [name for name, found in largest.items() if found >= MOST_SCALE * (1 - 1e-6)]
    by_axis = {"noise_by_axis": of_noise[:3], "rotation_noise_by_axis": of_noise[3:]}
    return {**slow, **noise, **by_axis, "at_bound": at_bound}


def _corner_covariances(result: MapResult) -> list[dict[str, object]]:
    """Of every adjusted sign the covariances of its corners, nine numbers each [m^2], in the order of the map's."""
    signs, covariance = result.hd_map.signs, result.uncertainty.corner.flatten(2)
    count = polygon.corner_count(signs.shape[: len(covariance)]).tolist()
    return [
        {"sign_id": name, "covariance": of_corner[:corners]}
        for name, of_corner, corners in zip(
            result.hd_map.sign_id, covariance.tolist(), count, strict=False
        )
    ]
