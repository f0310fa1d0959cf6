from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from worlds.small_world import Builder

from crowdmap_torch.geometry import polygon, se3
from crowdmap_torch.tables import Dataset
from crowdmap_torch.viewer.columns import encoded, unpacked
from crowdmap_torch.viewer.payload import (
    BUDGET,
    LINE_TOLERANCE_M,
    PLACE_STEP_M,
    lane_km,
    payload_of,
)
from crowdmap_torch.viewer.scene import Scene, scene_of_dataset


def test_signs_come_back_within_half_a_millimetre(scene: Scene) -> None:
    assert scene.hd_map is not None
    head, found = unpacked(payload_of(scene))
    signs = scene.hd_map.signs
    assert head["sign_id"] == list(scene.hd_map.sign_id)
    off = np.abs(found["sign.center"] - signs.center_world.numpy()).max()
    assert off <= PLACE_STEP_M / 2 * (1 + 1e-9)
    # Corners as the page makes them of center, rotation and size: two roundings more.
    R = se3.from_quaternion(
        torch.nn.functional.normalize(torch.from_numpy(found["sign.quaternion"]), dim=-1)
    )
    T = se3.make(R, torch.from_numpy(found["sign.center"]))
    shape = torch.from_numpy(found["sign.shape"][:, 0]).long()
    corners = se3.transform(
        T[:, None], polygon.corners(shape, torch.from_numpy(found["sign.size"]))
    )
    assert float((corners - signs.corners_world).norm(dim=-1).max()) < 1.5e-3
    template = np.array(head["templates"][int(shape[3])]).reshape(-1, 2)
    assert np.allclose(template, polygon.template(shape[3:4])[0, : len(template)].numpy())


def test_markers_come_back_within_a_centimetre(scene: Scene) -> None:
    assert scene.hd_map is not None
    _, found = unpacked(payload_of(scene))
    count = found["lane.count"][:, 0].astype(int)
    assert len(count) == len(scene.hd_map.lanes)
    # The markers of this world are straight: along y = 0 and y = 3.5.
    line = np.split(found["lane.point"], np.cumsum(count)[:-1])[1]
    assert np.abs(line[:, 1] - 3.5).max() < LINE_TOLERANCE_M + PLACE_STEP_M
    assert len(found["lane.sigma"]) == count.sum()


def test_a_map_without_markers_has_none(scene: Scene) -> None:
    assert scene.hd_map is not None
    none = scene.hd_map.lanes.select(torch.zeros(0, dtype=torch.long))
    bare = replace(scene, hd_map=replace(scene.hd_map, lanes=none, lane_id=()))
    _, found = unpacked(payload_of(bare))
    assert len(found["lane.type"]) == len(found["lane.count"]) == len(found["lane.point"]) == 0


def test_errors_against_the_survey_are_those_of_the_evaluation(scene: Scene) -> None:
    assert scene.hd_map is not None and scene.survey is not None
    _, found = unpacked(payload_of(scene))
    true = found["sign.true"][:, 0].astype(int)
    assert true.tolist() == list(range(9))
    error = scene.hd_map.signs.center_world - scene.survey.signs.center_world
    assert np.abs(found["sign.error"] - error.numpy()).max() < PLACE_STEP_M


def test_a_pair_counts_every_detection_and_the_file_holds_some(scene: Scene) -> None:
    assert scene.outcomes is not None
    head, found = unpacked(payload_of(scene))
    rows = scene.outcomes.rows
    used = int(((rows.sign >= 0) & ~rows.given_up).sum())
    assert found["pair.used"].sum() == used
    assert found["pair.given_up"].sum() == int((rows.given_up & (rows.sign >= 0)).sum())
    assert found["pair.near"].sum() == int((rows.near_sign >= 0).sum())
    assert head["drawn"] == [60, 60] and len(found["seen.pair"]) == 60
    # Where nothing is off by more than half a pixel in u and in v, that is the length of all residuals.
    rms = found["pair.rms"][found["pair.used"][:, 0] > 0]
    assert np.allclose(rms, np.hypot(0.5, 0.5), atol=0.006)
    corners = found["seen.corner"].reshape(-1, 8, 2)
    assert np.abs(corners - 600).max() < 60


def test_detections_are_thinned_to_the_budget(scene: Scene) -> None:
    assert scene.outcomes is not None and scene.hd_map is not None
    few = scene.outcomes
    g = torch.Generator().manual_seed(0)
    many = few.rows[torch.randint(0, len(few.rows), (20_000,), generator=g)]
    noise = torch.rand(many.corners_px.shape, generator=g, dtype=torch.float64)
    many = replace(many, corners_px=many.corners_px + 50 * noise, residual_px=noise)
    crowded = replace(scene, outcomes=replace(few, rows=many))
    payload = payload_of(crowded)
    head, found = unpacked(payload)
    assert len(encoded(payload)) <= BUDGET * max(lane_km(crowded), 1)
    drawn, of = head["drawn"]
    assert 0 < drawn < of == 20_000
    # Every pair has its share, and all are counted.
    assert set(found["seen.pair"][:, 0]) == set(range(len(found["pair.sign"])))
    names = ("pair.used", "pair.given_up", "pair.near")
    assert sum(found[name].sum() for name in names) == of


def test_two_markers_make_a_lane(build: Builder, scene: Scene) -> None:
    assert abs(lane_km(scene) - 0.1) < 1e-3
    assert lane_km(replace(scene, hd_map=build.hd_map(build.signs([[0.0, 0, 2]])))) == 0.1


def test_frames_of_a_data_set_come_back(tiny: Dataset) -> None:
    scene = scene_of_dataset(tiny, "tiny", None)
    payload = payload_of(scene)
    head, found = unpacked(payload)
    assert len(encoded(payload)) <= BUDGET * max(lane_km(scene), 1)
    drawn, frames = head["drawn"]
    assert 0 < drawn <= frames == sum(j.frame_count for j in tiny.journeys)
    assert len(found["frame.number"]) == drawn
    first = found["frame.drive"][:, 0] == 0
    number = torch.from_numpy(found["frame.number"][first, 0]).long()
    row = torch.searchsorted(tiny.journeys[0].frame_number, number)
    place = tiny.journeys[0].T_world_camera[row, :3, 3].numpy()
    assert np.abs(found["frame.place"][first] - place).max() <= 0.0051
    per_frame = torch.bincount(tiny.journeys[0].signs.frame, minlength=int(row.max()) + 1)[row]
    assert found["frame.signs"][first, 0].tolist() == per_frame.tolist()
    assert found["frame.signs"].sum() == len(found["frame.sign_shape"])
    assert found["frame.lane_count"].sum() == len(found["frame.lane_point"])
