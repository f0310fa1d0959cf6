"""A map against a survey: every figure of METRICS.md (the paper's VI)."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from crowdmap_torch.evaluation.association import evaluate_association
from crowdmap_torch.evaluation.lanes import (
    LaneEvaluationConfig,
    LaneFigures,
    evaluate_lanes,
    survey_samples,
)
from crowdmap_torch.evaluation.map_figures import MapFigures
from crowdmap_torch.evaluation.signs import (
    SignEvaluationConfig,
    compare_signs,
    evaluate_signs,
    sign_figures,
)
from crowdmap_torch.evaluation.single_journey import (
    JourneyLandmarks,
    SingleJourneyConfig,
    SingleJourneyFigures,
    evaluate_single_journeys,
)
from crowdmap_torch.evaluation.uncertainty import evaluate_uncertainty
from crowdmap_torch.evaluation.visibility import observable_signs, oracle_figures, seen_by_journeys
from crowdmap_torch.io.area import Area, area_of
from crowdmap_torch.io.truth import SignAssociations, Truth
from crowdmap_torch.processes.threads import one_core_each
from crowdmap_torch.survey.matching import SurveyMatchConfig
from crowdmap_torch.tables import HdMap, Lanes, Origin, Signs, Survey, to_device

_CONTROL_GATE_M = 1.0
"""A control sign without the survey's id is the survey's sign this near to it."""


@dataclass(frozen=True)
class Against:
    """A survey, and what of it is asked of a map: the same for every figure, of a finished map and of one in the making."""

    survey: Survey
    observable: Bool[Tensor, " n"] | None
    """By sign; None: every one."""
    control: Bool[Tensor, " n"]
    """Signs that are left out of every figure."""
    lanes_seen_by: Int[Tensor, " p"] | None
    """By sample of `survey_samples`, how many journeys have seen it; None: all count."""


def against(
    survey: Survey,
    *,
    truth: Truth | None = None,
    control_ids: Collection[str] = (),
    observable_ids: Collection[str] | None = None,
    area: Area | None = None,
) -> Against:
    """What is asked of a map: `observable_ids`, else what the journeys of `truth` have seen, else all.

    Of it what stands in `area`. ValueError for an id that the survey has not.
    """
    config = LaneEvaluationConfig()
    samples = survey_samples(survey, config.step_m)
    observable = lanes_seen = None
    if truth is not None:
        lanes_seen = seen_by_journeys(truth, samples)
    if observable_ids is not None:
        observable = _rows_named(survey, observable_ids, "observable")
    elif truth is not None:
        observable = observable_signs(truth, survey.signs)
    if area is not None:
        inside = area.holds(survey.signs.center_world)
        observable = inside if observable is None else observable & inside
        inside = area.holds(samples.point_world).long()
        lanes_seen = inside * (config.min_journeys if lanes_seen is None else lanes_seen)
    return Against(survey, observable, _rows_named(survey, control_ids, "control"), lanes_seen)


@one_core_each()
def evaluate_map(
    hd_map: HdMap,
    survey: Survey,
    *,
    truth: Truth | None = None,
    associations: SignAssociations | None = None,
    landmarks: Sequence[JourneyLandmarks] = (),
    control_ids: Collection[str] = (),
    observable_ids: Collection[str] | None = None,
    gate_m: float = 3.0,
    notes: tuple[str, ...] = (),
    asked: Against | None = None,
) -> MapFigures:
    """Figures of a map against a survey.

    `truth` holds the journeys in use of a simulated dataset: with it, what is observable, the
    oracle, associations (`associations.journey` indexes `truth.journeys`) and single-journey
    `landmarks` are judged too. Without it every surveyed sign is observable, unless
    `observable_ids` names those that are. Of a map of a part of the world (`bbox` in its provenance) only what stands
    inside that is. What is `asked` follows from all this, and may be known already. ValueError if the origins differ.
    """
    refuse_other_origin(hd_map.origin, survey.origin)
    hd_map, survey, truth = to_device((hd_map, survey, truth), "cpu")
    associations, landmarks = to_device((associations, landmarks), "cpu")
    config = SignEvaluationConfig(match=SurveyMatchConfig(gate_m=gate_m))
    if asked is None:
        asked = against(
            survey,
            truth=truth,
            control_ids=control_ids,
            observable_ids=observable_ids,
            area=area_of(hd_map.provenance),
        )
    comparison = compare_signs(
        hd_map.signs,
        survey.signs,
        observable=asked.observable,
        control=asked.control,
        config=config,
    )
    signs = sign_figures(comparison, survey.signs, config)
    oracle = oracle_center = None
    if truth is not None:
        oracle, oracle_center = oracle_figures(truth, survey.signs, comparison.observable)
    return MapFigures(
        signs=signs,
        oracle=oracle,
        oracle_center=oracle_center,
        absolute_over_oracle=signs.absolute.total.mean / oracle.total.mean
        if oracle is not None and oracle.total.mean > 0
        else math.nan,
        lanes=_evaluate_lanes(hd_map, asked, comparison.match.shift),
        association=evaluate_association(associations, truth, comparison.observable)
        if associations is not None and truth is not None
        else None,
        single_journey=_evaluate_landmarks(landmarks, survey, truth, config),
        uncertainty=evaluate_uncertainty(
            comparison,
            hd_map.signs,
            hd_map.shared_covariance,
            # A simulated survey is exact, whatever the default of its sigma.
            None if truth is not None else survey.signs.sigma,
        ),
        control_signs=int(comparison.control.sum()),
        gate_m=gate_m,
        notes=notes,
        comparison=comparison,
    )


def control_ids_of(control: Survey, survey: Survey) -> tuple[str, ...]:
    """The survey's signs that are control points: with the same id, else within a metre."""
    ids = set(survey.sign_id)
    named = [i for i in control.sign_id if i in ids]
    rest = torch.tensor(
        [i not in ids for i in control.sign_id], dtype=torch.bool, device=control.signs.shape.device
    )
    if not bool(rest.any()):
        return tuple(named)
    others = control.signs[rest]
    distance = (others.center_world[:, None] - survey.signs.center_world[None]).norm(dim=-1)
    if distance.shape[1] == 0:
        return tuple(named)
    nearest, row = distance.min(dim=1)
    near = row[nearest <= _CONTROL_GATE_M].tolist()
    return tuple(dict.fromkeys([*named, *(survey.sign_id[r] for r in near)]))


def progress_scalars(
    signs: Signs, asked: Against, *, lanes: Lanes | None = None
) -> dict[str, float]:
    """Errors of an unfinished map by TensorBoard tag: METRICS.md's figures, as `evaluate_map` has them of a finished one."""
    signs, lanes = to_device(signs, "cpu"), to_device(lanes, "cpu")
    survey = asked.survey
    figures = evaluate_signs(
        signs, survey.signs, observable=asked.observable, control=asked.control
    )
    scalars = {
        "error/corner_m": figures.absolute.total.mean,
        "error/corner_horizontal_m": figures.absolute.horizontal.mean,
        "error/corner_vertical_m": figures.absolute.vertical.mean,
        "error/corner_relative_m": figures.relative.total.mean,
        "error/center_m": figures.absolute_center.total.mean,
        "error/normal_deg": figures.normal_deg.mean,
        "error/sign_recall": figures.recall,
        "error/sign_precision": figures.precision,
    }
    if lanes is not None and len(survey.lane_id):
        shift = torch.tensor(figures.median_shift).to(signs.T_world_sign)
        found = evaluate_lanes(lanes, survey, seen_by=asked.lanes_seen_by, shift=shift)
        scalars["error/lane_lateral_m"] = found.lateral.mean
        scalars["error/lane_lateral_without_shift_m"] = found.lateral_without_shift.mean
        scalars["error/lane_recall"] = found.recall
    return {tag: value for tag, value in scalars.items() if math.isfinite(value)}


def refuse_other_origin(of_map: Origin, of_survey: Origin) -> None:
    """ValueError if the two local frames touch the ellipsoid at different places."""
    if not of_map.is_same(of_survey):
        raise ValueError(
            f"the map's origin {of_map} is not the survey's {of_survey}; expected one origin. "
            "Bring the survey into the map's local frame first."
        )


def _rows_named(survey: Survey, ids: Collection[str], what: str) -> Bool[Tensor, " n"]:
    unknown = sorted(set(ids) - set(survey.sign_id))
    if unknown:
        raise ValueError(f"{what} sign {unknown[0]!r} is not in the survey")
    named = set(ids)
    return torch.tensor(
        [i in named for i in survey.sign_id], dtype=torch.bool, device=survey.signs.shape.device
    )


def _evaluate_lanes(hd_map: HdMap, asked: Against, shift: Tensor) -> LaneFigures | None:
    if not len(asked.survey.lane_points):
        return None
    return evaluate_lanes(
        hd_map.lanes,
        asked.survey,
        seen_by=asked.lanes_seen_by,
        shift=shift,
        shared_covariance=hd_map.shared_covariance,
    )


def _evaluate_landmarks(
    landmarks: Sequence[JourneyLandmarks],
    survey: Survey,
    truth: Truth | None,
    config: SignEvaluationConfig,
) -> SingleJourneyFigures | None:
    by_id = {t.journey.journey_id: t for t in truth.journeys} if truth is not None else {}
    known = [one for one in landmarks if one.journey_id in by_id]
    if not known:
        return None
    return evaluate_single_journeys(
        known, [by_id[one.journey_id] for one in known], survey, SingleJourneyConfig(signs=config)
    )
