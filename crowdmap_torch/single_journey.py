"""One drive as it happens (section IV): a causal mapper that takes one frame at a time.

A step links the frame's detections and follows the road: a hundredth of a second. What takes longer, fitting the
signs and lanes that went out of sight, is done beside the drive by a thread of its own, and comes out a fixed number of
frames later: the same frames give the same results in the same steps, however fast they come.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import torch
from jaxtyping import Int
from torch import Tensor

from crowdmap_torch.config import MapperConfig
from crowdmap_torch.geometry import camera
from crowdmap_torch.geometry.trajectory import motion
from crowdmap_torch.lanes.reconstruct import reconstruct_lanes
from crowdmap_torch.noise.calibration import KnownCalibration, corrected_journey, corrected_rig
from crowdmap_torch.noise.white_noise import WhiteNoise
from crowdmap_torch.road.estimate import RoadTracker
from crowdmap_torch.signs.triangulate import triangulate_signs
from crowdmap_torch.tables import (
    Journey,
    Lanes,
    Rig,
    RoadEstimate,
    Signs,
    Tracklets,
    concatenate,
    concatenate_lanes,
)
from crowdmap_torch.tracking.lanes import LaneAssociator
from crowdmap_torch.tracking.signs import SignAssociator

MAX_OPEN_FRAMES = 1500
"""A landmark in view for longer is mapped from its latest frames: a car may stand at a light for an hour."""
SIGN_STRETCH_FRAMES = 75
"""Signs that went out of sight are mapped every so many frames: together they say more of the poses' drift."""
LANE_STRETCH_FRAMES = 150
"""Lane tracklets do not end where a marker goes on: what they showed is mapped every so many frames."""
_MOMENTS_NS = 400_000_000
"""Poses of so long tell how a car moves."""
MAPPING_FRAMES = 30
"""What was mapped comes out so many frames after its stretch ended: the mapping has that long to be done."""


@dataclass(frozen=True)
class StepResult:
    """What one frame told."""

    sign_tracklet: Int[Tensor, " d"]
    """Tracklet of each sign detection of the frame."""
    lane_tracklet: Int[Tensor, " l"]
    """Tracklet of each lane detection of the frame."""
    road: RoadEstimate
    """The road under the car, one row."""
    signs: Signs | None
    """Signs that went out of sight some frames ago. `frame` counts from the drive's start."""
    lanes: Lanes | None
    """Lane pieces of the last stretch, some frames after it was finished."""


@dataclass(frozen=True)
class _HeldFrame:
    """A frame that a landmark in sight, or an unfinished stretch, still needs."""

    part: Journey
    sign_label: Int[Tensor, " d"]
    """Tracklet of each sign detection; -1 once its sign was mapped."""
    sign_shift: Int[Tensor, " d"]
    lane_label: Int[Tensor, " l"]
    road: RoadEstimate


@dataclass(frozen=True)
class _Promise:
    """What a stretch showed, mapped when it is due."""

    due: int
    """The step in which it comes out."""
    result: Callable[[], Signs | Lanes]


class SingleJourneyMapper:
    """Maps a drive frame by frame, causally, with memory bounded by what is in sight.

    Association is exactly that of the batch (`associate_signs`, `associate_lanes`); signs come out when they are out of
    sight, lane pieces every stretch. `state_dict` and `load_state_dict` interrupt a drive and go on.
    """

    def __init__(
        self, rig: Rig, config: MapperConfig | None = None, known: KnownCalibration | None = None
    ) -> None:
        """Of a car with this rig, of whose calibration something may be `known` from a crowd (`calibration.json`).

        `config.road.method` is `causal` whatever the configuration smooths.
        """
        config = (config or MapperConfig()).resolved()
        if config.road.method == "smoothed":
            config = replace(config, road=replace(config.road, method="causal"))
        self.config = config
        self.known = known or {}
        self.rig = rig = corrected_rig(rig, self.known)
        self._given: list[tuple[Tensor, Tensor]] = []
        """Time and pose, as they came, of the frames of the last moments."""
        self._white = WhiteNoise(config.positioning)
        self._signs = SignAssociator(config.positioning, config.sign_association)
        self._lanes = LaneAssociator(config.lane_association)
        self._road = RoadTracker(rig, config.positioning, config.road)
        self._beside = ThreadPoolExecutor(1, thread_name_prefix="mapping")
        self._promised: list[_Promise] = []
        self._next = 0
        self._held: list[_HeldFrame] = []
        self._mapped_lanes = 0
        _load_derivatives(rig)

    @property
    def frames_held(self) -> int:
        """Frames in memory: those since the oldest landmark that is still in sight came up."""
        return len(self._held)

    @torch.no_grad()
    def step(self, frame: Journey) -> StepResult:
        """What a frame tells: a journey of one frame, as `frame_of` cuts it."""
        if frame.frame_count != 1:
            raise ValueError(f"expected a journey of one frame, found {frame.frame_count} frames")
        frame = self._corrected(frame)
        pose, number = frame.T_world_camera[0], self._next
        self._next += 1
        self._white.follow(*(x.cpu().numpy() for x in (frame.t_ns, pose[None, :3, 3])))
        white_sigma_m = self._white.sigma_m
        sign_label, sign_shift = self._signs.step(number, pose, frame.signs, white_sigma_m)
        lane_label = self._lanes.step(number, pose, frame.lanes, frame.lane_points, frame.rig)
        road = self._road.advance(frame)
        self._held.append(_HeldFrame(frame, sign_label, sign_shift, lane_label, road))
        if self._next % SIGN_STRETCH_FRAMES == 0:
            self._map_signs(self._ended_signs())
        if self._next - self._mapped_lanes >= LANE_STRETCH_FRAMES:
            self._map_lanes()
        self._forget()
        due = [p for p in self._promised if p.due <= self._next]
        self._promised = self._promised[len(due) :]
        signs, lanes = _collected(due)
        return StepResult(sign_label, lane_label, road, signs, lanes)

    @torch.no_grad()
    def finish(self) -> tuple[Signs | None, Lanes | None]:
        """What had not come out yet, and what was still in sight when the drive ended."""
        self._map_signs(self._held_signs())
        self._map_lanes()
        signs, lanes = _collected(self._promised)
        self._held, self._promised = [], []
        return signs, lanes

    def state_dict(self) -> dict[str, object]:
        """Everything that the next step needs."""
        return {
            "white": copy.deepcopy(self._white),
            "signs": self._signs.state_dict(),
            "lanes": self._lanes.state_dict(),
            "road": copy.deepcopy(self._road),
            "next": self._next,
            "given": list(self._given),
            "held": list(self._held),
            "mapped_lanes": self._mapped_lanes,
            "promised": [(p.due, p.result()) for p in self._promised],
        }

    def load_state_dict(self, state: dict) -> None:
        """Go on where another mapper with the same rig and configuration stopped."""
        self._white = copy.deepcopy(state["white"])
        self._signs.load_state_dict(state["signs"])
        self._lanes.load_state_dict(state["lanes"])
        self._road = copy.deepcopy(state["road"])
        self._next = state["next"]
        self._given = list(state["given"])
        self._held = list(state["held"])
        self._mapped_lanes = state["mapped_lanes"]
        self._promised = [_Promise(due, lambda made=made: made) for due, made in state["promised"]]

    def _corrected(self, frame: Journey) -> Journey:
        """The frame with what is known of the car put right."""
        if not self.known:
            return frame
        self._given.append((frame.t_ns, frame.T_world_camera))
        begins = int(frame.t_ns) - _MOMENTS_NS
        self._given = [(t_ns, T) for t_ns, T in self._given if int(t_ns) >= begins]
        t_ns, T = (torch.cat(part) for part in zip(*self._given, strict=True))
        velocity, turning = motion(T, t_ns)
        return corrected_journey(frame, self.known, (velocity[-1:], turning[-1:]))

    def _held_signs(self) -> Int[Tensor, " n"]:
        """Tracklets of signs that were not mapped yet."""
        if not self._held:
            return torch.zeros(0, dtype=torch.int64)
        label = torch.cat([held.sign_label for held in self._held]).unique()
        return label[label >= 0]

    def _ended_signs(self) -> Int[Tensor, " n"]:
        """Those of them that cannot be continued any more."""
        window = self.config.sign_association.window_frames
        recent = torch.cat([held.sign_label for held in self._held[-window - 1 :]])
        held = self._held_signs()
        return held[~torch.isin(held, recent)]

    def _map_signs(self, wanted: Int[Tensor, " n"]) -> None:
        """Has the signs of tracklets mapped; a sign is mapped once, so their detections are taken off."""
        if not len(wanted):
            return
        label = torch.cat([held.sign_label for held in self._held])
        shift = torch.cat([held.sign_shift for held in self._held])
        is_wanted = torch.isin(label, wanted)
        own = torch.where(is_wanted, torch.searchsorted(wanted, label), -1)
        config, tracklets = self.config, Tracklets(own, len(wanted), shift)
        parts = [held.part for held in self._held]
        first = self._next - len(parts)
        left = label.masked_fill(is_wanted, -1).split([len(h.sign_label) for h in self._held])
        self._held = [
            replace(held, sign_label=rest) for held, rest in zip(self._held, left, strict=True)
        ]

        def mapped() -> Signs:
            signs, _ = triangulate_signs(
                joined(parts), tracklets, config.positioning, config.sign_triangulation
            )
            return replace(signs, frame=signs.frame + first, tracklet=wanted[signs.tracklet])

        self._promise(mapped)

    def _map_lanes(self) -> None:
        """Has the lanes of the last stretch mapped."""
        start = self._stretch_start()
        self._mapped_lanes = self._next
        stretch = self._held[start:]
        if not stretch:
            return
        first = self._next - len(stretch)
        label = torch.cat([held.lane_label for held in stretch])
        used, own = torch.unique(label, return_inverse=True)

        def mapped() -> Lanes:
            part, road = joined([h.part for h in stretch]), concatenate([h.road for h in stretch])
            lanes, _ = reconstruct_lanes(part, Tracklets(own, len(used)), road, self.config.lane)
            return replace(lanes, frame=lanes.frame + first, tracklet=used[lanes.tracklet])

        self._promise(mapped)

    def _promise(self, mapped: Callable[[], Signs | Lanes]) -> None:
        result = self._beside.submit(mapped).result
        self._promised.append(_Promise(self._next + MAPPING_FRAMES, result))

    def _stretch_start(self) -> int:
        """The held frame with which the lanes' stretch starts: half a stretch of overlap, so that pieces meet."""
        first = self._next - len(self._held)
        return max(self._mapped_lanes - LANE_STRETCH_FRAMES // 2 - first, 0)

    def _forget(self) -> None:
        """Drops the frames that nothing in sight and no unfinished stretch needs."""
        in_sight = (i for i, held in enumerate(self._held) if bool((held.sign_label >= 0).any()))
        needed = min(next(in_sight, len(self._held)), self._stretch_start())
        del self._held[: max(needed, len(self._held) - MAX_OPEN_FRAMES)]


def _load_derivatives(rig: Rig) -> None:
    """Takes one derivative: torch loads its compiler with the first, a second that no step should have to wait."""
    px = rig.camera.K[None, :2, 2]
    ideal, _ = camera.unproject(rig.camera, px)
    camera.observation_matrix(rig.camera, px, ideal)


def _collected(promises: list[_Promise]) -> tuple[Signs | None, Lanes | None]:
    """The signs and the lanes of promises; None where there was none."""
    made = [promise.result() for promise in promises]
    signs = [one for one in made if isinstance(one, Signs)]
    lanes = [one for one in made if isinstance(one, Lanes)]
    return (concatenate(signs) if signs else None, concatenate_lanes(lanes) if lanes else None)


def frame_of(journey: Journey, index: int) -> Journey:
    """One frame of a journey as a journey of its own."""
    signs = journey.signs[journey.signs.frame == index]
    lane_rows = torch.nonzero(journey.lanes.frame == index)[:, 0]
    lanes = journey.lanes[lane_rows]
    new_row = torch.full((len(journey.lanes),), -1, device=lane_rows.device)
    new_row[lane_rows] = torch.arange(len(lane_rows), device=lane_rows.device)
    detection = new_row[journey.lane_points.detection]
    points = journey.lane_points[detection >= 0]
    at = slice(index, index + 1)
    return replace(
        journey,
        frame_number=journey.frame_number[at],
        t_ns=journey.t_ns[at],
        T_world_camera=journey.T_world_camera[at],
        sigma_position=None if journey.sigma_position is None else journey.sigma_position[at],
        sigma_rotation=None if journey.sigma_rotation is None else journey.sigma_rotation[at],
        signs=replace(signs, frame=torch.zeros_like(signs.frame)),
        lanes=replace(lanes, frame=torch.zeros_like(lanes.frame)),
        lane_points=replace(points, detection=detection[detection >= 0]),
    )


def joined(parts: list[Journey]) -> Journey:
    """Successive parts of one journey as one."""
    every_sigma = [p.sigma_position for p in parts if p.sigma_position is not None]
    every_turn = [p.sigma_rotation for p in parts if p.sigma_rotation is not None]
    signs, lanes, points = [], [], []
    frames = lane_rows = 0
    for p in parts:
        signs.append(replace(p.signs, frame=p.signs.frame + frames))
        lanes.append(replace(p.lanes, frame=p.lanes.frame + frames))
        points.append(replace(p.lane_points, detection=p.lane_points.detection + lane_rows))
        frames += p.frame_count
        lane_rows += len(p.lanes)
    return replace(
        parts[0],
        frame_number=torch.cat([p.frame_number for p in parts]),
        t_ns=torch.cat([p.t_ns for p in parts]),
        T_world_camera=torch.cat([p.T_world_camera for p in parts]),
        sigma_position=torch.cat(every_sigma) if len(every_sigma) == len(parts) else None,
        sigma_rotation=torch.cat(every_turn) if len(every_turn) == len(parts) else None,
        signs=concatenate(signs),
        lanes=concatenate(lanes),
        lane_points=concatenate(points),
    )
