"""Bundle adjustment of a simulated street whose associations are the true ones."""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
import torch
from torch import Tensor
from worlds.drives import signs_by_detection

from crowdmap_torch.adjustment import adjust
from crowdmap_torch.adjustment.bundle import Bundle
from crowdmap_torch.adjustment.config import AdjustConfig
from crowdmap_torch.adjustment.covariance import MapUncertainty, map_uncertainty
from crowdmap_torch.adjustment.observations import frame_offsets
from crowdmap_torch.evaluation.signs import SignFigures, evaluate_signs
from crowdmap_torch.geometry import camera, polygon, se3
from crowdmap_torch.io.maps import read_map
from crowdmap_torch.io.stages import read_stage, write_stage
from crowdmap_torch.io.trees import digest
from crowdmap_torch.io.truth import JourneyTruth, Truth
from crowdmap_torch.mapper import MapResult
from crowdmap_torch.noise.pose_prior import PosePriorConfig
from crowdmap_torch.noise.positioning import PositioningNoise
from crowdmap_torch.optim import levenberg_marquardt as lm
from crowdmap_torch.optim.levenberg_marquardt import LmConfig
from crowdmap_torch.optim.linearize import term_costs
from crowdmap_torch.studies.convergence import outliers
from crowdmap_torch.tables import Association, Dataset, Journey, Lanes, RoadEstimate, Signs, Survey

START_SIGMA_M = 0.1
"""What the cluster heads are off by at the start, along each axis."""


@dataclass(frozen=True)
class Street:
    """All that a bundle is built from."""

    journeys: tuple[Journey, ...]
    roads: tuple[RoadEstimate, ...]
    signs: Signs
    lanes: Lanes
    associations: tuple[Association, ...]
    drifts: tuple[Tensor, ...]

    def bundle(
        self, *, left_out: tuple[int, ...] = (), config: AdjustConfig | None = None
    ) -> Bundle:
        return adjust.build(
            self.journeys,
            self.roads,
            self.signs,
            self.lanes,
            self.associations,
            self.drifts,
            PositioningNoise(),
            config or AdjustConfig(),
            trusted=[
                torch.full_like(journey.t_ns, number not in left_out, dtype=torch.bool)
                for number, journey in enumerate(self.journeys)
            ],
        )


def true_association(truth: JourneyTruth, signs: Signs, row_of_sign: Tensor) -> Association:
    """What each detection truly shows, and which of its corners is the sign's first."""
    journey = truth.journey
    true = signs_by_detection(truth)
    row = torch.where(true >= 0, row_of_sign[true], -1)
    row = torch.where(row_of_shape(signs, row) == journey.signs.shape, row, -1)
    seen = torch.nonzero(row >= 0)[:, 0]
    of = signs[row[seen]]
    T = truth.T_world_camera[journey.signs.frame[seen]]
    px, _ = camera.project(
        journey.rig.camera, se3.transform(se3.inverse(T)[:, None], of.corners_world)
    )
    shift = torch.zeros_like(row)
    shift[seen], _ = polygon.best_shift(
        px, journey.signs.corners_px[seen], polygon.corner_count(of.shape)
    )
    return Association(row, shift, torch.full_like(journey.lanes.row, -1))


def row_of_shape(signs: Signs, row: Tensor) -> Tensor:
    return torch.where(row >= 0, signs.shape[row.clamp_min(0)], -1)


@pytest.fixture(scope="module")
def street(tiny: Dataset, tiny_folder: Path, tiny_truth: Truth, tiny_result: MapResult) -> Street:
    survey = read_map(tiny_folder / "survey").signs
    shown = torch.cat([signs_by_detection(t) for t in tiny_truth.journeys])
    often = torch.bincount(shown[shown >= 0], minlength=len(survey)) >= 20
    true_signs = survey[often]
    row_of_sign = torch.where(often, often.cumsum(0) - 1, -1)
    noise = torch.randn(
        len(true_signs), 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64
    )
    T = true_signs.T_world_sign.clone()
    T[:, :3, 3] += START_SIGMA_M * noise
    return Street(
        journeys=tiny.journeys,
        roads=tuple(m.road for m in tiny_result.journey_maps),
        signs=replace(true_signs, T_world_sign=T),
        lanes=tiny_result.first.lanes,
        associations=tuple(
            true_association(t, true_signs, row_of_sign) for t in tiny_truth.journeys
        ),
        drifts=tuple(torch.zeros(j.frame_count, 6, dtype=torch.float64) for j in tiny.journeys),
    )


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


@dataclass(frozen=True)
class Adjusted:
    """A bundle after its adjustment, and what was seen on the way."""

    bundle: Bundle
    reason: str
    scales: Tensor
    costs: list[float]


@pytest.fixture(scope="module")
def adjusted(street: Street) -> Adjusted:
    bundle = street.bundle()
    state = begun = adjust.start(bundle)
    scales, costs = [bundle.scale.clone()], [float(state.cost)]
    for _, state in adjust.steps(bundle, begun):
        scales.append(bundle.scale.clone())
        costs.append(float(state.cost))
    return Adjusted(bundle, state.reasons[0], torch.stack(scales), costs)


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
    bundle.corners, without.corners = outliers(rows, torch.Generator().manual_seed(2))
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


@pytest.fixture(scope="module")
def classes(street: Street) -> tuple[tuple[float, float], ...]:
    """The sizes that the signs of the street truly have: its signs start with them."""
    return tuple((width, height) for width, height in street.signs.size.tolist())


def size_error(bundle: Bundle, street: Street) -> Tensor:
    return (bundle.values()["size"] / street.signs.size).log().abs()


def test_size_classes_give_signs_their_sizes(street: Street, adjusted: Adjusted, classes):
    bundle = street.bundle(config=AdjustConfig(size_classes_m=classes))
    adjust.adjust(bundle)
    free = size_error(adjusted.bundle, street).mean()
    assert size_error(bundle, street).mean() < 0.5 * free


def test_signs_of_no_class_keep_their_sizes(street: Street, adjusted: Adjusted, classes):
    far = tuple((3 * width, 3 * height) for width, height in classes)
    bundle = street.bundle(config=AdjustConfig(size_classes_m=far))
    adjust.adjust(bundle)
    found, expected = bundle.values()["size"], adjusted.bundle.values()["size"]
    torch.testing.assert_close(found, expected, rtol=1e-3, atol=0)


@pytest.mark.parametrize(
    "options",
    [
        {"size_classes_m": ((0.6, 0.0),)},
        {"size_class_sigma": 0.0},
        {"innovation_chance": 1.0},
        {"innovation_chance": -1e-3},
    ],
    ids=str,
)
def test_settings_that_cannot_be_are_refused(options):
    with pytest.raises(ValueError, match=rf"{next(iter(options))}.*expected"):
        AdjustConfig(**options)


def signs_alone(
    street: Street, factor: tuple[float, ...], *, prior: PosePriorConfig | None = None
) -> tuple[Signs, MapUncertainty]:
    """The signs of a map without lanes, the positioning module's sigmas multiplied by `factor` of each journey."""
    journeys = []
    for journey, times in zip(street.journeys, factor, strict=True):
        assert journey.sigma_position is not None and journey.sigma_rotation is not None
        position, rotation = times * journey.sigma_position, times * journey.sigma_rotation
        journeys.append(replace(journey, sigma_position=position, sigma_rotation=rotation))
    lanes = street.lanes.select(torch.zeros(0, dtype=torch.int64))
    config = replace(AdjustConfig(), prior=prior or PosePriorConfig())
    bundle = replace(street, journeys=tuple(journeys), lanes=lanes).bundle(config=config)
    adjust.adjust(bundle)
    found = map_uncertainty(bundle, street.signs, lanes)
    return adjust.read_map(bundle, street.signs, lanes, found)[0], found


def test_sigmas_that_are_wrong_by_three_give_nearly_the_same_map(street: Street):
    right, of_right = signs_alone(street, (1.0, 1.0, 1.0))
    sigma = of_right.shared.trace().sqrt()
    for factor in ((3.0, 3.0, 3.0), (1 / 3, 1 / 3, 1 / 3)):
        wrong, of_wrong = signs_alone(street, factor)
        moved = (wrong.corners_world - right.corners_world)[right.corner_mask]
        # All journeys' sigmas are wrong alike: nobody weighs more on the whole. The drift's share does change, and with
        # it what each weighs where not all have been: small beside what the map does not know of itself.
        assert moved.norm(dim=1).mean() < 0.2 * sigma
        # Three journeys have six degrees of freedom for their biases, and the sigmas as given count for three.
        assert 0.5 < of_wrong.shared.trace().sqrt() / sigma < 2.0


def test_a_journey_that_claims_too_much_leaves_the_map_less_sure(street: Street):
    right, of_right = signs_alone(street, (1.0, 1.0, 1.0))
    claim = (1.0, 1 / 10, 1.0)
    # Its sigmas are as they were given if the fleet's count for millions of observations, and one is the fleet's.
    trusting = PosePriorConfig(scale_strength=1e9, scale_trust=1e9)
    believed, of_believed = signs_alone(street, claim, prior=trusting)
    doubted, of_doubted = signs_alone(street, claim)
    pulled, less = (
        (found.center_world - right.center_world).mean(0).norm() for found in (believed, doubted)
    )
    sure, doubtful = (found.shared.trace().sqrt() for found in (of_believed, of_doubted))
    assert sure < 0.3 * of_right.shared.trace().sqrt()
    # Two others against one cannot keep it from pulling, but it is seen that it does not fit.
    assert doubtful > 1.5 * sure and less / doubtful < 0.7 * pulled / sure


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


def test_increments_are_zero_at_rest(street: Street, adjusted: Adjusted):
    for bundle in (street.bundle(), adjusted.bundle):
        assert {name for name, _ in bundle.named_parameters()} == {
            f"delta_{name}" for name in bundle.names
        }
        for name, value in bundle.values().items():
            assert not getattr(bundle, f"delta_{name}").any()
            assert torch.allclose(value, getattr(bundle, f"base_{name}"), atol=1e-12)


def test_a_bundle_goes_on_from_its_state_dict(street: Street, adjusted: Adjusted, tmp_path: Path):
    torch.save(adjusted.bundle.state_dict(), tmp_path / "bundle.pt")
    other = street.bundle()
    other.load_state_dict(torch.load(tmp_path / "bundle.pt", weights_only=True))
    for name, value in other.values().items():
        assert torch.equal(value, adjusted.bundle.values()[name])
    same = deepcopy(adjusted.bundle)
    assert digest(other.state_dict()) == digest(same.state_dict())
    assert float(adjust.start(other).cost) == float(adjust.start(same).cost)


def reject_steps(monkeypatch: pytest.MonkeyPatch, numbers: tuple[int, ...]) -> None:
    """Makes these steps end where everything costs more."""
    step, costs, is_bad = lm.step, lm.term_costs, [False]

    def taken(problem, state, *arguments, **options):
        is_bad[0] = state.iterations in numbers
        return step(problem, state, *arguments, **options)

    def dearer(*arguments):
        return {k: cost + 1e9 * is_bad[0] for k, cost in costs(*arguments).items()}

    monkeypatch.setattr(lm, "step", taken)
    monkeypatch.setattr(lm, "term_costs", dearer)


@pytest.mark.parametrize(
    ("cut_unknowns", "most", "rejected"),
    [(0, 30, ()), (40, 3, ()), (0, 6, (2, 3))],
    ids=["whole drives", "drives that are cut", "with rejected steps"],
)
def test_an_adjustment_cut_at_any_step_goes_on_to_the_same_bits(
    street: Street,
    cut_unknowns: int,
    most: int,
    rejected: tuple[int, ...],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
):
    reject_steps(monkeypatch, rejected)
    config = AdjustConfig(cut_unknowns=cut_unknowns, frame_spacing_m=6.0)
    config = replace(config, lm=replace(config.lm, max_iterations=most))
    whole, kept = street.bundle(config=config), tmp_path / "step.pt"
    state = begun = adjust.start(whole)
    write_stage(kept, adjust.standing(whole, begun, 0), key="")
    number = -1
    for number, state in adjust.steps(whole, begun):
        # Each step is taken once more by a bundle that knows of the one before only what was kept.
        other = street.bundle(config=config)
        before = read_stage(kept, adjust.Standing, key="")
        again = adjust.go_on(other, before)
        first, again = next(adjust.steps(other, again, first=before.steps))
        assert first == number and bool(again.accepted) == (number not in rejected)
        here, there = (
            adjust.standing(*one, number + 1) for one in ((whole, state), (other, again))
        )
        write_stage(kept, here, key="")
        # A step that is rejected keeps the normal equations; a bundle that goes on makes them anew.
        there = replace(there, state=replace(there.state, linearizations=here.state.linearizations))
        assert digest(there) == digest(here)
    assert number + 1 == most if most < 30 else state.done
    # Nor is there a step after the last one.
    other = street.bundle(config=config)
    again = adjust.go_on(other, read_stage(kept, adjust.Standing, key=""))
    assert [*adjust.steps(other, again, first=number + 1)] == []
    assert digest(other.state_dict()) == digest(whole.state_dict())


def test_a_bundle_does_not_go_on_from_where_another_one_stood(street: Street, adjusted: Adjusted):
    there = adjust.standing(adjusted.bundle, adjust.start(deepcopy(adjusted.bundle)), 3)
    fewer = replace(
        street,
        signs=street.signs[torch.arange(len(street.signs) - 1)],
        associations=tuple(
            replace(a, sign=torch.where(a.sign < len(street.signs) - 1, a.sign, -1))
            for a in street.associations
        ),
    )
    with pytest.raises(ValueError, match=r"is torch.* expected torch.*, as the bundle has it"):
        adjust.go_on(fewer.bundle(), there)
    with pytest.raises(ValueError, match=r"'scale' is missing; expected torch\.float64"):
        others = {k: v for k, v in there.bundle.items() if k != "scale"}
        adjust.go_on(street.bundle(), replace(there, bundle=others))


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


def test_outlines_that_tremble_for_a_while_are_worth_less(street: Street):
    still = street.bundle()
    adjust.adjust(still)
    assert float(still.lasting) < 0.1
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
    assert 1.0 < float(bundle.lasting) < 9.0
    # And the map says so, beside what all journeys share.
    a, b = (map_uncertainty(x, street.signs, street.lanes) for x in (still, bundle))
    own = [(x.center - x.shared).diagonal(dim1=1, dim2=2).sum(1) for x in (a, b)]
    assert float((own[1] / own[0]).median()) > 1.2
