"""Loading of datasets: what comes out of a sound one."""

from __future__ import annotations

import json
import math
import re

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch

from crowdmap_torch.io.datasets import load_dataset, load_journey, row_count
from crowdmap_torch.io.errors import InputError


def test_journeys_come_in_the_order_of_their_names(sound) -> None:
    dataset = load_dataset(sound.write())
    assert [j.journey_id for j in dataset.journeys] == ["a", "b"]
    assert dataset.rejected == ()
    assert dataset.origin.lat_deg == 32.9


@pytest.mark.parametrize(
    ("wanted", "found"),
    [
        (["b"], ["b"]),
        (["b", "a", "b"], ["a", "b"]),
        (["[ab]"], ["a", "b"]),
        (["?", "a"], ["a", "b"]),
    ],
)
def test_journeys_are_chosen_by_id_and_by_pattern(sound, wanted: list[str], found: list[str]):
    dataset = load_dataset(sound.write(), journeys=wanted)
    assert [j.journey_id for j in dataset.journeys] == found


@pytest.mark.parametrize("name", ["c", "", "x*", "A"])
def test_a_name_of_no_journey_is_refused_with_those_that_there_are(sound, name: str):
    folder = sound.write()
    with pytest.raises(
        InputError, match=f"no journey is called '{re.escape(name)}'; there are a, b$"
    ):
        load_dataset(folder, journeys=["a", name])


def test_journeys_that_are_not_asked_for_may_be_bad(sound):
    sound.journeys["b"].poses["x"][0] = math.nan
    assert load_dataset(sound.write(), strict=True, journeys=["a"]).rejected == ()


def test_types_are_counted_in_one_list_of_the_dataset(sound) -> None:
    sound.journeys["b"].signs["type"] = ["DE:274", "AT:9", None]
    dataset = load_dataset(sound.write())
    assert dataset.type_names == ("AT:9", "DE:274", "US:R1-1")
    assert dataset.journeys[0].signs.type.tolist() == [-1, 1, 2]
    assert dataset.journeys[1].signs.type.tolist() == [0, -1, 1]


def test_a_pose_goes_through_the_mount(sound) -> None:
    a, b = load_dataset(sound.write()).journeys
    torch.testing.assert_close(a.T_world_camera, b.T_world_camera @ a.rig.T_link_camera)
    assert not torch.allclose(a.rig.T_link_camera, torch.eye(4, dtype=torch.float64))
    assert a.rig.T_link_camera[:3, 3].tolist() == pytest.approx([1.5, 0.1, 1.4])


def test_optional_columns_may_be_missing(sound) -> None:
    for name in ("type", "score", "track"):
        del sound.journeys["b"].signs[name]
    for name in ("type", "score"):
        del sound.journeys["b"].lanes[name]
    journey = load_dataset(sound.write()).journeys[1]
    assert journey.signs.type.tolist() == journey.signs.track.tolist() == [-1] * 3
    assert bool(journey.signs.score.isnan().all())
    assert journey.lanes.type.tolist() == [-1, -1]
    assert journey.sigma_position is None
    assert journey.sigma_rotation is None


def test_optional_columns_may_be_null_throughout(sound) -> None:
    nothing = [None] * 3
    sound.journeys["b"].signs |= {"type": nothing, "score": nothing, "track": pa.nulls(3)}
    sound.journeys["b"].poses |= {f"sigma_{k}": [None] * 4 for k in ("e", "n", "u", "rot")}
    dataset = load_dataset(sound.write())
    assert dataset.rejected == ()
    assert dataset.journeys[1].signs.track.tolist() == [-1] * 3
    assert dataset.journeys[1].sigma_position is None


def test_further_columns_files_and_keys_are_ignored(sound) -> None:
    sound.journeys["b"].signs["colour"] = [1.0, None, math.nan]
    sound.journeys["b"].head |= {"vehicle_id": "v", "started_at": "2026-05-01T10:00:00Z", "x": {}}
    folder = sound.write()
    (folder / "journeys" / "notes.txt").write_text("not a journey")
    (folder / "journeys" / ".hidden").mkdir()
    assert load_dataset(folder).rejected == ()


NUMBER_LISTS = [pa.list_(pa.float64()), pa.list_(pa.float32()), pa.large_list(pa.float64())]


@pytest.mark.parametrize("kind", NUMBER_LISTS, ids=str)
def test_lists_of_both_widths_and_integers_of_both_widths_are_the_same(sound, kind) -> None:
    reference = load_dataset(sound.write()).journeys[1]
    for columns in (sound.journeys["b"].signs, sound.journeys["b"].lanes):
        columns["u"], columns["v"] = pa.array(columns["u"], kind), pa.array(columns["v"], kind)
        columns["frame"] = pa.array(columns["frame"], pa.int32())
    sound.journeys["b"].signs["track"] = pa.array([7, None, 8], pa.int32())
    sound.journeys["b"].signs["shape"] = pa.array(
        sound.journeys["b"].signs["shape"], pa.string()
    ).dictionary_encode()
    other = load_dataset(sound.write()).journeys[1]
    assert torch.equal(other.signs.corners_px, reference.signs.corners_px)
    assert torch.equal(other.lane_points.px, reference.lane_points.px)
    assert torch.equal(other.signs.track, reference.signs.track)


@pytest.mark.parametrize("typed", [True, False], ids=["typed", "untyped"])
def test_a_journey_may_have_no_detections(sound, typed) -> None:
    for columns in (sound.journeys["b"].signs, sound.journeys["b"].lanes):
        for name in columns:
            columns[name] = [] if typed else pa.nulls(0)
    journey = load_dataset(sound.write()).journeys[1]
    assert len(journey.signs) == len(journey.lanes) == len(journey.lane_points) == 0
    assert journey.signs.corners_px.shape == (0, 8, 2)


def test_nothing_depends_on_the_order_of_rows(sound) -> None:
    reference = load_dataset(sound.write()).journeys[1]
    for columns in (sound.journeys["b"].signs, sound.journeys["b"].lanes):
        for name in columns:
            columns[name] = columns[name][::-1]
    other = load_dataset(sound.write()).journeys[1]
    assert sorted(other.signs.corners_px[:, 0, 0].tolist()) == sorted(
        reference.signs.corners_px[:, 0, 0].tolist()
    )
    assert torch.equal(other.signs.frame, reference.signs.frame)
    assert torch.equal(other.lane_points.px, reference.lane_points.px)


def test_a_journey_is_loaded_by_itself_as_in_its_dataset(sound) -> None:
    folder = sound.write()
    whole = load_dataset(folder).journeys[0]
    alone, type_names = load_journey(folder / "journeys" / "a")
    assert torch.equal(alone.T_world_camera, whole.T_world_camera)
    assert type_names == ("DE:274", "US:R1-1")


# --- real drives -----------------------------------------------------------------------------


@pytest.mark.parametrize("drive", ["kitti-00", "kitti-05", "kitti-06", "kitti-08"])
def test_real_drives_load(real_data, drive) -> None:
    folder = real_data("kitti-signs") / drive
    dataset = load_dataset(folder, strict=True)
    (journey,) = dataset.journeys
    rows = pq.read_metadata(folder / "journeys" / drive / "signs.parquet").num_rows
    assert row_count(journey, "sign") == rows
    assert len(journey.signs) >= 0.99 * rows
    assert len(journey.lanes) == 0
    origin = json.loads((folder / "dataset.json").read_text())["origin"]
    assert dataset.origin.lat_deg == origin["lat_deg"]


@pytest.mark.parametrize(
    ("stated", "vehicle"),
    [
        ("van 7", "van 7"),
        (7, "7"),
        ("\ud800", "\\ud800"),
        ("a\nb", "a\\u000ab"),
        (None, "r"),
        ("", "r"),
        (True, "r"),
        ([1], "r"),
        (10**3000, "r"),
    ],
)
def test_a_car_has_a_name_that_can_be_shown(sound, stated: object, vehicle: str):
    rig = sound.journeys["b"].head["rig"]
    sound.journeys["b"].head |= {"vehicle_id": stated}
    found = next(j for j in load_dataset(sound.write()).journeys if j.journey_id == "b")
    assert found.vehicle == (rig if vehicle == "r" else vehicle)


def test_long_names_of_cars_are_told_apart(sound):
    for name, end in (("a", "x"), ("b", "y")):
        sound.journeys[name].head |= {"vehicle_id": "v" * 5000 + end}
    one, other = (j.vehicle for j in load_dataset(sound.write()).journeys[:2])
    assert one != other and max(len(one), len(other)) < 120
