"""What each car has wrong for good: its mount, its camera, its clock, its detector; unknowns that its journeys share.

To first order every one of them adds a linear part to residuals that are there already. Mount and clock move the pose that
the positioning module's word is compared with; the others move what the image shows, or the road under it:

    pose       += [R_world_camera place + clock v; turn + clock omega]
    pixel      += focal (u - c) + principal + read_out (row / height - 1/2) du/dt + box (u - u_sign) + corner
    lane point += du/dleft lane        height of the road under the camera += height + load

with the derivatives taken where the unknowns are by now, as with lenses (`lenses`): residuals are those of the true camera.
What is left out is how the calibration changes the derivatives by poses and landmarks: some thousandths of them. Unknowns
are in units of their prior sigmas. A car is a `vehicle_id`, or else a rig. A load presses a car down for one drive: what
was seen from it tells the drive's height to millimetres, and the car's own, which its drives have about, no better than
loads differ.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from crowdmap_torch.adjustment.lane_matching import Shifts
from crowdmap_torch.adjustment.observations import CornerObservations, LanePointObservations
from crowdmap_torch.clustering.groups import group_sum
from crowdmap_torch.geometry.camera import Camera
from crowdmap_torch.geometry.trajectory import motion
from crowdmap_torch.noise.calibration import KnownCalibration
from crowdmap_torch.optim.problem import CostTerm
from crowdmap_torch.processes.sums import lasting
from crowdmap_torch.ranges import Degrees, LengthOrNone, PixelsOrNone, Settings, Share
from crowdmap_torch.residuals.calibration import with_linear_part
from crowdmap_torch.residuals.lane import (
    lane_reprojection_by_car,
    lane_reprojection_by_car_jacobian,
)
from crowdmap_torch.residuals.reprojection import pixel_error_jacobian
from crowdmap_torch.tables import Journey

_ALONG = 0.5
"""Least component, to the camera's right, of what is across a marker: one that is turned by more than 60 degrees from where
the camera looks, such as a stop line, runs across the road, where detectors have no left."""
_SUREST = 1e-3
"""Least share of the configuration's sigma that what was found before counts with."""


@dataclass(frozen=True)
class CalibrationConfig(Settings):
    """How far cars may be from their rig.yaml, 1-sigma, or less where the fleet shows so; what has 0 is known."""

    mount_deg: Degrees = 0.2
    """Turn of the camera about each of its axes against the stated mount."""
    mount_m: LengthOrNone = 0.05
    """Place of the camera against the stated mount, along its axes."""
    clock_s: Share = 0.015
    """Time by which pictures are taken later than they and their poses are stamped."""
    focal: Share = 0.002
    """Share by which the focal length is larger than stated."""
    principal_px: PixelsOrNone = 1.5
    """Principal point against the stated one, in u and in v."""
    read_out_s: Share = 0.02
    """Rolling shutter: time from the first row of the image to the last."""
    box: Share = 0.01
    """Share by which the outline of detected signs is too large."""
    corner_px: PixelsOrNone = 0.0
    """Shift of detected corners in u and in v."""
    lane_m: LengthOrNone = 0.03
    """How far to the left of a marker's middle, as the driver sees it, its points are detected."""
    height_m: LengthOrNone = 0.03
    """Height of the camera above the road against the stated one, in the mean of the car's loads."""
    load_m: LengthOrNone = 0.012
    """What load, fuel and tyres add to that for a drive; 0: nothing."""
    in_common: Share = 0.3
    """Share of the variances of clocks, read-outs and detectors' habits that all cars have in common."""

    @classmethod
    def off(cls) -> CalibrationConfig:
        """Everything is known."""
        every = (one.name for kind in VARIABLES.values() for one in kind)
        return cls(**dict.fromkeys((*every, "load_m"), 0.0))


@dataclass(frozen=True)
class Parameter:
    """One kind of what a car has wrong."""

    name: str
    """Of the configuration's sigma."""
    count: int
    """How many numbers it is."""
    unit: float = 1.0
    """Of the configuration's number, in those of this package."""
    alike: bool = False
    """Whether cars of one make have some of it in common: programs are the same in all of them, mounts and lenses not."""


MOUNT = (
    Parameter("mount_deg", 3, math.pi / 180),
    Parameter("mount_m", 3),
    Parameter("clock_s", 1, alike=True),
)
"""What moves the pose."""
OPTICS = (
    Parameter("focal", 1),
    Parameter("principal_px", 2),
    Parameter("read_out_s", 1, alike=True),
    Parameter("box", 1, alike=True),
    Parameter("corner_px", 2, alike=True),
    Parameter("lane_m", 1, alike=True),
    Parameter("height_m", 1),
)
"""What moves the image, and the road under it."""
VARIABLES = {"mount": MOUNT, "optics": OPTICS}
"""The unknowns of every car, by variable of the bundle."""
LOAD = "load"
"""The variable of the bundle that has a number for each drive: how much higher than its car's usual the camera is."""


def columns(variable: str, config: CalibrationConfig) -> dict[str, slice]:
    """Where in its variable every parameter is that is not known."""
    found, first = {}, 0
    for one in VARIABLES[variable]:
        if getattr(config, one.name) > 0:
            found[one.name] = slice(first, first + one.count)
            first += one.count
    return found


def alike(variable: str, config: CalibrationConfig) -> Bool[Tensor, " k"]:
    """Which of a car's unknown numbers are as those of other cars."""
    unknown = (one for one in VARIABLES[variable] if getattr(config, one.name) > 0)
    return torch.tensor([one.alike for one in unknown for _ in range(one.count)])


def width(variable: str, config: CalibrationConfig) -> int:
    """How many numbers of a car are unknown."""
    return max((at.stop for at in columns(variable, config).values()), default=0)


@dataclass(frozen=True)
class Kind:
    """Numbers of every car whose prior sigmas have scales in common."""

    variable: str
    at: slice
    """Where in the variable they are."""
    alike: bool
    """Whether cars have some of it in common: then the scale is that of what they differ in alone."""


@dataclass(frozen=True)
class ByOptics:
    """Derivatives of rows by the optics of their cars, in units of the configuration's sigmas."""

    image: Float[Tensor, "m 2 k"]
    """Of the pixel, as long as what is seen is where it is."""
    height: Float[Tensor, "m _ k"]
    """Of a lane point's height over the road; nothing for corners."""
    left: Float[Tensor, "_ 3"]
    """Along the world's axes, to where a lane point is detected that is not on its marker; nothing for corners."""

    @classmethod
    def none(cls, count: int, config: CalibrationConfig, like: Tensor, heights: int) -> ByOptics:
        """Those of rows of which nothing is known yet."""
        k = width("optics", config)
        by = like.new_zeros(count, 2, k), like.new_zeros(count, heights, k)
        return cls(*by, like.new_zeros(count * heights, 3))

    def put(self, at: slice, some: ByOptics) -> None:
        """Takes over those of some rows, in place."""
        self.image[at], self.height[at], self.left[at] = some.image, some.height, some.left


@dataclass(frozen=True)
class Fleet:
    """The cars, and what of their journeys the derivatives by their calibration need."""

    vehicles: tuple[str, ...]
    of_journey: Int[Tensor, " j"]
    """Car of each journey."""
    of_pose: Int[Tensor, " p"]
    """Car of each pose of the bundle."""
    velocity: Float[Tensor, "p 3"]
    """Of the camera, along the world's axes [m/s]."""
    turning: Float[Tensor, "p 3"]
    """Of the camera, about its own axes [rad/s]."""
    expected: dict[str, Float[Tensor, "v _"]]
    """What is known of every car before, by variable: zero, or what was found earlier."""
    prior_sigma: dict[str, Float[Tensor, "v _"]]
    """1-sigma of that."""
    found_before: dict[str, Bool[Tensor, "v _"]]
    """What was found earlier: it has nothing in common with other cars that is not in it already."""
    config: CalibrationConfig

    @property
    def variables(self) -> tuple[str, ...]:
        """Those of the cars of which anything is unknown."""
        return tuple(self.expected)

    @property
    def start(self) -> dict[str, Float[Tensor, "_ k"]]:
        """Where all unknowns start, by variable: the cars', and a number for each drive, its load."""
        if not self.config.load_m:
            return self.expected
        return {**self.expected, LOAD: self.velocity.new_zeros(len(self.of_journey), 1)}

    def blocks(self, journey: Int[Tensor, " n"]) -> dict[str, Int[Tensor, " n"]]:
        """By variable of `start` the block that drives have."""
        return {name: journey if name == LOAD else self.of_journey[journey] for name in self.start}

    @property
    def kinds(self) -> tuple[Kind, ...]:
        """What has scales of its own: every parameter. All drives have loads: those count as configured."""
        return tuple(
            Kind(variable, at, bool(alike(variable, self.config)[at.start]))
            for variable in self.variables
            for at in columns(variable, self.config).values()
        )

    def new(self, kind: Kind) -> Int[Tensor, " n"]:
        """The cars of which nothing of that kind was found before."""
        before = self.found_before[kind.variable][:, kind.at.start]
        return lasting("new", lambda: torch.nonzero(~before)[:, 0], before)

    def of_poses(self, term: CostTerm, by: Float[Tensor, "p 6 k"]) -> CostTerm:
        """`pose_white`, of the pose that a true mount and clock would give; `by` is `by_mount` of the poses."""
        if "mount" not in self.variables:
            return term
        return with_linear_part(term, "mount", self.of_pose, -by)

    def of_corners(self, term: CostTerm, rows: CornerObservations, by: ByOptics) -> CostTerm:
        """`sign_reprojection` by the true camera; `by` are `by_optics` of the corners."""
        if "optics" not in self.variables:
            return term
        return with_linear_part(term, "optics", self.of_pose[rows.frame], by.image)

    def of_lane_points(
        self,
        terms: dict[str, CostTerm],
        rows: LanePointObservations,
        normal_px: Float[Tensor, "m 2"],
        by: ByOptics,
    ) -> dict[str, CostTerm]:
        """`lane_reprojection` by the true camera, and `lane_height` at its true height over the road."""
        image, ground = terms["lane_reprojection"], terms["lane_height"]
        if "optics" in self.variables:
            car = self.of_pose[rows.frame]
            across = (normal_px[:, :, None] * by.image).sum(1)
            image = replace(
                image,
                residual=lane_reprojection_by_car,
                slots=(*image.slots, ("optics", car)),
                constants=(*image.constants, by.left, self._left_m.expand_as(across), across),
                jacobian=lane_reprojection_by_car_jacobian,
            )
            ground = with_linear_part(ground, "optics", car, by.height)
        if self.config.load_m:
            higher = rows.camera_height.new_full((len(rows), 1, 1), -self.config.load_m)
            ground = with_linear_part(ground, LOAD, rows.journey, higher)
        return {"lane_reprojection": image, "lane_height": ground}

    @property
    def _left_m(self) -> Float[Tensor, " k"]:
        """By how many metres each number of the optics has lane points to the left."""
        left_m = self.velocity.new_zeros(width("optics", self.config))
        left_m[columns("optics", self.config).get("lane_m", slice(0))] = self.config.lane_m
        return left_m

    def shifts(
        self, rows: LanePointObservations, by: ByOptics, values: Mapping[str, Tensor]
    ) -> Shifts | None:
        """Where the true cameras and detectors see lane points; None: as stated."""
        if "optics" not in self.variables:
            return None
        optics = values["optics"][self.of_pose[rows.frame], :, None]
        return Shifts(by.left * (self._left_m @ optics), (by.image @ optics)[..., 0])

    def by_mount(self, pose: Float[Tensor, "p 4 4"]) -> Float[Tensor, "p 6 k"]:
        """Derivatives of what the poses given are wrong by, as tangents of geometry.se3, where the poses are `pose`.

        A lever arm points to where the camera is, not to where a pose that is given with noise has it: that noise is
        in what is compared with it as well, and thousands of frames would take the one for the other.
        """
        config, at = self.config, columns("mount", self.config)
        by = pose.new_zeros(len(pose), 6, width("mount", config))
        if "mount_deg" in at:
            eye = torch.eye(3).to(by)
            by[:, 3:, at["mount_deg"]] = eye * math.radians(config.mount_deg)
        if "mount_m" in at:
            by[:, :3, at["mount_m"]] = pose[:, :3, :3] * config.mount_m
        if "clock_s" in at:
            moved = torch.cat((self.velocity, self.turning), dim=-1)
            by[:, :, at["clock_s"]] = moved[..., None] * config.clock_s
        return by

    def by_optics(
        self,
        rows: CornerObservations | LanePointObservations,
        lenses: Sequence[Camera],
        point_camera: Float[Tensor, "m 3"],
        pose: Float[Tensor, "p 4 4"],
        left_lane: Float[Tensor, "m 3"] | None = None,
    ) -> ByOptics:
        """Derivatives by the optics of the rows' cars of where points `point_camera` are seen, and above the road.

        Lane points have `left_lane`, along the road and across their marker, to either side.
        """
        config, at = self.config, columns("optics", self.config)
        by = point_camera.new_zeros(len(rows), 2, width("optics", config))
        error, by_point = pixel_error_jacobian(point_camera.mT, rows.matrix.permute(1, 2, 0))
        seen, by_point = rows.px + error.mT, by_point.permute(2, 0, 1)
        middle = torch.stack([lens.K[:2, 2] for lens in lenses])[rows.lens]
        tall = seen.new_tensor([float(lens.height) for lens in lenses])[rows.lens]
        of_corners = isinstance(rows, CornerObservations)
        if "focal" in at:
            by[..., at["focal"]] = (seen - middle)[..., None] * config.focal
        if "principal_px" in at:
            by[..., at["principal_px"]] = torch.eye(2).to(by) * config.principal_px
        if "read_out_s" in at:
            to_camera = pose[rows.frame, :3, :3].mT
            moves = -(to_camera @ self.velocity[rows.frame, :, None])[..., 0]
            moves = moves - torch.linalg.cross(self.turning[rows.frame], point_camera)
            share = (seen[:, 1] / tall - 0.5) * config.read_out_s
            by[..., at["read_out_s"]] = (by_point @ moves[..., None]) * share[:, None, None]
        if "box" in at and of_corners:
            by[..., at["box"]] = (seen - _means(seen, rows.detection))[..., None] * config.box
        if "corner_px" in at and of_corners:
            by[..., at["corner_px"]] = torch.eye(2).to(by) * config.corner_px
        if isinstance(rows, CornerObservations) or left_lane is None:
            return ByOptics(by, by[:, :0], point_camera[:0])
        # To the left of who drives there. No more is asked of where the camera looks: what a frame's own noise turns, all
        # frames together would take for a shift of their detectors.
        to_right = (left_lane * pose[rows.frame, :3, 0]).sum(-1, keepdim=True)
        left = torch.where(to_right.abs() > _ALONG, -to_right.sign() * left_lane, 0.0)
        return ByOptics(by, self._by_height(rows, lenses, point_camera), left)

    def _by_height(
        self,
        rows: LanePointObservations,
        lenses: Sequence[Camera],
        point_camera: Float[Tensor, "m 3"],
    ) -> Float[Tensor, "m 1 k"]:
        """Derivatives of the height of lane points over the road plane under the camera.

        The plane's normal n was read off the image, by the stated camera: its horizon stays where it is in the image.
        """
        config, at = self.config, columns("optics", self.config)
        height = point_camera.new_zeros(len(rows), 1, width("optics", config))
        n, (x, y, z) = rows.normal_camera, point_camera.unbind(-1)
        above = (n * point_camera).sum(-1)
        flat = n[:, 0].square() + n[:, 1].square()
        if "focal" in at:
            grown = n[:, 0] * x + n[:, 1] * y - above * flat
            height[:, 0, at["focal"]] = grown[:, None] * config.focal
        if "principal_px" in at:
            focal = torch.stack([lens.K.diagonal()[:2] for lens in lenses])[rows.lens]
            sunk = (z - above * n[:, 2])[:, None]
            height[:, 0, at["principal_px"]] = n[:, :2] / focal * sunk * config.principal_px
        if "height_m" in at:
            height[:, 0, at["height_m"]] = -config.height_m
        return height


def fleet_of(
    journeys: Sequence[Journey],
    frame: Int[Tensor, " p"],
    journey: Int[Tensor, " p"],
    config: CalibrationConfig,
    known: Mapping[str, KnownCalibration],
) -> Fleet:
    """The cars of some journeys, and what is `known` of some of them.

    `frame` and `journey` are those of the poses of the bundle, frames counted over all.
    """
    vehicles = tuple(dict.fromkeys(one.vehicle for one in journeys))
    number = {name: k for k, name in enumerate(vehicles)}
    of_journey = torch.tensor([number[one.vehicle] for one in journeys], device=frame.device)
    velocity, turning = (
        torch.cat(part)[frame]
        for part in zip(*(motion(one.T_world_camera, one.t_ns) for one in journeys), strict=True)
    )
    expected, sigma, found_before = {}, {}, {}
    for variable in VARIABLES:
        if count := width(variable, config):
            expected[variable] = velocity.new_zeros(len(vehicles), count)
            sigma[variable] = torch.ones_like(expected[variable])
            found_before[variable] = torch.zeros_like(expected[variable], dtype=torch.bool)
            for name, at in columns(variable, config).items():
                for car in vehicles:
                    if found := known.get(car, {}).get(name):
                        of_number = velocity.new_tensor(found) / getattr(config, name)
                        expected[variable][number[car], at] = of_number[0]
                        found_before[variable][number[car], at] = True
                        # What was found is not surer than before because it is asked for again.
                        sigma[variable][number[car], at] = of_number[1].clamp(_SUREST, 1.0)
    cars = of_journey[journey]
    return Fleet(
        vehicles, of_journey, cars, velocity, turning, expected, sigma, found_before, config
    )


def _means(value: Float[Tensor, "m 2"], group: Int[Tensor, " m"]) -> Float[Tensor, "m 2"]:
    """The mean of each row's group; the rows of a group are adjacent."""
    _, of, count = torch.unique_consecutive(group, return_inverse=True, return_counts=True)
    return (group_sum(value, of, len(count)) / count[:, None])[of]
