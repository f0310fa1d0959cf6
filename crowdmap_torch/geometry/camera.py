"""Projection into raw, distorted pixels and back, for Brown-Conrady and Kannala-Brandt lenses.

The only file that imports kornia's cameras. A distortion model is a function from the plane z = 1
("ideal" coordinates) to pixels; everything here (Jacobian, inverse, domain) is derived from that
one function, so the lens models differ in nothing else.

A polynomial lens model is right in a neighbourhood of the optical axis only: further out a barrel
model folds back into the image. `Camera.monotonic_radius` is where that begins; rays beyond it are
never visible, pixels that only such a ray could explain never close.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Bool, Float
from kornia.geometry.calibration import distort_points, undistort_points
from kornia.geometry.camera.distortion_kannala_brandt import (
    distort_points_kannala_brandt,
    undistort_points_kannala_brandt,
)
from torch import Tensor
from torch.autograd import forward_ad
from torch.func import debug_unwrap, vjp

from crowdmap_torch.processes.amounts import at_once

MODELS = ("brown_conrady", "kannala_brandt")
COEFFICIENT_COUNTS = {"brown_conrady": (0, 4, 5, 8, 12, 14), "kannala_brandt": (4,)}
"""How many distortion coefficients each model can have."""
MAX_OFF_AXIS = math.radians(85.0)
"""Rays this far off the optical axis or further are not used [rad]."""
CLOSING_TOLERANCE_PX = 0.01
"""A pixel closes if it is undistorted and distorted again with a smaller error."""

_MIN_POLE_ANGLE = math.radians(10.0)
_LOT = 1 << 14
"""Pixels whose projective maps are found at once on a CPU: what each step makes is as large as all that is kept."""
_CHUNK = 1 << 18
_NEWTON_STEPS = 30
_CONVERGED_PX = 1e-9
_KORNIA_STEPS = 8


@dataclass(frozen=True, eq=False)
class Camera:
    """A calibrated camera: x right, y down, z forward; pixel (0, 0) is a pixel's centre."""

    model: str
    """`brown_conrady` or `kannala_brandt`."""
    width: int
    height: int
    K: Float[Tensor, "3 3"]
    distortion: Float[Tensor, " k"]
    """`brown_conrady`: OpenCV's order, 0, 4, 5, 8, 12 or 14 numbers; `kannala_brandt`: k1..k4."""

    def __post_init__(self) -> None:
        if self.model not in MODELS:
            raise ValueError(f"camera model {self.model!r} is unknown; expected one of {MODELS}")
        if self.distortion.shape[-1] not in (counts := COEFFICIENT_COUNTS[self.model]):
            raise ValueError(
                f"camera model {self.model!r} has {self.distortion.shape[-1]} distortion "
                f"coefficients; expected one of {counts}"
            )

    @property
    def is_linear(self) -> bool:
        """Whether the camera is a pinhole's, without any distortion."""
        return self.model == "brown_conrady" and self.distortion.numel() == 0

    @cached_property
    def monotonic_radius(self) -> float:
        """Radius on the plane z = 1 up to which the lens is one-to-one; `MAX_OFF_AXIS` at most."""
        return _monotonic_radius(self)

    @cached_property
    def _start_table(self) -> tuple[Tensor, Tensor]:
        return _radial_table(self)


def project(
    camera: Camera, p_camera: Float[Tensor, "*batch 3"]
) -> tuple[Float[Tensor, "*batch 2"], Bool[Tensor, "*batch"]]:
    """Raw pixels of points in the camera frame, and which of them the camera sees.

    Visible: in front, less than `MAX_OFF_AXIS` off axis, within the monotonic radius and inside the
    image. Pixels of other points are finite or not as the model pleases. Differentiable; also for
    one point under `vmap` and `jacfwd`.
    """
    z = p_camera[..., 2]
    in_front = z > 1e-9
    # Points behind the camera get a depth that keeps values and gradients finite.
    ideal = p_camera[..., :2] / torch.where(in_front, z, torch.ones_like(z))[..., None]
    px = distort(camera, ideal)
    radius_sq = ideal.square().sum(-1)
    visible = in_front & (radius_sq < camera.monotonic_radius**2) & inside_image(camera, px)
    return px, visible


def distort(camera: Camera, ideal: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 2"]:
    """Raw pixels of points on the plane z = 1; meaningful within the monotonic radius only."""
    K = camera.K.to(ideal)
    focal, centre = torch.stack((K[0, 0], K[1, 1])), K[:2, 2]
    if camera.model == "kannala_brandt":
        lens = torch.cat((focal, centre, camera.distortion.to(ideal)))
        return distort_points_kannala_brandt(ideal, lens)
    pinhole_px = ideal * focal + centre
    if camera.distortion.numel() == 0:
        return pinhole_px
    raw_px = distort_points(pinhole_px.reshape(-1, 2), K, camera.distortion.to(ideal))
    return raw_px.reshape(ideal.shape)


def unproject(
    camera: Camera, px: Float[Tensor, "*batch 2"]
) -> tuple[Float[Tensor, "*batch 2"], Bool[Tensor, "*batch"]]:
    """Points on the plane z = 1 whose raw pixels are `px`, and for which of them that is true.

    A pixel closes if the ray is less than `MAX_OFF_AXIS` off axis, lies where the lens is
    one-to-one, and projects to within `CLOSING_TOLERANCE_PX` of the pixel. Those that do not close
    hold the last iterate, which is finite.
    """
    chunks = [_unproject_chunk(camera, chunk) for chunk in px.reshape(-1, 2).split(_CHUNK)]
    ideal, closes = (torch.cat(part) for part in zip(*chunks, strict=True))
    return ideal.reshape(px.shape), closes.reshape(px.shape[:-1])


def inside_image(camera: Camera, px: Float[Tensor, "*batch 2"]) -> Bool[Tensor, "*batch"]:
    """Whether pixels lie in the image, which reaches half a pixel beyond the outermost centres."""
    u, v = px.unbind(-1)
    inside_u = (u >= -0.5) & (u <= camera.width - 0.5)
    return inside_u & (v >= -0.5) & (v <= camera.height - 0.5)


def pixel_jacobian(camera: Camera, ideal: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 2 2"]:
    """Derivative of raw pixels by ideal coordinates, by autograd of the distortion."""
    return _distort_with_jacobian(camera, ideal)[1]


def observation_matrix(
    camera: Camera,
    px: Float[Tensor, "*batch 2"],
    ideal: Float[Tensor, "*batch 2"],
    *,
    bend: Float[Tensor, "*batch 2"] | None = None,
) -> Float[Tensor, "*batch 3 3"]:
    """The matrix M that turns a camera-frame point p into its pixel error, `(M p)[:2] / (M p)[2]`.

    The error is that of the raw pixel, projected minus observed, at a point seen at `ideal` exactly so, derivative
    included: at the undistorted `px`, or wherever a solver has its point by now. Without distortion it is exact
    everywhere. With distortion the lens is replaced by the projective map that agrees with it there: with `d = p_xy / p_z -
    ideal` the error is `distort(ideal) - px + W d / (1 + g . d)`, W being the lens' derivative and g its `bend`, found
    here unless it is given.
    """
    parts = (px, ideal) if bend is None else (px, ideal, bend)
    lots = (part.reshape(-1, 2).split(at_once(_LOT, px.device)) for part in parts)
    found = [_observation_chunk(camera, *lot) for lot in zip(*lots, strict=True)]
    return torch.cat(found).view(*px.shape[:-1], 3, 3)


def _observation_chunk(
    camera: Camera,
    px: Float[Tensor, "n 2"],
    ideal: Float[Tensor, "n 2"],
    bend: Float[Tensor, "n 2"] | None = None,
) -> Float[Tensor, "n 3 3"]:
    observed, W = _distort_with_jacobian(camera, ideal)
    g = projective_bend(camera, ideal) if bend is None else bend
    # At the undistorted pixel nothing but rounding where that closes.
    offset = observed - px
    g_ideal = 1 - (g * ideal).sum(-1, keepdim=True)
    left = W + offset[..., :, None] * g[..., None, :]
    right = offset * g_ideal - (W @ ideal[..., None])[..., 0]
    top = torch.cat((left, right[..., None]), dim=-1)
    bottom = torch.cat((g, g_ideal), dim=-1)[..., None, :]
    return torch.cat((top, bottom), dim=-2)


def projective_bend(camera: Camera, ideal: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 2"]:
    """The g of `observation_matrix`; zero where its pole would be near, as next to a fold.

    Of all g, `-grad(log det W) / 3` fits the second derivatives best (it is exact for a lens that is a projective map): at
    3 px from `ideal` 0.01 px are left where W alone, g = 0, leaves 0.05, and 0.3 for fisheyes.
    """
    if camera.is_linear:
        return torch.zeros_like(ideal)

    def log_det(x: Tensor) -> Tensor:
        W = _distort_with_jacobian(camera, x)[1]
        det = W[..., 0, 0] * W[..., 1, 1] - W[..., 0, 1] * W[..., 1, 0]
        return det.abs().log()

    value, pull_back = _vjp(camera, log_det, ideal)
    g = -pull_back(torch.ones_like(value))[0] / 3
    # The nearest ray of the plane 1 + g . d = 0, whose normal in the camera frame is (g, 1 - g .
    # ideal).
    normal = torch.cat((g, 1 - (g * ideal).sum(-1, keepdim=True)), dim=-1)
    ray = torch.cat((ideal, torch.ones_like(ideal[..., :1])), dim=-1)
    sine = 1 / (normal.square().sum(-1) * ray.square().sum(-1)).sqrt()
    return torch.where((sine > math.sin(_MIN_POLE_ANGLE))[..., None], g, 0.0)


def closing_share(camera: Camera, step_px: float = 16.0) -> float:
    """Share of a grid over the image, borders included, whose pixels close.

    Below 0.9 a calibration is not usable.
    Pixels that a sound model explains by rays of `MAX_OFF_AXIS` or more (the rim of a fisheye's
    image) count neither way.
    """
    u = _grid(camera, camera.width, step_px)
    v = _grid(camera, camera.height, step_px)
    px = torch.stack(torch.meshgrid(u, v, indexing="xy"), dim=-1).reshape(-1, 2)
    closes = unproject(camera, px)[1]
    counts = closes | ~_beyond_max_off_axis(camera, px)
    return (closes.sum() / counts.sum().clamp_min(1)).item()


def _beyond_max_off_axis(camera: Camera, px: Tensor) -> Tensor:
    """Whether pixels lie outside the image of all rays up to `MAX_OFF_AXIS`, if no ray folds."""
    if camera.monotonic_radius < math.tan(MAX_OFF_AXIS) * (1 - 1e-6):
        return torch.zeros_like(px[:, 0], dtype=torch.bool)
    return _distorted_radius(camera, px)[1] >= camera._start_table[1][-1]


def _grid(camera: Camera, length: int, step_px: float) -> Tensor:
    count = max(2, math.ceil(length / step_px) + 1)
    return torch.linspace(-0.5, length - 0.5, count, dtype=camera.K.dtype, device=camera.K.device)


def _distort_with_jacobian(camera: Camera, ideal: Tensor) -> tuple[Tensor, Tensor]:
    """Pixels and their derivatives; one backward pass for each of the two pixel coordinates."""
    # Reverse mode: forward mode of the same function runs its formulas in Python, ten times as slow
    # for a thousand points.
    px, pull_back = _vjp(camera, lambda x: distort(camera, x), ideal)
    along_u = torch.zeros_like(px)
    along_u[..., 0] = 1
    rows = (pull_back(seed)[0] for seed in (along_u, along_u.flip(-1)))
    return px, torch.stack(tuple(rows), dim=-2)


def _vjp(
    camera: Camera, function: Callable[[Tensor], Tensor], x: Tensor
) -> tuple[Tensor, Callable[[Tensor], tuple[Tensor, ...]]]:
    """What `torch.func.vjp` gives of a function by a camera.

    That imports torch's compiler, 0.8 s and 80 MB in every process. It is left alone where plain autograd does: where no
    transform (`torch.func`, forward mode) is asked for derivatives, and none are by the camera.
    """
    given = (camera.K, camera.distortion)
    if any(tensor.requires_grad for tensor in given) or any(map(_is_transformed, (x, *given))):
        value, pull_back, *_ = vjp(function, x)
        return value, pull_back
    tracked = torch.is_grad_enabled() and x.requires_grad
    if tracked:
        at = x
    else:
        # Made by a factory: `requires_grad_` is refused while a transform is at work.
        at = torch.zeros_like(x, requires_grad=True)
        at.data.copy_(x.detach())
    with torch.enable_grad():
        value = function(at)

    def pull(seed: Tensor) -> tuple[Tensor, ...]:
        # Of a sum: handed the seeds themselves, autograd imports sympy.
        with torch.enable_grad():
            total = (value * seed).sum()
        return torch.autograd.grad(total, at, retain_graph=True, create_graph=tracked)

    return value if tracked else value.detach(), pull


def _is_transformed(x: Tensor) -> bool:
    return debug_unwrap(x) is not x or forward_ad.unpack_dual(x).tangent is not None


def _unproject_chunk(camera: Camera, px: Tensor) -> tuple[Tensor, Tensor]:
    finite = px.isfinite().all(-1)
    px = torch.where(finite[:, None], px, camera.K[:2, 2].to(px))
    ideal, error_px = _newton(camera, px, _kornia_start(camera, px))
    # kornia's iteration leaves its region of convergence with strong lenses; start those again from
    # a table.
    again = (~(error_px < _CONVERGED_PX)).nonzero()[:, 0]
    if len(again):
        retried, retried_error = _newton(camera, px[again], _table_start(camera, px[again]))
        better = ~(error_px[again] <= retried_error)
        ideal[again[better]], error_px[again[better]] = retried[better], retried_error[better]
    radius = ideal.square().sum(-1).sqrt()
    within = radius < camera.monotonic_radius
    return ideal, finite & within & (error_px < CLOSING_TOLERANCE_PX)


def _newton(camera: Camera, px: Tensor, start: Tensor) -> tuple[Tensor, Tensor]:
    """Ideal points and their pixel errors after damped Newton steps."""
    ideal = start.clone()
    value, J = _distort_with_jacobian(camera, ideal)
    error = (value - px).square().sum(-1).sqrt()
    step_scale = torch.ones_like(error)
    limit = camera.monotonic_radius
    active = torch.arange(len(px), device=px.device)
    for _ in range(_NEWTON_STEPS):
        active = active[(error[active] >= _CONVERGED_PX) & (step_scale[active] > 1e-4)]
        if not len(active):
            break
        step = _solve_2x2(J[active], px[active] - value[active]) * step_scale[active, None]
        moved = ideal[active] + step
        # Never more than half of what is left on the way to the fold, where the Jacobian is
        # singular.
        cap = (ideal[active].square().sum(-1).sqrt() + limit) / 2
        moved = moved * (cap / moved.square().sum(-1).sqrt().clamp_min(1e-12)).clamp_max(1)[:, None]
        moved_value, moved_J = _distort_with_jacobian(camera, moved)
        moved_error = (moved_value - px[active]).square().sum(-1).sqrt()
        accepted = moved_error < error[active]
        rows = active[accepted]
        ideal[rows], value[rows], J[rows] = (
            moved[accepted],
            moved_value[accepted],
            moved_J[accepted],
        )
        error[rows] = moved_error[accepted]
        step_scale[active] *= torch.where(accepted, 2.0, 0.25).to(step_scale)
        step_scale.clamp_max_(1)
    return ideal, error


def _solve_2x2(J: Tensor, rhs: Tensor) -> Tensor:
    (a, b), (c, d) = (row.unbind(-1) for row in J.unbind(-2))
    det = a * d - b * c
    det = torch.where(det.abs() < 1e-300, torch.ones_like(det), det)
    x, y = rhs.unbind(-1)
    return torch.stack((d * x - b * y, a * y - c * x), dim=-1) / det[..., None]


def _kornia_start(camera: Camera, px: Tensor) -> Tensor:
    """The inverse by kornia, pulled back into the monotonic radius where it left it."""
    K = camera.K.to(px)
    focal, centre = torch.stack((K[0, 0], K[1, 1])), K[:2, 2]
    if camera.distortion.numel() == 0:
        return (px - centre) / focal
    distortion = camera.distortion.to(px)
    if camera.model == "kannala_brandt":
        ideal = undistort_points_kannala_brandt(px, torch.cat((focal, centre, distortion)))
    else:
        ideal = undistort_points(px, K, distortion, num_iters=_KORNIA_STEPS)
        ideal = (ideal - centre) / focal
    radius = ideal.square().sum(-1, keepdim=True).sqrt()
    usable = radius < camera.monotonic_radius
    if bool(usable.all()):
        return ideal
    return torch.where(usable, ideal, _table_start(camera, px))


def _table_start(camera: Camera, px: Tensor) -> Tensor:
    """The inverse of the lens' radial part, by linear interpolation of a table."""
    distorted, distorted_radius = _distorted_radius(camera, px)
    table_radius, table_distorted = (column.to(px) for column in camera._start_table)
    right = torch.searchsorted(table_distorted, distorted_radius.contiguous())
    right = right.clamp(1, len(table_distorted) - 1)
    left = right - 1
    span = (table_distorted[right] - table_distorted[left]).clamp_min(1e-15)
    share = ((distorted_radius - table_distorted[left]) / span).clamp(0, 1)
    radius = table_radius[left] + share * (table_radius[right] - table_radius[left])
    return distorted * (radius / distorted_radius.clamp_min(1e-12))[:, None]


def _distorted_radius(camera: Camera, px: Tensor) -> tuple[Tensor, Tensor]:
    """Pixels relative to the image of the optical axis, over the focal length, and their norms."""
    focal = torch.stack((camera.K[0, 0], camera.K[1, 1])).to(px)
    distorted = (px - distort(camera, px.new_zeros(2))) / focal
    return distorted, distorted.square().sum(-1).sqrt()


def _radial_table(camera: Camera, count: int = 512) -> tuple[Tensor, Tensor]:
    """Radii on the plane z = 1 and the mean distorted radii (over directions) that they map to."""
    focal = torch.stack((camera.K[0, 0], camera.K[1, 1]))
    angle = torch.linspace(0, math.atan(camera.monotonic_radius), count).to(camera.K)
    radius = angle.tan() * (1 - 1e-6)
    direction = _directions(camera, 8)
    centre = distort(camera, torch.zeros_like(focal))
    distorted = (distort(camera, radius[:, None, None] * direction) - centre) / focal
    mean = distorted.square().sum(-1).sqrt().mean(-1)
    return radius, mean.cummax(0).values


def _directions(camera: Camera, count: int) -> Tensor:
    angle = torch.arange(count).to(camera.K) * (2 * math.pi / count)
    return torch.stack((angle.cos(), angle.sin()), dim=-1)


def _monotonic_radius(camera: Camera) -> float:
    """Where, going outward along any of many directions, det J first falls to zero."""
    direction = _directions(camera, 72)

    def folded(angle: Tensor) -> Tensor:
        ideal = angle.tan()[..., None] * direction
        return ~(torch.linalg.det(pixel_jacobian(camera, ideal)) > 0)

    angle = torch.linspace(0, MAX_OFF_AXIS, 341).to(camera.K)
    bad = folded(angle[:, None].expand(-1, len(direction)))
    if not bool(bad.any()):
        return math.tan(MAX_OFF_AXIS)
    first = torch.where(bad.any(0), bad.to(torch.uint8).argmax(0), len(angle) - 1)
    low, high = angle[(first - 1).clamp_min(0)], angle[first]
    share = torch.linspace(0, 1, 33).to(angle)[1:-1, None]
    for _ in range(8):
        # The first of many places between that is folded: a call costs much more than a place.
        between = torch.cat((low[None], low + share * (high - low), high[None]))
        bad = folded(between)
        bad[0], bad[-1] = False, True
        at = bad.to(torch.uint8).argmax(0, keepdim=True)
        low, high = between.gather(0, at - 1)[0], between.gather(0, at)[0]
    return math.tan(min(low.min().item(), MAX_OFF_AXIS))
