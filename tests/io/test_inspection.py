"""All faults of all files, by the rules of the readers."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import yaml

from crowdmap_torch.io.datasets import load_dataset
from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.faults import Fault, gathered
from crowdmap_torch.io.inspection import inspect_dataset


@pytest.fixture
def bad(tiny_folder: Path, tmp_path: Path) -> Path:
    """A copy of a small data set, to be spoilt."""
    return Path(shutil.copytree(tiny_folder, tmp_path / "bad"))


def refused(folder: Path) -> list[Fault]:
    return [fault for fault in inspect_dataset(folder) if not fault.drops]


def changed(path: Path, name: str, column: object) -> None:
    table = pq.read_table(path)
    pq.write_table(table.set_column(table.column_names.index(name), name, pa.array(column)), path)


def test_nothing_is_refused_of_a_good_data_set_and_faults_are_raised_again_after(
    tiny_folder: Path,
) -> None:
    assert refused(tiny_folder) == []
    assert gathered() is None


def test_rows_that_are_left_out_are_named_as_many_as_the_loader_counts(tiny_folder: Path) -> None:
    dropped = [fault for fault in inspect_dataset(tiny_folder) if fault.drops]
    rows = sum(len(f.rows) for f in dropped if not f.rule.startswith("lane point"))
    counted = [j.dropped.items() for j in load_dataset(tiny_folder).journeys]
    known = sum(n for items in counted for why, n in items if not why.startswith("lane point"))
    assert rows == known


def test_every_wrong_row_of_every_column_is_named(bad: Path) -> None:
    path = bad / "journeys" / "journey-000" / "poses.parquet"
    table = pq.read_table(path)
    x, qw = (table[name].to_numpy().copy() for name in ("x", "qw"))
    x[[2, 7]], qw[[4, 5]] = np.nan, 3.0
    t_ns = table["t_ns"].to_numpy().copy()
    t_ns[3] = t_ns[2]
    for name, column in (("x", x), ("qw", qw), ("t_ns", t_ns)):
        changed(path, name, column)
    found = {(fault.code, fault.column): fault.rows for fault in refused(bad)}
    assert found == {
        ("order", "t_ns"): (3,),
        ("not-finite", "x"): (2, 7),
        ("quaternion-length", ""): (4, 5),
    }
    assert {fault.path for fault in refused(bad)} == {path}


def test_a_wrong_type_and_a_missing_column_hide_nothing_else(bad: Path) -> None:
    path = bad / "journeys" / "journey-001" / "poses.parquet"
    table = pq.read_table(path)
    z = table["z"].to_numpy().copy()
    z[1] = np.inf
    table = table.set_column(table.column_names.index("x"), "x", table["x"].cast(pa.float32()))
    table = table.set_column(table.column_names.index("z"), "z", pa.array(z)).drop_columns(["qz"])
    pq.write_table(table, path)
    assert [(fault.code, fault.column) for fault in refused(bad)] == [
        ("missing-column", "qz"),
        ("column-type", "x"),
        ("not-finite", "z"),
    ]


def test_a_broken_rig_and_broken_poses_do_not_keep_detections_from_being_looked_at(
    bad: Path,
) -> None:
    for path in bad.glob("rigs/*/rig.yaml"):
        path.write_text(path.read_text().replace("width: 1280", "width: wide"))
    journey = bad / "journeys" / "journey-002"
    (journey / "poses.parquet").write_bytes(b"nothing")
    signs = pq.read_table(journey / "signs.parquet")
    shapes = signs["shape"].to_pylist()
    shapes[1] = "circle"
    changed(journey / "signs.parquet", "shape", shapes)
    found = {(f.path.name, f.rows) for f in refused(bad)}
    assert found == {("rig.yaml", ()), ("poses.parquet", ()), ("signs.parquet", (1,))}


def test_every_wrong_key_of_a_text_file_is_named_once(bad: Path) -> None:
    head = json.loads((bad / "dataset.json").read_text())
    origin = {"lat_deg": 91, "lon_deg": "east"}
    wrong = {"format": "map", "version": 2, "origin": origin}
    (bad / "dataset.json").write_text(json.dumps(head | wrong))
    rig = next(iter(sorted(bad.glob("rigs/*/rig.yaml"))))
    content = yaml.safe_load(rig.read_text())
    camera, road = content["camera"], content["road"]
    camera |= {"model": "lomo", "fx": 0.5, "cy": None, "distortion": [1, "k2", "k3"], "fov": 90}
    del camera["width"]
    content["road"] = {"normal": [0, 0.5, 0], "height": road["height_m"]}
    rig.write_text(yaml.safe_dump(content | {"mount": 3}))
    journey = bad / "journeys" / "journey-001" / "journey.json"
    journey.write_text(json.dumps({"format": "crowdmap-journey", "version": True, "rig": "../rig"}))
    assert [(f.path.name, f.code, re.split("is |: e", f.rule)[0]) for f in refused(bad)] == [
        ("dataset.json", "other-version", "format"),
        ("dataset.json", "other-version", "version"),
        ("dataset.json", "range", "origin.lat_deg"),
        ("dataset.json", "value", "origin.lon_deg"),
        ("dataset.json", "missing-key", "origin.height_m: "),
        ("rig.yaml", "missing-key", "camera: key 'width' "),
        ("rig.yaml", "unknown-key", "camera: key 'fov' "),
        ("rig.yaml", "unknown-name", "camera.model"),
        ("rig.yaml", "value", "camera.distortion[1]"),
        ("rig.yaml", "range", "camera.fx"),
        ("rig.yaml", "value", "camera.cy"),
        ("rig.yaml", "missing-key", "road: key 'height_m' "),
        ("rig.yaml", "unknown-key", "road: key 'height' "),
        ("rig.yaml", "value", "road.normal"),
        ("rig.yaml", "value", "mount"),
        ("journey.json", "other-version", "version"),
        ("journey.json", "missing-key", "journey_id: "),
        ("journey.json", "value", "rig"),
    ]


def test_a_section_that_is_no_mapping_is_one_fault(bad: Path) -> None:
    (bad / "dataset.json").write_text('{"format": "crowdmap-dataset", "version": 1, "origin": []}')
    rig = next(iter(sorted(bad.glob("rigs/*/rig.yaml"))))
    rig.write_text("road: {normal: [0, 1, 0], height_m: 1.4}\n")
    assert [(fault.path.name, fault.code) for fault in refused(bad)] == [
        ("dataset.json", "value"),
        ("rig.yaml", "missing-key"),
    ]


def test_a_survey_is_looked_at_too(bad: Path) -> None:
    head = json.loads((bad / "survey" / "map.json").read_text())
    head["origin"]["lat_deg"] += 1
    (bad / "survey" / "map.json").write_text(json.dumps(head))
    (fault,) = refused(bad)
    assert fault.path == bad / "survey" / "map.json" and "expected that of" in fault.rule
    (bad / "survey" / "signs.parquet").write_bytes(b"nothing")
    assert [fault.path.name for fault in refused(bad)] == ["map.json", "signs.parquet"]


def test_every_fault_of_a_survey_is_named(bad: Path) -> None:
    survey = bad / "survey"
    head = json.loads((survey / "map.json").read_text())
    head["version"], head["origin"]["lat_deg"] = 2, "north"
    (survey / "map.json").write_text(json.dumps(head))
    signs = pq.read_table(survey / "signs.parquet").to_pydict()
    assert len(signs["sign_id"]) >= 6
    signs["sign_id"][1] = signs["sign_id"][0]
    signs["shape"][2] = "circle"
    signs["corners"][3] = signs["corners"][3][:-1]
    signs["corners"][4][0] = [0.0, 1.0]
    signs["corners"][5][1][2] = float("nan")
    signs["corners"][0] = signs["corners"][0][::-1]
    columns = {"corners": pa.list_(pa.list_(pa.float64()))}
    sigma = [0.02] * len(signs["sign_id"])
    sigma[0] = sigma[2] = -1.0
    table = {name: pa.array(rows, columns.get(name)) for name, rows in signs.items()}
    pq.write_table(pa.table(table | {"sigma_m": pa.array(sigma)}), survey / "signs.parquet")
    lanes = pq.read_table(survey / "lanes.parquet").to_pydict()
    lanes["lane_id"][0] = ""
    lanes["points"][1] = lanes["points"][1][:1]
    lanes["points"][2][3] = [1e7, 0.0, 0.0]
    lanes["points"][3][0] = None
    pq.write_table(
        pa.table({"lane_id": lanes["lane_id"], "points": lanes["points"]}), survey / "lanes.parquet"
    )
    found = [(fault.path.name, fault.code, fault.rows) for fault in refused(bad)]
    assert found == [
        ("map.json", "other-version", ()),
        ("map.json", "value", ()),
        ("signs.parquet", "name-twice", (1,)),
        ("signs.parquet", "unknown-name", (2,)),
        ("signs.parquet", "point-count", (4,)),
        ("signs.parquet", "not-finite", (5,)),
        ("signs.parquet", "point-count", (3,)),
        ("signs.parquet", "value", (0,)),
        ("signs.parquet", "range", (0, 2)),
        ("lanes.parquet", "null", (0,)),
        ("lanes.parquet", "null", (3,)),
        ("lanes.parquet", "far-away", (2,)),
        ("lanes.parquet", "point-count", (1,)),
    ]


def test_a_folder_that_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="folder is missing"):
        inspect_dataset(tmp_path / "none")
    (fault,) = [f for f in inspect_dataset(tmp_path) if f.path.name == "journeys"]
    assert "one folder for each journey" in fault.rule
