from __future__ import annotations

import numpy as np
import pytest

from crowdmap_torch.io.formats.exporters.drives import layers_of
from crowdmap_torch.io.formats.exporters.features import layers
from crowdmap_torch.io.formats.geodesy import local_from_geodetic
from crowdmap_torch.tables import Dataset, HdMap, Survey


def test_drives_and_frames_are_where_cars_were(tiny: Dataset):
    drives, frames = layers_of(tiny)
    assert drives.feature_id == tuple(j.journey_id for j in tiny.journeys)
    position = np.concatenate([j.T_world_camera[:, :3, 3].numpy() for j in tiny.journeys])
    for layer in (drives, frames):
        local = local_from_geodetic(np.concatenate(layer.place)[:, [1, 0, 2]], tiny.origin)
        np.testing.assert_allclose(local, position, rtol=0, atol=1e-8)
        assert {len(layer), len(layer.place)} == {len(c) for c in layer.columns.values()}
    assert len(frames) == len(set(frames.feature_id)) == len(position)
    for kind in ("sign", "lane"):
        column = f"{kind}_detections"
        assert sum(frames.columns[column]) == sum(drives.columns[column]) > 0
    assert 60 < drives.columns["length_m"][0] < 130


def test_a_survey_has_the_layers_of_a_map(tiny_survey: Survey, hd_map: HdMap):
    found = layers_of(tiny_survey)
    assert [layer.name for layer in found] == [layer.name for layer in layers(hd_map)]
    signs, plates, lanes = found
    assert signs.feature_id == tiny_survey.sign_id and lanes.feature_id == tiny_survey.lane_id
    local = local_from_geodetic(np.concatenate(signs.place)[:, [1, 0, 2]], tiny_survey.origin)
    np.testing.assert_allclose(local, tiny_survey.signs.center_world.numpy(), rtol=0, atol=1e-8)
    assert len(plates) == len(tiny_survey.sign_id)
    assert sum(map(len, lanes.place)) == len(tiny_survey.lane_points)


def test_what_has_no_place_is_refused():
    with pytest.raises(TypeError):
        layers_of(3)  # pyright: ignore[reportArgumentType]
