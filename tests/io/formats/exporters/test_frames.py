"""What a notebook is handed: the numbers of the tables, under the names of FORMAT.md."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.formats.exporters.export import export_map
from crowdmap_torch.io.formats.exporters.frames import to_geojson, to_geopandas, to_pandas
from crowdmap_torch.tables import Dataset, HdMap, Survey


def test_the_geojson_of_a_map_is_the_exported_one(hd_map: HdMap, tmp_path: Path):
    export_map(hd_map, tmp_path / "map.geojson", "geojson")
    assert to_geojson(hd_map) == json.loads((tmp_path / "map.geojson").read_text("utf-8"))


def test_the_geojson_of_drives_has_a_line_for_each_and_their_frames(tiny: Dataset):
    found = json.loads(json.dumps(to_geojson(tiny), allow_nan=False))
    kinds = [feature["properties"]["layer"] for feature in found["features"]]
    assert kinds.count("drives") == 3
    assert kinds.count("frames") == sum(j.frame_count for j in tiny.journeys)


@pytest.mark.parametrize("name", ["to_pandas", "to_geopandas"])
def test_a_package_that_is_not_there_is_one_line(
    name: str, hd_map: HdMap, monkeypatch: pytest.MonkeyPatch
):
    package = name.removeprefix("to_")
    monkeypatch.setitem(sys.modules, package, None)
    call = {"to_pandas": to_pandas, "to_geopandas": to_geopandas}[name]
    with pytest.raises(
        InputError, match=f"^{name} needs the Python package '{package}', .*pip install"
    ):
        call(hd_map)


def test_frames_have_the_columns_of_the_format(hd_map: HdMap, tiny: Dataset, tiny_survey: Survey):
    pytest.importorskip("pandas", reason="pandas is not installed")
    frames = to_pandas(hd_map)
    assert isinstance(frames, dict) and [*frames] == ["signs", "lanes"]
    assert frames["signs"]["sign_id"].tolist() == [*hd_map.sign_id]
    assert frames["signs"]["x"].tolist() == hd_map.signs.center_world[:, 0].tolist()
    assert [*to_pandas(tiny)] == ["drives", "frames"]
    assert len(to_pandas(tiny_survey)["signs"]) == len(tiny_survey.signs)
    detections = tiny.journeys[0].signs
    flat = to_pandas(detections)
    assert len(flat) == len(detections) and "corners_px" in flat
    assert torch.equal(torch.as_tensor(flat["frame"].to_numpy()), detections.frame)


def test_geometry_is_where_signs_stand(hd_map: HdMap, tiny: Dataset):
    pytest.importorskip("geopandas", reason="GeoPandas (extra [gis]) is not installed")
    frames = to_geopandas(hd_map)
    assert [*frames] == ["signs", "plates", "lanes"]
    signs = frames["signs"]
    assert signs.crs == "EPSG:4979" and signs.geometry.has_z.all()
    place = to_geojson(hd_map)["features"][0]["geometry"]["coordinates"]
    point = signs.geometry.iloc[0]
    assert (point.x, point.y, point.z) == pytest.approx(place, abs=1e-5)
    assert frames["plates"].geometry.is_valid.all()
    assert len(to_geopandas(tiny)["drives"]) == 3


def test_the_library_is_loaded_without_what_a_notebook_alone_needs():
    code = (
        "import sys, crowdmap_torch; crowdmap_torch.to_pandas, crowdmap_torch.load_dataset; "
        "print(sorted({'pandas', 'geopandas', 'pyogrio', 'sklearn', 'tensorboard'} & {*sys.modules}))"
    )
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ended.stdout == "[]\n"


def test_tables_have_what_the_package_has(hd_map: HdMap, tiny: Dataset, tiny_survey: Survey):
    pytest.importorskip("pandas")
    for what in (hd_map, tiny, tiny_survey):
        assert what.to_geojson() == to_geojson(what)
        own, functions = what.to_pandas(), to_pandas(what)
        assert [*own] == [*functions]
        assert all(own[name].equals(functions[name]) for name in own)
    assert hd_map.signs.to_pandas()["shape"].tolist() == hd_map.signs.shape.tolist()
    for figure in (hd_map.plot(), hd_map.plot(tiny_survey), tiny.plot()):
        assert figure.axes[0].lines or figure.axes[0].collections
