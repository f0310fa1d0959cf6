from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from crowdmap_torch.io.datasets import load_dataset
from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.formats.composing.compose import compose, write_new
from crowdmap_torch.io.formats.composing.parts import Asked
from crowdmap_torch.io.formats.geodesy import R_ecef_local, ecef_from_local, local_from_geodetic
from crowdmap_torch.io.formats.importers import comma2k19
from crowdmap_torch.tables import Origin


def write_segment(folder: Path, *, speed: float = 10.0) -> Path:
    """A car that drives north on a level road; its device looks two hundredths of a radian down."""
    origin = Origin(37.0, -122.0, 30.0)
    seconds = np.arange(20) * 0.05
    position = np.stack((0 * seconds, speed * seconds, 0 * seconds), axis=-1)
    # Forward, right and down of a level device that looks north; then its nose goes down.
    R_enu_device = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
    cos, sin = np.cos(-0.02), np.sin(-0.02)
    R = R_ecef_local(origin) @ R_enu_device @ [[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]]
    w = np.sqrt(1 + np.trace(R)) / 2
    xyz = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) / (4 * w)
    arrays = {
        "frame_positions": ecef_from_local(position, origin),
        "frame_orientations": np.tile([w, *xyz], (len(seconds), 1)),
        "frame_gps_times": np.stack((np.full(20, 2012.0), 404106.0 + seconds), axis=-1),
    }
    (folder / "global_pose").mkdir(parents=True)
    for name, values in arrays.items():
        with (folder / "global_pose" / name).open("wb") as file:
            np.save(file, values)
    return folder


def test_the_road_lies_along_the_way(tmp_path: Path):
    asked = Asked(camera_height=1.2)
    parts = comma2k19.read((write_segment(tmp_path / "segment"),), asked)
    write_new(tmp_path / "DATA", compose([parts], asked))
    (journey,) = load_dataset(tmp_path / "DATA").journeys
    # Its nose is down, so the road's normal leans forward in its camera.
    expected = (0, np.cos(0.02), np.sin(0.02))
    np.testing.assert_allclose(journey.rig.road_normal_camera, expected, atol=1e-6)
    np.testing.assert_allclose(journey.T_world_camera[-1, :3, 3], (0, 9.5, 0), atol=1e-4)
    assert journey.T_world_camera[0, 2, 2] == pytest.approx(-np.sin(0.02), abs=1e-6)
    # GPS week 2012 began on 29 July 2018; UTC is 18 seconds behind.
    assert journey.t_ns[0] == 1_532_822_400_000_000_000 + 404_106 * 10**9 - 18 * 10**9


def test_a_real_segment_agrees_with_its_own_velocities_and_fixes(
    real_data: Callable[[str], Path], tmp_path: Path
):
    folder = real_data("comma2k19/example_1")
    asked = Asked(camera_height=1.22)
    write_new(tmp_path / "DATA", compose([comma2k19.read((folder,), asked)], asked))
    dataset = load_dataset(tmp_path / "DATA")
    (journey,) = dataset.journeys
    T, seconds = journey.T_world_camera.numpy(), (journey.t_ns - journey.t_ns[0]).numpy() * 1e-9
    velocity = np.gradient(T[:, :3, 3], seconds, axis=0)
    speed = np.linalg.norm(velocity, axis=1)
    own = np.linalg.norm(np.load(folder / "global_pose" / "frame_velocities"), axis=1)
    assert np.abs(speed - own).mean() < 0.01
    # The camera looks where the car goes, but for its mount: some degrees.
    angle = np.degrees(np.arccos((T[:, :3, 2] * velocity).sum(-1) / speed))
    assert angle.mean() < 6
    # Its road is level across and along.
    normal = (T[:, :3, :3] @ journey.rig.road_normal_camera.numpy()).mean(0)
    np.testing.assert_allclose(normal, (0, 0, -1), atol=0.03)
    # The consumer receiver of the same drive: its own clock, and places some metres off.
    fix = np.load(folder / "GNSS" / "live_gnss_ublox" / "value")
    t_fix = np.load(folder / "GNSS" / "live_gnss_ublox" / "t")
    boot = np.load(folder / "global_pose" / "frame_times")
    inside = (t_fix > boot[0]) & (t_fix < boot[-1])
    at = np.interp(t_fix[inside], boot, journey.t_ns.numpy() * 1e-9)
    assert np.abs(fix[inside, 3] * 1e-3 - at).max() < 0.5
    place = local_from_geodetic(fix[inside, :3], dataset.origin)
    ours = np.stack([np.interp(t_fix[inside], boot, T[:, k, 3]) for k in range(2)], axis=-1)
    assert np.linalg.norm(place[:, :2] - ours, axis=1).max() < 5


@pytest.mark.parametrize(
    ("name", "values", "expected"),
    [
        ("frame_positions", np.zeros((20, 2)), r"expected float rows of 3"),
        ("frame_positions", np.full((20, 3), np.nan), "row 0 is not finite"),
        ("frame_positions", np.ones((3, 3)), "3 positions, 20 orientations and 20 times"),
        ("frame_orientations", np.ones((20, 4)), "row 0 has length 2"),
        ("frame_gps_times", np.ones((20, 2)), "row 1: its time is not after"),
        ("frame_positions", None, "cannot be read as a NumPy array"),
    ],
)
def test_a_segment_with_a_mistake_is_refused(tmp_path: Path, name: str, values, expected: str):
    folder = write_segment(tmp_path)
    with (folder / "global_pose" / name).open("wb") as file:
        if values is not None:
            np.save(file, values)
    with pytest.raises(InputError, match=expected):
        comma2k19.read((folder,), Asked())


def test_a_car_that_stands_does_not_show_its_road(tmp_path: Path):
    with pytest.raises(InputError, match="never drives faster than 3 m/s"):
        comma2k19.read((write_segment(tmp_path, speed=1.0),), Asked())
