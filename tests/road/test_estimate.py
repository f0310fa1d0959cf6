from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from worlds.road_drives import (
    EXACT,
    SimulatedDrives,
    angle_deg,
    blind_journey,
    frames_of,
    in_other_order,
    poses_on_plane,
    simulate,
)

from crowdmap_torch.geometry import se3
from crowdmap_torch.noise.positioning import PositioningNoise
from crowdmap_torch.road.coplanarity import CoplanarityConfig
from crowdmap_torch.road.estimate import METHODS, RoadConfig, RoadTracker, estimate_road
from crowdmap_torch.road.measurements import MeasurementConfig
from crowdmap_torch.simulate.vehicle import VehicleConfig

F64 = torch.float64


@pytest.fixture(scope="module")
def hills(tmp_path_factory) -> SimulatedDrives:
    return simulate(tmp_path_factory.mktemp("road") / "hills", "hills", length_m=350.0, journeys=2)


@pytest.fixture(scope="module")
def suburb(tmp_path_factory) -> SimulatedDrives:
    return simulate(tmp_path_factory.mktemp("road") / "suburb", "suburb", length_m=350.0, seed=3)


FIRM = MeasurementConfig(softer_from=1e3)
"""No drive shows springs so soft."""


def mean_error_deg(
    drives: SimulatedDrives, method: str, measurements: MeasurementConfig | None = None
) -> float:
    config = RoadConfig(method=method, measurements=measurements or MeasurementConfig())
    errors = []
    for truth in drives.truths:
        road = estimate_road(truth.journey, PositioningNoise(), config)
        errors.append(angle_deg(road.normal_camera, truth.road_normal_camera))
    return torch.cat(errors).mean().item()


@pytest.mark.parametrize("world", ["hills", "suburb"])
def test_normal_under_load_on_curved_roads(world: str, request: pytest.FixtureRequest) -> None:
    drives = request.getfixturevalue(world)
    calibrated = mean_error_deg(drives, "calibration")
    # Over long drives it is 0.15 degrees; 350 m leave the roll less time.
    assert mean_error_deg(drives, "smoothed") < min(0.2, calibrated / 2)
    assert mean_error_deg(drives, "causal") < min(0.3, calibrated / 1.5)


@pytest.mark.parametrize(("world", "seed"), [("block", 0), ("block", 2), ("suburb", 1)])
def test_cars_that_nod_as_they_brake_are_followed(tmp_path, world: str, seed: int) -> None:
    nodding = VehicleConfig(squat_deg=1.5)
    drives = simulate(tmp_path / world, world, length_m=350.0, seed=seed, vehicle=nodding)
    # Trusted like others, a part of what braking does is taken for a slope of the road.
    assert mean_error_deg(drives, "smoothed", FIRM) > 0.3
    assert mean_error_deg(drives, "smoothed") < 0.2
    test_sigma_says_how_wrong_the_normal_is(drives)


def test_springs_as_usual_are_trusted_as_usual(hills: SimulatedDrives, suburb: SimulatedDrives):
    for truth in (*hills.truths, *suburb.truths):
        found, firm = (
            estimate_road(truth.journey, PositioningNoise(), RoadConfig(measurements=how))
            for how in (MeasurementConfig(), FIRM)
        )
        assert torch.equal(found.normal_camera, firm.normal_camera)


def test_sigma_says_how_wrong_the_normal_is(hills: SimulatedDrives) -> None:
    for truth in hills.truths:
        road = estimate_road(truth.journey, PositioningNoise(), RoadConfig())
        off = torch.deg2rad(angle_deg(road.normal_camera, truth.road_normal_camera))
        # A whole drive shares one roll: one draw of chi squared with few degrees of freedom.
        assert 0.1 < (off / road.sigma).square().mean() < 5


def test_normals_are_unit_vectors_towards_the_road(suburb: SimulatedDrives) -> None:
    journey = suburb.truths[0].journey
    for method in METHODS:
        road = estimate_road(journey, PositioningNoise(), RoadConfig(method=method))
        assert len(road) == journey.frame_count
        ones = torch.ones(len(road), dtype=F64)
        torch.testing.assert_close(road.normal_camera.norm(dim=-1), ones)
        assert bool((road.normal_camera[:, 1] > 0.9).all())
        assert bool((road.height == journey.rig.camera_height).all())
        assert bool((road.sigma > 0).all() and road.sigma.isfinite().all())


@pytest.mark.parametrize("method", ["causal", "paper2017"])
@pytest.mark.parametrize("size", [1, 37])
def test_streaming_gives_what_the_batch_gives(
    suburb: SimulatedDrives, method: str, size: int
) -> None:
    journey = frames_of(suburb.truths[0].journey, 0, 120 if size == 1 else 400)
    config = RoadConfig(
        method=method, coplanarity=CoplanarityConfig(min_segments=1, segment_m=10.0, update_m=15.0)
    )
    whole = estimate_road(journey, PositioningNoise(), config)
    tracker = RoadTracker(journey.rig, PositioningNoise(), config)
    parts = [
        tracker.advance(frames_of(journey, k, min(k + size, journey.frame_count)))
        for k in range(0, journey.frame_count, size)
    ]
    # Sums in another order: rounding, and what a minimum makes of it.
    normal = torch.cat([p.normal_camera for p in parts])
    torch.testing.assert_close(normal, whole.normal_camera, atol=1e-6, rtol=0)
    sigma = torch.cat([p.sigma for p in parts])
    torch.testing.assert_close(sigma, whole.sigma, atol=1e-6, rtol=1e-3)


@pytest.mark.parametrize("method", ["causal", "paper2017"])
def test_the_future_changes_nothing(suburb: SimulatedDrives, method: str) -> None:
    journey = suburb.truths[0].journey
    config = RoadConfig(method=method)
    whole = estimate_road(journey, PositioningNoise(), config).normal_camera
    start = estimate_road(frames_of(journey, 0, 300), PositioningNoise(), config).normal_camera
    torch.testing.assert_close(start, whole[:300], atol=1e-9, rtol=0)


def test_paper_keeps_calibration_where_the_solution_is_far_from_it() -> None:
    station = torch.arange(500, dtype=F64) * 0.8
    poses = poses_on_plane(0.8 * torch.sin(station / 20), 0.8, pitch=0.10)
    road = estimate_road(blind_journey(poses), PositioningNoise(), RoadConfig(method="paper2017"))
    calibrated = torch.tensor([0.0, 1.0, 0.0], dtype=F64).expand(len(road), 3)
    torch.testing.assert_close(road.normal_camera, calibrated)


@pytest.mark.parametrize("method", ["smoothed", "causal"])
def test_without_markers_the_way_gives_the_pitch_and_calibration_the_roll(method: str) -> None:
    poses = poses_on_plane(torch.zeros(1500, dtype=F64), 0.8, pitch=0.02)
    road = estimate_road(blind_journey(poses), PositioningNoise(), RoadConfig(method=method))
    true = torch.nn.functional.normalize(torch.tensor([0.0, 1.0, 0.02], dtype=F64), dim=-1)
    # Exact poses; the filter expects positions that drift and leans on calibration accordingly.
    assert angle_deg(road.normal_camera[-1:], true[None]).item() < 0.12
    assert road.sigma[-1] < road.sigma[0] or method == "smoothed"


@pytest.mark.parametrize("method", METHODS)
def test_standing_turning_on_the_spot_and_reversing_cause_no_harm(method: str) -> None:
    generator = torch.Generator().manual_seed(3)
    still = torch.zeros(300, dtype=F64)
    spin = torch.linspace(0, 6, 200, dtype=F64)
    heading = torch.cat((still, spin, spin[-1:].expand(300)))
    step = torch.cat((still, torch.zeros(200, dtype=F64), torch.full((300,), -0.5, dtype=F64)))
    poses = poses_on_plane(heading, step)
    noise = torch.randn(len(poses), 6, dtype=F64, generator=generator)
    noise = noise * torch.tensor([0.02] * 3 + [4e-4] * 3, dtype=F64)
    road = estimate_road(
        blind_journey(se3.retract(poses, noise)), PositioningNoise(), RoadConfig(method=method)
    )
    down = torch.tensor([0.0, 1.0, 0.0], dtype=F64).expand(len(road), 3)
    assert angle_deg(road.normal_camera, down).max() < 0.6


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("frames", [0, 1, 2])
def test_few_frames_give_the_calibration(method: str, frames: int) -> None:
    poses = poses_on_plane(torch.zeros(frames, dtype=F64), 0.8)
    road = estimate_road(
        blind_journey(poses, normal=(0.0, 1.0, 0.02)), PositioningNoise(), RoadConfig(method=method)
    )
    assert len(road) == frames
    normal = torch.tensor([0.0, 1.0, 0.02], dtype=F64).expand(frames, 3)
    assert bool(
        (angle_deg(road.normal_camera, normal / normal.norm(dim=-1, keepdim=True)) < 0.2).all()
    )


def test_a_gap_in_the_frames_is_survived(suburb: SimulatedDrives) -> None:
    truth = suburb.truths[0]
    keep = torch.cat((torch.arange(200), torch.arange(230, truth.journey.frame_count)))
    front, back = (
        frames_of(truth.journey, 0, 200),
        frames_of(truth.journey, 230, truth.journey.frame_count),
    )
    journey = replace(
        front,
        frame_number=torch.cat((front.frame_number, back.frame_number)),
        t_ns=torch.cat((front.t_ns, back.t_ns)),
        T_world_camera=torch.cat((front.T_world_camera, back.T_world_camera)),
    )
    road = estimate_road(journey, PositioningNoise(), RoadConfig(method="smoothed"))
    # The second part has no markers here: it lives on what the first one showed.
    assert angle_deg(road.normal_camera, truth.road_normal_camera[keep]).mean() < 0.4


def test_the_normal_does_not_depend_on_where_the_world_is(suburb: SimulatedDrives) -> None:
    journey = suburb.truths[0].journey
    turn = torch.tensor([0.0, 0.0, 0.0, 0.0, 0.0, 2.0], dtype=F64)
    T_there_world = se3.exp(turn + torch.tensor([500.0, -300.0, 40.0, 0, 0, 0], dtype=F64))
    moved = replace(journey, T_world_camera=T_there_world @ journey.T_world_camera)
    for method in ("smoothed", "causal", "paper2017"):
        here = estimate_road(journey, PositioningNoise(), RoadConfig(method=method)).normal_camera
        there = estimate_road(moved, PositioningNoise(), RoadConfig(method=method)).normal_camera
        torch.testing.assert_close(there, here, atol=1e-7, rtol=0)


def test_order_of_detections_does_not_matter(suburb: SimulatedDrives, generator) -> None:
    journey = frames_of(suburb.truths[0].journey, 0, 150)
    shuffled = in_other_order(journey, torch.randperm(len(journey.lanes), generator=generator))
    here = estimate_road(journey, PositioningNoise(), RoadConfig()).normal_camera
    there = estimate_road(shuffled, PositioningNoise(), RoadConfig()).normal_camera
    torch.testing.assert_close(there, here, atol=1e-9, rtol=0)


def test_perfect_poses_leave_little_error(tmp_path) -> None:
    car = VehicleConfig(load_deg=1.5, load_roll_deg=0.0)
    drives = simulate(tmp_path / "exact", "highway", length_m=400.0, positioning=EXACT, vehicle=car)
    assert mean_error_deg(drives, "smoothed") < 0.12


def test_unknown_choices_are_refused() -> None:
    with pytest.raises(ValueError, match="method: expected one of smoothed"):
        RoadConfig(method="guess")
