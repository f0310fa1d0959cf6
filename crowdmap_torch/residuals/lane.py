"""What holds lanes, cubic splines of control points in the world: pixels, the road, and each other (V-B, eq:ba).

As in `reprojection`: a residual for one observation, which many pass through with the rows last, and its Jacobians.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from crowdmap_torch.optim.problem import Follows, Jacobian
from crowdmap_torch.residuals.reprojection import (
    by_pose_and_point,
    components,
    into_camera,
    pixel_error,
    pixel_error_jacobian,
)


def lane_reprojection(
    T_world_camera: Float[Tensor, "4 4 *#rows"],
    c0: Float[Tensor, "3 *#rows"],
    c1: Float[Tensor, "3 *#rows"],
    c2: Float[Tensor, "3 *#rows"],
    c3: Float[Tensor, "3 *#rows"],
    weights: Float[Tensor, "4 *#rows"],
    normal_px: Float[Tensor, "2 *#rows"],
    observation: Float[Tensor, "3 3 *#rows"],
) -> Float[Tensor, "1 *#rows"]:
    """Pixel error of one lane point along the image normal of the projected spline (V-B, second sum of eq:ba).

    The spline point is `sum weights * coefficients`, at the closest parameter, which is held between steps. Unlike the
    paper, the error along the spline is left out: a marker has no points to match in that direction.
    """
    point = into_camera(T_world_camera, _spline_point((c0, c1, c2, c3), weights))
    return _along(normal_px, pixel_error(point, observation))


def lane_reprojection_by_car(
    T_world_camera: Float[Tensor, "4 4 *#rows"],
    c0: Float[Tensor, "3 *#rows"],
    c1: Float[Tensor, "3 *#rows"],
    c2: Float[Tensor, "3 *#rows"],
    c3: Float[Tensor, "3 *#rows"],
    optics: Float[Tensor, "k *#rows"],
    weights: Float[Tensor, "4 *#rows"],
    normal_px: Float[Tensor, "2 *#rows"],
    observation: Float[Tensor, "3 3 *#rows"],
    left_world: Float[Tensor, "3 *#rows"],
    left_m: Float[Tensor, "k *#rows"],
    by_optics: Float[Tensor, "k *#rows"],
) -> Float[Tensor, "1 *#rows"]:
    """`lane_reprojection` by a car whose camera and detector have the errors `optics`.

    They make it see the spline point by `left_m . optics` metres to the left, along `left_world`, and move what is seen by
    `by_optics . optics` pixels along the image normal. Markers that are detected to the left and markers that lie there
    look the same: so do they here, wherever a step may take them and whichever way a camera looks.
    """
    spline = _spline_point((c0, c1, c2, c3), weights)
    seen = into_camera(T_world_camera, spline + left_world * (left_m * optics).sum(0))
    return _along(normal_px, pixel_error(seen, observation)) + (by_optics * optics).sum(0)


def lane_height(
    T_world_camera: Float[Tensor, "4 4 *#rows"],
    c0: Float[Tensor, "3 *#rows"],
    c1: Float[Tensor, "3 *#rows"],
    c2: Float[Tensor, "3 *#rows"],
    c3: Float[Tensor, "3 *#rows"],
    weights: Float[Tensor, "4 *#rows"],
    road_normal_camera: Float[Tensor, "3 *#rows"],
    camera_height: Float[Tensor, "*#rows"],
) -> Float[Tensor, "1 *#rows"]:
    """Height of a spline point over the road plane under the camera [m] (IV-C, eq:ipm, as a residual).

    A car that follows a marker sees it in one plane through its own path: how low the marker lies cannot be told
    from how far aside. What can tell is the road the car stands on.
    """
    point = into_camera(T_world_camera, _spline_point((c0, c1, c2, c3), weights))
    return (components(road_normal_camera, point) - camera_height)[None]


def lane_prior(
    coefficient: Float[Tensor, "3 *#rows"],
    start: Float[Tensor, "3 *#rows"],
    R_world_lane: Float[Tensor, "3 3 *#rows"],
) -> Float[Tensor, "3 *#rows"]:
    """Displacement of a spline coefficient from its start, along the lane, across it and upwards [m]."""
    return components(R_world_lane, coefficient - start)


def lane_stretch(
    c0: Float[Tensor, "3 *#rows"],
    c1: Float[Tensor, "3 *#rows"],
    start: Float[Tensor, "3 *#rows"],
    R_world_lane: Float[Tensor, "3 3 *#rows"],
) -> Float[Tensor, "3 *#rows"]:
    """Change of the step between two neighbouring coefficients, along the lane, across it and upwards [m].

    `start` is the step at first. Observations say nothing about sliding along the marker, and little where it is hardly
    seen; a marker may slide as a whole, but its coefficients neither bunch nor tear.
    """
    return components(R_world_lane, c1 - c0 - start)


def lane_slide(
    T_world_camera: Float[Tensor, "4 4 *#rows"],
    coefficient: Float[Tensor, "3 *#rows"],
    offset: Float[Tensor, "3 *#rows"],
    along: Float[Tensor, "3 *#rows"],
) -> Float[Tensor, "1 *#rows"]:
    """How far a coefficient has slid along its marker, against a camera that drove by [m].

    Held between steps only, at the `offset` of the moment. Against a camera and not against the world: the map may
    shift as a whole, and the journeys' positions must not be counted twice.
    """
    return components(along, coefficient - T_world_camera[:3, 3] - offset)[None]


def lane_reprojection_jacobian(
    T_world_camera: Float[Tensor, "4 4 m"],
    c0: Float[Tensor, "3 m"],
    c1: Float[Tensor, "3 m"],
    c2: Float[Tensor, "3 m"],
    c3: Float[Tensor, "3 m"],
    weights: Float[Tensor, "4 m"],
    normal_px: Float[Tensor, "2 m"],
    observation: Float[Tensor, "3 3 m"],
) -> tuple[Float[Tensor, "1 m"], tuple[Jacobian, ...]]:
    """`lane_reprojection` and its Jacobians by camera pose and the four coefficients."""
    point = into_camera(T_world_camera, _spline_point((c0, c1, c2, c3), weights))
    error, by_camera = pixel_error_jacobian(point, observation)
    # The image normal makes one row of two before the chain rule goes on.
    by_camera = _along(normal_px, by_camera)
    return _along(normal_px, error), _by_pose_and_spline(T_world_camera, point, by_camera, weights)


def lane_reprojection_by_car_jacobian(
    T_world_camera: Float[Tensor, "4 4 m"],
    c0: Float[Tensor, "3 m"],
    c1: Float[Tensor, "3 m"],
    c2: Float[Tensor, "3 m"],
    c3: Float[Tensor, "3 m"],
    optics: Float[Tensor, "k m"],
    weights: Float[Tensor, "4 m"],
    normal_px: Float[Tensor, "2 m"],
    observation: Float[Tensor, "3 3 m"],
    left_world: Float[Tensor, "3 m"],
    left_m: Float[Tensor, "k m"],
    by_optics: Float[Tensor, "k m"],
) -> tuple[Float[Tensor, "1 m"], tuple[Jacobian, ...]]:
    """`lane_reprojection_by_car` and its Jacobians by camera pose, the four coefficients and the optics."""
    spline = _spline_point((c0, c1, c2, c3), weights)
    shifted = torch.addcmul(spline, left_world, (left_m * optics).sum(0))
    seen = into_camera(T_world_camera, shifted)
    error, by_camera = pixel_error_jacobian(seen, observation)
    by_camera = _along(normal_px, by_camera)
    by_left = (by_camera[0] * components(T_world_camera[:3, :3], left_world)).sum(0)
    by_car = torch.addcmul(by_optics, left_m, by_left)
    by_slot = *_by_pose_and_spline(T_world_camera, seen, by_camera, weights), by_car[None]
    return _along(normal_px, error) + (by_optics * optics).sum(0), by_slot


def lane_height_jacobian(
    T_world_camera: Float[Tensor, "4 4 m"],
    c0: Float[Tensor, "3 m"],
    c1: Float[Tensor, "3 m"],
    c2: Float[Tensor, "3 m"],
    c3: Float[Tensor, "3 m"],
    weights: Float[Tensor, "4 m"],
    road_normal_camera: Float[Tensor, "3 m"],
    camera_height: Float[Tensor, " m"],
) -> tuple[Float[Tensor, "1 m"], tuple[Jacobian, ...]]:
    """`lane_height` and its Jacobians by camera pose and the four coefficients."""
    point = into_camera(T_world_camera, _spline_point((c0, c1, c2, c3), weights))
    height = (components(road_normal_camera, point) - camera_height)[None]
    by_camera = road_normal_camera[None]
    return height, _by_pose_and_spline(T_world_camera, point, by_camera, weights)


def _spline_point(
    coefficients: tuple[Tensor, ...], weights: Float[Tensor, "4 *#rows"]
) -> Float[Tensor, "3 *#rows"]:
    """The point of a spline that its four coefficients make."""
    c0, c1, c2, c3 = coefficients
    point = torch.addcmul(c0 * weights[0], c1, weights[1])
    return torch.addcmul(torch.addcmul(point, c2, weights[2]), c3, weights[3])


def _along(
    normal_px: Float[Tensor, "2 *#rows"], error: Float[Tensor, "2 *#k_rows"]
) -> Float[Tensor, "1 *#k_rows"]:
    """Pixel errors, or their Jacobian's two rows, along an image normal."""
    return (normal_px[0] * error[0] + normal_px[1] * error[1])[None]


def _by_pose_and_spline(
    T_world_camera: Float[Tensor, "4 4 m"],
    point_camera: Float[Tensor, "3 m"],
    by_camera: Float[Tensor, "1 3 m"],
    weights: Float[Tensor, "4 m"],
) -> tuple[Jacobian, ...]:
    """Jacobians by the camera's pose and by each coefficient, which moves the point by its weight."""
    by_pose, _ = by_pose_and_point(T_world_camera, point_camera, by_camera)
    return by_pose, *(Follows(3, -weight) for weight in weights)
