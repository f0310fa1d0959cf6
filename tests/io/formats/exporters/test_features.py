from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from crowdmap_torch.io.formats.exporters.features import LAYERS, heading_deg, layers
from crowdmap_torch.io.formats.geodesy import local_from_geodetic
from crowdmap_torch.tables import HdMap


def test_every_landmark_is_a_feature_where_it_stands(hd_map: HdMap):
    signs, plates, lanes = layers(hd_map)
    assert tuple(layer.name for layer in (signs, plates, lanes)) == LAYERS
    assert signs.feature_id == hd_map.sign_id and lanes.feature_id == hd_map.lane_id
    local = local_from_geodetic(np.concatenate(signs.place)[:, [1, 0, 2]], hd_map.origin)
    np.testing.assert_allclose(local, hd_map.signs.center_world.numpy(), rtol=0, atol=1e-8)
    for row, place in enumerate(plates.place):
        local = local_from_geodetic(place[:, [1, 0, 2]], hd_map.origin)
        np.testing.assert_allclose(local, plates.lists["corners"][row], rtol=0, atol=1e-8)
    control = hd_map.lanes.control.point_world
    first = local_from_geodetic(lanes.place[0][0, [1, 0, 2]], hd_map.origin)
    np.testing.assert_allclose(first, control[hd_map.lanes.control_start[0]], rtol=0, atol=1e-8)


def test_every_column_has_a_value_for_every_feature(hd_map: HdMap):
    for layer in layers(hd_map):
        columns = (layer.columns | layer.lists).values()
        assert {len(layer), len(layer.place)} == {len(column) for column in columns}


def test_signs_face_where_their_normals_point():
    normal = torch.tensor([[0.0, 1, 0], [1, 0, 0], [0, -1, 0.2], [-1, 0, 0]])
    assert heading_deg(normal) == [0, 90, 180, 270]


def test_a_map_without_landmarks_has_layers_without_features(hd_map: HdMap):
    for layer in layers(nothing_of(hd_map)):
        assert len(layer) == 0 and layer.place == ()


def nothing_of(hd_map: HdMap) -> HdMap:
    none = torch.empty(0, dtype=torch.int64)
    return replace(
        hd_map, signs=hd_map.signs[none], lanes=hd_map.lanes.select(none), sign_id=(), lane_id=()
    )
