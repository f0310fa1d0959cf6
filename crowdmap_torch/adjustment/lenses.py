"""Points of images, and the lenses around them: exact where the solver has each point by now, projective within a step.

A pixel error is `distort(p_xy / p_z) - px`, by the camera's own model (geometry.camera). Within one step of the solver the
lens is replaced by its observation matrix at the point's own place: there value and derivative are the exact ones, and
what a step moves the point by is a few pixels. So a step costs what it costs without a lens, and the minimum is that of
the exact model.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.geometry import camera
from crowdmap_torch.geometry.camera import Camera
from crowdmap_torch.residuals.reprojection import MIN_DEPTH
from crowdmap_torch.tables import Journey, Rows

_WITHIN = 0.99
"""Share of the radius up to which a lens is one-to-one, beyond which, as nearer than `MIN_DEPTH`, it is taken
as it is around the detection."""
Seen = TypeVar("Seen", bound="SeenPoints")


@dataclass(frozen=True)
class SeenPoints(Rows):
    """Points seen in frames."""

    frame: Int[Tensor, " m"]
    """Frame, counted over all journeys."""
    lens: Int[Tensor, " m"]
    """Number of the camera (`lenses_of`)."""
    px: Float[Tensor, "m 2"]
    """Raw, distorted pixel."""
    ideal: Float[Tensor, "m 2"]
    """The same, undistorted, on the plane z = 1."""
    bend: Float[Tensor, "m 2"]
    """Of the lens there (`projective_bend`)."""
    matrix: Float[Tensor, "m 3 3"]
    """Observation matrix: around the detection, until `relinearised`."""


def lenses_of(journeys: Sequence[Journey]) -> tuple[tuple[Camera, ...], list[int]]:
    """The different cameras of some journeys, and the number of each journey's."""
    found: dict[tuple, Camera] = {}
    keys = [_key(journey.rig.camera) for journey in journeys]
    for key, journey in zip(keys, journeys, strict=True):
        found.setdefault(key, journey.rig.camera)
    number = {key: k for k, key in enumerate(found)}
    return tuple(found.values()), [number[key] for key in keys]


def seen_points(
    lens: Camera, number: int, px: Float[Tensor, "m 2"], ideal: Float[Tensor, "m 2"]
) -> dict[str, Any]:
    """The columns of `SeenPoints`, but for the frame, of points seen by one camera."""
    bend = camera.projective_bend(lens, ideal)
    return {
        "lens": torch.full(px.shape[:1], number, dtype=torch.int64, device=px.device),
        "px": px,
        "ideal": ideal,
        "bend": bend,
        "matrix": camera.observation_matrix(lens, px, ideal, bend=bend),
    }


def rows_by_lens(seen: SeenPoints, lenses: Sequence[Camera]) -> tuple[Int[Tensor, " _"], ...]:
    """The points of each camera, none of those that are exact as they are."""
    return tuple(
        torch.nonzero((seen.lens == number) & (not lens.is_linear))[:, 0]
        for number, lens in enumerate(lenses)
    )


def relinearised(
    seen: Seen,
    lenses: Sequence[Camera],
    rows: Sequence[Int[Tensor, " _"]],
    point_camera: Float[Tensor, "m 3"],
) -> Seen:
    """The points with the lens as it is where `point_camera` are; `rows` are those of `rows_by_lens`."""
    matrix = seen.matrix.clone()
    for lens, mine in zip(lenses, rows, strict=True):
        if not len(mine):
            continue
        point, around = point_camera[mine], seen.ideal[mine]
        depth = point[:, 2:].clamp_min(MIN_DEPTH)
        ideal = point[:, :2] / depth
        radius = ideal.square().sum(-1, keepdim=True).sqrt()
        sound = (point[:, 2:] > MIN_DEPTH) & (radius < _WITHIN * lens.monotonic_radius)
        at = torch.where(sound, ideal, around)
        matrix[mine] = camera.observation_matrix(lens, seen.px[mine], at, bend=seen.bend[mine])
    return replace(seen, matrix=matrix)


def _key(lens: Camera) -> tuple:
    """What two cameras have in common if they are alike."""
    numbers = (*lens.K.flatten().tolist(), *lens.distortion.tolist())
    return lens.model, lens.width, lens.height, *numbers
