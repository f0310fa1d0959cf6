from __future__ import annotations

import pytest
import torch

from crowdmap_torch import mapper
from crowdmap_torch.adjustment import adjust
from crowdmap_torch.config import MapperConfig
from crowdmap_torch.geometry import polygon
from crowdmap_torch.mapper import MapResult
from crowdmap_torch.report.drives import corners_of, drifts_of
from crowdmap_torch.report.outcomes import sign_outcomes
from crowdmap_torch.tables import Dataset


def test_corners_are_where_they_were_detected_and_as_far_as_their_signs(
    tiny: Dataset, tiny_result: MapResult
):
    config = MapperConfig()
    first = tiny_result.first
    bundle = mapper.build_bundle(tiny.journeys, tiny_result.journey_maps, first, config)
    adjust.start(bundle)
    outcomes = sign_outcomes(tiny, tiny_result, bundle, config)
    corners, rows = corners_of(tiny, tiny_result, outcomes), outcomes.rows
    seen = rows.residual_px[:, 0].isfinite().all(-1)
    assert len(corners) == int(polygon.corner_count(rows.shape[seen]).sum()) > 100
    assert torch.equal(corners.journey.unique(), torch.arange(3))
    assert ((corners.place > 0) & (corners.place < 1)).all()
    known = corners.range_m[corners.range_m.isfinite()]
    assert len(known) > 0.9 * len(corners) and (known > 2).all() and (known < 100).all()
    # Of the first detection that is in a sign.
    row = int(torch.nonzero(seen & (rows.sign >= 0))[0])
    journey = int(rows.journey[row])
    frame = tiny.journeys[journey].frame_number.tolist().index(int(rows.frame[row]))
    camera = tiny_result.poses[journey][frame, :3, 3]
    center = tiny_result.hd_map.signs.center_world[rows.sign[row]]
    count = polygon.corner_count(rows.shape)
    at = int(count[:row][seen[:row]].sum())
    assert float(corners.range_m[at]) == pytest.approx(float((center - camera).norm()))
    width = tiny.journeys[journey].rig.camera.width
    assert float(corners.place[at, 0]) == pytest.approx(float(rows.corners_px[row, 0, 0]) / width)


def test_drift_is_what_is_added_less_its_mean(tiny: Dataset, tiny_result: MapResult):
    found = drifts_of(tiny, tiny_result)
    assert [d.journey_id for d in found] == [j.journey_id for j in tiny.journeys]
    for drift, journey, pose in zip(found, tiny.journeys, tiny_result.poses, strict=True):
        moved = (pose - journey.T_world_camera)[:, :3, 3]
        assert drift.up_m[0] == pytest.approx(float(moved[0, 2] - moved[:, 2].mean()))
        assert drift.way_m[0] == 0 and list(drift.way_m) == sorted(drift.way_m)
        assert len(drift.way_m) == len(drift.east_m) == len(drift.north_m) <= 200
