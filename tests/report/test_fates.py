"""Every detection has one fate, and a map without rows says what became of them."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from worlds.drives import without_detections

from crowdmap_torch.config import MapperConfig
from crowdmap_torch.crowd_signs.outages import Outage
from crowdmap_torch.crowd_signs.outlier_journeys import OutlierJourney
from crowdmap_torch.geometry.trajectory import station
from crowdmap_torch.io.area import OUTSIDE
from crowdmap_torch.io.datasets import row_count
from crowdmap_torch.lanes import reconstruct
from crowdmap_torch.mapper import MapResult
from crowdmap_torch.report.fates import (
    _WHY,
    IMPROBABLE,
    MAPPED,
    NO_TRACK,
    OUTAGE,
    OUTLIER_JOURNEY,
    TOO_FEW_JOURNEYS,
    lane_fates,
    missing_findings,
    sign_fates,
)
from crowdmap_torch.signs import pruning
from crowdmap_torch.tables import Association, Dataset

CONFIG = MapperConfig()


def without_landmarks(result: MapResult) -> MapResult:
    """No detection shows anything."""

    def nothing(found: Association) -> Association:
        return replace(
            found, sign=torch.full_like(found.sign, -1), lane=torch.full_like(found.lane, -1)
        )

    return replace(result, associations=tuple(map(nothing, result.associations)))


def test_every_row_of_the_files_has_one_fate(tiny: Dataset, tiny_result: MapResult) -> None:
    signs, lanes = sign_fates(tiny, tiny_result, CONFIG), lane_fates(tiny, tiny_result)
    assert sum(signs.values()) == sum(row_count(j, "sign") for j in tiny.journeys)
    assert sum(lanes.values()) == sum(row_count(j, "lane") for j in tiny.journeys)
    mapped = sum(int((a.sign >= 0).sum()) for a in tiny_result.associations)
    assert signs[MAPPED] == mapped > 0 and lanes[MAPPED] > 0


def test_detections_of_an_improbable_sign_are_not_in_the_map(
    tiny: Dataset, tiny_result: MapResult
) -> None:
    signs = tiny_result.hd_map.signs
    doubted = replace(signs, confidence=torch.zeros_like(signs.confidence))
    result = replace(tiny_result, hd_map=replace(tiny_result.hd_map, signs=doubted))
    before, after = (sign_fates(tiny, r, CONFIG) for r in (tiny_result, result))
    assert after[MAPPED] == 0 and after[IMPROBABLE] == before[MAPPED]
    (finding,) = missing_findings(tiny, result, CONFIG)
    assert finding.kind == "no-signs"
    assert f"{before[MAPPED]:,} {IMPROBABLE}" in finding.evidence


def test_detections_of_kept_tracks_are_lost_to_few_journeys_or_bad_ones(
    tiny: Dataset, tiny_result: MapResult
) -> None:
    result = without_landmarks(tiny_result)
    fates = sign_fates(tiny, result, CONFIG)
    kept = sum(
        int((m.sign_report.reason[m.sign_tracklets.label[m.sign_tracklets.label >= 0]] == 0).sum())
        for m in result.journey_maps
    )
    assert fates[TOO_FEW_JOURNEYS] == kept > 0
    assert fates[NO_TRACK] == sum(
        int((m.sign_tracklets.label < 0).sum()) for m in result.journey_maps
    )
    crowd = result.first.crowd
    report = replace(crowd.report, outlier_journeys=(OutlierJourney(1, "heads elsewhere"),))
    spoilt = replace(result, first=replace(result.first, crowd=replace(crowd, report=report)))
    again = sign_fates(tiny, spoilt, CONFIG)
    assert again[OUTLIER_JOURNEY] > 0
    assert again[OUTLIER_JOURNEY] + again[TOO_FEW_JOURNEYS] == kept


def test_what_an_outage_took_the_say_of_is_told_apart(
    tiny: Dataset, tiny_result: MapResult
) -> None:
    result = without_landmarks(tiny_result)
    before = sign_fates(tiny, result, CONFIG), lane_fates(tiny, result)
    crowd = result.first.crowd
    end = float(station(tiny.journeys[1].T_world_camera)[-1])
    report = replace(crowd.report, outages=(Outage(1, end / 2, end, 2.0),))
    spoilt = replace(result, first=replace(result.first, crowd=replace(crowd, report=report)))
    for was, now in zip(
        before, (sign_fates(tiny, spoilt, CONFIG), lane_fates(tiny, spoilt)), strict=True
    ):
        assert now[OUTAGE] > 0
        assert now[OUTAGE] + now[TOO_FEW_JOURNEYS] == was[TOO_FEW_JOURNEYS]
        assert sum(now.values()) == sum(was.values())
    nowhere = replace(report, outages=(Outage(1, end + 1, end + 2, 2.0),))
    spoilt = replace(result, first=replace(result.first, crowd=replace(crowd, report=nowhere)))
    assert sign_fates(tiny, spoilt, CONFIG) == before[0]


def test_an_empty_map_is_told_with_a_count_for_every_reason(
    tiny: Dataset, tiny_result: MapResult
) -> None:
    result = without_landmarks(tiny_result)
    found = missing_findings(tiny, result, CONFIG)
    assert [finding.kind for finding in found] == ["no-signs", "no-lanes"]
    for finding, fates in zip(
        found, (sign_fates(tiny, result, CONFIG), lane_fates(tiny, result)), strict=True
    ):
        assert all(f"{count:,} {fate}" in finding.evidence for fate, count in fates.items())
        assert "\n" not in finding.line(3)


def test_every_fate_that_is_explained_exists() -> None:
    tracks = {f"in a track: {why}" for why in (*pruning.REASONS, *reconstruct.REASONS)}
    others = {NO_TRACK, OUTLIER_JOURNEY, OUTAGE, TOO_FEW_JOURNEYS, IMPROBABLE}
    others.add(f"dropped at the door: {OUTSIDE}")
    assert _WHY.keys() <= tracks | others


def test_a_map_with_what_was_detected_is_not_told_of(tiny: Dataset, tiny_result: MapResult) -> None:
    assert missing_findings(tiny, tiny_result, CONFIG) == ()


@pytest.mark.parametrize("dropped", [0, 7])
def test_nothing_detected_is_told_apart_from_everything_dropped(
    tiny: Dataset, tiny_result: MapResult, dropped: int
) -> None:
    empty = tuple(
        replace(
            without_detections(journey, torch.arange(journey.frame_count)),
            dropped={"sign: not clockwise": dropped} if dropped else {},
        )
        for journey in tiny.journeys
    )
    none = torch.zeros(0, dtype=torch.int64)
    result = replace(tiny_result, associations=(Association(none, none, none),) * 3)
    maps = tuple(
        replace(
            made,
            sign_tracklets=replace(made.sign_tracklets, label=none, shift=none),
            lane_tracklets=replace(made.lane_tracklets, label=none),
        )
        for made in result.journey_maps
    )
    result = replace(result, journey_maps=maps)
    (finding,) = missing_findings(replace(tiny, journeys=empty), result, CONFIG)
    assert finding.kind == ("no-signs" if dropped else "no-detections")
    assert ("21 dropped at the door: not clockwise" in finding.evidence) == bool(dropped)
