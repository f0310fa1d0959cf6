"""What the journeys of a study are worth, alone, averaged and mapped together, as plain numbers."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from crowdmap_torch.benchmark.association import sign_associations
from crowdmap_torch.clustering.groups import group_mode
from crowdmap_torch.config import MapperConfig
from crowdmap_torch.crowd_signs.cluster import sign_heads
from crowdmap_torch.evaluation.evaluate import evaluate_map
from crowdmap_torch.evaluation.map_figures import MapFigures
from crowdmap_torch.evaluation.signs import SignFigures, evaluate_signs
from crowdmap_torch.evaluation.single_journey import JourneyLandmarks, evaluate_single_journeys
from crowdmap_torch.evaluation.visibility import MIN_FRAMES, MIN_JOURNEYS, frames_of_signs
from crowdmap_torch.io.datasets import load_dataset
from crowdmap_torch.io.documents import plain, read_json
from crowdmap_torch.io.maps import certain_part
from crowdmap_torch.io.surveys import read_survey
from crowdmap_torch.io.truth import JourneyTruth, Truth, read_truth
from crowdmap_torch.mapper import JourneyMap, adjusted_map, clusters_map, first_map
from crowdmap_torch.noise.pose_prior import variance_of_mean
from crowdmap_torch.simulate.positioning import PositioningConfig
from crowdmap_torch.studies.recovered import recovered
from crowdmap_torch.tables import Association, Dataset, HdMap, Survey, concatenate


@dataclass(frozen=True)
class Drives:
    """A simulated dataset and all that is known of it."""

    dataset: Dataset
    survey: Survey
    truth: Truth
    bad: dict[str, str]
    """The faults of bad drives, by journey."""
    vehicles: Mapping[str, Any]
    """What cars truly have wrong (FORMAT.md), by vehicle."""

    def select(self, rows: Sequence[int]) -> Drives:
        """Some of the journeys."""
        journeys = tuple(self.dataset.journeys[row] for row in rows)
        truth = tuple(self.truth.journeys[row] for row in rows)
        return replace(
            self, dataset=replace(self.dataset, journeys=journeys), truth=Truth(journeys=truth)
        )


@lru_cache(maxsize=1)
def load_drives(folder: Path) -> Drives:
    """A simulated dataset; the last one stays in memory, as tasks come dataset by dataset."""
    dataset = load_dataset(folder, strict=True)
    survey = read_survey(folder / "survey")
    truth = read_truth(folder / "survey", survey, dataset.journeys)
    bad = read_json(folder / "survey" / "truth" / "bad_drives.json").content
    vehicles = read_json(folder / "survey" / "truth" / "vehicles.json").content
    return Drives(dataset, survey, truth, bad, vehicles)


def measure_journey(drives: Drives, row: int, made: JourneyMap) -> dict[str, Any]:
    """What one journey's own map is worth: as it is (`signs`), and with its pose errors taken off (`clean`)."""
    truth = drives.truth.journeys[row]
    seen = frames_of_signs(truth, len(drives.survey.signs)) >= MIN_FRAMES
    landmarks = JourneyLandmarks(truth.journey.journey_id, made.signs, made.lanes)
    return {
        "signs": plain(evaluate_signs(made.signs, drives.survey.signs, observable=seen)),
        "clean": plain(evaluate_single_journeys([landmarks], [truth], drives.survey)),
    }


@torch.no_grad()
def measure_map(
    drives: Drives,
    maps: Sequence[JourneyMap],
    config: MapperConfig,
    *,
    adjusted: bool,
    control: int = 0,
) -> dict[str, Any]:
    """Figures of the map of all journeys of `drives`: cluster heads, and the adjusted map if it is asked for.

    `control` surveyed signs, far from each other, pin the adjusted map and are left out of its figures. With them come
    the plain average of the single-journey signs, bad drives found, and the seconds of this process.
    """
    begun = time.process_time()
    dataset, journeys = drives.dataset, drives.dataset.journeys
    first = first_map(journeys, maps, config)
    hd_map, associations = clusters_map(dataset, first), first.associations
    seconds = {"heads": time.process_time() - begun}
    observable = observable_rows(drives)
    outliers = [journeys[found.journey].journey_id for found in first.crowd.report.outlier_journeys]
    label = first.crowd.label
    measured = {
        "heads": map_figures(drives, certain_part(hd_map, config.min_confidence), associations),
        "average": plain(averaged_signs(drives, maps, observable)),
        # The paper's own measure of data loss: signs of single journeys, and those that clustering left out.
        "clusters": {"signs": len(label), "left_out": int((label < 0).sum())},
        "bad": drives.bad,
        "outlier_journeys": outliers,
        "seconds": seconds,
    }
    if not adjusted:
        return measured
    begun = time.process_time()
    pins = spread_signs(drives.survey, observable, control)
    known = drives.survey.signs[pins] if control else None
    result = adjusted_map(dataset, maps, first, config, control=known)
    seconds["adjusted"] = time.process_time() - begun
    names = tuple(drives.survey.sign_id[row] for row in pins.tolist())
    final = certain_part(result.hd_map, config.min_confidence)
    measured["map"] = map_figures(drives, final, result.associations, names)
    measured["control_points"] = result.control_points
    measured["shared_covariance"] = final.shared_covariance.tolist()
    measured["calibration"] = recovered(result.uncertainty, drives.vehicles)
    return measured


def observable_rows(drives: Drives) -> Bool[Tensor, " n"]:
    """The signs that count (METRICS.md); of fewer journeys than that asks for, all of them must have seen a sign."""
    signs = drives.survey.signs
    seen = torch.zeros(len(signs), dtype=torch.int64)
    for truth in drives.truth.journeys:
        seen += frames_of_signs(truth, len(signs)) >= MIN_FRAMES
    return seen >= min(MIN_JOURNEYS, len(drives.truth.journeys))


def shared_part(
    drives: Drives, positioning: PositioningConfig, covariance: Float[Tensor, "3 3"]
) -> dict[str, float]:
    """How far out the draw of the mean of all poses' errors is, and how large that mean is beside a map's `covariance`.

    `drawn_nees`: its normalised squared error against the sigmas that it was drawn from, which is what the map's
    `shared_nees` comes to for one who knows everything but this mean. `expected_nees`: the mean of `shared_nees` over
    all draws by those sigmas, with the `covariance` that the map states; 3 is right. The scales of the sigmas are found
    from what differs between journeys, which says nothing of their mean: so the draw has no part in it.
    """
    journeys = drives.truth.journeys
    shift, variance = torch.zeros(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
    bias = (positioning.bias_e_m, positioning.bias_n_m, positioning.bias_u_m)
    for truth in journeys:
        shift += truth.mean_error_m / len(journeys)
        slow = variance_of_mean(truth.way_m.sum() / positioning.drift_length_m)
        own = shift.new_tensor(bias).square() + positioning.drift_m**2 * slow
        slow = variance_of_mean(truth.way_m.sum() / positioning.bias_wander_length_m)
        own = own + positioning.bias_wander_m**2 * slow
        variance += own / len(journeys) ** 2
    expected = torch.linalg.solve(covariance, torch.diag(variance)).trace()
    return {
        "drawn_nees": float((shift.square() / variance).sum()),
        "expected_nees": float(expected),
    }


def averaged_signs(
    drives: Drives, maps: Sequence[JourneyMap], observable: Bool[Tensor, " n"]
) -> SignFigures:
    """What a plain average makes of the journeys' own signs, were it known which sign each of them is."""
    signs = concatenate([made.signs for made in maps])
    true = torch.cat(
        [true_signs(made, truth) for made, truth in zip(maps, drives.truth.journeys, strict=True)]
    )
    known = true >= 0
    _, label = true[known].unique(return_inverse=True)
    heads = sign_heads(signs[known], label, method="paper2017")
    return evaluate_signs(heads, drives.survey.signs, observable=observable)


def true_signs(made: JourneyMap, truth: JourneyTruth) -> Int[Tensor, " n"]:
    """The survey's sign that most detections of each of a journey's signs show; -1 for false ones."""
    tracklets = made.sign_tracklets
    shown = truth.sign[truth.journey.signs.row]
    one = torch.ones(len(shown), dtype=torch.float64)
    # Code 0 stands for false detections, which have a vote too.
    return group_mode(shown + 1, one, tracklets.label, tracklets.count)[made.signs.tracklet] - 1


def spread_signs(survey: Survey, among: Bool[Tensor, " n"], count: int) -> Int[Tensor, " c"]:
    """Rows of `count` surveyed signs, each the farthest from those before it."""
    rows = torch.nonzero(among)[:, 0]
    center = survey.signs.center_world[rows]
    chosen: list[int] = []
    away = (center - center.mean(0)).norm(dim=1)
    for _ in range(min(count, len(rows))):
        farthest = int(away.argmax())
        reach = (center - center[farthest]).norm(dim=1)
        away = torch.minimum(away, reach) if chosen else reach
        chosen.append(farthest)
    return rows[torch.tensor(chosen, dtype=torch.int64)]


def map_figures(
    drives: Drives,
    hd_map: HdMap,
    associations: Sequence[Association],
    control_ids: Sequence[str] = (),
) -> dict[str, Any]:
    """METRICS.md's figures; those of lanes where there are any."""
    survey, truth = drives.survey, drives.truth
    named = None
    if len(truth.journeys) < MIN_JOURNEYS:
        rows = torch.nonzero(observable_rows(drives))[:, 0].tolist()
        named = tuple(survey.sign_id[row] for row in rows)
    if not any(len(journey.lanes) for journey in drives.dataset.journeys):
        none = torch.zeros(0, dtype=torch.int64)
        survey = replace(survey, lane_id=(), lane_points=survey.lane_points[none])
    figures: MapFigures = evaluate_map(
        hd_map,
        survey,
        truth=truth,
        associations=sign_associations(drives.dataset, associations),
        control_ids=control_ids,
        observable_ids=named,
    )
    return figures.as_dict()
