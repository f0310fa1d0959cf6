"""Loading of datasets that are spoilt: which line names each fault."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from crowdmap_torch.io.datasets import load_dataset, load_journey
from crowdmap_torch.io.errors import InputError


def column(values: list, kind: pa.DataType) -> pa.Array:
    return pa.array(values, kind)


# --- faults that set a journey aside ---------------------------------------------------------


def put(file: str, name: str, values: list | pa.Array) -> Callable:
    return lambda j: getattr(j, file).update({name: values})


def change(file: str, name: str, row: int, value: object) -> Callable:
    return lambda j: getattr(j, file)[name].__setitem__(row, value)


def drop(file: str, name: str) -> Callable:
    return lambda j: getattr(j, file).pop(name)


def head(**changes: object) -> Callable:
    return lambda j: j.head.update(changes)


def replace(file: str, content: object) -> Callable:
    return lambda j: setattr(j, file, content)


def no_rows(j) -> None:
    j.poses = {name: [] for name in j.poses}


def stretched(j) -> None:
    j.poses["qw"][2] = 0.51


FAULTS = {
    "journey.json missing": (replace("head", None), "journey.json: the file is missing"),
    "journey.json no json": (replace("head", "{"), "journey.json: cannot be read as JSON"),
    "journey.json a list": (replace("head", [1]), "journey.json: expected a mapping"),
    "journey.json key twice": (
        replace("head", '{"rig": "a", "rig": "b"}'),
        "journey.json: .*'rig' is given twice",
    ),
    "journey.json NaN": (replace("head", '{"format": NaN}'), "journey.json: .*NaN is not allowed"),
    "journey format": (head(format="crowdmap-map"), "format: expected 'crowdmap-journey'"),
    "journey version": (head(version=2), "version: expected version 1, found 2"),
    "journey version true": (head(version=True), "version: expected version 1, found True"),
    "journey_id missing": (lambda j: j.head.pop("journey_id"), "journey_id: is missing"),
    "journey_id of another": (head(journey_id="b"), "journey_id: 'b' in the folder 'a'"),
    "journey_id a number": (head(journey_id=3), "journey_id: expected a text"),
    "rig missing": (lambda j: j.head.pop("rig"), "rig: is missing"),
    "rig unknown": (head(rig="nobody"), "nobody: the rig's folder is missing"),
    "rig outside": (head(rig="../rigs/b"), "rig: expected the plain name of a folder"),
    "rig dots": (head(rig=".."), "rig: expected the plain name of a folder"),
    "poses missing": (replace("poses", None), "poses.parquet: the file is missing"),
    "signs missing": (replace("signs", None), "signs.parquet: the file is missing"),
    "lanes missing": (replace("lanes", None), "lanes.parquet: the file is missing"),
    "poses empty file": (replace("poses", b""), "poses.parquet: cannot be read as Parquet"),
    "signs corrupt": (replace("signs", b"PAR1 no PAR1"), "signs.parquet: cannot be read as Parq"),
    "poses without rows": (no_rows, "poses.parquet: has no rows"),
    "column missing": (drop("poses", "qz"), "poses.parquet: column 'qz' is missing"),
    "signs column missing": (drop("signs", "u"), "signs.parquet: column 'u' is missing"),
    "lanes column missing": (drop("lanes", "frame"), "lanes.parquet: column 'frame' is missing"),
    "frame null": (change("poses", "frame", 1, None), "poses.parquet: row 1: column 'frame' is nu"),
    "x null": (change("poses", "x", 2, None), "poses.parquet: row 2: column 'x' is null"),
    "x NaN": (change("poses", "x", 2, math.nan), "row 2: column 'x': expected a finite number"),
    "z infinite": (change("poses", "z", 0, math.inf), "row 0: column 'z': expected a finite"),
    "qw NaN": (change("poses", "qw", 3, math.nan), "row 3: column 'qw': expected a finite"),
    "quaternion length": (stretched, "poses.parquet: row 2: quaternion .* has length 1.005"),
    "x a text": (
        put("poses", "x", column(["0"] * 4, pa.string())),
        "poses.parquet: column 'x' has type string; expected float64",
    ),
    "x single": (
        put("poses", "x", column([0.0] * 4, pa.float32())),
        "poses.parquet: column 'x' has type float; expected float64",
    ),
    "frame a float": (
        put("poses", "frame", column([10.0, 11.0, 13.0, 14.0], pa.float64())),
        "poses.parquet: column 'frame' has type double; expected int64",
    ),
    "t_ns a timestamp": (
        put("poses", "t_ns", column([1, 2, 3, 4], pa.timestamp("ns"))),
        r"column 't_ns' has type timestamp\[ns\]; expected int64",
    ),
    "frame twice": (
        put("poses", "frame", [10, 11, 11, 14]),
        "poses.parquet: row 2: column 'frame': 11 after 11; expected strictly increasing",
    ),
    "frame falls": (put("poses", "frame", [10, 9, 13, 14]), "row 1: column 'frame': 9 after 10"),
    "time stands": (put("poses", "t_ns", [1, 2, 2, 3]), "row 2: column 't_ns': 2 after 2"),
    "far away": (
        put("poses", "x", [0.0, 1.0, 2e6, 3.0]),
        r"poses.parquet: row 2: the position \(2000000, 0.2, 0\) is over 1,000 km .* UTM",
    ),
    "huge": (put("poses", "z", [0.0, 1e300, 0.0, 0.0]), "row 1: the position .* is over 1,000 km"),
    "teleport": (
        put("poses", "x", [0.0, 1.0, 5000.0, 5001.0]),
        "poses.parquet: row 0: from frame 10 to frame 14 the car moves 5001 m in 0.198 s",
    ),
    "too fast": (
        lambda j: j.poses.update(t_ns=[10**9 * k for k in range(4)], x=[0.0, 160.0, 320.0, 480.0]),
        "poses.parquet: row 0: from frame 10 to frame 11 the car moves 160 m in 1 s",
    ),
    "times beyond": (put("poses", "t_ns", [1, 2, 3, 2**62]), "row 3: column 't_ns': .*at most"),
    "sigma below zero": (
        put("poses", "sigma_rot", [0.1, -0.1, 0.1, 0.1]),
        "row 1: column 'sigma_rot': expected 0 or more",
    ),
    "sigma NaN": (
        put("poses", "sigma_e", [0.1, 0.1, math.nan, 0.1]),
        "row 2: column 'sigma_e': expected a finite",
    ),
    "sign frame": (change("signs", "frame", 1, 12), "signs.parquet: row 1: frame 12 is not in"),
    "sign frame beyond": (change("signs", "frame", 2, 99), "signs.parquet: row 2: frame 99"),
    "lane frame": (change("lanes", "frame", 1, -1), "lanes.parquet: row 1: frame -1 is not in"),
    "shape unknown": (
        change("signs", "shape", 1, "round"),
        "signs.parquet: row 1: column 'shape': 'round' is unknown; expected one of triangle",
    ),
    "shape null": (change("signs", "shape", 0, None), "row 0: column 'shape' is null"),
    "shape a number": (put("signs", "shape", column([1, 2, 3], pa.int64())), "'shape' has type"),
    "too few corners": (
        lambda j: (j.signs["u"][0].pop(), j.signs["v"][0].pop()),
        "signs.parquet: row 0: rectangle with 3 corners; expected 4",
    ),
    "too many corners": (
        lambda j: (j.signs["u"][1].append(75.0), j.signs["v"][1].append(30.0)),
        "signs.parquet: row 1: triangle with 4 corners; expected 3",
    ),
    "u shorter than v": (
        lambda j: j.signs["u"][0].pop(),
        "signs.parquet: row 0: 3 values in u and 4 in v",
    ),
    "lane u shorter": (lambda j: j.lanes["u"][0].pop(), "lanes.parquet: row 0: 2 values in u and"),
    "u null": (change("signs", "u", 2, None), "signs.parquet: row 2: column 'u' is null"),
    "u holds null": (
        change("signs", "u", 1, [80.0, None, 70.0]),
        "signs.parquet: row 1: column 'u': expected finite numbers, found null",
    ),
    "u holds NaN": (
        change("signs", "u", 1, [80.0, math.nan, 70.0]),
        "signs.parquet: row 1: column 'u': expected finite numbers, found nan",
    ),
    "v infinite": (
        change("lanes", "v", 1, [50.0, -math.inf]),
        "lanes.parquet: row 1: column 'v': expected finite numbers, found -inf",
    ),
    "u of integers": (
        put("lanes", "u", column([[1, 2, 3], [4, 5]], pa.list_(pa.int64()))),
        r"lanes.parquet: column 'u' has type list<.*int64>; expected list<double>",
    ),
    "u no list": (put("signs", "u", column([1.0, 2.0, 3.0], pa.float64())), "'u' has type double"),
    "one lane point": (
        lambda j: j.lanes.update(u=[[1.0], [2.0, 3.0]], v=[[1.0], [2.0, 3.0]]),
        "lanes.parquet: row 0: lane marker with 1 points; expected 2 or more",
    ),
    "no lane point": (
        lambda j: j.lanes.update(u=[[], [2.0, 3.0]], v=[[], [2.0, 3.0]]),
        "lanes.parquet: row 0: lane marker with 0 points",
    ),
    "lane type": (change("lanes", "type", 0, "dotted"), "row 0: column 'type': 'dotted' is unkno"),
    "score above 1": (change("signs", "score", 0, 1.5), "row 0: column 'score': expected 0 to 1"),
    "score below 0": (change("lanes", "score", 1, -0.1), "row 1: column 'score': expected 0 to 1"),
    "score NaN": (change("signs", "score", 0, math.nan), "column 'score': expected a finite"),
    "type a number": (put("signs", "type", column([1, 2, 3], pa.int64())), "'type' has type int64"),
    "track a float": (
        put("signs", "track", column([1.0, None, 2.0], pa.float64())),
        "column 'track' has type double; expected int64",
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_sets_the_journey_aside_in_one_line(sound, fault) -> None:
    spoil, reason = FAULTS[fault]
    spoil(sound.journeys["a"])
    folder = sound.write()
    dataset = load_dataset(folder)
    assert [j.journey_id for j in dataset.journeys] == ["b"]
    assert [r.journey_id for r in dataset.rejected] == ["a"]
    line = dataset.rejected[0].reason
    assert "\n" not in line
    with pytest.raises(InputError, match=reason):
        load_journey(folder / "journeys" / "a")
    with pytest.raises(InputError, match="journey 'a': ") as error:
        load_dataset(folder, strict=True)
    assert line in str(error.value)


def test_a_column_that_is_there_twice_is_refused(sound) -> None:
    folder = sound.write()
    path = folder / "journeys" / "a" / "poses.parquet"
    table = pq.read_table(path)
    pq.write_table(
        pa.Table.from_arrays([*table.columns, table.column("x")], names=[*table.column_names, "x"]),
        path,
    )
    assert "column 'x' is there twice" in load_dataset(folder).rejected[0].reason


def test_text_that_is_not_utf8_is_refused(sound) -> None:
    raw = pa.array([b"\xff\xfe", b"ok", b"ok"], pa.binary()).view(pa.string())
    sound.journeys["a"].signs["type"] = raw
    assert "column 'type': expected UTF-8" in load_dataset(sound.write()).rejected[0].reason


def test_a_broken_rig_sets_all_its_journeys_aside(sound) -> None:
    sound.rigs["a"]["camera"]["fx"] = -1
    sound.journeys["c"] = copy.deepcopy(sound.journeys["a"])
    sound.journeys["c"].head["journey_id"] = "c"
    dataset = load_dataset(sound.write())
    assert [r.journey_id for r in dataset.rejected] == ["a", "c"]
    assert dataset.rejected[0].reason == dataset.rejected[1].reason


# --- faults of the dataset itself ------------------------------------------------------------


def no_journeys(sound) -> None:
    sound.journeys.clear()
    (sound.folder / "journeys").mkdir(parents=True)


DATASET_FAULTS = {
    "missing head": (lambda t: setattr(t, "head", None), "dataset.json: the file is missing"),
    "no json": (lambda t: setattr(t, "head", "origin:"), "dataset.json: cannot be read as JSON"),
    "format": (lambda t: t.head.update(format="x"), "format: expected 'crowdmap-dataset'"),
    "version": (lambda t: t.head.update(version="1"), "version: expected version 1, found '1'"),
    "no origin": (lambda t: t.head.pop("origin"), "dataset.json: origin: is missing"),
    "latitude": (
        lambda t: t.head["origin"].update(lat_deg=91),
        "origin.lat_deg: expected a number in -90 to 90, found 91",
    ),
    "longitude": (lambda t: t.head["origin"].update(lon_deg=-181.0), "origin.lon_deg: expected"),
    "height": (lambda t: t.head["origin"].update(height_m="120"), "origin.height_m: expected a nu"),
    "no folder": (lambda t: t.journeys.clear(), "journeys: the folder is missing"),
    "no journeys": (no_journeys, "journeys: has no journeys"),
    "all set aside": (
        lambda t: [j.poses.pop("x") for j in t.journeys.values()],
        "all 2 journeys are set aside; the first, 'a', because .*column 'x' is missing",
    ),
}


@pytest.mark.parametrize("fault", DATASET_FAULTS)
def test_a_fault_of_the_dataset_is_one_line(sound, fault) -> None:
    spoil, reason = DATASET_FAULTS[fault]
    spoil(sound)
    folder = sound.write()
    with pytest.raises(InputError, match=reason) as error:
        load_dataset(folder)
    assert "\n" not in str(error.value)


def test_a_dataset_that_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="the dataset's folder is missing"):
        load_dataset(tmp_path / "nowhere")
