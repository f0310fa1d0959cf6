from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from worlds import foreign

from crowdmap_torch.geometry import polygon
from crowdmap_torch.io.datasets import load_dataset
from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.formats.composing import axes
from crowdmap_torch.io.formats.composing.compose import (
    add_to,
    compose,
    write_new,
    write_survey_alone,
)
from crowdmap_torch.io.formats.composing.parts import Asked, Parts, SurveyRows, Track
from crowdmap_torch.io.formats.importers import coco, tum, tusimple
from crowdmap_torch.io.surveys import read_survey
from crowdmap_torch.tables import Origin

ORIGIN = Origin(48.0, 11.0, 500.0)
SAID = Asked(origin=ORIGIN, world="enu", link="camera", images="number")


def parts_of(folder: Path, asked: Asked = SAID) -> list[Parts]:
    return [
        tum.read((foreign.write_tum(folder / "drive.txt"),), asked),
        coco.read((foreign.write_json(folder / "signs.json", foreign.coco()),), asked),
        tusimple.read((foreign.write_tusimple(folder / "lanes.json"),), asked),
    ]


def test_a_data_set_holds_what_its_sources_say(tmp_path: Path):
    drive = compose(parts_of(tmp_path), SAID, rig=foreign.write_rig(tmp_path / "car"))
    write_new(tmp_path / "DATA", drive)
    dataset = load_dataset(tmp_path / "DATA", strict=True)
    (journey,) = dataset.journeys
    assert dataset.origin == ORIGIN
    assert (journey.journey_id, journey.rig.rig_id) == ("drive", "car")
    assert journey.frame_number.tolist() == list(range(foreign.FRAMES))
    assert journey.t_ns.tolist() == [100_000_000_000 + k * 10**8 for k in range(foreign.FRAMES)]
    np.testing.assert_allclose(journey.T_world_camera, foreign.camera_poses(), atol=1e-9)
    assert journey.signs.frame.tolist() == [2, 3]
    assert journey.signs.shape.tolist() == [polygon.OCTAGON, polygon.INVERTED_TRIANGLE]
    # A box counts from the corner of the first pixel, keypoints from its centre.
    stop, give_way = journey.signs.corners_px.numpy()
    np.testing.assert_allclose((stop.min(0), stop.max(0)), ((100, 200), (130, 240)), atol=1e-4)
    np.testing.assert_allclose(give_way[:3], ((320, 100), (310, 120), (300, 100)))
    types = [dataset.type_names[k] for k in journey.signs.type.tolist()]
    assert types == ["regulatory--stop--g1", "regulatory--yield--g1"]
    assert journey.signs.track.tolist() == [-1, 7]
    assert journey.signs.score[0] == 0.5 and journey.signs.score[1].isnan()
    assert journey.lanes.frame.tolist() == [0]
    assert journey.lane_points.px.tolist() == [[290.5, 440], [300, 420]]
    assert drive.notes == (
        "1 outlines are their shapes drawn into boxes",
        "1 lane markers left out: with less than two points",
    )


@pytest.mark.parametrize("world", axes.WORLDS)
@pytest.mark.parametrize("link", axes.LINKS)
def test_axes_that_are_said_give_the_same_poses(tmp_path: Path, world: str, link: str):
    camera_at = (1.0, -0.5, 0.25)
    T_enu_world = np.eye(4)
    T_enu_world[:3, :3] = axes.WORLDS[world]
    T_link_camera = axes.link_camera(link, camera_at)
    T = np.linalg.inv(T_enu_world) @ foreign.camera_poses() @ np.linalg.inv(T_link_camera)
    times = np.arange(foreign.FRAMES) * 10**8
    track = Track(tmp_path / "drive", times, T, world=None, link=None)
    asked = replace(SAID, world=world, link=link, camera_at=camera_at)
    drive = compose([Parts(track=track)], asked, rig=foreign.write_rig(tmp_path / "car"))
    np.testing.assert_allclose(drive.frames.track.T_world_link, foreign.camera_poses(), atol=1e-12)


def test_axes_turn_forward_where_they_should():
    # Forward, left and up of a body in the camera's right, down, forward.
    assert (axes.LINKS["flu"].T @ (1, 0, 0)).tolist() == [0, 0, 1]
    assert (axes.LINKS["flu"].T @ (0, 1, 0)).tolist() == [-1, 0, 0]
    assert (axes.LINKS["frd"].T @ (0, 1, 0)).tolist() == [1, 0, 0]
    assert (axes.LINKS["rub"].T @ (0, 1, 0)).tolist() == [0, -1, 0]
    assert (axes.WORLDS["ned"] @ (1, 0, 0)).tolist() == [0, 1, 0]
    assert (axes.WORLDS["rdf"] @ (0, 0, 1)).tolist() == [0, 1, 0]
    turns = np.stack([*axes.WORLDS.values(), *axes.LINKS.values()])
    assert np.linalg.det(turns) == pytest.approx(np.ones(len(turns)))


def test_poses_of_a_mounts_link_are_kept(tmp_path: Path):
    rig = foreign.write_rig(tmp_path / "car", mount=True)
    asked = replace(SAID, link="mount")
    write_new(tmp_path / "DATA", compose(parts_of(tmp_path, asked), asked, rig=rig))
    (journey,) = load_dataset(tmp_path / "DATA").journeys
    # The mount's camera is ahead of its link, along the link's x: here the world's x, east.
    place = journey.T_world_camera[0, :3, 3].tolist()
    np.testing.assert_allclose(place, np.add(foreign.north(0), (1, 0.5, 0)), atol=1e-9)


@pytest.mark.parametrize(
    ("changed", "expected"),
    [
        ({"world": None}, "give --world"),
        ({"link": None}, "give --axes"),
        ({"images": None}, "--images number"),
        ({"origin": None}, "give --origin"),
        ({"link": "flu"}, "--camera-at"),
        ({"link": "mount"}, "has no mount"),
    ],
)
def test_what_nobody_said_is_asked_for(tmp_path: Path, changed: dict, expected: str):
    asked = replace(SAID, **changed)
    with pytest.raises(InputError, match=expected):
        compose(parts_of(tmp_path, asked), asked, rig=foreign.write_rig(tmp_path / "car"))


def test_all_that_nobody_said_is_asked_for_at_once(tmp_path: Path):
    expected = r"drive\.txt: .* give --world .*, --axes .*, --images .*, --origin LAT LON HEIGHT"
    with pytest.raises(InputError, match=expected):
        compose(parts_of(tmp_path), Asked(), rig=foreign.write_rig(tmp_path / "car"))


def test_what_contradicts_is_refused(tmp_path: Path):
    rig = foreign.write_rig(tmp_path / "car")
    poses, signs, lanes = parts_of(tmp_path)
    assert poses.track is not None and signs.signs is not None
    with pytest.raises(InputError, match="no source gives the poses"):
        compose([signs, lanes], SAID, rig=rig)
    with pytest.raises(InputError, match="both give the poses"):
        compose([poses, poses], SAID, rig=rig)
    with pytest.raises(InputError, match="no source gives the rig"):
        compose([poses], SAID)
    fixed = replace(poses, track=replace(poses.track, world="rdf"))
    with pytest.raises(InputError, match=r"axes are rdf .*leave --world out"):
        compose([fixed], SAID, rig=rig)
    with pytest.raises(InputError, match="two origins"):
        compose([replace(poses, origin=Origin(1.0, 2.0, 3.0))], SAID, rig=rig)
    large = replace(signs, signs=replace(signs.signs, size_px=(1280, 960)))
    with pytest.raises(InputError, match="1280 x 960 px, the rig's camera has 640 x 480"):
        compose([poses, large], SAID, rig=rig)
    mounted = foreign.write_rig(tmp_path / "mounted", mount=True)
    with pytest.raises(InputError, match="expected --axes mount"):
        compose([poses], SAID, rig=mounted)


def test_what_breaks_the_format_leaves_nothing(tmp_path: Path):
    path = foreign.write_tum(tmp_path / "drive.txt", every_s=0.001)
    poses = tum.read((path,), SAID)
    assert poses.track is not None
    poses.track.T_world_link[3, 0, 3] = 5e5
    drive = compose([poses], SAID, rig=foreign.write_rig(tmp_path / "car"))
    expected = r"breaks FORMAT\.md: .*DATA/journeys/drive/poses\.parquet: row"
    with pytest.raises(InputError, match=expected):
        write_new(tmp_path / "DATA", drive)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["car", "drive.txt"]


def test_journeys_are_added_to_what_is_there(tmp_path: Path):
    rig = foreign.write_rig(tmp_path / "car")
    first = compose(parts_of(tmp_path), SAID, rig=rig, vehicle_id="one")
    write_new(tmp_path / "DATA", first)
    with pytest.raises(InputError, match="exists already; choose another folder, --add"):
        write_new(tmp_path / "DATA", first)
    with pytest.raises(InputError, match="give the journey another name"):
        add_to(tmp_path / "DATA", first)
    second = replace(first, journey_id="second", vehicle_id=None)
    with pytest.raises(InputError, match="its origin is"):
        add_to(tmp_path / "DATA", replace(second, origin=Origin(0.0, 0.0, 0.0)))
    other = foreign.write_rig(tmp_path / "other" / "car", mount=True)
    mounted = compose(
        parts_of(tmp_path), replace(SAID, link="mount"), rig=other, journey_id="third"
    )
    with pytest.raises(InputError, match="a rig of this name is another one"):
        add_to(tmp_path / "DATA", mounted)
    add_to(tmp_path / "DATA", second)
    folder = tmp_path / "DATA"
    assert sorted(path.name for path in folder.iterdir()) == ["dataset.json", "journeys", "rigs"]
    assert sorted(path.name for path in (folder / "journeys").iterdir()) == ["drive", "second"]


def survey_rows(folder: Path) -> SurveyRows:
    """A solid line, a sign with its corners and one whose centre alone is known."""
    corners = np.array([[0.0, 10, 3], [1, 10, 3], [1, 10, 2], [0, 10, 2]])
    return SurveyRows(
        source=folder / "map.osm",
        lane_id=("a",),
        lane_type=np.array([0]),
        lane_points=(np.array([[0.0, 0, 0], [0, 50, 0]]),),
        sign_id=("one", "two"),
        sign_shape=np.array([polygon.RECTANGLE, polygon.OCTAGON]),
        sign_code=("US:R2-1", None),
        sign_corners=(corners, np.array([[5.0, 5, 2]])),
    )


def test_a_survey_comes_with_the_first_journey_or_alone(tmp_path: Path):
    rig = foreign.write_rig(tmp_path / "car")
    survey = Parts(survey=survey_rows(tmp_path), origin=ORIGIN)
    drive = compose([*parts_of(tmp_path), survey], SAID, rig=rig)
    write_new(tmp_path / "DATA", drive)
    found = read_survey(tmp_path / "DATA" / "survey")
    assert (found.origin, found.lane_id, found.sign_id) == (ORIGIN, ("a",), ("one", "two"))
    assert found.signs.has_corners.tolist() == [True, False]
    assert found.signs.center_world[1].tolist() == [5, 5, 2]
    with pytest.raises(InputError, match="a data set has one survey"):
        add_to(tmp_path / "DATA", replace(drive, journey_id="second"))
    with pytest.raises(InputError, match="both give the survey"):
        compose([*parts_of(tmp_path), survey, survey], SAID, rig=rig)
    write_survey_alone(tmp_path / "SURVEY", [survey])
    assert read_survey(tmp_path / "SURVEY").sign_id == found.sign_id
    with pytest.raises(InputError, match="exists already"):
        write_survey_alone(tmp_path / "SURVEY", [survey])
    with pytest.raises(InputError, match=r"DATA is no map \(it has no map\.json\)"):
        write_survey_alone(tmp_path / "DATA", [survey], overwrite=True)


def test_a_survey_that_breaks_the_format_leaves_nothing(tmp_path: Path):
    rows = survey_rows(tmp_path)
    twice = replace(rows, sign_id=("one", "one"))
    with pytest.raises(
        InputError, match=r"map\.osm/signs\.parquet: row 1: .*'one' stands in row 0 too"
    ):
        write_survey_alone(tmp_path / "SURVEY", [Parts(survey=twice, origin=ORIGIN)])
    assert list(tmp_path.iterdir()) == []


def test_a_survey_can_be_added_to_journeys_without(tmp_path: Path):
    rig = foreign.write_rig(tmp_path / "car")
    write_new(tmp_path / "DATA", compose(parts_of(tmp_path), SAID, rig=rig))
    survey = Parts(survey=survey_rows(tmp_path), origin=ORIGIN)
    second = compose([*parts_of(tmp_path), survey], SAID, rig=rig, journey_id="second")
    add_to(tmp_path / "DATA", second)
    assert len(read_survey(tmp_path / "DATA" / "survey").lane_id) == 1


def test_what_is_no_data_set_is_left_alone(tmp_path: Path):
    drive = compose(parts_of(tmp_path), SAID, rig=foreign.write_rig(tmp_path / "car"))
    (tmp_path / "DATA").mkdir()
    (tmp_path / "DATA" / "photo.jpg").write_text("")
    with pytest.raises(InputError, match="is no dataset"):
        write_new(tmp_path / "DATA", drive, overwrite=True)
    assert (tmp_path / "DATA" / "photo.jpg").exists()
