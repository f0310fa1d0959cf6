"""The adjustment by autograd and in closed form, with exact lenses, and with residuals that somebody else wrote."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from crowdmap_torch.adjustment import adjust
from crowdmap_torch.adjustment.bundle import Bundle
from crowdmap_torch.adjustment.calibration import CalibrationConfig
from crowdmap_torch.config import MapperConfig
from crowdmap_torch.geometry import camera, se3
from crowdmap_torch.mapper import MapResult, build_bundle
from crowdmap_torch.optim.linearize import term_costs
from crowdmap_torch.optim.problem import CostTerm, Problem
from crowdmap_torch.tables import Dataset, Journey

Build = Callable[..., Bundle]


LENS = torch.tensor([-0.25, 0.08, 4e-4, -3e-4], dtype=torch.float64)


def through_a_lens(journey: Journey) -> Journey:
    """The same drive, had its camera a lens that bends straight lines."""
    assert journey.rig.camera.is_linear
    lens = replace(journey.rig.camera, distortion=LENS)
    signs, points = journey.signs, journey.lane_points
    return replace(
        journey,
        rig=replace(journey.rig, camera=lens),
        signs=replace(signs, corners_px=camera.distort(lens, signs.corners_ideal)),
        lane_points=replace(points, px=camera.distort(lens, points.ideal)),
    )


@pytest.fixture(scope="module")
def build(tiny: Dataset, tiny_result: MapResult) -> Build:
    """Three journeys with a frame every six metres, two of them through a lens; few steps."""
    one, *others = tiny.journeys
    journeys = (one, *(through_a_lens(journey) for journey in others))
    config = MapperConfig()

    def built(jacobians: str, calibration: CalibrationConfig | None = None) -> Bundle:
        lm = replace(config.adjust.lm, max_iterations=3)
        own = replace(config.adjust, lm=lm, frame_spacing_m=6.0, jacobians=jacobians)
        settings = replace(config, adjust=own, calibration=calibration or config.calibration)
        return build_bundle(journeys, tiny_result.journey_maps, tiny_result.first, settings)

    return built


def test_both_ways_lead_to_the_same_map(build: Build) -> None:
    closed, autograd = build("closed"), build("autograd")
    for bundle in (closed, autograd):
        adjust.adjust(bundle)
    terms = autograd.problem().terms
    assert all(term.jacobian is None for term in terms.values())
    assert any(term.jacobian is not None for term in closed.problem().terms.values())
    for name, value in closed.values().items():
        torch.testing.assert_close(autograd.values()[name], value, rtol=0, atol=1e-6)


def test_unknown_jacobians_are_refused(build: Build) -> None:
    with pytest.raises(ValueError, match="jacobians: expected one of closed, autograd"):
        build("by hand")


def exact_errors(bundle: Bundle, values: dict[str, Tensor]) -> Tensor:
    """Pixel errors of sign corners by geometry.camera alone, lens and all."""
    rows = bundle.corners
    plane = torch.nn.functional.pad(rows.template * values["size"][rows.sign], (0, 1))
    point = se3.transform(values["sign"][rows.sign], plane)
    seen = se3.transform(se3.inverse(values["pose"])[rows.frame], point)
    px = torch.zeros_like(rows.px)
    for number, lens in enumerate(bundle.lenses):
        mine = rows.lens == number
        px = px.index_put((mine,), camera.project(lens, seen[mine])[0])
    return px - rows.px


def test_the_gradient_is_that_of_the_exact_lens(build: Build) -> None:
    bundle = build("closed", CalibrationConfig.off())
    assert {lens.is_linear for lens in bundle.lenses} == {False, True}
    state = adjust.start(bundle)
    for number, _, _ in adjust.steps(bundle, state):
        if number == 1:
            break
    term = bundle.problem().terms["sign_reprojection"]
    assert term.weight is not None
    squares = (exact_errors(bundle, bundle.values()) * term.weight[:, None]).square().sum(-1)
    exact = term.loss.rho(squares).sum() / 2
    found = term_costs(Problem(bundle.variables, {"corners": term}), bundle.values())["corners"]
    torch.testing.assert_close(found.sum(), exact, rtol=1e-9, atol=1e-9)
    deltas = [bundle.get_parameter(f"delta_{name}") for name in ("pose", "sign", "size")]
    by_exact = torch.autograd.grad(exact, deltas, retain_graph=True)
    by_ours = torch.autograd.grad(found.sum(), deltas)
    for ours, theirs in zip(by_ours, by_exact, strict=True):
        scale = float(theirs.abs().max())
        assert scale > 0
        torch.testing.assert_close(ours, theirs, rtol=0, atol=1e-9 * scale)


def test_a_residual_of_ones_own_is_a_term_like_any_other(build: Build) -> None:
    bundle = build("closed")
    known = torch.tensor([0.3, -0.2, 0.1], dtype=torch.float64)

    def tied(bias: Tensor, pose: Tensor, there: Tensor) -> Tensor:
        """Of one row, without a line of derivative: on the border, and on a pose."""
        return torch.cat((bias[:3] - there, 1e-3 * (pose[:3, 3] - there)))

    first, frame = torch.zeros(1, dtype=torch.int64), torch.zeros(1, dtype=torch.int64)
    sure = bundle.scale.new_full((1,), 1e4)
    bundle.fixed["tied"] = CostTerm(tied, (("bias", first), ("pose", frame)), (known[None],), sure)
    adjust.adjust(bundle)
    torch.testing.assert_close(bundle.values()["bias"][0, :3], known, rtol=0, atol=0.05)
