"""What became of every sign detection of a run, row by row: for RUN/sign_detections.parquet and the viewer."""

from __future__ import annotations

from itertools import accumulate

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from crowdmap_torch.adjustment.bundle import Bundle
from crowdmap_torch.adjustment.observations import rank_within
from crowdmap_torch.config import MapperConfig
from crowdmap_torch.crowd_signs.projections import candidates_nearby, misfit_px
from crowdmap_torch.geometry import polygon
from crowdmap_torch.io.sign_outcomes import NamedOutcomes, SignOutcomes
from crowdmap_torch.mapper import MapResult
from crowdmap_torch.report.fates import sign_fates_by_row
from crowdmap_torch.report.watch import corner_residuals
from crowdmap_torch.tables import Association, Dataset, Journey, Signs, concatenate

_REACH_M = 200.0
"""A sign that is further away is hardly detected."""
_NEAREST = 16
"""So many signs are compared with a detection that shows none."""
_LEAST_PX = 12.0
"""A detection is near a sign that its corners miss by less than this, or by less than the sign's size in the image."""


@torch.no_grad()
def sign_outcomes(
    dataset: Dataset, result: MapResult, bundle: Bundle, config: MapperConfig
) -> NamedOutcomes:
    """Fate, sign and residuals of every sign detection, on the CPU; `bundle` is the adjusted one.

    Detections that came to a sign after the adjustment have no residual.
    """
    begins = accumulate((len(journey.signs) for journey in dataset.journeys), initial=0)
    px, residual, given_up = _adjusted(bundle, sum(len(j.signs) for j in dataset.journeys))
    names: dict[str, int] = {}
    tables = []
    for number, (journey, found, pose, begin, (own, code)) in enumerate(
        zip(
            dataset.journeys,
            result.associations,
            result.poses,
            begins,
            sign_fates_by_row(dataset, result, config),
            strict=False,
        )
    ):
        mine = slice(begin, begin + len(journey.signs))
        fate = torch.tensor([names.setdefault(name, len(names)) for name in own])
        seen = residual[mine].isfinite().all(-1, keepdim=True)
        tables.append(
            SignOutcomes(
                journey=torch.full_like(journey.signs.row, number),
                row=journey.signs.row,
                frame=journey.frame_number[journey.signs.frame],
                shape=journey.signs.shape,
                fate=fate[code],
                sign=found.sign,
                near_sign=_near(journey, pose, result.hd_map.signs, found),
                given_up=given_up[mine],
                corners_px=torch.where(seen, px[mine], journey.signs.corners_px),
                residual_px=residual[mine],
            )
        )
    ids = tuple(journey.journey_id for journey in dataset.journeys)
    return NamedOutcomes(concatenate(tables), ids, tuple(names), result.hd_map.sign_id)


def _adjusted(
    bundle: Bundle, detections: int
) -> tuple[Float[Tensor, "d 8 2"], Float[Tensor, "d 8 2"], Bool[Tensor, " d"]]:
    """Corners in the order of their signs and their residuals, NaN of detections without, and which were given up."""
    rows = bundle.corners
    px = torch.full((detections, polygon.MAX_CORNERS, 2), torch.nan, dtype=torch.float64)
    residual = px.clone()
    given_up = torch.zeros(detections, dtype=torch.bool)
    # Odd numbers are the centres of boxes, which are no corners.
    corner = torch.nonzero(rows.detection % 2 == 0)[:, 0].cpu()
    key = rows.detection.cpu()[corner]
    detection, slot = key // 2, rank_within(key)
    for values, of_corner in ((px, rows.px.cpu()), (residual, corner_residuals(bundle))):
        values[detection, slot] = of_corner[corner].double()
        # Slots past the shape's number of corners repeat the last one.
        for k in range(1, polygon.MAX_CORNERS):
            is_none = values[:, k].isnan()
            values[:, k] = torch.where(is_none, values[:, k - 1], values[:, k])
    given_up[detection] = bundle.given_up.cpu()[key]
    return px, residual, given_up


def _near(
    journey: Journey, pose: Float[Tensor, "f 4 4"], signs: Signs, found: Association
) -> Int[Tensor, " d"]:
    """Of detections in no sign the sign whose projection they lie on; -1 for none."""
    near = torch.full_like(found.sign, -1)
    pairs = candidates_nearby(journey, pose, signs, found, reach_m=_REACH_M, count=_NEAREST)
    if not len(pairs):
        return near
    misfit, _ = misfit_px(journey.signs, signs, pairs, torch.zeros_like(pairs.px[:, 0]))
    fits = misfit < pairs.size.clamp_min(_LEAST_PX)
    order = torch.nonzero(fits)[:, 0]
    order = order[misfit[order].argsort(descending=True, stable=True)].flip(0)
    order = order[pairs.row[order].argsort(stable=True)]
    # Of each detection's the first is the best.
    begins = torch.ones_like(order, dtype=torch.bool)
    begins[1:] = pairs.row[order[1:]] != pairs.row[order[:-1]]
    best = order[begins]
    near[pairs.row[best]] = pairs.sign[best]
    return near
