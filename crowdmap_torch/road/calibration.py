"""IV-C, offline calibration: the road normal and the camera height from pictures of surveyed points in a garage.

The points of a picture give the camera's place in the room (ePnP, Lepetit et al. 2009, then least
squares on the pixels); the plane through the floor points, brought into the camera's frame, is
where the road will be. Ten points on a wall leave the normal a quarter of a degree unsure, so the
mean of several pictures is taken.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.geometry.camera import Camera, project, unproject
from crowdmap_torch.geometry.plane import fit_plane
from crowdmap_torch.ranges import Degrees, Length, Pixels, Settings

MIN_POINTS = 6
"""Points of a picture; ePnP needs four, and has no way to see a wrong one among so few."""


@dataclass(frozen=True)
class SurveyedPoints:
    """Points on the wall and the floor, in a frame of the room [m]."""

    name: tuple[str, ...]
    position: Float[Tensor, "n 3"]
    is_floor: tuple[bool, ...]


@dataclass(frozen=True)
class Annotations:
    """Where points were seen in pictures: raw, distorted pixels."""

    picture: tuple[str, ...]
    """Names of the pictures."""
    of_picture: Int[Tensor, " m"]
    point: Int[Tensor, " m"]
    px: Float[Tensor, "m 2"]


@dataclass(frozen=True)
class CalibrationConfig(Settings):
    """When pictures are good enough."""

    max_rms_px: Pixels = 3.0
    """Pictures whose points miss by more are refused."""
    max_spread_deg: Degrees = 1.0
    """Pictures whose normal is further than this from the mean are refused."""
    max_floor_m: Length = 0.02
    """Floor points further than this from their plane are refused."""


@dataclass(frozen=True)
class RoadCalibration:
    """The road in the camera frame, and how well the pictures agree on it."""

    normal_camera: Float[Tensor, " 3"]
    """Unit normal from the camera towards the road."""
    height: float
    """Distance of the camera's centre from the road [m]."""
    picture: tuple[str, ...]
    rms_px: tuple[float, ...]
    """Reprojection error of each picture."""
    off_deg: tuple[float, ...]
    """Angle of each picture's normal from the mean."""
    sigma_deg: float
    """1-sigma of the mean normal's angle, from the pictures' scatter; NaN for a single picture."""
    sigma_height: float
    """1-sigma of the mean height, likewise [m]."""


def calibrate_road(
    camera: Camera, points: SurveyedPoints, seen: Annotations, config: CalibrationConfig
) -> RoadCalibration:
    """The mean over pictures of the floor's plane in the camera frame.

    ValueError where pictures or points are too few or wrong.
    """
    origin, up = _floor(points, config)
    if not seen.picture:
        raise ValueError("there is no picture; expected one or more with annotated points")
    ideal, closes = unproject(camera, seen.px)
    if not bool(closes.all()):
        row = int((~closes).nonzero()[0, 0])
        raise ValueError(
            f"picture {seen.picture[int(seen.of_picture[row])]!r}: pixel "
            f"({seen.px[row, 0]:.1f}, {seen.px[row, 1]:.1f}) of point "
            f"{points.name[int(seen.point[row])]!r} cannot be undistorted; is it in raw pixels of this camera?"
        )
    normals, heights, errors = [], [], []
    for k, name in enumerate(seen.picture):
        rows = (seen.of_picture == k).nonzero()[:, 0]
        position = points.position[seen.point[rows]]
        R, t = _camera_in_room(name, position, ideal[rows])
        missed = project(camera, position @ R.T + t)[0] - seen.px[rows]
        errors.append(missed.square().sum(-1).mean().sqrt().item())
        if not errors[-1] <= config.max_rms_px:
            worst = int(missed.square().sum(-1).argmax())
            raise ValueError(
                f"picture {name!r}: its points miss by {errors[-1]:.2f} px; expected "
                f"{config.max_rms_px:g} or less. The worst is {points.name[int(seen.point[rows][worst])]!r}, "
                f"{missed[worst].norm():.1f} px off: are names, pixels and the camera's model right?"
            )
        centre = -R.T @ t
        above = float((centre - origin) @ up)
        if above <= 0.05:
            raise ValueError(
                f"picture {name!r}: the camera is {above:.2f} m above the floor; expected it above. "
                "Is the room's frame right-handed, and are the points on the right side of the wall?"
            )
        normals.append(-R @ up)
        heights.append(above)
    return _mean(seen.picture, torch.stack(normals), heights, errors, config)


def _floor(
    points: SurveyedPoints, config: CalibrationConfig
) -> tuple[Float[Tensor, " 3"], Float[Tensor, " 3"]]:
    """A point of the floor's plane, and its normal on the side where the wall's points are."""
    is_floor = torch.tensor(points.is_floor, dtype=torch.bool)
    floor, wall = points.position[is_floor], points.position[~is_floor]
    if len(floor) < 3:
        raise ValueError(f"{len(floor)} floor points; expected three or more, not on one line")
    if not len(wall):
        raise ValueError("no wall point; expected some, to tell above the floor from below")
    centre, up, _ = fit_plane(floor)
    spread = torch.linalg.svdvals(floor - centre)
    if not spread[1] > 0.1:
        raise ValueError("the floor points lie on one line; expected them spread over the floor")
    off = ((floor - centre) @ up).abs()
    if off.max() > config.max_floor_m:
        name = [n for n, f in zip(points.name, points.is_floor, strict=True) if f][
            int(off.argmax())
        ]
        raise ValueError(
            f"floor point {name!r} is {off.max():.3f} m off the plane of the floor points; "
            f"expected {config.max_floor_m:g} or less"
        )
    return centre, up if float(((wall - centre) @ up).mean()) > 0 else -up


def _camera_in_room(
    picture: str, position: Float[Tensor, "k 3"], ideal: Float[Tensor, "k 2"]
) -> tuple[Float[Tensor, "3 3"], Float[Tensor, " 3"]]:
    """R and t from the room to the camera frame, by ePnP and then least squares."""
    if len(position) < MIN_POINTS:
        raise ValueError(
            f"picture {picture!r}: {len(position)} points; expected {MIN_POINTS} or more"
        )
    centred = position - position.mean(0)
    if not torch.linalg.svdvals(centred)[1] > 0.1:
        raise ValueError(f"picture {picture!r}: its points lie on one line; annotate others too")
    # OpenCV sees ideal points: a camera without a lens.
    world, image = position.numpy(), ideal.numpy()
    eye, none = np.eye(3), np.zeros(0)
    found, rotation, translation = cv2.solvePnP(world, image, eye, none, flags=cv2.SOLVEPNP_EPNP)
    if not found or not np.isfinite(rotation).all():
        raise ValueError(f"picture {picture!r}: no camera pose fits its points; check their names")
    rotation, translation = cv2.solvePnPRefineLM(world, image, eye, none, rotation, translation)
    R = torch.from_numpy(cv2.Rodrigues(rotation)[0])
    t = torch.from_numpy(translation)[:, 0]
    if not bool(((position @ R.T + t)[:, 2] > 0).all()):
        raise ValueError(
            f"picture {picture!r}: points come out behind the camera; check their names"
        )
    return R, t


def _mean(
    picture: tuple[str, ...],
    normals: Float[Tensor, "k 3"],
    heights: list[float],
    errors: list[float],
    config: CalibrationConfig,
) -> RoadCalibration:
    mean = torch.nn.functional.normalize(normals.mean(0), dim=-1)
    off = torch.linalg.cross(normals, mean.expand_as(normals)).norm(dim=-1).clamp(0, 1).asin()
    off_deg = tuple(math.degrees(a) for a in off.tolist())
    if max(off_deg) > config.max_spread_deg:
        worst = off_deg.index(max(off_deg))
        raise ValueError(
            f"picture {picture[worst]!r}: its normal is {off_deg[worst]:.2f} degrees off the mean of "
            f"the pictures; expected {config.max_spread_deg:g} or less. Take it out, or look at all of them"
        )
    height = torch.tensor(heights, dtype=torch.float64)
    k = len(picture)
    scatter = off.square().sum().div(k - 1).sqrt().item() if k > 1 else math.nan
    return RoadCalibration(
        normal_camera=mean,
        height=height.mean().item(),
        picture=picture,
        rms_px=tuple(errors),
        off_deg=off_deg,
        sigma_deg=math.degrees(scatter) / math.sqrt(k),
        sigma_height=height.std().item() / math.sqrt(k) if k > 1 else math.nan,
    )
