"""IV-C: the road normal in the camera frame, frame by frame, from poses and lane markers.

`paper2017` is the paper's online adjustment: the normal that makes segments of the road planar
(eq:rne). It knows the road by the car's movement alone, and positions that drift by centimetres a
metre leave it a third of a degree unsure. Unlike the paper, `causal` and `smoothed` also see the
vanishing point of the lane markers, the slope of the way, the widths of neighbouring lanes and the
calibration, each with its own uncertainty, and follow the shaking of the springs in the measured
rotations.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.noise.positioning import PositioningNoise
from crowdmap_torch.ranges import Degrees, RoundsOrNone, Settings
from crowdmap_torch.road.coplanarity import (
    CoplanarityConfig,
    NormalUpdates,
    PoseNodes,
    coplanar_normals,
    pick_nodes,
)
from crowdmap_torch.road.ego_motion import EgoMotion, motion_of_poses, normal_camera, road_frame
from crowdmap_torch.road.kalman import (
    CROSS,
    GROWTH,
    SLOPE,
    KalmanConfig,
    RoadState,
    filter_forward,
    first_state,
    smooth_backward,
)
from crowdmap_torch.road.measurements import (
    MeasurementConfig,
    MeasurementState,
    first_measurement_state,
    lane_rays,
    softer_springs,
    take_measurements,
    width_moments,
)
from crowdmap_torch.road.surface import flattened_rays, lay_surface
from crowdmap_torch.road.vanishing_point import LaneRays, VanishingFit, fit_vanishing
from crowdmap_torch.tables import Journey, Rig, RoadEstimate, concatenate

_LOOKS = 5
"""What a drive shows of its springs is known after two or three."""
_NODS = 3.0
"""Springs hardly go further than so many of their sigmas."""
METHODS = ("smoothed", "causal", "paper2017", "calibration")


@dataclass(frozen=True)
class RoadConfig(Settings):
    """How the road normal is followed during a drive (IV-C)."""

    method: str = "smoothed"
    """`smoothed`: all measurements, all frames; `causal`: past frames only; `paper2017`: eq:rne on past frames;
    `calibration`: no adjustment."""
    max_adjustment_deg: Degrees = 3.0
    """Normals further from calibration than this are not admitted; of a car that nods further than others (`softer_from`)
    by as much further."""
    refinements: RoundsOrNone = 1
    """How often the markers are looked at again on the curved road found so far; method
    `smoothed`."""
    coplanarity: CoplanarityConfig = field(default_factory=CoplanarityConfig)
    """Method `paper2017`."""
    measurements: MeasurementConfig = field(default_factory=MeasurementConfig)
    """How far measurements are trusted; methods `smoothed` and `causal`."""
    kalman: KalmanConfig = field(default_factory=KalmanConfig)
    """How roads and cars behave; methods `smoothed` and `causal`."""

    def __post_init__(self) -> None:
        """Refuses unknown methods."""
        super().__post_init__()
        if self.method not in METHODS:
            raise ValueError(f"method: expected one of {', '.join(METHODS)}, found {self.method!r}")


@torch.no_grad()
def estimate_road(
    journey: Journey, positioning: PositioningNoise, config: RoadConfig
) -> RoadEstimate:
    """The road in every frame of a journey; the height is the calibrated one, as in the paper."""
    if config.method != "smoothed":
        return RoadTracker(journey.rig, positioning, config).advance(journey)
    if not journey.frame_count:
        return _calibrated(journey.rig, 0, config, journey.T_world_camera)
    motion = motion_of_poses(journey.T_world_camera, journey.t_ns, road_frame(journey.rig))
    rays = _rays(journey, motion)
    fit = _fit(rays, torch.zeros_like(motion.alpha), journey.rig, config)
    moments = width_moments(fit, rays, journey.rig.camera_height, config.measurements)
    state, springs = _smoothed(motion, fit, moments, positioning, config)
    for _ in range(config.refinements):
        alpha, beta = motion.alpha + state.mean[:, SLOPE], motion.beta + state.mean[:, CROSS]
        height = torch.full_like(alpha, journey.rig.camera_height)
        surface = lay_surface(motion, alpha, beta, height)
        flat = flattened_rays(surface, motion, rays, alpha, beta, height)
        fit = _fit(flat, alpha, journey.rig, config)
        # The flattened image has no bends, nor the roll and growth assumed: deviations from them
        # are what it still shows.
        known = fit.by_curvature * state.mean[:, GROWTH]
        fit = replace(
            fit,
            alpha=fit.alpha + known,
            bend=torch.zeros_like(fit.bend),
            by_twist=torch.zeros_like(fit.by_twist),
        )
        moments = width_moments(fit, flat, journey.rig.camera_height, config.measurements, beta)
        state, springs = _smoothed(motion, fit, moments, positioning, config)
    # Who nods by degrees is far from calibration.
    nods = math.hypot(*springs) - math.hypot(*config.measurements.shaking)
    return _estimate(motion, state, journey.rig, positioning, config, further=_NODS * nods)


class RoadTracker:
    """The causal methods, some frames at a time; its memory does not grow with the drive."""

    def __init__(self, rig: Rig, positioning: PositioningNoise, config: RoadConfig) -> None:
        if config.method == "smoothed":
            config = replace(config, method="causal")
        self._rig = rig
        self._positioning = positioning
        self._config = config
        self._memory: _Memory | None = None

    @torch.no_grad()
    def advance(self, part: Journey) -> RoadEstimate:
        """The road in the next frames of the drive; `part` holds these frames and their detections, no others."""
        config, frames = self._config, part.frame_count
        if config.method == "calibration" or not frames:
            return _calibrated(self._rig, frames, config, part.T_world_camera)
        memory = self._memory
        R_road_camera = road_frame(self._rig)
        T, t_ns = part.T_world_camera, part.t_ns
        if memory is not None:
            T, t_ns = (
                torch.cat((memory.T_world_camera[None], T)),
                torch.cat((memory.t_ns[None], t_ns)),
            )
        motion = motion_of_poses(T, t_ns, R_road_camera)
        dt = torch.diff(motion.t_s, prepend=motion.t_s[:1])
        if memory is None:
            memory = _first_memory(motion, config)
        else:
            motion, dt = motion[1:], dt[1:]
        step = self._step_paper if config.method == "paper2017" else self._step_filter
        estimate, memory = step(part, motion, dt, memory)
        self._memory = replace(memory, T_world_camera=T[-1], t_ns=t_ns[-1])
        return estimate

    def _step_filter(
        self, part: Journey, motion: EgoMotion, dt: Float[Tensor, " f"], memory: _Memory
    ) -> tuple[RoadEstimate, _Memory]:
        config, rig = self._config, self._rig
        rays = _rays(part, motion)
        fit = _fit(rays, torch.zeros_like(motion.alpha), rig, config)
        moments = width_moments(fit, rays, rig.camera_height, config.measurements)
        measurements, so_far = take_measurements(
            motion, dt, fit, moments, memory.so_far, self._positioning, config.measurements
        )
        states = filter_forward(memory.state, measurements, self._positioning, config.kalman).state
        last = RoadState(states.mean[-1], states.covariance[-1])
        return _estimate(motion, states, rig, self._positioning, config), replace(
            memory, state=last, so_far=so_far
        )

    def _step_paper(
        self, part: Journey, motion: EgoMotion, dt: Float[Tensor, " f"], memory: _Memory
    ) -> tuple[RoadEstimate, _Memory]:
        c = self._config.coplanarity
        walked = memory.so_far.station + motion.station
        station = torch.cat((memory.so_far.station[None], walked)).cummax(0)[0]
        nodes = concatenate((memory.nodes, pick_nodes(motion, station, c)))
        update = (station / c.update_m).floor()
        frame = (update[1:] > update[:-1]).nonzero()[:, 0]
        updates = coplanar_normals(
            nodes, frame, station[1:][frame], self._rig.camera_height, memory.tilt[:2], c
        )
        tilt = _latest_admitted(updates, memory.tilt, len(motion), self._config)
        kept = nodes[nodes.cell >= nodes.cell[-1:] - (c.segments + 2) * c.poses]
        so_far = replace(memory.so_far, station=station[-1])
        memory = replace(memory, nodes=kept, tilt=tilt[-1], so_far=so_far)
        alpha, beta, sigma = tilt.unbind(-1)
        return _road_table(motion, alpha, beta, sigma, self._rig), memory


@dataclass(frozen=True)
class _Memory:
    """All that the frames to come need of those gone by."""

    T_world_camera: Float[Tensor, "4 4"]
    t_ns: Int[Tensor, ""]
    so_far: MeasurementState
    state: RoadState
    nodes: PoseNodes
    tilt: Float[Tensor, " 3"]
    """Pitch, roll and sigma of the normal last admitted; method `paper2017`."""


def _first_memory(motion: EgoMotion, config: RoadConfig) -> _Memory:
    zero = motion.alpha[0] * 0
    sigma = zero + math.hypot(*config.kalman.stance_sigma)
    none = torch.zeros(0, dtype=torch.int64, device=zero.device)
    return _Memory(
        T_world_camera=torch.eye(4).to(zero),
        t_ns=none.sum(),
        so_far=first_measurement_state(motion),
        state=first_state(config.kalman, zero),
        nodes=PoseNodes(none, zero.new_zeros(0, 3, 3), zero.new_zeros(0, 3)),
        tilt=torch.stack((zero, zero, sigma)),
    )


def _rays(journey: Journey, motion: EgoMotion) -> LaneRays:
    points = journey.lane_points
    return lane_rays(
        points.ideal,
        points.detection,
        journey.lanes.frame,
        journey.frame_count,
        motion.R_road_camera,
    )


def _fit(rays: LaneRays, alpha: Float[Tensor, " f"], rig: Rig, config: RoadConfig) -> VanishingFit:
    focal = (rig.camera.K[0, 0] * rig.camera.K[1, 1]).sqrt().item()
    vanishing = config.measurements.vanishing
    return fit_vanishing(rays, alpha, rig.camera_height, vanishing.noise_px / focal, vanishing)


def _smoothed(
    motion: EgoMotion,
    fit: VanishingFit,
    moments: Float[Tensor, "f 6"],
    positioning: PositioningNoise,
    config: RoadConfig,
) -> tuple[RoadState, tuple[float, float]]:
    """All frames by all measurements, with springs that are as soft as the drive shows, which go with them."""
    dt = torch.diff(motion.t_s, prepend=motion.t_s[:1])
    start, begin = first_state(config.kalman, motion.alpha), first_measurement_state(motion)
    trusted, looks = config.measurements, 0
    while True:
        given = motion, dt, fit, moments, begin, positioning, trusted
        measurements, _ = take_measurements(*given)
        state = smooth_backward(filter_forward(start, measurements, positioning, config.kalman))
        pitch, roll = softer_springs(motion, dt, state, trusted)
        looks += 1
        if (pitch, roll) == trusted.shaking or looks == _LOOKS:
            return state, trusted.shaking
        trusted = replace(trusted, shaking=(pitch, roll))


def _estimate(
    motion: EgoMotion,
    state: RoadState,
    rig: Rig,
    positioning: PositioningNoise,
    config: RoadConfig,
    *,
    further: float = 0.0,
) -> RoadEstimate:
    """Normals of slopes; those too far from calibration, and `further` [rad] than that, are replaced by it."""
    alpha, beta = motion.alpha + state.mean[:, SLOPE], motion.beta + state.mean[:, CROSS]
    variance = state.covariance[:, SLOPE, SLOPE] + state.covariance[:, CROSS, CROSS]
    sigma = (variance + 2 * positioning.white_sigma_rad**2).sqrt()
    admitted = _is_admitted(alpha, beta, config, further)
    alpha, beta = (torch.where(admitted, value, 0.0) for value in (alpha, beta))
    sigma = torch.where(admitted, sigma, math.hypot(*config.kalman.stance_sigma))
    return _road_table(motion, alpha, beta, sigma, rig)


def _road_table(
    motion: EgoMotion, alpha: Tensor, beta: Tensor, sigma: Tensor, rig: Rig
) -> RoadEstimate:
    return RoadEstimate(
        normal_camera=normal_camera(alpha, beta, motion.R_road_camera),
        height=torch.full_like(alpha, rig.camera_height),
        sigma=sigma,
    )


def _calibrated(rig: Rig, frames: int, config: RoadConfig, like: Tensor) -> RoadEstimate:
    sigma = like.new_full((frames,), math.hypot(*config.kalman.stance_sigma))
    normal = torch.nn.functional.normalize(rig.road_normal_camera.to(like), dim=-1)
    return RoadEstimate(
        normal_camera=normal.expand(frames, 3).clone(),
        height=torch.full_like(sigma, rig.camera_height),
        sigma=sigma,
    )


def _is_admitted(alpha: Tensor, beta: Tensor, config: RoadConfig, further: float = 0.0) -> Tensor:
    limit = math.tan(math.radians(config.max_adjustment_deg)) + further
    return torch.hypot(alpha, beta) < limit


def _latest_admitted(
    updates: NormalUpdates, before: Float[Tensor, " 3"], frames: int, config: RoadConfig
) -> Float[Tensor, "f 3"]:
    """Pitch, roll and sigma of the last update before each frame that was admitted."""
    good = _is_admitted(updates.alpha, updates.beta, config) & updates.sigma.isfinite()
    tilt = torch.stack((updates.alpha, updates.beta, updates.sigma), dim=-1)[good]
    tilt = torch.cat((before[None], tilt))
    frame = updates.frame[good]
    row = torch.searchsorted(frame, torch.arange(frames, device=frame.device), right=True)
    return tilt[row]
