"""Maps in tiles by the commands: a run around the corner of four tiles, and everything that opens what it wrote."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch

from crowdmap_torch.cli import main
from crowdmap_torch.geometry import quadtree
from crowdmap_torch.io.area import Area
from crowdmap_torch.io.formats.geodesy import geodetic_from_local
from crowdmap_torch.io.maps import read_map
from crowdmap_torch.tables import HdMap, Origin

MIDDLE_M = 14.0, -68.5
"""East and north of the tiny street's origin: of what is mapped some is on all four sides of it."""


@pytest.fixture(scope="module")
def drives(tiny_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The tiny data set with `MIDDLE_M` where four tiles meet."""
    folder = tmp_path_factory.mktemp("corner") / "dataset"
    shutil.copytree(tiny_folder, folder)
    tile = quadtree.tiles_at(np.array([-117.2]), np.array([32.9]), 14)
    west, south, _, _ = quadtree.bounds_deg(tile, 14)[0].tolist()
    corner = Origin(south, west, 120.0)
    there = geodetic_from_local(np.array([[*MIDDLE_M, 0.0]]), corner)[0]
    lat, lon = 2 * south - there[0], 2 * west - there[1]
    for path in (folder / "dataset.json", folder / "survey" / "map.json"):
        head = json.loads(path.read_text())
        head["origin"] |= {"lat_deg": lat, "lon_deg": lon}
        path.write_text(json.dumps(head))
    return folder


@pytest.fixture(scope="module")
def runs(drives: Path, rough: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The map of a run in tiles, kept aside, and of the same run again without them, over the first."""
    folder = tmp_path_factory.mktemp("runs")
    run = ["optimize", str(drives), "--out", str(folder / "run"), "--workers", "1", "-q"]
    run += ["--config", str(rough)]
    assert main([*run, "--tiles"]) == 0
    shutil.copytree(folder / "run", folder / "tiled")
    assert main([*run, "--overwrite"]) == 0
    return folder / "tiled", folder / "run"


def places(hd_map: HdMap) -> tuple[object, ...]:
    return hd_map.sign_id, hd_map.lane_id, hd_map.type_names, hd_map.origin


def test_a_run_in_tiles_has_the_map_of_one_without(runs: tuple[Path, Path]):
    tiled, whole = (read_map(run / "map") for run in runs)
    assert places(tiled) == places(whole)
    for one, other in ((tiled.signs, whole.signs), (tiled.lanes.control, whole.lanes.control)):
        for name in one.__dataclass_fields__:
            assert torch.equal(getattr(one, name), getattr(other, name))


def test_landmarks_around_a_corner_are_in_four_tiles(runs: tuple[Path, Path]):
    folder = runs[0] / "map"
    assert sorted(p.name for p in folder.iterdir()) == ["map.json", "tiles"]
    index = json.loads((folder / "map.json").read_text())["tiles"]["index"]
    assert len(index) == 4 and len(list((folder / "tiles").iterdir())) == 4
    tiles = quadtree.tiles_of([tile["quadkey"] for tile in index])
    for tile, is_high in zip(index, tiles > tiles.min(0), strict=True):
        inside = folder / "tiles" / tile["quadkey"]
        signs = pq.ParquetFile(inside / "signs.parquet").read()["center"].to_pylist()
        lanes = pq.ParquetFile(inside / "lanes.parquet").read()["points"].to_pylist()
        assert (len(signs), len(lanes)) == (tile["signs"], tile["lanes"])
        place = np.array([*signs, *(points[0] for points in lanes)])[:, :2]
        # East and north of the corner, or not: a centimetre for the ellipsoid.
        away = np.where(is_high, 1, -1) * (place - MIDDLE_M)
        assert len(place) and (away > -0.01).all()


def test_a_map_in_one_piece_leaves_no_tiles_of_the_run_before(runs: tuple[Path, Path]):
    assert not (runs[1] / "map" / "tiles").exists()
    assert not (runs[1] / "unfinished").exists()
    assert not (runs[0] / "map_clusters" / "tiles").exists()


def test_commands_say_the_same_of_both_forms(
    runs: tuple[Path, Path], drives: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    surveys = tmp_path / "survey", tmp_path / "whole"
    for to, survey in zip(("tiles", "map"), surveys, strict=True):
        assert main(["export", str(drives / "survey"), "--to", to, "-o", str(survey)]) == 0
        assert "left out: truth" in capsys.readouterr().out
    said = []
    for run, survey in ((runs[0], surveys[0]), (runs[0], surveys[1]), (runs[1], surveys[1])):
        assert main(["evaluate", str(run / "map"), str(survey)]) == 0
        said.append(capsys.readouterr().out)
    assert said[0] == said[1] == said[2] != ""
    for to, name in (("geojson", "map.geojson"), ("compact", "map.cmap")):
        files = [tmp_path / str(k) / name for k in range(2)]
        for run, file in zip(runs, files, strict=True):
            assert main(["export", str(run), "--to", to, "-o", str(file)]) == 0
        told = capsys.readouterr().out.splitlines()
        assert [line.split(": ")[-1] for line in told[: len(told) // 2]] == [
            line.split(": ")[-1] for line in told[len(told) // 2 :]
        ]
    assert main(["view", str(runs[0]), "--out", str(tmp_path / "view.html")]) == 0
    world = ["simulate", str(tmp_path / "new"), "--map", str(runs[0] / "map"), "--journeys", "1"]
    assert main(world) == 0
    shutil.copytree(drives, tmp_path / "data")
    shutil.rmtree(tmp_path / "data" / "survey")
    surveys[0].rename(tmp_path / "data" / "survey")
    assert main(["check", str(tmp_path / "data")]) == main(["check", str(drives)])


def test_a_map_goes_into_tiles_and_back(
    runs: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    whole = runs[1] / "map"
    to_tiles = ["export", str(whole), "--to", "tiles", "--level", "20", "-o", str(tmp_path / "t")]
    assert main(to_tiles) == 0
    assert {len(p.name) for p in (tmp_path / "t" / "tiles").iterdir()} == {20}
    assert main(["export", str(tmp_path / "t"), "--to", "map", "-o", str(tmp_path / "back")]) == 0
    for path in whole.glob("*.parquet"):
        assert pq.read_table(tmp_path / "back" / path.name).equals(pq.read_table(path))
    capsys.readouterr()
    assert main(to_tiles) == 2
    assert "exists" in capsys.readouterr().err
    assert main([*to_tiles, "--overwrite"]) == 0


def test_a_part_by_its_area_is_read_from_its_tiles_alone(
    runs: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """The quarter north-east of where four tiles meet: the same of either form, in every form."""
    east, north = MIDDLE_M
    area = ["--bbox", f"{east + 1},{north + 1},1000,1000"]
    whole, tiled = runs[1] / "map", tmp_path / "tiled"
    shutil.copytree(runs[0] / "map", tiled)
    head = read_map(whole, area=Area(east + 1, north + 1, 1000, 1000))
    assert 0 < len(head.signs) < len(read_map(whole).signs)
    for to in ("map", "tiles"):
        out = [tmp_path / f"{to}-{k}" for k in range(2)]
        for source, part in zip((whole, tiled), out, strict=True):
            assert main(["export", str(source), "--to", to, "-o", str(part), *area]) == 0
            told = f"{len(head.signs)} signs, {len(head.lanes)} lane pieces"
            assert told in capsys.readouterr().out
            assert places(read_map(part)) == places(head)
            assert torch.equal(read_map(part).signs.center_world, head.signs.center_world)
    for source, name in ((whole, "a.geojson"), (tiled, "b.geojson")):
        file = str(tmp_path / name)
        assert main(["export", str(source), "--to", "geojson", "-o", file, *area]) == 0
    ids = [
        {
            f["properties"]["sign_id"]
            for f in json.loads((tmp_path / n).read_text())["features"]
            if f["properties"]["layer"] == "signs"
        }
        for n in ("a.geojson", "b.geojson")
    ]
    assert ids[0] == ids[1] == set(head.sign_id)
    capsys.readouterr()
    nowhere = ["export", str(whole), "--to", "map", "-o", str(tmp_path / "none")]
    for words, told in (
        ([*nowhere, "--bbox", "5000,5000,6000,6000"], "nothing of it lies in the area"),
        (["export", str(runs[1]), "--to", "tum", *area], "--bbox is of maps"),
    ):
        assert main(words) == 2
        assert told in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main([*nowhere, "--bbox", "3,2,1"])
    assert not (tmp_path / "none").exists()


def test_a_map_without_a_place_on_the_earth_has_no_tiles(
    runs: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    shutil.copytree(runs[1] / "map", tmp_path / "map")
    head = json.loads((tmp_path / "map" / "map.json").read_text())
    del head["origin"]
    (tmp_path / "map" / "map.json").write_text(json.dumps(head))
    assert main(["export", str(tmp_path / "map"), "--to", "tiles"]) == 2
    said = capsys.readouterr().err
    assert "origin: is missing" in said and said.count("\n") == 1
    assert not (tmp_path / "map.tiles").exists()


@pytest.mark.parametrize("level", ["0", "25", "fine"])
def test_a_level_that_is_none_is_refused(
    level: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    with pytest.raises(SystemExit):
        main(["optimize", "--tiles", level, str(tmp_path), "--out", str(tmp_path / "run")])
    assert "expected" in capsys.readouterr().err
