"""Drives past signs with known answers: exact projections, and whatever fault a test asks for."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor
from worlds.drives import make_journey
from worlds.small_world import Builder

from crowdmap_torch.geometry import camera as cameras
from crowdmap_torch.geometry import polygon, se3
from crowdmap_torch.geometry.camera import Camera
from crowdmap_torch.noise.positioning import PositioningNoise
from crowdmap_torch.signs.pruning import SignTriangulationConfig
from crowdmap_torch.signs.triangulate import SignReport, triangulate_signs, views_of
from crowdmap_torch.signs.views import SignViews
from crowdmap_torch.tables import Association, Journey, Rig, SignDetections, Signs, Tracklets
from crowdmap_torch.tracking.sign_features import SignAssociationConfig
from crowdmap_torch.tracking.signs import associate_signs

F64 = torch.float64
CAMERA = Camera(
    "brown_conrady",
    1280,
    800,
    torch.tensor([[1000.0, 0.0, 639.5], [0.0, 1000.0, 399.5], [0.0, 0.0, 1.0]], dtype=F64),
    torch.zeros(0, dtype=F64),
)
RIG = Rig("rig", CAMERA, torch.eye(4, dtype=F64), torch.tensor([0.0, 1.0, 0.0], dtype=F64), 1.45)
R_WORLD_CAMERA = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]], dtype=F64)
"""A level camera that looks north."""
ALL_SHAPES = list(range(len(polygon.SHAPES)))
ALONG_THE_ROAD = [(3.5 * (-1) ** i, 45.0 + 4.0 * i, 2.0 + 0.3 * i) for i in ALL_SHAPES]
"""A place for a sign of each shape."""
NOISE = PositioningNoise()


@dataclass(frozen=True)
class SignDrive:
    """A journey, the signs that are there, and which of them each detection shows."""

    journey: Journey
    sign: Tensor
    """Row of the true sign of each detection."""
    T_world_sign: Tensor
    size: Tensor
    shape: Tensor

    @property
    def corners_world(self) -> Tensor:
        return se3.transform(self.T_world_sign[:, None], polygon.corners(self.shape, self.size))


def straight_poses(frames: int, step_m: float = 0.8) -> Tensor:
    """A level drive to the north from the origin, 1.5 m above the road."""
    p = torch.zeros(frames, 3, dtype=F64)
    p[:, 1] = step_m * torch.arange(frames)
    p[:, 2] = 1.5
    return se3.make(R_WORLD_CAMERA.expand(frames, 3, 3), p)


def signs_at(center, *, yaw_deg: float | list[float] = 0.0) -> Tensor:
    """Upright signs that face south, turned about the vertical."""
    center = torch.as_tensor(center, dtype=F64).reshape(-1, 3)
    yaw = torch.deg2rad(torch.as_tensor(yaw_deg, dtype=F64)).expand(len(center))
    z = torch.stack((yaw.sin(), -yaw.cos(), torch.zeros_like(yaw)), dim=-1)
    y = torch.zeros_like(z)
    y[:, 2] = 1
    return se3.make(torch.stack((torch.linalg.cross(y, z), y, z), dim=-1), center)


def drive_past(
    poses: Tensor,
    T_world_sign: Tensor,
    *,
    shape: list[int] | None = None,
    size: tuple[float, float] = (0.75, 0.6),
    noise_px: float = 0.0,
    depth_m: tuple[float, float] = (8.0, 80.0),
    seed: int = 0,
) -> SignDrive:
    """Every sign in every frame that has all of it in the image, outlines beginning at any corner, rows in any order."""
    generator = torch.Generator().manual_seed(seed)
    n = len(T_world_sign)
    codes = torch.full((n,), polygon.RECTANGLE) if shape is None else torch.tensor(shape)
    sizes = torch.tensor(size, dtype=F64).expand(n, 2)
    corners = se3.transform(T_world_sign[:, None], polygon.corners(codes, sizes))
    in_camera = se3.transform(se3.inverse(poses)[:, None, None], corners)
    px, visible = cameras.project(CAMERA, in_camera)
    depth = in_camera[..., 2].mean(-1)
    seen = visible.all(-1) & (depth > depth_m[0]) & (depth < depth_m[1])
    frame, sign = torch.nonzero(seen, as_tuple=True)
    order = torch.randperm(len(frame), generator=generator)
    frame, sign = frame[order], sign[order]
    d = len(frame)
    count = polygon.corner_count(codes[sign])
    noise = noise_px * torch.randn(d, 8, 2, dtype=F64, generator=generator)
    start = (torch.rand(d, generator=generator) * count).long()
    raw = polygon.roll(polygon.pad(px[frame, sign] + noise, count), start, count)
    ideal, _ = cameras.unproject(CAMERA, raw)
    detections = SignDetections(
        row=torch.arange(d),
        frame=frame,
        shape=codes[sign],
        corners_px=raw,
        corners_ideal=ideal,
        type=sign % 3,
        score=torch.full((d,), 0.9, dtype=F64),
        track=torch.full((d,), -1),
    )
    journey = make_journey(RIG, poses, signs=detections)
    return SignDrive(journey, sign, T_world_sign, sizes, codes)


def seen(drive: SignDrive) -> SignViews:
    """The views of a drive, corners in the order of the signs' templates."""
    signs = drive.journey.signs
    T = se3.inverse(drive.journey.T_world_camera[signs.frame])
    exact = se3.transform(T[:, None], drive.corners_world[drive.sign])
    px, _ = cameras.project(drive.journey.rig.camera, exact)
    shift, _ = polygon.best_shift(px, signs.corners_px, polygon.corner_count(signs.shape))
    tracklets = Tracklets(drive.sign, len(drive.T_world_sign), shift)
    return views_of(drive.journey, tracklets, torch.arange(len(signs)), drive.sign)


def with_rows(drive: SignDrive, rows: Tensor) -> SignDrive:
    """The same drive with these of its detections, in this order."""
    signs = replace(drive.journey.signs[rows], row=torch.arange(len(drive.sign[rows])))
    return replace(drive, journey=replace(drive.journey, signs=signs), sign=drive.sign[rows])


def with_signs(drive: SignDrive, **columns: Tensor) -> SignDrive:
    """The same drive with columns of its detections replaced."""
    journey = replace(drive.journey, signs=replace(drive.journey.signs, **columns))
    return replace(drive, journey=journey)


def moved_corners(
    drive: SignDrive, row: int | Tensor, push_px: tuple[float, float] | Tensor
) -> SignDrive:
    """The same drive with the corners of one detection, or of some, pushed aside."""
    px = drive.journey.signs.corners_px.clone()
    px[row] += torch.as_tensor(push_px, dtype=F64)
    return with_signs(drive, corners_px=px, corners_ideal=cameras.unproject(CAMERA, px)[0])


def taken_for(drive: SignDrive, row: int, shape: int) -> SignDrive:
    """The same drive with one detection taken for another shape, its outline in the same box."""
    signs = drive.journey.signs
    low, high = signs.corners_px[row].amin(0), signs.corners_px[row].amax(0)
    outline = polygon.template(torch.tensor(shape)) * torch.tensor([1.0, -1.0], dtype=F64)
    span = outline.amax(0) - outline.amin(0)
    px = signs.corners_px.clone()
    px[row] = (outline - outline.amin(0)) / span * (high - low) + low
    codes = signs.shape.clone()
    codes[row] = shape
    ideal = cameras.unproject(CAMERA, px)[0]
    return with_signs(drive, corners_px=px, corners_ideal=ideal, shape=codes)


def tracklets_per_sign(label: Tensor, sign: Tensor) -> list[set[int]]:
    """The labels under which each true sign is found."""
    return [set(label[sign == s].tolist()) for s in sorted(set(sign.tolist()))]


def map_of(drive: SignDrive) -> Signs:
    """The map that holds just the signs of the drive."""
    signs = Builder().signs(drive.T_world_sign[:, :3, 3])
    return replace(signs, T_world_sign=drive.T_world_sign, size=drive.size, shape=drive.shape)


def shift_of(drive: SignDrive) -> Tensor:
    """How the corners of each detection are turned against those of its sign."""
    poses = drive.journey.T_world_camera[drive.journey.signs.frame]
    corners = se3.transform(se3.inverse(poses)[:, None], drive.corners_world[drive.sign])
    px, _ = cameras.project(CAMERA, corners)
    count = polygon.corner_count(drive.shape[drive.sign])
    return polygon.best_shift(px, drive.journey.signs.corners_px, count)[0]


def associated(drive: SignDrive, known: Tensor) -> Association:
    """The true association of the detections that are known, none of the others."""
    shift = torch.where(known, shift_of(drive), 0)
    return Association(torch.where(known, drive.sign, -1), shift, torch.zeros(0, dtype=torch.int64))


def tracklets_of(label: Tensor) -> Tracklets:
    """A tracklet for each label."""
    return Tracklets(label, int(label.max()) + 1)


def two_journeys(
    drive: SignDrive, second: Tensor
) -> tuple[list[Journey], list[Tensor], list[Association]]:
    """The drive twice, with poses and associations; `second` is the sign of each detection of the other journey."""
    known = torch.ones(len(drive.sign), dtype=torch.bool)
    first = associated(drive, known)
    journeys = [drive.journey, drive.journey]
    return journeys, [j.T_world_camera for j in journeys], [first, replace(first, sign=second)]


def mixed_street() -> SignDrive:
    """A drive past a sign of every shape, half a pixel of noise on its corners."""
    return drive_past(
        straight_poses(80), signs_at(ALONG_THE_ROAD, yaw_deg=8.0), shape=ALL_SHAPES, noise_px=0.5
    )


def mapped(journey: Journey) -> tuple[Signs, SignReport]:
    """The signs of a journey, as they are found by default."""
    tracklets = associate_signs(journey, NOISE, SignAssociationConfig())
    return triangulate_signs(journey, tracklets, NOISE, SignTriangulationConfig())


def by_truth(drive: SignDrive) -> Tracklets:
    """Tracklets as the truth has them; shifts from association."""
    found = associate_signs(drive.journey, NOISE, SignAssociationConfig())
    return Tracklets(drive.sign, len(drive.T_world_sign), found.shift)


def corner_errors(signs: Signs, drive: SignDrive) -> torch.Tensor:
    """Mean corner error of every true sign against the nearest mapped one [m]."""
    nearest = torch.cdist(drive.T_world_sign[:, :3, 3], signs.center_world).argmin(-1)
    difference = signs.corners_world[nearest] - drive.corners_world
    return difference.norm(dim=-1).mean(-1)
