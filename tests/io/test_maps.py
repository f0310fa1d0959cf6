"""Maps: written and read again, column by column, and which line names each fault."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import pyarrow.parquet as pq
import pytest
import torch

from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.maps import read_map, write_map
from crowdmap_torch.io.surveys import read_survey

MAP_SIGN_COLUMNS = {
    "sign_id": "string",
    "shape": "string",
    "type": "string",
    "corners": "list<element: list<element: double>>",
    "center": "list<element: double>",
    "normal": "list<element: double>",
    "width_m": "double",
    "height_m": "double",
    "covariance": "list<element: double>",
    "n_journeys": "int64",
    "n_observations": "int64",
    "first_seen_ns": "int64",
    "last_seen_ns": "int64",
    "confidence": "double",
}
MAP_LANE_COLUMNS = {
    "lane_id": "string",
    "type": "string",
    "control_points": "list<element: list<element: double>>",
    "points": "list<element: list<element: double>>",
    "sigma_m": "list<element: double>",
    "n_journeys": "int64",
    "n_observations": "int64",
    "first_seen_ns": "int64",
    "last_seen_ns": "int64",
    "confidence": "double",
}


def schema(path: Path) -> dict[str, str]:
    return {f.name: str(f.type) for f in pq.read_schema(path)}


# --- writing ---------------------------------------------------------------------------------


def test_a_map_has_the_files_and_columns_of_the_format(hd_map, tmp_path: Path) -> None:
    write_map(hd_map, tmp_path / "map")
    assert sorted(p.name for p in (tmp_path / "map").iterdir()) == [
        "lanes.parquet",
        "map.json",
        "signs.parquet",
        "tentative_signs.parquet",
    ]
    assert schema(tmp_path / "map" / "signs.parquet") == MAP_SIGN_COLUMNS
    assert schema(tmp_path / "map" / "tentative_signs.parquet") == MAP_SIGN_COLUMNS
    assert schema(tmp_path / "map" / "lanes.parquet") == MAP_LANE_COLUMNS
    head = json.loads((tmp_path / "map" / "map.json").read_text())
    assert head["format"] == "crowdmap-map"
    assert head["version"] == 1
    assert head["origin"] == {"lat_deg": 32.9, "lon_deg": -117.2, "height_m": 120.0}
    assert head["shared_covariance"] == [0.1, 0, 0, 0, 0.1, 0, 0, 0, 0.1]
    assert head["provenance"] == {"version": "0.1.0", "journeys": ["a", "b"]}


def test_improbable_signs_are_tentative(hd_map, tmp_path: Path) -> None:
    write_map(hd_map, tmp_path / "map", min_confidence=0.5)
    certain = pq.read_table(tmp_path / "map" / "signs.parquet").column("sign_id").to_pylist()
    tentative = pq.read_table(tmp_path / "map" / "tentative_signs.parquet")
    assert certain == [name for name in hd_map.sign_id if name not in ("s1", "s4")]
    assert tentative.column("sign_id").to_pylist() == ["s1", "s4"]


def test_a_map_comes_back_as_it_was_written(hd_map, tmp_path: Path) -> None:
    write_map(hd_map, tmp_path / "map", min_confidence=0)
    again = read_map(tmp_path / "map")
    assert again.origin == hd_map.origin
    assert again.sign_id == hd_map.sign_id
    assert again.lane_id == hd_map.lane_id
    assert again.type_names == hd_map.type_names
    assert again.provenance == hd_map.provenance
    # Coordinates of 100 m in float64.
    torch.testing.assert_close(again.shared_covariance, hd_map.shared_covariance)
    for name in ("T_world_sign", "size", "corners_world", "covariance", "confidence"):
        torch.testing.assert_close(
            getattr(again.signs, name), getattr(hd_map.signs, name), atol=1e-12, rtol=1e-12
        )
    support = ("n_journeys", "n_observations", "first_seen_ns", "last_seen_ns")
    for name in ("shape", "type", "journey", "tracklet", "frame", *support):
        assert torch.equal(getattr(again.signs, name), getattr(hd_map.signs, name)), name
    packed = hd_map.lanes.select(torch.arange(2))
    for name in ("type", "control_start", "control_count", "confidence", *support):
        assert torch.equal(getattr(again.lanes, name), getattr(packed, name)), name
    assert torch.equal(again.lanes.control.point_world, packed.control.point_world)
    assert torch.equal(again.lanes.control.sigma, packed.control.sigma)


def test_a_map_without_signs_and_lanes_is_a_map(hd_map, tmp_path: Path) -> None:
    none = torch.zeros(0, dtype=torch.int64)
    empty = replace(
        hd_map,
        signs=hd_map.signs[none],
        lanes=hd_map.lanes.select(none),
        sign_id=(),
        lane_id=(),
        type_names=(),
    )
    write_map(empty, tmp_path / "map")
    assert schema(tmp_path / "map" / "signs.parquet") == MAP_SIGN_COLUMNS
    assert schema(tmp_path / "map" / "lanes.parquet") == MAP_LANE_COLUMNS
    again = read_map(tmp_path / "map")
    assert len(again.signs) == len(again.lanes) == len(again.lanes.control.point_world) == 0
    survey = read_survey(tmp_path / "map")
    assert len(survey.signs) == len(survey.lane_points) == 0


def test_numbers_that_are_not_finite_are_not_written(hd_map, tmp_path: Path) -> None:
    write_map(hd_map, tmp_path / "map")
    covariance = hd_map.signs.covariance.clone()
    covariance[2, 1, 1] = math.nan
    broken = replace(hd_map, signs=replace(hd_map.signs, covariance=covariance))
    with pytest.raises(ValueError, match=r"covariance: value .* is not finite"):
        write_map(broken, tmp_path / "map")
    # The older map is untouched.
    assert set(hd_map.sign_id) - {*read_map(tmp_path / "map").sign_id} == {"s1", "s4"}


def test_a_map_is_a_survey(hd_map, tmp_path: Path) -> None:
    write_map(hd_map, tmp_path / "map", min_confidence=0)
    survey = read_survey(tmp_path / "map")
    assert survey.sign_id == hd_map.sign_id
    torch.testing.assert_close(survey.signs.corners_world, hd_map.signs.corners_world)
    torch.testing.assert_close(survey.signs.center_world, hd_map.signs.center_world)
    torch.testing.assert_close(survey.signs.normal_world, hd_map.signs.normal_world)
    assert survey.signs.sigma.tolist() == [0.02] * len(hd_map.signs)
    assert survey.signs.has_corners.all()
    assert survey.lane_id == hd_map.lane_id
    assert torch.equal(survey.lane_type, hd_map.lanes.type)
    assert survey.lane_points.lane.bincount().tolist()[1] >= 2


@pytest.mark.parametrize("read", [read_map, read_survey])
def test_what_is_no_map_is_refused(tmp_path: Path, read) -> None:
    with pytest.raises(InputError, match="the map's folder is missing"):
        read(tmp_path / "nowhere")
    (tmp_path / "map.json").write_text('{"format": "crowdmap-dataset", "version": 1}')
    with pytest.raises(InputError, match="format: expected 'crowdmap-map'"):
        read(tmp_path)
