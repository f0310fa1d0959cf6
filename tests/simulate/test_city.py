from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch

from crowdmap_torch.geometry.camera import unproject
from crowdmap_torch.io.datasets import load_dataset
from crowdmap_torch.io.maps import read_map
from crowdmap_torch.simulate import sign_detections
from crowdmap_torch.simulate.dataset import (
    SimulatedJourney,
    SimulationConfig,
    make_fleet,
    make_journey,
    make_world,
    write_dataset,
)
from crowdmap_torch.simulate.lane_perception import DAY, detect_lanes
from crowdmap_torch.simulate.roads import SPACING_M
from crowdmap_torch.simulate.routes import random_corners
from crowdmap_torch.simulate.sign_perception import detect_signs
from crowdmap_torch.simulate.street_grid import CityConfig
from crowdmap_torch.simulate.vehicle import VehicleConfig
from crowdmap_torch.simulate.worlds import CITY, World

SMALL = SimulationConfig(
    world=replace(
        CITY, length_m=600.0, city=replace(CITY.city, square_m=600.0, street_every_m=200.0)
    ),
    journeys=3,
    seed=4,
)
PERFECT = replace(
    DAY,
    lane_noise_px=0.0,
    missed_lanes=0.0,
    lane_occlusions_per_km=0.0,
    lane_point_outliers=0.0,
    merged_lanes=0.0,
    false_lanes=0.0,
)


@pytest.fixture(scope="module")
def city() -> World:
    return make_world(SMALL)


@pytest.fixture(scope="module")
def journeys(city: World) -> list[SimulatedJourney]:
    fleet = make_fleet(SMALL)
    return [make_journey(SMALL, city, fleet, index) for index in range(6)]


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("city") / "data"
    write_dataset(SMALL, out)
    return out


def _heading(journey: SimulatedJourney) -> np.ndarray:
    ahead = journey.drive.R_world_camera[:, :2, 2]
    return np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))


def test_streets_of_one_city_meet_on_one_ground(city: World):
    grid = city.streets
    assert grid is not None and len(grid.way) == 2 * 4 * 3
    ends: dict[tuple[int, int], list[np.ndarray]] = {}
    for (a, b), way in grid.way.items():
        step = np.linalg.norm(np.diff(way, axis=0), axis=1)
        np.testing.assert_allclose(step, SPACING_M, rtol=1e-3)
        ends.setdefault(a, []).append(way[0])
        ends.setdefault(b, []).append(way[-1])
    for met in ends.values():
        assert len(met) >= 2 and np.ptp(met, axis=0).max() < 2 * SPACING_M
    np.testing.assert_allclose(
        city.markers.point[:, 2], grid.height(city.markers.point[:, :2]), atol=1e-9
    )
    slope = np.linalg.norm(grid.slope(city.markers.point[:, :2]), axis=-1)
    assert 0.2 * CITY.road.grade < slope.max() <= CITY.road.grade


def test_ids_are_given_once_and_markers_end_before_crossings(city: World):
    assert len(set(city.markers.lane_id)) == len(city.markers)
    assert len(set(city.signs.sign_id)) == len(city.signs)
    assert city.markers.length().max() < 300.0
    grid = city.streets
    assert grid is not None
    for (a, _), way in grid.way.items():
        away = np.linalg.norm(city.markers.point[:, :2] - way[0], axis=-1)
        assert away.min() > grid.lane_width, a


def test_drives_stay_in_a_lane_on_the_right_and_turn_to_both_sides(
    city: World, journeys: list[SimulatedJourney]
):
    turned = []
    middle = [k for k, kind in enumerate(city.markers.type) if kind == "double"]
    for journey in journeys:
        drive = journey.drive
        turned.append(np.diff(_heading(journey)[[0, -1]]))
        assert drive.distance[-1] == pytest.approx(600.0, abs=15.0)
        p = drive.p_world_camera[:, :2]
        ahead = drive.R_world_camera[:, :2, 2]
        for marker in middle:
            line = city.markers.points_of(marker)[:, :2]
            along = (line[-1] - line[0]) / np.linalg.norm(line[-1] - line[0])
            away = p[:, None] - line[None]
            near = np.linalg.norm(away, axis=-1).argmin(1)
            inside = (near > 0) & (near < len(line) - 1) & (np.abs(ahead @ along) > 0.95)
            foot = away[np.arange(len(p)), near]
            left = along[0] * foot[:, 1] - along[1] * foot[:, 0]
            left = left * np.sign(ahead @ along)
            on_it = inside & (np.abs(left) < 8.0)
            assert (left[on_it] < -0.5).all(), "the line in the middle is on the driver's left"
    assert np.max(turned) > 1.0 and np.min(turned) < -1.0


def test_all_streets_are_driven_alike(city: World):
    grid = city.streets
    assert grid is not None
    count = dict.fromkeys(grid.way, 0)
    rng = np.random.default_rng(0)
    for _ in range(300):
        for a, b in pairwise(random_corners(grid, 3000.0, rng)):
            count[min(a, b), max(a, b)] += 1
    often = np.array(list(count.values()))
    # About 200 visits each: by chance 7 % at 1 sigma, and more as one visit leads to another.
    assert often.min() > 0.7 * often.mean() and often.max() < 1.4 * often.mean()


def test_cars_slow_down_where_they_turn(journeys: list[SimulatedJourney]):
    speeds, rates = [], []
    for journey in journeys:
        drive = journey.drive
        yaw = np.abs(np.gradient(_heading(journey), drive.t))
        smooth = np.convolve(yaw, np.ones(9) / 9, mode="same")
        speeds.append(drive.speed[9:-9])
        rates.append(smooth[9:-9])
    speed, rate = np.concatenate(speeds), np.concatenate(rates)
    in_turn = rate > 0.35
    assert in_turn.sum() > 50
    assert speed[in_turn].max() < 7.5 < np.quantile(speed, 0.6)
    # What drivers bear, and what vibration adds to a heading.
    assert (speed * rate)[in_turn].max() < 1.5 * VehicleConfig().lateral_acceleration


def test_a_drive_does_not_depend_on_how_many_there_are_and_differs_from_others(
    city: World, journeys: list[SimulatedJourney]
):
    again = make_journey(replace(SMALL, journeys=50), city, make_fleet(SMALL), 2)
    np.testing.assert_array_equal(again.T_reported, journeys[2].T_reported)
    np.testing.assert_array_equal(again.lanes.px, journeys[2].lanes.px)
    starts = np.array([journey.drive.p_world_camera[0] for journey in journeys])
    apart = np.linalg.norm(starts[:, None] - starts[None], axis=-1) + 1e9 * np.eye(len(starts))
    assert apart.min() > 5.0


def test_points_of_lane_detections_lie_on_their_markers_in_turns_too(
    city: World, journeys: list[SimulatedJourney]
):
    for journey in journeys:
        drive, rig = journey.drive, journey.vehicle.true_rig
        rows = detect_lanes(
            city, drive, rig.camera, PERFECT, np.random.default_rng(0), frame_rate_hz=15.0
        )
        assert np.unique(rows.frame).size > 0.85 * len(drive)
        assert np.bincount(rows.frame).max() <= PERFECT.max_lanes
        first = np.cumsum(rows.count) - rows.count
        for row in range(0, len(rows), 97):
            point = city.markers.points_of(int(rows.marker[row]))
            p = (point - drive.p_world_camera[rows.frame[row]]) @ drive.R_world_camera[
                rows.frame[row]
            ]
            p = p[(p[:, 2] > 1.0) & (p[:, 2] < 70.0)]
            fine = np.concatenate([p[:-1] + u * np.diff(p, axis=0) for u in np.linspace(0, 1, 60)])
            seen = rows.px[first[row] : first[row] + rows.count[row]]
            ray = np.concatenate((_ideal(rig.camera, seen), np.ones((len(seen), 1))), axis=1)
            image = fine[:, :2] / fine[:, 2:]
            off = np.linalg.norm(ray[:, None, :2] - image[None], axis=-1).min(1)
            assert off.max() * float(rig.camera.K[0, 0]) < 2.0


def _ideal(camera, px: np.ndarray) -> np.ndarray:

    return unproject(camera, torch.from_numpy(px))[0].numpy()


def test_houses_hide_signs_of_other_streets(city: World, journeys: list[SimulatedJourney]):
    grid = city.streets
    assert grid is not None
    config = replace(sign_detections.DAY, ghosts_per_frame=0.0, ghost_runs_per_frame=0.0)
    hidden = 0
    for journey in journeys[:3]:
        kept, all_ = (
            detect_signs(
                city.signs,
                journey.drive,
                journey.vehicle.true_rig.camera,
                config,
                np.random.default_rng(0),
                frame_rate_hz=15.0,
                streets=streets,
            )
            for streets in (grid, None)
        )
        hidden += len(all_) - len(kept)
        shown = kept.sign >= 0
        eye = journey.drive.p_world_camera[kept.frame[shown], :2]
        assert grid.sees(eye, city.signs.center[kept.sign[shown], :2]).all()
    assert hidden > 0
    way = grid.way[(0, 0), (1, 0)]
    assert grid.sees(way[:1], way[-1:]).all()
    block = (way[len(way) // 2] + grid.way[(0, 1), (1, 1)][len(way) // 2]) / 2
    assert not grid.sees(way[:1], block[None]).any()


def test_a_city_is_written_and_read_like_any_world(city: World, data: Path):
    loaded = load_dataset(data)
    assert [len(journey.t_ns) > 300 for journey in loaded.journeys] == [True] * 3
    survey = read_map(data / "survey")
    assert len(survey.sign_id) == len(city.signs) and len(survey.lane_id) == len(city.markers)


def test_fleets_errors_and_bad_drives_are_possible_in_a_city(city: World):
    config = replace(
        SMALL,
        fleet=replace(SMALL.fleet, vehicles=2, read_out_s=0.02, lane_error_m=0.03),
        positioning=replace(SMALL.positioning, bias_wander_m=1.0, outages=1.0),
    )
    for fault in ("jump", "wrong-calibration", "moved-signs"):
        journey = make_journey(config, city, make_fleet(config), 1, fault)
        assert len(journey.signs) > 50 and len(journey.lanes) > 200


@pytest.mark.parametrize(
    ("changes", "rule"),
    [
        ({"square_m": 100.0}, "square_m: expected 0 .one road. or street_every_m .250."),
        ({"square_m": 2e4}, "square_m: expected"),
        ({"square_m": 600.0, "street_shift_m": 100.0}, "may come as near as 38 m"),
    ],
)
def test_a_city_without_room_for_its_blocks_is_refused(changes: dict[str, float], rule: str):
    with pytest.raises(ValueError, match=rule):
        CityConfig(**changes)
