"""Covariances of an adjusted map against the inverse of the whole dense system."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor
from torch.func import jacfwd

from crowdmap_torch.adjustment import adjust
from crowdmap_torch.adjustment.bundle import Bundle
from crowdmap_torch.adjustment.covariance import MapUncertainty, map_uncertainty
from crowdmap_torch.config import MapperConfig
from crowdmap_torch.geometry import polygon, se3, spline_basis
from crowdmap_torch.mapper import MapResult, build_bundle
from crowdmap_torch.noise.pose_evidence import pose_evidence
from crowdmap_torch.noise.positioning import PositioningNoise
from crowdmap_torch.optim.problem import positive
from crowdmap_torch.optim.solvers.dense import DenseBackend
from crowdmap_torch.tables import Dataset

_CUT = 60
"""Unknowns along a stretch of a drive that is cut: three stretches or more."""


def built(tiny: Dataset, tiny_result: MapResult, *, wander_m: float, cut: int) -> Bundle:
    """Three journeys with a frame every six metres."""
    config = MapperConfig()
    config = replace(
        config,
        adjust=replace(config.adjust, frame_spacing_m=6.0, cut_unknowns=cut),
        positioning=replace(config.positioning, wander_length_m=wander_m),
    )
    maps, first = tiny_result.journey_maps, tiny_result.first
    bundle = build_bundle(tiny.journeys, maps, first, config)
    adjust.start(bundle)
    return bundle


@pytest.fixture(
    scope="module",
    params=[(3000.0, 0), (60.0, 0), (3000.0, _CUT), (60.0, _CUT)],
    ids=["short", "long", "short and cut", "long and cut"],
)
def bundle(request: pytest.FixtureRequest, tiny: Dataset, tiny_result: MapResult) -> Bundle:
    """The bias is one, or wanders within what was driven; drives are whole, or cut."""
    wander_m, cut = request.param
    return built(tiny, tiny_result, wander_m=wander_m, cut=cut)


@pytest.fixture(scope="module")
def found(bundle: Bundle, tiny_result: MapResult) -> MapUncertainty:
    return map_uncertainty(bundle, tiny_result.first.signs, tiny_result.first.lanes)


@pytest.fixture(scope="module")
def dense(bundle: Bundle):
    """Joint covariance of all unknowns, and the columns of each variable's blocks."""
    with torch.no_grad():
        values = bundle.values()
        scale = bundle.prior.expected_scale(values["drift"], bundle.prior_scale, bundle.drift_told)
        problem = bundle.information(scale)
        normal = DenseBackend().assemble(problem, values)
        covariance = normal.covariance(floor=1e-9).matrix[0]

    def columns(name: str) -> Tensor:
        where = normal.where
        return where.offset[name][:, None] + torch.arange(where.tangent_dim[name])

    return covariance, columns


def test_what_signs_have_to_themselves_is_never_less_than_nothing(found: MapUncertainty):
    assert torch.allclose(found.of_their_own, found.center - found.shared, atol=1e-12)
    sure = torch.tensor([1e-4, 1.0, 4.0]).double().diag().expand_as(found.center)
    found = replace(found, center=sure, shared=torch.eye(3).double())
    expected = torch.tensor([0.0, 0.0, 3.0]).double().diag()
    assert torch.allclose(found.of_their_own, expected.expand_as(sure))


def test_centres_and_what_they_share_are_blocks_of_the_inverse(found: MapUncertainty, dense):
    covariance, columns = dense
    at = columns("sign")[:, :3]
    expected = covariance[at[:, :, None], at[:, None]]
    torch.testing.assert_close(found.center, expected, rtol=1e-5, atol=1e-9)
    rows = at.flatten()
    joint = covariance[rows][:, rows]
    alike = torch.eye(3, dtype=torch.float64).repeat(len(at), 1)
    left = joint - alike @ found.shared @ alike.mT
    value, vector = torch.linalg.eigh(left)
    # What is left is a covariance, and no more can be taken off: three of its directions are used up.
    assert (value[:3].abs() < 1e-5 * value[-1]).all() and (value[3:] > 0).all()
    more = joint - 1.001 * alike @ found.shared @ alike.mT
    assert ((vector[:, :3].mT @ more @ vector[:, :3]).diagonal() < 0).all()


def test_corners_follow_from_pose_and_size(
    bundle: Bundle, found: MapUncertainty, dense, tiny_result: MapResult
):
    covariance, columns = dense
    values, shape = bundle.values(), tiny_result.first.signs.shape
    at = torch.cat((columns("sign"), columns("size")), dim=1)
    for k in range(len(shape)):
        T, size = values["sign"][k : k + 1], values["size"][k : k + 1]
        _, _, shift = polygon.canonical_with_shift(T, size, shape[k : k + 1])

        def corners(tangent: Tensor, T=T, size=size, k=k) -> Tensor:
            moved = se3.retract(T, tangent[None, :6])
            sides = positive(size, tangent[None, 6:])
            return se3.transform(moved[:, None], polygon.corners(shape[k : k + 1], sides))[0]

        J = jacfwd(corners)(torch.zeros(8, dtype=torch.float64))
        expected = J @ covariance[at[k]][:, at[k]] @ J.mT
        count = int(polygon.corner_count(shape[k]))
        order = (torch.arange(count) + shift) % count
        torch.testing.assert_close(found.corner[k, :count], expected[order], rtol=1e-5, atol=1e-9)


def test_lane_sigmas_are_of_points_on_the_spline(
    bundle: Bundle, found: MapUncertainty, dense, tiny_result: MapResult
):
    covariance, columns = dense
    at = columns("lane")
    across = bundle.fixed["lane_prior"].constants[1][:, :, 1]
    count = tiny_result.first.lanes.control_count
    start = 0
    for c in count.tolist():
        coefficient = torch.eye(c, dtype=torch.float64)
        weight = spline_basis.from_coefficients_flat(coefficient, torch.tensor([c]))
        mine = slice(start, start + c)
        start += c
        for k in range(c):
            push = (weight[k][:, None] * across[mine][k]).flatten()
            own = at[mine].flatten()
            variance = push @ covariance[own][:, own] @ push
            assert float(found.lane_sigma[mine][k] ** 2) == pytest.approx(float(variance), rel=1e-4)


def test_biases_are_means_of_the_drift_along_the_way(bundle: Bundle, found: MapUncertainty, dense):
    covariance, columns = dense
    nodes, values = bundle.prior.nodes, bundle.values()
    at = columns("drift")
    for journey in range(3):
        mine = torch.nonzero(nodes.journey == journey)[:, 0]
        R = values["pose"][nodes.first[mine], :3, :3]
        turn = (R @ values["drift"][mine, 3:6, None])[:, 2, 0]
        mean = torch.cat((values["drift"][mine, :3].mean(0), turn.mean()[None]))
        torch.testing.assert_close(found.bias[journey], mean)
        push = torch.zeros(len(mine), bundle.prior.numbers, 4, dtype=torch.float64)
        push[:, :3, :3] = torch.eye(3)
        push[:, 3:6, 3] = R[:, 2]
        push = push.flatten(0, 1) / len(mine)
        own = at[mine].flatten()
        expected = push.mT @ covariance[own][:, own] @ push
        torch.testing.assert_close(found.bias_covariance[journey], expected, rtol=1e-5, atol=1e-10)


def test_a_journey_without_a_say_has_no_bias(tiny: Dataset, tiny_result: MapResult):
    first = tiny_result.first
    roads = [m.road for m in tiny_result.journey_maps]
    built = adjust.build(
        tiny.journeys,
        roads,
        first.signs,
        first.lanes,
        first.associations,
        first.drifts,
        PositioningNoise(),
        replace(MapperConfig().adjust, frame_spacing_m=6.0),
        trusted=[
            torch.full_like(j.t_ns, n != 1, dtype=torch.bool) for n, j in enumerate(tiny.journeys)
        ],
    )
    adjust.start(built)
    found = map_uncertainty(built, first.signs, first.lanes)
    assert found.bias[1].isnan().all() and found.bias_covariance[1].isnan().all()
    assert found.bias[[0, 2]].isfinite().all()
    assert (torch.linalg.eigvalsh(found.bias_covariance[[0, 2]]) > 0).all()


@pytest.mark.parametrize("wander_m", [3000.0, 60.0], ids=["short", "long"])
def test_drives_that_are_cut_are_solved_as_whole_ones(
    tiny: Dataset, tiny_result: MapResult, wander_m: float
):
    whole, cut = (built(tiny, tiny_result, wander_m=wander_m, cut=n) for n in (0, _CUT))
    assert len(whole.prior.cut) == 0 and len(cut.prior.cut) >= 6
    damping = torch.tensor([1e-12], dtype=torch.float64)
    of_whole, of_cut = (b.backend().assemble(b.problem(), b.values()) for b in (whole, cut))
    # What is left once the states at cuts have taken the place that they would have anyway.
    expected, found = of_whole.solve(damping), of_cut.solve(damping)
    for name, delta in expected.delta.items():
        if name != "cut":
            torch.testing.assert_close(found.delta[name], delta, rtol=1e-6, atol=1e-8)
    for name in ("pose", "drift"):
        torch.testing.assert_close(
            *(e.conditional_covariance(name) for e in (of_cut, of_whole)), rtol=1e-6, atol=1e-14
        )
    told, expected_told = (
        pose_evidence(b.prior, e, b.prior_scale) for b, e in ((cut, of_cut), (whole, of_whole))
    )
    torch.testing.assert_close(told.told, expected_told.told, rtol=1e-6, atol=1e-9)
    torch.testing.assert_close(told.left, expected_told.left, rtol=1e-6, atol=1e-14)
