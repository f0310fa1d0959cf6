"""Bundle adjustment of a simulated street whose associations are the true ones."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor
from worlds.adjusted_street import Adjusted, Street

from crowdmap_torch.adjustment import adjust
from crowdmap_torch.adjustment.config import AdjustConfig
from crowdmap_torch.adjustment.covariance import map_uncertainty
from crowdmap_torch.adjustment.observations import frame_offsets
from crowdmap_torch.evaluation.signs import SignFigures, evaluate_signs
from crowdmap_torch.geometry import camera
from crowdmap_torch.optim.levenberg_marquardt import LmConfig
from crowdmap_torch.optim.linearize import term_costs
from crowdmap_torch.studies.convergence import outliers
from crowdmap_torch.tables import Journey, Signs, Survey


def trembling(journey: Journey, sign: Tensor, seed: int) -> Journey:
    """The journey with outlines that are off to one side, each sign's for some frames to the same."""
    g = torch.Generator().manual_seed(seed)
    signs = journey.signs
    push = torch.randn(len(signs), 2, generator=g, dtype=torch.float64)
    shift, last = torch.zeros_like(push), {}
    for row in torch.argsort(signs.frame, stable=True).tolist():
        before = last.get(int(sign[row]))
        shift[row] = push[row] if before is None else 0.8 * before + 0.6 * push[row]
        last[int(sign[row])] = shift[row]
    px = signs.corners_px + shift[:, None]
    ideal = camera.unproject(journey.rig.camera, px)[0]
    return replace(journey, signs=replace(signs, corners_px=px, corners_ideal=ideal))


@pytest.fixture(scope="module")
def figures(tiny_survey: Survey) -> Callable[[Signs], SignFigures]:
    return lambda signs: evaluate_signs(signs, tiny_survey.signs)


def test_the_relative_corner_error_falls_to_less_than_half(
    street: Street, adjusted: Adjusted, figures
):
    signs, _ = adjust.read_map(adjusted.bundle, street.signs, street.lanes)
    before, after = figures(street.signs), figures(signs)
    # 0.1 m along each axis at the start; what journeys with half a pixel of noise know is 2 to 4 cm.
    assert before.relative.total.mean > 0.1
    assert after.relative.total.mean < 0.5 * before.relative.total.mean
    assert after.relative.total.mean < 0.06
    assert after.recall == before.recall


def test_a_start_a_metre_off_leads_to_the_same_map(street: Street, adjusted: Adjusted):
    generator = torch.Generator().manual_seed(1)

    def metre(*shape: int) -> Tensor:
        way = torch.randn(*shape, 3, generator=generator, dtype=torch.float64)
        return torch.nn.functional.normalize(way, dim=-1)

    T = street.signs.T_world_sign.clone()
    T[:, :3, 3] += metre(len(T))
    biases = metre(len(street.journeys))
    drifts = tuple(
        torch.cat((bias.expand(j.frame_count, 3), torch.zeros(j.frame_count, 3).double()), dim=1)
        for j, bias in zip(street.journeys, biases, strict=True)
    )
    lanes = street.lanes
    point = lanes.control.point_world + metre(len(lanes))[lanes.piece_of_control]
    lanes = replace(lanes, control=replace(lanes.control, point_world=point))
    signs = replace(street.signs, T_world_sign=T)
    far = replace(street, signs=signs, lanes=lanes, drifts=drifts)
    bundle = far.bundle()
    adjust.adjust(bundle)
    found, expected = bundle.values(), adjusted.bundle.values()
    assert all(value.isfinite().all() for value in found.values())
    # Lanes a metre off lose most of their points; they may not run away with the rest.
    assert (found["sign"] - expected["sign"])[:, :3, 3].norm(dim=1).max() < 0.1
    poses = (torch.cat(adjust.read_poses(b, street.journeys)) for b in (bundle, adjusted.bundle))
    assert torch.sub(*poses)[:, :3, 3].norm(dim=1).mean() < 0.1
    assert (found["size"] / expected["size"]).log().abs().max() < 0.1
    start = bundle.fixed["lane_prior"].constants[0]
    assert (found["lane"] - start).norm(dim=1).max() < 3.0


def test_gross_outliers_are_as_good_as_not_there(street: Street, adjusted: Adjusted):
    bundle, without = street.bundle(), street.bundle()
    rows = bundle.corners
    # All corners of one detection in 33 are 10 to 40 pixels off.
    for one, kept in zip(
        (bundle, without), outliers(rows, torch.Generator().manual_seed(2)), strict=True
    ):
        one.see(kept)
    left, every = (len((r.detection // 2).unique()) for r in (without.corners, rows))
    assert every - left > 10
    for one in (bundle, without):
        adjust.adjust(one)
    found, clean, least = (
        adjust.read_map(b, street.signs, street.lanes)[0].corners_world
        for b in (bundle, adjusted.bundle, without)
    )
    mask = street.signs.corner_mask
    # No corner tells them from detections that were not made, which cost what they would have said.
    assert (found - least).norm(dim=-1)[mask].max() < 0.01
    moved, least_moved = ((s - clean).norm(dim=-1)[mask].mean() for s in (found, least))
    assert moved < 0.01 and moved < least_moved + 0.005


def test_the_adjustment_says_that_it_converged(adjusted: Adjusted):
    assert adjusted.reason.startswith("converged")
    assert len(adjusted.costs) < adjusted.bundle.config.lm.max_iterations


def test_scales_never_grow_and_stay_above_their_least(adjusted: Adjusted):
    config = adjusted.bundle.config
    assert (adjusted.scales.diff(dim=0) <= 0).all()
    least = torch.tensor(
        [config.sign_sigma_px, config.lane_sigma_px, config.lane_correlation], dtype=torch.float64
    )
    assert (adjusted.scales >= least).all() and adjusted.scales.isfinite().all()
    # The start is 0.1 m off, several pixels; in the end the detections' own noise is left.
    assert adjusted.scales[0, 0] > 3 and adjusted.scales[-1, 0] < 1.0


def test_adjust_is_the_same_loop(street: Street, adjusted: Adjusted):
    bundle = street.bundle()
    state = adjust.adjust(bundle)
    assert float(state.cost) == pytest.approx(adjusted.costs[-1], rel=1e-9)
    for name, value in bundle.values().items():
        assert torch.allclose(value, adjusted.bundle.values()[name], atol=1e-9)


def test_a_torch_optimiser_on_the_increments_lowers_the_cost_and_stays_on_the_manifold(
    street: Street,
):
    bundle = street.bundle()
    bundle.refresh()
    problem = bundle.problem()

    def cost() -> Tensor:
        return torch.stack([c.sum() for c in term_costs(problem, bundle.values()).values()]).sum()

    # A tenth of the stiffest step: the drift from one metre to the next, 4e-4 rad.
    optimiser = torch.optim.Adam(bundle.parameters(), lr=4e-5)
    before = cost().item()
    for _ in range(20):
        optimiser.zero_grad()
        cost().backward()
        optimiser.step()
    assert cost().item() < before
    values = bundle.values()
    eye = torch.eye(3, dtype=torch.float64)
    for name in ("pose", "sign"):
        R = values[name][:, :3, :3].detach()
        assert (R @ R.mT - eye).abs().max() < 1e-12
        assert (torch.linalg.det(R) > 0).all()
        assert getattr(bundle, f"delta_{name}").abs().max() > 0
    assert (values["size"] > 0).all()
    bundle.fold({k: v.detach() for k, v in values.items()})
    assert cost().item() < before and not any(p.any() for p in bundle.parameters())


def test_covariances_are_symmetric_and_positive(street: Street, adjusted: Adjusted):
    found = map_uncertainty(adjusted.bundle, street.signs, street.lanes)
    signs, lanes = adjust.read_map(adjusted.bundle, street.signs, street.lanes, found)
    shared = found.shared
    assert torch.allclose(signs.covariance, signs.covariance.mT, atol=1e-9)
    assert torch.equal(shared, shared.mT)
    assert (torch.linalg.eigvalsh(signs.covariance) > 0).all()
    assert (torch.linalg.eigvalsh(shared) >= 0).all()
    # All share the journeys' biases, 0.3 m each and three of them: no place is better known than that.
    sigma = signs.covariance.diagonal(dim1=1, dim2=2).sqrt()
    assert sigma.min() > 0.1 and sigma.max() < 0.6
    assert (shared.diagonal() <= signs.covariance.diagonal(dim1=1, dim2=2).mean(0)).all()
    assert lanes.control.sigma.isfinite().all()
    assert lanes.control.sigma.min() > 0.05


def test_refined_poses_are_the_bundles_where_it_has_them(street: Street, adjusted: Adjusted):
    bundle = adjusted.bundle
    poses = adjust.read_poses(bundle, street.journeys)
    assert [len(p) for p in poses] == [j.frame_count for j in street.journeys]
    assert torch.equal(torch.cat(poses)[bundle.frame], bundle.values()["pose"])


def test_refined_poses_between_are_moved_like_their_neighbours(street: Street, adjusted: Adjusted):
    # With three metres between frames most are not in the bundle.
    config = replace(AdjustConfig(), frame_spacing_m=3.0, lm=LmConfig(max_iterations=8))
    bundle = street.bundle(config=config)
    adjust.adjust(bundle)
    poses = adjust.read_poses(bundle, street.journeys)
    for journey, of_all, of_few in zip(
        street.journeys, adjust.read_poses(adjusted.bundle, street.journeys), poses, strict=True
    ):
        moved = (of_few - journey.T_world_camera)[:, :3, 3]
        # White noise of frames is 2 cm and stays where a frame is not in the bundle; drift is slow.
        assert moved.diff(dim=0).norm(dim=1).max() < 0.15
        assert (of_few - of_all)[:, :3, 3].norm(dim=1).mean() < 0.1


def test_journeys_left_out_have_no_say_and_keep_their_poses(street: Street):
    bundle = street.bundle(left_out=(1,))
    offsets = frame_offsets(street.journeys)
    inside = (bundle.frame >= offsets[1]) & (bundle.frame < offsets[2])
    assert not inside.any() and len(bundle.frame)
    adjust.start(bundle)
    poses = adjust.read_poses(bundle, street.journeys)
    assert torch.equal(poses[1], street.journeys[1].T_world_camera)


def test_nothing_observed_is_a_bundle_that_moves_nothing(street: Street):
    none = torch.zeros(0, dtype=torch.int64)
    signs = street.signs[none]
    lanes = street.lanes.select(none)
    blind = tuple(replace(a, sign=torch.full_like(a.sign, -1)) for a in street.associations)
    empty = replace(street, signs=signs, lanes=lanes, associations=blind)
    bundle = empty.bundle()
    adjust.adjust(bundle)
    found = map_uncertainty(bundle, signs, lanes)
    after, lanes_after = adjust.read_map(bundle, signs, lanes, found)
    assert len(after) == len(lanes_after) == 0 and not found.shared.any()
    assert found.bias.isnan().all() and found.bias_covariance.isnan().all()
    for journey, poses in zip(
        street.journeys, adjust.read_poses(bundle, street.journeys), strict=True
    ):
        assert torch.equal(poses, journey.T_world_camera)


def test_signs_alone_and_lanes_alone_can_be_adjusted(street: Street):
    few_steps = replace(AdjustConfig(), lm=LmConfig(max_iterations=3))
    none = torch.zeros(0, dtype=torch.int64)
    blind = tuple(replace(a, sign=torch.full_like(a.sign, -1)) for a in street.associations)
    for part in (
        replace(street, lanes=street.lanes.select(none)),
        replace(street, signs=street.signs[none], associations=blind),
    ):
        bundle = part.bundle(config=few_steps)
        state = adjust.adjust(bundle)
        assert state.cost.isfinite().all()
        found = map_uncertainty(bundle, part.signs, part.lanes)
        signs, lanes = adjust.read_map(bundle, part.signs, part.lanes, found)
        shared = found.shared
        assert (torch.linalg.eigvalsh(shared) >= -1e-12).all() and shared.any()
        assert signs.covariance.isfinite().all() and lanes.control.sigma.isfinite().all()


def test_outlines_that_tremble_for_a_while_are_worth_less(street: Street, adjusted: Adjusted):
    still = adjusted.bundle
    assert float(still.lasting[0]) < 0.1
    journeys = tuple(
        trembling(journey, found.sign, seed)
        for seed, (journey, found) in enumerate(
            zip(street.journeys, street.associations, strict=True)
        )
    )
    bundle = replace(street, journeys=journeys).bundle()
    adjust.adjust(bundle)
    # Shifts of one pixel that last for five frames: nine times that variance in the mean of many, some of which the
    # poses take for theirs.
    assert 1.0 < float(bundle.lasting[0]) < 9.0
    # And the map says so, beside what all journeys share.
    a, b = (map_uncertainty(x, street.signs, street.lanes) for x in (still, bundle))
    own = [(x.center - x.shared).diagonal(dim1=1, dim2=2).sum(1) for x in (a, b)]
    assert float((own[1] / own[0]).median()) > 1.2


def test_where_no_frame_shows_the_map_it_stays_as_it_is(street: Street):
    far = street.lanes.control.point_world + torch.tensor([0.0, 0.0, 500.0], dtype=torch.float64)
    lanes = replace(street.lanes, control=replace(street.lanes.control, point_world=far))
    nothing = tuple(replace(a, sign=torch.full_like(a.sign, -1)) for a in street.associations)
    alone = replace(street, signs=street.signs[:0], lanes=lanes, associations=nothing)
    bundle = alone.bundle()
    assert len(bundle.values()["pose"]) == 0 < len(bundle.values()["lane"])
    assert adjust.adjust(bundle).done
    signs, kept = adjust.read_map(bundle, alone.signs, lanes)
    assert len(signs) == 0
    assert torch.allclose(kept.control.point_world, far, atol=1e-6)
