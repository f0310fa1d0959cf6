"""What is said of each detection: its fate as counted, its residual as the adjustment has it, the sign it lies on."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import pytest
import torch

from crowdmap_torch import mapper
from crowdmap_torch.adjustment.bundle import Bundle
from crowdmap_torch.config import MapperConfig
from crowdmap_torch.geometry import polygon
from crowdmap_torch.io.sign_outcomes import NamedOutcomes
from crowdmap_torch.mapper import MapResult
from crowdmap_torch.report.fates import MAPPED, sign_fates
from crowdmap_torch.report.outcomes import sign_outcomes
from crowdmap_torch.report.watch import corner_residuals
from crowdmap_torch.tables import Dataset

CONFIG = MapperConfig()


@pytest.fixture(scope="module")
def bundle(tiny: Dataset, tiny_result: MapResult) -> Bundle:
    """The bundle before its first step."""
    result = tiny_result
    return mapper.build_bundle(tiny.journeys, result.journey_maps, result.first, CONFIG)


@pytest.fixture(scope="module")
def outcomes(tiny: Dataset, tiny_result: MapResult, bundle: Bundle) -> NamedOutcomes:
    return sign_outcomes(tiny, tiny_result, bundle, CONFIG)


def test_every_detection_has_the_fate_that_is_counted(
    tiny: Dataset, tiny_result: MapResult, outcomes: NamedOutcomes
) -> None:
    rows = outcomes.rows
    assert len(rows) == sum(len(journey.signs) for journey in tiny.journeys)
    told = Counter(outcomes.fate[k] for k in rows.fate.tolist())
    counted = sign_fates(tiny, tiny_result, CONFIG)
    assert told == {k: n for k, n in counted.items() if not k.startswith("dropped")}
    assert bool((rows.sign >= 0)[rows.fate == outcomes.fate.index(MAPPED)].all())


def test_residuals_are_those_of_the_adjustment(bundle: Bundle, outcomes: NamedOutcomes) -> None:
    rows = outcomes.rows
    has = rows.residual_px.isfinite().all(-1).all(-1)
    mask = polygon.corner_mask(rows.shape) & has[:, None]
    assert int(mask.sum()) == len(bundle.corners) > 0
    assert torch.allclose(rows.residual_px[mask], corner_residuals(bundle))
    assert torch.equal(rows.corners_px[mask], bundle.corners.px)
    assert bool((rows.sign >= 0)[has].all())


def test_what_the_adjustment_gave_up_is_told(
    tiny: Dataset, tiny_result: MapResult, bundle: Bundle
) -> None:
    before = bundle.given_up.clone()
    bundle.given_up[bundle.corners.detection[0]] = True
    told = sign_outcomes(tiny, tiny_result, bundle, CONFIG).rows.given_up
    bundle.given_up.copy_(before)
    assert int(bundle.corners.detection[0]) // 2 in told.nonzero()[:, 0].tolist()


def test_a_detection_without_a_sign_is_near_the_one_it_lies_on(
    tiny: Dataset, tiny_result: MapResult, bundle: Bundle
) -> None:
    first = tiny_result.associations[0]
    row = int(torch.nonzero(first.sign >= 0)[0, 0])
    lost = replace(first, sign=first.sign.index_fill(0, torch.tensor([row]), -1))
    result = replace(tiny_result, associations=(lost, *tiny_result.associations[1:]))
    rows = sign_outcomes(tiny, result, bundle, CONFIG).rows
    assert int(rows.near_sign[row]) == int(first.sign[row])
    assert int(rows.sign[row]) == -1
    # Those that show a sign are near none.
    assert bool((rows.near_sign[rows.sign >= 0] == -1).all())
