from __future__ import annotations

import json

import pytest
from worlds.marked_roads import two_way_road

from crowdmap_torch.io.formats.exporters.head import head, json_text


def test_what_a_map_says_of_itself_comes_back_from_json():
    road = two_way_road()
    told = json.loads(json_text(head(road)))
    assert told["provenance"] == road.provenance
    assert told["origin"] == {"lat_deg": 32.9, "lon_deg": -117.2, "height_m": 120.0}
    assert told["shared_covariance"] == [0.0] * 9


def test_numbers_that_are_none_are_refused():
    with pytest.raises(ValueError, match="not JSON compliant"):
        json_text(float("nan"))
