"""Whether signs seen from several frames meet in one point, and if not, under which mistake they do.

Rays to one sign meet if poses, frames, lens and pixels belong together; what keeps them apart is noise of a pixel and
the drift of the poses over a few tens of metres. Each usual mistake is undone in turn: if the rays of most journeys
then meet much better, it is the cause.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from crowdmap_torch.geometry import se3
from crowdmap_torch.geometry.camera import Camera, project, unproject
from crowdmap_torch.geometry.triangulation import midpoint_ragged
from crowdmap_torch.plausibility.finding import Finding, Repair
from crowdmap_torch.plausibility.rig import COEFFICIENT_ORDERS, reordered
from crowdmap_torch.plausibility.units import LENGTH_UNITS
from crowdmap_torch.tables import Journey, Tracklets


@dataclass(frozen=True)
class ConsistencyLimits:
    """When rays meet so much better that a mistake is named."""

    least_views: int = 6
    """Views of a sign that counts."""
    least_parallax_deg: float = 3.0
    """Root mean square angle between its rays."""
    better: float = 0.75
    """Misfit under another order of the lens's coefficients against that of what is given, in the median over journeys."""
    better_shifted: float = 0.93
    """The same of frames shifted: less will do, since the best of several shifts is the same in most journeys."""
    agreeing: float = 0.8
    """Share of the journeys in which it has to be smaller."""
    shifts: tuple[int, ...] = (-3, -2, -1, 1, 2, 3)
    """Frames by which the numbers may be off."""
    size_m: tuple[float, float] = (0.05, 25.0)
    """Median size of the signs: less and more is another unit of positions."""
    usual_m: tuple[float, float] = (0.3, 2.5)
    """The same under the unit that is named."""
    meeting_px: float = 15.0
    """How far rays may miss each other where their meeting alone tells a unit."""


@dataclass(frozen=True)
class SignsSeen:
    """Views of the signs of one journey: raw pixels of the outlines' middles."""

    px: Float[Tensor, "m 2"]
    extent_px: Float[Tensor, " m"]
    frame: Int[Tensor, " m"]
    sign: Int[Tensor, " m"]
    count: int


@dataclass(frozen=True)
class DriveRays:
    """How well the rays of one journey meet."""

    misfit_px: float
    size_m: float
    """Median of its signs."""
    tried: tuple[tuple[str, float, Finding], ...]
    """Mistakes by name, the misfit where each is undone against that of what is given, and what is said of it then."""


def drive_rays(
    journey: Journey, tracks: Tracklets, limits: ConsistencyLimits | None = None
) -> DriveRays | None:
    """How well a journey's rays meet, as they are given and under every usual mistake; None if no sign tells."""
    limits = limits or ConsistencyLimits()
    views = sign_views(journey, tracks, limits.least_views)
    rays = None if views is None else rays_of(views, journey.rig.camera)
    met = None if rays is None else met_at(journey, rays, 0, limits)
    if views is None or rays is None or met is None:
        return None
    given = met.misfit_px
    size = float((views.extent_px * met.distance)[met.counted].median()) / rays.focal_px
    tried = []
    for name, camera, shift, finding in _instead(journey, limits):
        other = rays if camera is journey.rig.camera else rays_of(views, camera)
        under = met_at(journey, other, shift, limits)
        tried.append((name, math.inf if under is None else under.misfit_px / given, finding))
    return DriveRays(given, size, tuple(tried))


def consistency_findings(
    drives: Sequence[DriveRays | None], limits: ConsistencyLimits | None = None
) -> list[Finding]:
    """Mistakes of all journeys under which their signs' rays do not meet."""
    limits = limits or ConsistencyLimits()
    told = [drive for drive in drives if drive is not None]
    tried: dict[str, list[float]] = {}
    findings: dict[str, Finding] = {}
    for drive in told:
        for name, ratio, finding in drive.tried:
            tried.setdefault(name, []).append(ratio)
            findings[name] = finding
    if scale := _scale_findings([drive.size_m for drive in told], limits):
        return scale
    named = []
    for name, ratios in tried.items():
        found, is_shift = torch.tensor(ratios), findings[name].kind == "frame-offset"
        others = [torch.tensor(tried[n]) for n in tried if is_shift and n != name and "offset" in n]
        best = torch.stack([torch.ones_like(found), *others]).amin(0)
        enough = limits.better_shifted if is_shift else limits.better
        ratio = float(found.median())
        if ratio < enough and float((found < best).double().mean()) >= limits.agreeing:
            named.append((ratio, name))
    if not named:
        return []
    ratio, name = min(named)
    usual = sorted(drive.misfit_px for drive in told)[len(told) // 2]
    evidence = (
        f"rays to one sign miss each other by {usual:.1f} px, and by {ratio * usual:.1f} px if"
    )
    return [replace(findings[name], evidence=f"{evidence} {findings[name].evidence}")]


def sign_views(journey: Journey, tracks: Tracklets, fewest: int) -> SignsSeen | None:
    """The views of all signs with so many of them; None if there is no such sign."""
    label = tracks.label
    often = torch.bincount(label[label >= 0], minlength=tracks.count) >= fewest
    used = (
        torch.nonzero((label >= 0) & often[label.clamp_min(0)])[:, 0] if tracks.count else label[:0]
    )
    if not len(used):
        return None
    sign, compact = label[used].unique(return_inverse=True)
    corners = journey.signs.corners_px[used]
    middle = (corners.amin(1) + corners.amax(1)) / 2
    extent = (corners.amax(1) - corners.amin(1)).amax(-1)
    return SignsSeen(middle, extent, journey.signs.frame[used], compact, len(sign))


@dataclass(frozen=True)
class Rays:
    """Views as directions in the camera's frame."""

    views: SignsSeen
    ray_camera: Float[Tensor, "m 3"]
    closes: Bool[Tensor, " m"]
    focal_px: float


def rays_of(views: SignsSeen, camera: Camera) -> Rays:
    """Their directions by a camera's lens."""
    ideal, closes = unproject(camera, views.px)
    ray = torch.nn.functional.normalize(torch.nn.functional.pad(ideal, (0, 1), value=1.0), dim=-1)
    return Rays(views, ray, closes, float(camera.K[0, 0]))


@dataclass(frozen=True)
class Met:
    """Where all rays to a sign together put its middle, beside each of them."""

    point_world: Float[Tensor, "m 3"]
    off_px: Float[Tensor, " m"]
    """How far the sign's middle was seen from there."""
    distance: Float[Tensor, " m"]
    """From the camera [m]."""
    counted: Bool[Tensor, " m"]
    """Of signs that are seen from directions that differ, in front of the camera."""

    @property
    def misfit_px(self) -> float:
        """The median over the views that count."""
        return float(self.off_px[self.counted].median())


def met_at(
    journey: Journey, rays: Rays, shift: int = 0, limits: ConsistencyLimits | None = None
) -> Met | None:
    """Where rays meet if detections are of frames so many later; None if too few signs are seen so that one could tell."""
    limits = limits or ConsistencyLimits()
    views = rays.views
    frame = (views.frame + shift).clamp(0, journey.frame_count - 1)
    T_world_camera = journey.T_world_camera[frame]
    origin, ray = T_world_camera[:, :3, 3], se3.rotate(T_world_camera, rays.ray_camera)
    first, _ = midpoint_ragged(origin, ray, views.sign, views.count, rays.closes.to(ray))
    # Once more with angles alike, not metres.
    weight = rays.closes / (first[views.sign] - origin).norm(dim=-1).clamp_min(1.0).square()
    point, spread = midpoint_ragged(origin, ray, views.sign, views.count, weight)
    to_point = point[views.sign] - origin
    towards = torch.nn.functional.normalize(to_point, dim=-1)
    angle = torch.linalg.cross(towards, ray).norm(dim=-1)
    least = math.radians(limits.least_parallax_deg) ** 2
    counted = rays.closes & (spread[views.sign] > least) & ((towards * ray).sum(-1) > 0)
    if int(counted.sum()) < limits.least_views:
        return None
    return Met(point[views.sign], angle * rays.focal_px, to_point.norm(dim=-1), counted)


@dataclass(frozen=True)
class Meeting:
    """The views of signs whose rays meet, beside where they meet."""

    detected_px: Float[Tensor, "m 2"]
    """Middles of outlines, raw pixels."""
    projected_px: Float[Tensor, "m 2"]
    """Where the point in which all rays of a sign meet is in the same image."""
    point_world: Float[Tensor, "m 3"]
    size: Float[Tensor, " m"]
    """The sign's larger side, by its distance [m]."""
    sign: Int[Tensor, " m"]


def meeting_of(
    journey: Journey, tracks: Tracklets, limits: ConsistencyLimits | None = None
) -> Meeting | None:
    """Where signs are seen, and where they would be from all frames together; None if that tells nothing."""
    limits = limits or ConsistencyLimits()
    views = sign_views(journey, tracks, limits.least_views)
    met = None if views is None else met_at(journey, rays_of(views, journey.rig.camera), 0, limits)
    if views is None or met is None:
        return None
    T_camera_world = se3.inverse(journey.T_world_camera[views.frame])
    px, is_seen = project(journey.rig.camera, se3.transform(T_camera_world, met.point_world))
    kept = met.counted & is_seen
    size = views.extent_px * met.distance / journey.rig.camera.K[0, 0]
    columns = (views.px, px, met.point_world, size, views.sign)
    return Meeting(*(column[kept] for column in columns))


def _scale_findings(sizes: Sequence[float], limits: ConsistencyLimits) -> list[Finding]:
    """Whether signs have the size of signs."""
    if not sizes:
        return []
    usual = sorted(sizes)[len(sizes) // 2]
    low, high = limits.size_m
    if low <= usual <= high:
        return []
    low, high = limits.usual_m
    units = [(unit, f) for unit, f in LENGTH_UNITS if low <= usual * f <= high]
    unit, factor = units[0] if len(units) == 1 else ("another unit", 0.0)
    return [
        Finding(
            "scale",
            f"signs are {usual:.2g} m large in the median",
            f"positions are in {unit}",
            "write metres",
            repair=Repair("length-unit", (factor,)) if factor else None,
        )
    ]


def crawl_findings(journey: Journey, tracks: Tracklets, limits: ConsistencyLimits) -> list[Finding]:
    """Whether a car that hardly moves does so in kilometres: `journey` as it is then, with its signs told apart.

    A car that stands sees all signs in one direction: under no unit do their rays meet.
    """
    views = sign_views(journey, tracks, limits.least_views)
    met = None if views is None else met_at(journey, rays_of(views, journey.rig.camera), 0, limits)
    if views is None or met is None or met.misfit_px > limits.meeting_px:
        return []
    focal_px = float(journey.rig.camera.K[0, 0])
    usual = float((views.extent_px * met.distance)[met.counted].median()) / focal_px
    low, high = limits.usual_m
    if not low <= usual <= high:
        return []
    return [
        Finding(
            "crawl",
            f"the car hardly moves, and signs would be {usual:.2g} mm large",
            "positions are in kilometres",
            "write metres",
            repair=Repair("length-unit", (_PER_KM,)),
        )
    ]


_PER_KM = 1e3


def _instead(
    journey: Journey, limits: ConsistencyLimits
) -> Iterator[tuple[str, Camera, int, Finding]]:
    camera = journey.rig.camera
    for shift in limits.shifts:
        cause = "frame numbers of detections and poses do not match"
        yield (
            f"frame-offset {shift}",
            camera,
            shift,
            Finding(
                "frame-offset",
                f"detections are taken {abs(shift)} frames {'later' if shift > 0 else 'earlier'}",
                cause,
                "number detections by the frame that they were made in",
                repair=Repair("frames", (float(shift),)),
            ),
        )
    lens = camera.distortion
    if camera.model == "brown_conrady" and bool((lens != 0).any()):
        for name, order in COEFFICIENT_ORDERS.items():
            other = reordered(camera, order)
            # A lens is hardly off its axis: p1 and p2 are the smallest.
            if 2 * float(other.distortion[2:4].abs().max()) > float(lens[2:4].abs().max()):
                continue
            yield (
                f"coefficient-order {name}",
                other,
                0,
                Finding(
                    "coefficient-order",
                    f"the coefficients are {name}",
                    "distortion coefficients are in another order",
                    "write k1, k2, p1, p2, k3 (OpenCV's order)",
                    repair=Repair("coefficients", tuple(map(float, order))),
                ),
            )
