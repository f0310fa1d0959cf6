"""Every residual's Jacobian in closed form against forward- and reverse-mode autograd through the retractions.

A new residual is covered by one line of CATALOGUE: its arguments are drawn by their names.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import replace
from functools import cache

import pytest
import torch
from torch import Tensor
from torch.func import jacfwd, vmap

from crowdmap_torch.geometry import se3
from crowdmap_torch.optim.linearize import autograd_jacobians, dense, residuals
from crowdmap_torch.optim.problem import CostTerm, Variable, euclidean, positive
from crowdmap_torch.residuals import lane, pose, reprojection, sign_prior

MODULES = (reprojection, lane, pose, sign_prior)
SPLINE = ("point",) * 4
CATALOGUE: dict[Callable[..., Tensor], tuple[str, ...]] = {
    reprojection.point_reprojection: ("pose", "point"),
    reprojection.sign_reprojection: ("pose", "pose", "size"),
    reprojection.sign_view: ("pose", "size"),
    reprojection.drifting_sign_view: ("pose", "size", "drift", "drift"),
    lane.lane_reprojection: ("pose", *SPLINE),
    lane.lane_reprojection_by_car: ("pose", *SPLINE, "optics"),
    lane.lane_height: ("pose", *SPLINE),
    lane.lane_prior: ("point",),
    lane.lane_stretch: ("point", "point"),
    lane.lane_slide: ("pose", "point"),
    pose.pose_prior: ("pose",),
    pose.pose_deviation: ("pose", "error"),
    pose.relative_pose: ("pose", "pose"),
    pose.gauss_markov_start: ("drift", "drift"),
    pose.gauss_markov_step: ("drift", "drift", "drift"),
    pose.wandering_start: ("wander", "error"),
    pose.wandering_step: ("wander", "wander", "error"),
    pose.sideways_parting: ("drift", "drift"),
    pose.parting_of_course: ("drift", "drift", "stance"),
    pose.parting_before_cut: ("drift", "error", "stance"),
    pose.parting_behind_cut: ("error", "drift"),
    sign_prior.sign_habit: ("pose", "size"),
    sign_prior.sign_place: ("pose", "size"),
    sign_prior.size_class: ("size",),
}
"""The kind of variable of each slot; what the residual takes beyond them is constant."""
KINDS = {
    "pose": Variable(6, se3.retract),
    "point": Variable(3, euclidean),
    "size": Variable(2, positive),
    "drift": Variable(8, euclidean),
    "error": Variable(6, euclidean),
    "wander": Variable(9, euclidean),
    "optics": Variable(7, euclidean),
    "stance": Variable(2, euclidean),
}
ROWS = 24
CORNERS = 3


@cache
def drawn() -> dict[str, Tensor]:
    """An argument of every name, rows first."""
    generator = torch.Generator().manual_seed(5)

    def noise(*shape: int, scale: float = 1.0) -> Tensor:
        return scale * torch.randn(ROWS, *shape, dtype=torch.float64, generator=generator)

    camera, to = se3.exp(noise(6)), se3.exp(noise(6))
    ahead = torch.cat((noise(2), 6 + noise(1).abs()), dim=-1)
    # Two points behind the camera, where the projection is held.
    ahead[:2, 2] = -3.0
    point, sign = se3.transform(camera, ahead), se3.exp(noise(6))
    sign[:, :3, 3] = point
    # Right at the prior, where angles vanish; next to it; far from it.
    off = noise(6, scale=0.4)
    off[0], off[1] = 0, off[1] * 1e-4
    off[2, 3:] = torch.tensor([2.0, 1.0, 0.0])
    before, after, *of_knots = (noise(8, scale=0.1) for _ in range(4))
    # By the drift's rotation a view's Jacobian is taken at none.
    before[:, 3:6], after[:, 3:6] = 0, 0
    observation = torch.eye(3).double() + noise(CORNERS, 3, 3, scale=0.02)
    steps = (0.5 * noise(3) for _ in range(4))
    names = dict(
        T_world_camera=camera, T_world_from=camera, T_world_to=to, T_world_sign=sign,
        prior=se3.retract(camera, off), measured=se3.retract(se3.inverse(camera) @ to, off),
        point_world=point, surveyed=point + noise(3), observation=observation[:, 0],
        size=0.5 + noise(2).abs(), usual=0.5 + noise(2).abs(), template=noise(2, scale=0.4),
        coefficient=point, start=noise(3), offset=noise(3), R_world_lane=to[:, :3, :3],
        weights=torch.softmax(noise(4), dim=-1), normal_px=noise(2), along=noise(3),
        road_normal_camera=noise(3), camera_height=noise(), drift=noise(6), state=noise(8),
        mean=noise(8), keep=noise(8).sigmoid(), before=before, after=after, seen=noise(),
        by_before=of_knots[0], by_after=of_knots[1], facing=noise(3), share=noise().sigmoid(),
        expected=noise(2 * CORNERS), whitening=noise(2 * CORNERS, 2 * CORNERS),
        corners_template=noise(CORNERS, 2, scale=0.4), corners_observation=observation,
    )  # fmt: skip
    names["typical_size"] = names["usual"]
    wander = dict(state=noise(9), before=noise(9), after=noise(9), mean=noise(6))
    names |= {f"wandering_{name}": value for name, value in wander.items()}
    names |= dict(optics=noise(7), left_m=noise(7, scale=0.1), by_optics=noise(7))
    names["left_world"] = torch.nn.functional.normalize(noise(3), dim=-1)
    names["wandering_keep"] = noise(9).sigmoid()
    names |= dict(stance=noise(2), of_before=noise(6), of_after=noise(6), of_stance=noise(2))
    names["cut"] = noise(6)
    return names | {f"c{i}": point + step for i, step in enumerate(steps)}


def term_of(residual: Callable[..., Tensor]) -> tuple[CostTerm, dict[str, Tensor]]:
    """A term of that residual, every slot a variable of its own, and the values to take it at."""
    kinds, names = CATALOGUE[residual], drawn()
    kind = "corners_" if residual.__name__.endswith("sign_view") else ""
    kind = "wandering_" if residual.__name__.startswith("wandering") else kind
    arguments = [
        names.get(kind + name, names[name]) for name in inspect.signature(residual).parameters
    ]
    every = torch.arange(ROWS)
    slots = tuple((f"{i}_{kind}", every) for i, kind in enumerate(kinds))
    module = next(m for m in MODULES if m.__name__ == residual.__module__)
    term = CostTerm(
        residual,
        slots,
        tuple(arguments[len(kinds) :]),
        jacobian=getattr(module, f"{residual.__name__}_jacobian", None),
    )
    return term, {name: value for (name, _), value in zip(slots, arguments, strict=False)}


def variables_of(residual: Callable[..., Tensor]) -> dict[str, Variable]:
    return {f"{i}_{kind}": KINDS[kind] for i, kind in enumerate(CATALOGUE[residual])}


def named(residual: Callable[..., Tensor]) -> str:
    return residual.__name__


def test_every_closed_jacobian_is_in_the_catalogue():
    closed = {
        name.removesuffix("_jacobian")
        for module in MODULES
        for name, function in vars(module).items()
        if name.endswith("_jacobian") and function.__module__ == module.__name__
    }
    # Steps on the way, held to autograd by the residuals that go through them.
    assert closed - {"pixel_error", "corner_errors"} <= {named(residual) for residual in CATALOGUE}


@pytest.mark.parametrize("residual", CATALOGUE, ids=named)
def test_closed_jacobians_are_those_of_forward_and_reverse_autograd(residual):
    term, values = term_of(residual)
    variables = variables_of(residual)
    blocks, kinds = tuple(values.values()), tuple(variables.values())
    error, reverse = autograd_jacobians(term, variables, values)

    def moved(tangents, blocks, constants):
        at = (
            kind.retract(block[None], xi[None])[0]
            for kind, block, xi in zip(kinds, blocks, tangents, strict=True)
        )
        return residual(*at, *constants)

    zero = tuple(torch.zeros(ROWS, kind.tangent_dim, dtype=torch.float64) for kind in kinds)
    forward = vmap(jacfwd(moved), out_dims=-1)(zero, blocks, term.constants)
    rows_last = (x.movedim(0, -1).contiguous() for x in (*blocks, *term.constants))
    value, closed = (error, reverse) if term.jacobian is None else term.jacobian(*rows_last)
    torch.testing.assert_close(value, residuals(term, values).mT)
    torch.testing.assert_close(value, error)
    for J, by_forward, by_reverse in zip(dense(closed), forward, reverse, strict=False):
        torch.testing.assert_close(J, by_forward, rtol=1e-9, atol=1e-9)
        torch.testing.assert_close(by_reverse, by_forward, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("residual", CATALOGUE, ids=named)
def test_gradients_by_autograd_are_finite_everywhere(residual):
    term, values = term_of(residual)
    leaves = {name: value.clone().requires_grad_() for name, value in values.items()}
    residuals(term, leaves).square().sum().backward()
    for leaf in leaves.values():
        assert leaf.grad is not None and bool(leaf.grad.isfinite().all())


@pytest.mark.parametrize("angle", [0.0, 1e-5, 0.5, 1.4])
@pytest.mark.parametrize("jacobian", [pose.pose_prior_jacobian, pose.relative_pose_jacobian])
def test_deviations_of_many_poses_are_those_of_one(jacobian, angle):
    """Where all are turned by less than a right angle, logarithms are taken in a shorter way."""
    T, axis = drawn()["T_world_camera"], torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64)
    turned = se3.retract(T, torch.cat((axis, angle * axis)).expand(ROWS, 6))
    at_rest = torch.eye(4, dtype=torch.float64).expand(ROWS, 4, 4)
    blocks = (turned, T) if jacobian is pose.pose_prior_jacobian else (T, turned, at_rest)
    expected = se3.local(T, turned)[:, 3:]
    found, _ = jacobian(*(x.movedim(0, -1) for x in blocks))
    torch.testing.assert_close(found[3:].mT, expected, rtol=1e-11, atol=1e-14)


def test_markers_seen_to_the_left_and_markers_that_lie_there_are_alike_wherever_the_camera_is():
    term, values = term_of(lane.lane_reprojection_by_car)
    names = drawn()
    shift = torch.linspace(-0.5, 0.5, ROWS).double()
    m = names["left_m"]
    seen = shift[:, None] * m / m.square().sum(1, keepdim=True)
    # What else the optics do to the image is not asked here.
    term = replace(term, constants=(*term.constants[:-1], torch.zeros_like(m)))
    for T in (names["T_world_camera"], se3.retract(names["T_world_camera"], names["drift"])):
        here = {**values, "0_pose": T}
        aside = names["left_world"] * shift[:, None]
        lies = {f"{i}_point": here[f"{i}_point"] + aside for i in range(1, 5)}
        torch.testing.assert_close(
            residuals(term, {**here, **lies}),
            residuals(term, {**here, "5_optics": here["5_optics"] + seen}),
        )
