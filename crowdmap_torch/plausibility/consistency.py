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
from scipy.special import ndtr, stdtrit
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
    least_journeys: int = 4
    """Journeys from which a lever arm is concluded: what one shows is mostly the drift of its poses."""
    least_lever_m: float = 0.6
    """Shorter levers are not named."""
    size_m: tuple[float, float] = (0.05, 25.0)
    """Median size of the signs: less and more is another unit of positions."""
    usual_m: tuple[float, float] = (0.3, 2.5)
    """The same under the unit that is named."""
    meeting_px: float = 15.0
    """How far rays may miss each other where their meeting alone tells a unit."""
    sure: float = 3.0
    """Standard deviations that a lever has to exceed; of few journeys as many as are as rare by Student's distribution."""


_REWEIGHTINGS = 8
"""Rounds of reweighting by Cauchy's loss."""


@dataclass(frozen=True)
class _Views:
    """Views of the signs of one journey: raw pixels of the outlines' middles."""

    px: Float[Tensor, "m 2"]
    extent_px: Float[Tensor, " m"]
    frame: Int[Tensor, " m"]
    sign: Int[Tensor, " m"]
    count: int


def consistency_findings(
    journeys: Sequence[Journey],
    tracklets: Sequence[Tracklets],
    limits: ConsistencyLimits | None = None,
) -> list[Finding]:
    """Mistakes of all journeys under which their signs' rays do not meet."""
    limits = limits or ConsistencyLimits()
    given_px: list[float] = []
    sizes: list[float] = []
    levers: list[_Lever] = []
    tried: dict[str, list[float]] = {}
    findings: dict[str, Finding] = {}
    for journey, tracks in zip(journeys, tracklets, strict=True):
        views = _views(journey, tracks, limits)
        rays = None if views is None else _rays(views, journey.rig.camera)
        met = None if rays is None else _met(journey, rays, 0, limits)
        if views is None or rays is None or met is None:
            continue
        given = met.misfit_px
        sizes.append(float((views.extent_px * met.distance)[met.counted].median()) / rays.focal_px)
        given_px.append(given)
        levers.append(_lever(journey, rays))
        for name, camera, shift, finding in _instead(journey, limits):
            other = rays if camera is journey.rig.camera else _rays(views, camera)
            under = _met(journey, other, shift, limits)
            ratio = math.inf if under is None else under.misfit_px / given
            tried.setdefault(name, []).append(ratio)
            findings[name] = finding
    if scale := _scale_findings(sizes, limits):
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
        return _lever_findings(levers, limits)
    ratio, name = min(named)
    usual = sorted(given_px)[len(given_px) // 2]
    evidence = (
        f"rays to one sign miss each other by {usual:.1f} px, and by {ratio * usual:.1f} px if"
    )
    return [replace(findings[name], evidence=f"{evidence} {findings[name].evidence}")]


def _views(journey: Journey, tracks: Tracklets, limits: ConsistencyLimits) -> _Views | None:
    label = tracks.label
    often = torch.bincount(label[label >= 0], minlength=tracks.count) >= limits.least_views
    used = (
        torch.nonzero((label >= 0) & often[label.clamp_min(0)])[:, 0] if tracks.count else label[:0]
    )
    if not len(used):
        return None
    sign, compact = label[used].unique(return_inverse=True)
    corners = journey.signs.corners_px[used]
    middle = (corners.amin(1) + corners.amax(1)) / 2
    extent = (corners.amax(1) - corners.amin(1)).amax(-1)
    return _Views(middle, extent, journey.signs.frame[used], compact, len(sign))


@dataclass(frozen=True)
class _Rays:
    """Views as directions in the camera's frame."""

    views: _Views
    ray_camera: Float[Tensor, "m 3"]
    closes: Bool[Tensor, " m"]
    focal_px: float


def _rays(views: _Views, camera: Camera) -> _Rays:
    ideal, closes = unproject(camera, views.px)
    ray = torch.nn.functional.normalize(torch.nn.functional.pad(ideal, (0, 1), value=1.0), dim=-1)
    return _Rays(views, ray, closes, float(camera.K[0, 0]))


@dataclass(frozen=True)
class _Met:
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


def _met(journey: Journey, rays: _Rays, shift: int, limits: ConsistencyLimits) -> _Met | None:
    """Where rays meet if detections are of frames so many later; None if too few signs are seen so that one could tell."""
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
    return _Met(point[views.sign], angle * rays.focal_px, to_point.norm(dim=-1), counted)


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
    views = _views(journey, tracks, limits)
    met = None if views is None else _met(journey, _rays(views, journey.rig.camera), 0, limits)
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
    views = _views(journey, tracks, limits)
    met = None if views is None else _met(journey, _rays(views, journey.rig.camera), 0, limits)
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


@dataclass(frozen=True)
class _Lever:
    """Where, in the camera's frame, a journey's positions are of, if not of the camera."""

    place: Float[Tensor, " 3"]
    """By the rays' best meeting [m]."""
    information: Float[Tensor, "3 3"]
    """What its rays tell of it; what the poses' drift does to it is not in there."""


def _lever(journey: Journey, rays: _Rays) -> _Lever:
    """The lever under which the rays of a journey meet best.

    A lever moves all views of a straight drive alike; only where the car turns does it keep rays apart. Signs are
    eliminated, what is left are three unknowns.
    """
    views = rays.views
    T = journey.T_world_camera[views.frame]
    R, given = T[:, :3, :3], T[:, :3, 3]
    ray = se3.rotate(T, rays.ray_camera)
    eye = torch.eye(3, dtype=ray.dtype, device=ray.device)
    across = eye - ray[:, :, None] * ray[:, None]
    weight, lever, information = rays.closes.to(ray), ray.new_zeros(3), eye
    for _ in range(_REWEIGHTINGS):
        origin = given - R @ lever
        point, _ = midpoint_ragged(origin, ray, views.sign, views.count, weight)
        off = (across @ (origin - point[views.sign])[..., None])[..., 0]
        away = (point[views.sign] - origin).norm(dim=-1).clamp_min(1.0)
        angle = off.norm(dim=-1) / away
        usual = angle.median().clamp_min(1e-6)
        weight = rays.closes / away.square() / (1 + (angle / usual).square())
        by_point = weight[:, None, None] * across
        # [[A, B], [B^T, C]] over signs and the lever; A is block diagonal.
        A = ray.new_zeros(views.count, 3, 3).index_add(0, views.sign, by_point) + 1e-9 * eye
        B = ray.new_zeros(views.count, 3, 3).index_add(0, views.sign, by_point @ R)
        at = (by_point @ given[..., None])[..., 0]
        right = ray.new_zeros(views.count, 3).index_add(0, views.sign, at)
        solved = torch.linalg.solve(A, torch.cat((B, right[..., None]), dim=-1))
        C = (R.mT @ by_point @ R).sum(0) - (B.mT @ solved[..., :3]).sum(0)
        rest = (R.mT @ at[..., None])[..., 0].sum(0) - (B.mT @ solved[..., 3:])[..., 0].sum(0)
        lever = torch.linalg.solve(C + 1e-9 * eye, rest)
        information = C / usual.square()
    return _Lever(lever, information)


def _lever_findings(levers: Sequence[_Lever], limits: ConsistencyLimits) -> list[Finding]:
    """Whether the journeys agree that positions are of another place on the car, ahead of the camera or behind it."""
    count = len(levers)
    if count < limits.least_journeys:
        return []
    information = torch.stack([lever.information for lever in levers])
    told = (information @ torch.stack([lever.place for lever in levers])[..., None])[..., 0]
    # Of all journeys, and of all but one in turn: what drift does to each of them shows in how these differ (jackknife).
    without = torch.linalg.solve(information.sum(0) - information, told.sum(0) - told)[:, 2]
    usual = float(torch.linalg.solve(information.sum(0), told.sum(0))[2])
    sigma = float((count - 1) ** 0.5 * without.std(correction=0))
    as_rare = float(stdtrit(count - 1, ndtr(limits.sure)))
    if abs(usual) < max(limits.least_lever_m, as_rare * sigma):
        return []
    where = "ahead of" if usual > 0 else "behind"
    return [
        Finding(
            "lever-arm",
            f"rays to one sign meet best if positions are of a place {abs(usual):.1f} m {where} "
            f"the camera (sigma {sigma:.1f} m)",
            "positions are of an antenna or an IMU, not of the pose link",
            "give the rig a mount (rig.urdf) from that place to the camera",
        )
    ]


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
