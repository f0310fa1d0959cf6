"""Whether positions are of another place on the car than its camera, ahead of it or behind it: an antenna, an IMU.

Such a lever moves all that a straight drive sees alike; only where the car turns does it keep rays to a sign apart. So does
the drift of the poses: which of the two it was is a matter of how much the car turned, and a sigma says so.

Rotations must not be asked where the car headed: where one is wrong, so is the ray, by the sign's distance, and drives on
straight roads would all show levers of metres, ahead of the camera. The chord of the way from some metres before to as many
after says it, too, and what is wrong with that has nothing to do with the rays (an instrumental variable).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import astuple, dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from crowdmap_torch.geometry import se3
from crowdmap_torch.geometry.trajectory import station
from crowdmap_torch.noise.positioning import PositioningNoise
from crowdmap_torch.plausibility.consistency import Rays, met_at, rays_of, sign_views
from crowdmap_torch.plausibility.finding import Finding
from crowdmap_torch.tables import Journey, Tracklets


@dataclass(frozen=True)
class LeverLimits:
    """What counts, and when a lever is named."""

    views: tuple[int, int] = (4, 16)
    """Fewest views of a sign that counts, and the most of them that are looked at."""
    at_once: int = 1024
    """Views of a drive whose errors are one covariance, at most; longer drives are looked at stretch by stretch."""
    furthest_m: float = 120.0
    """Signs beyond that say nothing."""
    slipped: float = 5.0
    """Views that miss the others of their sign by more than so many times the median have no say."""
    half_chord_m: float = 10.0
    """How far before and behind a view the car's way is looked at for where it headed."""
    straight: float = 0.7
    """Least length of the chord, as a share of the way: cars that turn on the spot or drive back have no say there."""
    least_journeys: int = 4
    """Journeys from which a lever is concluded: how they differ says whether the noise is what it is thought to be."""
    least_m: float = 0.6
    """Shorter levers are not named."""
    sure: float = 3.0
    """Standard deviations that a lever has to exceed."""


@dataclass(frozen=True)
class Lever:
    """How far ahead of the camera the place is that positions are of [m]."""

    ahead_m: float
    sigma_m: float
    """With the drift of the poses, and by how journeys differ where they do so more than drift explains."""

    @property
    def significance(self) -> float:
        """How many standard deviations it is."""
        return abs(self.ahead_m) / self.sigma_m

    def shortest_m(self, limits: LeverLimits) -> float:
        """Levers that are shorter would not be named, for all that the drives tell [m]."""
        return max(limits.least_m, limits.sure * self.sigma_m)


@dataclass(frozen=True)
class Said:
    """What a journey says of the lever: `told = gain * lever + noise`."""

    told: float
    gain: float
    variance: float
    """Of the noise."""


HIDDEN_LEVER = "lever-hidden"
"""The kind of what is no mistake: that one would not show."""
_LEAST_PX, _USUAL_PX = 0.2, 0.7
"""Noise of a sign's middle: at least, and before views say what it is."""
_ROUNDS = 4
"""Of Cauchy's weights."""
_FLAT = 1e-9
"""What is known of signs before they are seen, as a share of what is known of them then."""


def lever_of(said: Sequence[Said | None], limits: LeverLimits | None = None) -> Lever | None:
    """The lever that all journeys together show; None where too few of them tell anything."""
    return _together([one for one in said if one is not None], limits or LeverLimits())


def lever_findings(lever: Lever | None, limits: LeverLimits | None = None) -> list[Finding]:
    """Whether positions are of another place than the camera."""
    limits = limits or LeverLimits()
    if lever is None or abs(lever.ahead_m) < lever.shortest_m(limits):
        return []
    where = "ahead of" if lever.ahead_m > 0 else "behind"
    return [
        Finding(
            "lever-arm",
            f"rays to one sign meet best if positions are of a place {abs(lever.ahead_m):.1f} m {where} "
            f"the camera (sigma {lever.sigma_m:.1f} m)",
            "positions are of an antenna or an IMU, not of the pose link",
            "give the rig a mount (rig.urdf) from that place to the camera",
        )
    ]


def hidden_lever(lever: Lever | None, limits: LeverLimits | None = None) -> list[Finding]:
    """Which levers would not show in these drives; nothing where none is asked for, or all that count would."""
    limits = limits or LeverLimits()
    if lever is None or lever_findings(lever, limits):
        return []
    shortest = lever.shortest_m(limits)
    if shortest <= limits.least_m:
        return []
    return [
        Finding(
            HIDDEN_LEVER,
            f"cars turn little while they see signs: only positions of a place {shortest:.1f} m or more ahead of the "
            "camera or behind it would show",
            "few drives, or straight roads",
            "measure what positions are of, an antenna, an IMU or the camera, or check more drives",
        )
    ]


def _together(said: Sequence[Said], limits: LeverLimits) -> Lever | None:
    gain = sum(one.gain for one in said)
    if len(said) < limits.least_journeys or gain <= 0:
        return None
    ahead = sum(one.told for one in said) / gain
    misfit = sum((one.told - ahead * one.gain) ** 2 / one.variance for one in said)
    scatter = max(1.0, misfit / (len(said) - 1))
    return Lever(ahead, math.sqrt(scatter * sum(one.variance for one in said)) / gain)


@dataclass(frozen=True)
class _Seen:
    """Views that count, in the order of their frames."""

    T_world_camera: Float[Tensor, "m 4 4"]
    ray_world: Float[Tensor, "m 3"]
    heading: Float[Tensor, "m 3"]
    """Unit vectors along the chord."""
    point_world: Float[Tensor, "m 3"]
    """Where the sign is about."""
    station: Float[Tensor, " m"]
    frame: Int[Tensor, " m"]
    sign: Int[Tensor, " m"]
    count: int
    focal_px: float


def said_of_lever(
    journey: Journey,
    tracks: Tracklets,
    positioning: PositioningNoise,
    limits: LeverLimits | None = None,
) -> Said | None:
    """What a journey says of the lever; None where it tells nothing."""
    limits = limits or LeverLimits()
    views = sign_views(journey, tracks, limits.views[0])
    rays = None if views is None else rays_of(views, journey.rig.camera)
    seen = None if rays is None else _seen(journey, rays, limits)
    if seen is None:
        return None
    pieces = [_of(piece, positioning) for piece in _pieces(seen, limits)]
    told, gain, variance = (sum(of_each) for of_each in zip(*map(astuple, pieces), strict=True))
    return Said(told, gain, variance)


def _seen(journey: Journey, rays: Rays, limits: LeverLimits) -> _Seen | None:
    met = met_at(journey, rays)
    if met is None:
        return None
    views, along = rays.views, station(journey.T_world_camera)
    heading, is_known = _headings(journey, along, limits)
    usual = met.off_px[met.counted].median()
    counted = met.counted & is_known[views.frame] & (met.distance < limits.furthest_m)
    rows = _thinned(counted & (met.off_px <= limits.slipped * usual), views.sign, limits.views)
    if not len(rows):
        return None
    rows = rows[views.frame[rows].argsort(stable=True)]
    frame = views.frame[rows]
    T = journey.T_world_camera[frame]
    sign = views.sign[rows].unique(return_inverse=True)[1]
    ray = se3.rotate(T, rays.ray_camera[rows])
    columns = (T, ray, heading[frame], met.point_world[rows], along[frame], frame, sign)
    return _Seen(*columns, int(sign.max()) + 1, rays.focal_px)


def _pieces(seen: _Seen, limits: LeverLimits) -> list[_Seen]:
    """Stretches of a long drive, whose drift has forgotten that of the one before; each has signs of its own."""
    count = len(seen.frame)
    if count <= limits.at_once:
        return [seen]
    # Signs in the order in which they come into sight.
    first = seen.frame.new_full((seen.count,), count)
    first.scatter_reduce_(0, seen.sign, torch.arange(count, device=first.device), "amin")
    order = first.argsort()
    before = torch.bincount(seen.sign, minlength=seen.count)[order].cumsum(0) - 1
    each = math.ceil(count / math.ceil(2 * count / limits.at_once))
    piece = torch.empty_like(order)
    piece[order] = before // each
    pieces = []
    for number in piece.unique():
        rows = torch.nonzero(piece[seen.sign] == number)[:, 0]
        own, sign = seen.sign[rows].unique(return_inverse=True)
        pieces.append(
            _Seen(
                T_world_camera=seen.T_world_camera[rows],
                ray_world=seen.ray_world[rows],
                heading=seen.heading[rows],
                point_world=seen.point_world[rows],
                station=seen.station[rows],
                frame=seen.frame[rows],
                sign=sign,
                count=len(own),
                focal_px=seen.focal_px,
            )
        )
    return pieces


def _thinned(
    counted: Bool[Tensor, " m"], sign: Int[Tensor, " m"], views: tuple[int, int]
) -> Int[Tensor, " k"]:
    """Rows that count, of each sign some of its first to its last; none of signs with too few."""
    fewest, most = views
    kept = [sign[:0]]
    for own in sign[counted].unique():
        rows = torch.nonzero(counted & (sign == own))[:, 0]
        if len(rows) >= fewest:
            some = torch.linspace(0, len(rows) - 1, min(most, len(rows)), device=rows.device)
            kept.append(rows[some.round().long()])
    return torch.cat(kept)


def _headings(
    journey: Journey, along: Float[Tensor, " f"], limits: LeverLimits
) -> tuple[Float[Tensor, "f 3"], Bool[Tensor, " f"]]:
    """The chord of the way around every frame as a unit vector, to where the camera looks, and where that is a heading."""
    T, half = journey.T_world_camera, limits.half_chord_m
    ends = [_at(along, T[:, :3, 3], along + shift) for shift in (-half, half)]
    chord = ends[1] - ends[0]
    length = chord.norm(dim=-1)
    heading = chord / length.clamp_min(1e-6)[:, None]
    ahead = (heading * T[:, :3, 2]).sum(-1)
    inside = (along - half >= along[0]) & (along + half <= along[-1])
    told = inside & (length > limits.straight * 2 * half) & (ahead.abs() > limits.straight)
    return heading * ahead.sign()[:, None], told


def _at(
    along: Float[Tensor, " f"], place: Float[Tensor, "f 3"], wanted: Float[Tensor, " f"]
) -> Float[Tensor, "f 3"]:
    """Places at ways along the drive, linear in between."""
    after = torch.searchsorted(along, wanted.contiguous()).clamp(1, len(along) - 1)
    before = after - 1
    step = (along[after] - along[before]).clamp_min(1e-9)
    share = ((wanted - along[before]) / step).clamp(0.0, 1.0)[:, None]
    return (1 - share) * place[before] + share * place[after]


def _of(seen: _Seen, positioning: PositioningNoise) -> Said:
    """What signs at unknown places, seen from poses that drift, say of the lever.

    Signs are found first, as if there were none (Gauss-Newton, drift and noise as one covariance). What they leave is
    regressed on how the lever would show, with how it would show by the chords as instrument.
    """
    m, n = len(seen.frame), seen.count
    point = seen.ray_world.new_zeros(n, 3).index_copy(0, seen.sign, seen.point_world)
    inflated, noise_px = seen.ray_world.new_ones(m), _USUAL_PX
    for _ in range(_ROUNDS):
        w = _whitened(seen, point, noise_px, inflated, positioning)
        moved = w.solved(w.missed)
        left = w.missed - w.by_sign @ moved
        left = torch.linalg.solve_triangular(w.root.mT, left[:, None], upper=True)
        # What of a misfit is the pixels' own, in their standard deviations but for Cauchy's weights.
        own = left.unflatten(0, (m, 2))[..., 0].norm(dim=-1) * w.noise_m * inflated.sqrt()
        noise_px = max(_LEAST_PX, noise_px * float(own.median()))
        inflated = 1 + own.square()
        point = point + moved.unflatten(0, (n, 3))
    w = _whitened(seen, point, noise_px, inflated, positioning)
    asked = w.asked - w.by_sign @ w.solved(w.asked)
    return Said(float(asked @ w.missed), float(asked @ w.shows), float(asked @ asked))


@dataclass(frozen=True)
class _Whitened:
    """Errors across the rays, two for each view, in standard deviations, and what they would do if something changed."""

    missed: Float[Tensor, " k"]
    by_sign: Float[Tensor, "k p"]
    shows: Float[Tensor, " k"]
    """By a metre of lever where the camera looks by its rotation, ..."""
    asked: Float[Tensor, " k"]
    """... and where it does by the chord."""
    root: Float[Tensor, "k k"]
    """Of the covariance [m]."""
    noise_m: Float[Tensor, " m"]
    """What of it is the pixels' own."""

    def solved(self, wanted: Float[Tensor, " k"]) -> Float[Tensor, " p"]:
        """How far signs move to come nearest to errors."""
        N = self.by_sign.mT @ self.by_sign
        flat = _FLAT * N.diagonal().mean() * torch.eye(len(N)).to(N)
        return torch.linalg.solve(N + flat, self.by_sign.mT @ wanted)


def _whitened(
    seen: _Seen,
    point: Float[Tensor, "n 3"],
    noise_px: float,
    inflated: Float[Tensor, " m"],
    positioning: PositioningNoise,
) -> _Whitened:
    T, ray = seen.T_world_camera, seen.ray_world
    off = point[seen.sign] - T[:, :3, 3]
    distance = off.norm(dim=-1)
    towards = off / distance[:, None]
    E = _across(towards)
    noise_m = noise_px / seen.focal_px * distance * inflated.sqrt()
    S = _covariance(seen, E, distance, positioning)
    root = torch.linalg.cholesky(S + torch.diag(noise_m.square().repeat_interleave(2)))
    on_plane = ray / (ray * towards).sum(-1, keepdim=True) * distance[:, None]
    by_sign = ray.new_zeros(len(ray), 2, seen.count, 3)
    by_sign[torch.arange(len(ray)), :, seen.sign] = E
    columns = torch.stack((on_plane, T[:, :3, 2], seen.heading), dim=-1)
    both = torch.cat((by_sign.flatten(2), E @ columns), dim=-1).flatten(0, 1)
    white = torch.linalg.solve_triangular(root, both, upper=False)
    missed, shows, asked = white[:, -3:].unbind(-1)
    return _Whitened(missed, white[:, :-3], shows, asked, root, noise_m)


def _across(towards: Float[Tensor, "m 3"]) -> Float[Tensor, "m 2 3"]:
    """Two unit vectors across each direction, one of them level."""
    up = torch.zeros_like(towards)
    up[:, 2] = 1.0
    level = torch.nn.functional.normalize(torch.linalg.cross(up, towards), dim=-1)
    return torch.stack((level, torch.linalg.cross(towards, level)), dim=1)


def _covariance(
    seen: _Seen,
    E: Float[Tensor, "m 2 3"],
    distance: Float[Tensor, " m"],
    positioning: PositioningNoise,
) -> Float[Tensor, "k k"]:
    """Covariance of what poses get wrong in all views of a drive, across the rays [m^2]."""
    p = positioning
    way = (seen.station[:, None] - seen.station).abs()
    is_same = (seen.frame[:, None] == seen.frame).to(way)
    place = p.drift_sigma_m**2 * torch.exp(-way / p.drift_length_m) + p.white_sigma_m**2 * is_same
    turn = (
        p.rotation_sigma_rad**2 * torch.exp(-way / p.rotation_length_m)
        + p.white_sigma_rad**2 * is_same
        + p.bias_sigma_rad**2
    ) * (distance[:, None] * distance)
    turned = torch.stack((E[:, 1], -E[:, 0]), dim=1)
    by_place = torch.einsum("iac,jbc->iajb", E, E) * place[:, None, :, None]
    by_turn = torch.einsum("iac,jbc->iajb", turned, turned) * turn[:, None, :, None]
    return (by_place + by_turn).flatten(2).flatten(0, 1)
