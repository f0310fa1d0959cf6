from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path

import pytest
import torch
from worlds.drives import with_shuffled_rows

from crowdmap_torch.geometry import polygon
from crowdmap_torch.io.datasets import load_dataset, row_count
from crowdmap_torch.tables import Dataset


def test_detections_come_in_the_order_of_frames_with_their_rows(sound) -> None:
    signs = load_dataset(sound.write()).journeys[1].signs
    assert signs.row.tolist() == [1, 2, 0]
    assert signs.frame.tolist() == [0, 0, 2]
    assert [polygon.SHAPES[k] for k in signs.shape] == ["triangle", "octagon", "rectangle"]
    assert signs.track.tolist() == [-1, 8, 7]
    assert signs.score.isnan().tolist() == [True, False, False]


def test_detections_of_a_frame_come_in_one_order_however_the_rows_stood(
    tiny_folder: Path, tiny: Dataset, tmp_path: Path
) -> None:
    shuffled = load_dataset(with_shuffled_rows(tiny_folder, tmp_path / "dataset", seed=1))
    for one, other in zip(tiny.journeys, shuffled.journeys, strict=True):
        for name in ("signs", "lanes", "lane_points"):
            a, b = getattr(one, name), getattr(other, name)
            columns = {f.name for f in fields(a)}
            assert "row" not in columns or not torch.equal(a.row, b.row)
            for column in columns - {"row"}:
                assert torch.allclose(
                    getattr(a, column), getattr(b, column), rtol=0, atol=0, equal_nan=True
                ), f"{name}.{column}"


def test_slots_past_the_corners_repeat_the_last_corner(sound) -> None:
    triangle = load_dataset(sound.write()).journeys[1].signs.corners_px[0]
    assert triangle[:3].tolist() == [[80.0, 20.0], [90.0, 40.0], [70.0, 40.0]]
    assert (triangle[3:] == triangle[2]).all()


def test_ideal_coordinates_are_undistorted_pixels(sound) -> None:
    journey = load_dataset(sound.write()).journeys[1]
    expected = (journey.signs.corners_px - torch.tensor([59.5, 39.5])) / 100
    torch.testing.assert_close(journey.signs.corners_ideal, expected)
    expected = (journey.lane_points.px - torch.tensor([59.5, 39.5])) / 100
    torch.testing.assert_close(journey.lane_points.ideal, expected)


def test_lane_points_follow_their_detections(sound) -> None:
    journey = load_dataset(sound.write()).journeys[1]
    assert journey.lanes.row.tolist() == [1, 0]
    assert journey.lanes.type.tolist() == [-1, 0]
    assert journey.lane_points.detection.tolist() == [0, 0, 1, 1, 1]
    # From the bottom of the image up.
    assert journey.lane_points.px[2:].tolist() == [[20.0, 79.0], [40.0, 60.0], [60.0, 50.0]]


def quad(u: list[float], v: list[float]) -> Callable:
    def spoil(journey) -> None:
        for name, value in {"frame": 11, "shape": "rectangle", "u": u, "v": v}.items():
            journey.signs[name].append(value)
        for name in ("type", "score", "track"):
            journey.signs[name].append(None)

    return spoil


SIGN_FAULTS = {
    "anticlockwise": (quad([30, 30, 50, 50], [20, 30, 30, 20]), "sign: not clockwise"),
    "bow tie": (quad([30, 50, 34, 50], [20, 20, 40, 34]), "sign: crosses itself"),
    "a line": (quad([30, 40, 50, 45], [20, 25, 30, 27.5]), "sign: no area"),
    "a point": (quad([30] * 4, [20] * 4), "sign: no area"),
    "a corner twice": (quad([30, 50, 50, 50], [20, 20, 20, 30]), "sign: crosses itself"),
    "left of the image": (quad([-0.6, 20, 20, 0], [5, 5, 15, 15]), "sign: outside the image"),
    "right of the image": (quad([100, 119.6, 119, 100], [5, 5, 9, 9]), "sign: outside the image"),
    "below the image": (quad([1, 9, 9, 1], [70, 70, 79.6, 79]), "sign: outside the image"),
    "far outside": (quad([1e9, 2e9, 2e9, 1e9], [0, 0, 1e9, 1e9]), "sign: outside the image"),
}


@pytest.mark.parametrize("fault", SIGN_FAULTS)
def test_a_sign_of_faulty_geometry_is_dropped_and_counted(sound, fault) -> None:
    spoil, reason = SIGN_FAULTS[fault]
    spoil(sound.journeys["b"])
    dataset = load_dataset(sound.write())
    assert dataset.rejected == ()
    journey = dataset.journeys[1]
    assert journey.dropped == {reason: 1}
    assert journey.signs.row.tolist() == [1, 2, 0]
    assert row_count(journey, "sign") == 4


def test_the_image_reaches_half_a_pixel_beyond_the_outermost_centres(sound) -> None:
    quad([-0.5, 119.5, 119.5, -0.5], [-0.5, -0.5, 79.5, 79.5])(sound.journeys["b"])
    assert load_dataset(sound.write()).journeys[1].dropped == {}


FISHEYE = {
    "model": "kannala_brandt",
    "width": 400,
    "height": 400,
    "fx": 130.0,
    "fy": 130.0,
    "cx": 199.5,
    "cy": 199.5,
    "distortion": [0.0, 0.0, 0.0, 0.0],
}


def test_rays_85_degrees_or_more_off_the_axis_are_dropped(sound) -> None:
    # A fisheye without distortion terms: 130 px a radian; 84 degrees are 190.6 px, 86 are 195.1 px.
    sound.rigs["b"]["camera"] = dict(FISHEYE)
    journey = sound.journeys["b"]
    for columns in (journey.signs, journey.lanes):
        columns |= {name: [] for name in columns}
    for angle in (84, 86):
        edge = 199.5 + 130 * math.radians(angle)
        quad([edge - 20, edge, edge, edge - 20], [195, 199.5, 205, 205])(journey)
    loaded = load_dataset(sound.write()).journeys[1]
    assert loaded.signs.row.tolist() == [0]
    assert loaded.dropped == {"sign: 85 degrees or more off the axis": 1}


def test_corners_whose_undistortion_does_not_close_are_dropped(sound) -> None:
    # A barrel so strong that the image's corners lie beyond its fold: 7 % of the image.
    sound.rigs["b"]["camera"] |= {"distortion": [-0.32, 0.0, 0.0, 0.0]}
    quad([0, 4, 4, 0], [0, 0, 4, 4])(sound.journeys["b"])
    journey = load_dataset(sound.write()).journeys[1]
    assert journey.dropped == {"sign: undistortion does not close": 1}


def test_lane_points_outside_the_image_are_left_out(sound) -> None:
    sound.journeys["b"].lanes["u"][0][1] = 200.0
    journey = load_dataset(sound.write()).journeys[1]
    assert journey.dropped == {"lane point: outside the image": 1}
    assert journey.lane_points.px[:, 0].tolist() == [90.0, 70.0, 20.0, 60.0]
    assert row_count(journey, "lane") == 2


def test_a_lane_with_less_than_two_points_left_is_dropped(sound) -> None:
    sound.journeys["b"].lanes["u"][0][1:] = [200.0, -3.0]
    journey = load_dataset(sound.write()).journeys[1]
    assert journey.dropped == {
        "lane: fewer than two usable points": 1,
        "lane point: outside the image": 2,
    }
    assert journey.lanes.row.tolist() == [1]
    assert journey.lane_points.detection.tolist() == [0, 0]
    assert row_count(journey, "lane") == 2


def test_a_lane_without_length_is_dropped(sound) -> None:
    sound.journeys["b"].lanes |= {"u": [[60.0] * 3, [70.0, 90.0]], "v": [[50.0] * 3, [50.0, 75.0]]}
    journey = load_dataset(sound.write()).journeys[1]
    assert journey.dropped == {"lane: no length": 1}
    assert journey.lanes.row.tolist() == [1]
