"""Drives that take the way of recorded ones once more, for simulated detectors."""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree

from crowdmap_torch.simulate.recordings import Recording
from crowdmap_torch.simulate.rigs import SimulatedRig
from crowdmap_torch.simulate.roads import SPACING_M, Road
from crowdmap_torch.simulate.vehicle import Drive, VehicleConfig


def drive_again(
    recording: Recording,
    stated: SimulatedRig,
    true: SimulatedRig,
    road: Road,
    config: VehicleConfig,
    rng: np.random.Generator,
) -> Drive:
    """A drive with a recording's own poses: those nearest to the frames of a camera that begins at a random moment.

    The recorded poses are those of the stated rig; the true one sits where its errors put it.
    """
    rate = config.frame_rate_hz
    moments = np.arange(rng.uniform(0, 1 / rate), recording.t[-1], 1 / rate)
    after = np.searchsorted(recording.t, moments).clip(1, len(recording.t) - 1)
    is_before = moments - recording.t[after - 1] < recording.t[after] - moments
    row = np.unique(after - is_before)
    row = row[rng.random(len(row)) >= config.frame_loss]
    T = recording.T_world_camera[row] @ np.linalg.inv(stated.T_link_camera) @ true.T_link_camera
    p, R = T[:, :3, 3], T[:, :3, :3]
    t = recording.t[row] - recording.t[row[0]]
    station = np.asarray(KDTree(road.centre).query(recording.way_m()[row])[1]) * SPACING_M
    up = road.tangent_frame(station, np.zeros(len(station)))[:, :, 2]
    steps = np.linalg.norm(np.diff(p, axis=0), axis=-1)
    distance = np.concatenate(([0.0], np.cumsum(steps)))
    return Drive(
        frame=np.rint(t * rate).astype(np.int64),
        t=t,
        direction=1,
        station=station,
        offset=np.zeros(len(row)),
        distance=distance,
        speed=np.gradient(distance, t),
        p_world_camera=p,
        R_world_camera=R,
        road_normal_camera=-(R.transpose(0, 2, 1) @ up[..., None])[..., 0],
        camera_height=np.full(len(row), true.camera_height),
    )
