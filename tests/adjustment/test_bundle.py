"""The bundle's problem: there from the start, and of the matches and scales of the moment."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import pytest
import torch

from crowdmap_torch.adjustment import adjust, relinearisation
from crowdmap_torch.adjustment import bundle as bundle_module
from crowdmap_torch.adjustment.bundle import AtRest, Bundle
from crowdmap_torch.adjustment.calibration import columns
from crowdmap_torch.adjustment.lane_matching import follow
from crowdmap_torch.adjustment.parts import Observations, Priors, Unknowns
from crowdmap_torch.adjustment.steps import _NEAR
from crowdmap_torch.config import MapperConfig
from crowdmap_torch.geometry import se3
from crowdmap_torch.mapper import MapResult, build_bundle
from crowdmap_torch.noise.pose_prior import WANDER_SCALE, PosePrior
from crowdmap_torch.noise.positioning import PositioningNoise
from crowdmap_torch.optim.linearize import residuals, term_costs
from crowdmap_torch.tables import Dataset

if TYPE_CHECKING:
    from worlds.adjusted_street import Street


@pytest.fixture(scope="module")
def build(tiny: Dataset, tiny_result: MapResult) -> Callable[[], Bundle]:
    """Three journeys with a frame every six metres."""
    return builder(tiny, tiny_result, 6.0)


def builder(tiny: Dataset, tiny_result: MapResult, spacing_m: float) -> Callable[[], Bundle]:
    """Three journeys with a frame every so many metres."""
    config = MapperConfig()
    config = replace(config, adjust=replace(config.adjust, frame_spacing_m=spacing_m))
    return lambda: build_bundle(tiny.journeys, tiny_result.journey_maps, tiny_result.first, config)


def costs(bundle: Bundle) -> dict[str, float]:
    with torch.no_grad():
        by_term = term_costs(bundle.problem(), bundle.values())
    return {name: float(cost) for name, cost in by_term.items()}


def test_the_problem_is_there_before_the_first_refresh(build: Callable[[], Bundle]):
    fresh, refreshed = build(), build()
    refreshed.refresh()
    found = costs(fresh)
    assert found == costs(refreshed)
    assert {"sign_reprojection", "lane_reprojection", "lane_slide"} <= found.keys()
    assert torch.equal(fresh.scale, refreshed.scale) and fresh.scale.isfinite().all()


def test_asking_again_changes_nothing(build: Callable[[], Bundle]):
    bundle = build()
    assert costs(bundle) == costs(bundle)


def test_a_bundle_that_was_loaded_has_the_matches_and_scales_of_the_other(
    build: Callable[[], Bundle],
):
    saved, loaded = build(), build()
    saved.refresh()
    found = costs(saved)
    loaded.problem()
    loaded.load_state_dict(saved.state_dict())
    assert costs(loaded) == found
    saved.refresh()
    loaded.refresh()
    assert costs(loaded) == costs(saved)


def test_what_is_known_of_poses_is_found_anew_when_scales_or_judgements_have_changed(
    build: Callable[[], Bundle],
):
    bundle = build()
    # With corrections, or by how little landmarks move, it ends before any scale has been at rest for a step.
    slow = replace(bundle.config.lm, corrections=0, move_tolerance=0.0)
    bundle.config = replace(bundle.config, lm=slow)
    state = adjust.start(bundle)
    assert bundle.evidence() is None
    for _ in adjust.steps(bundle, state):
        if bundle.evidence() is not None:
            break
    kept = bundle.evidence()
    assert kept is not None and bool((kept.left > 0).all())
    for change in (lambda: bundle.prior_scale[1, 0].mul_(1.05), lambda: bundle.judged.add_(1)):
        change()
        assert bundle.evidence() is None
        bundle.told_at.copy_(bundle.scales())


@pytest.mark.parametrize(("few", "near"), [(False, 1.0), (True, _NEAR)])
def test_scales_that_move_no_landmark_keep_no_adjustment_going(
    tiny: Dataset, tiny_result: MapResult, monkeypatch: pytest.MonkeyPatch, few: bool, near: float
):
    # Of fewer frames lane points that are followed for ever slide along their markers, a millimetre a step.
    build = builder(tiny, tiny_result, 5.0)
    bundle, refresh = build(), Bundle.refresh

    def restless(self: Bundle, *args: Any, **how: Any) -> AtRest:
        refresh(self, *args, **how)
        return AtRest(False, few)

    def moving(self: Bundle, *args: Any, **how: Any) -> AtRest:
        return replace(restless(self, *args, **how), judging=False)

    monkeypatch.setattr(Bundle, "refresh", restless)
    state = adjust.adjust(bundle)
    lm_config = bundle.config.lm
    assert state.iterations < lm_config.max_iterations and int(bundle.judged) >= 1
    assert float(state.in_sigmas_left) < near * lm_config.move_tolerance
    # By scales that go on moving landmarks nothing is judged.
    monkeypatch.setattr(Bundle, "refresh", moving)
    bundle, moves = build(), replace(lm_config, max_iterations=state.iterations, move_tolerance=0.0)
    bundle.config = replace(bundle.config, lm=moves)
    assert adjust.adjust(bundle).iterations == state.iterations and int(bundle.judged) == 0


def test_the_papers_cost_weighs_every_corner_and_lane_point_by_itself_and_all_pixels_alike(
    tiny: Dataset, tiny_result: MapResult
):
    config = MapperConfig(method="paper2017").resolved().adjust
    config = replace(config, frame_spacing_m=6.0)
    bundle = build_bundle(
        tiny.journeys,
        tiny_result.journey_maps,
        tiny_result.first,
        replace(MapperConfig(), adjust=config),
    )
    found, values = costs(bundle), bundle.values()
    sigma, of_lanes, factor = bundle.scale.unbind()
    assert sigma == of_lanes and factor == 1.0
    assert (bundle.corner_sigma() == sigma).all()

    def tukey(error_px: list[float]) -> float:
        c_px = config.tukey_c * float(sigma)
        inside = max(1 - sum(e * e for e in error_px) / c_px**2, 0.0)
        return config.tukey_c**2 / 6 * (1 - inside**3)

    for name in ("sign_reprojection", "lane_reprojection"):
        term = bundle.problem().terms[name]
        assert term.weight is not None
        residual = residuals(replace(term, weight=(term.weight > 0).to(sigma)), values)
        total = sum(tukey(row) for row in residual.tolist())
        assert found[name] == pytest.approx(total, rel=1e-9)
    # Nothing else is judged, and what was found stays.
    equations = bundle.backend().assemble(bundle.problem(), values)
    assert not bundle.judge(equations) and not bundle.given_up.any()


def test_whether_a_lane_point_is_too_far_ahead_does_not_depend_on_its_own_noise(
    build: Callable[[], Bundle],
):
    bundle = build()
    reach = bundle.config.max_ground_distance_m
    rows, values = bundle.lane_points, {k: v.detach() for k, v in bundle.values().items()}
    T = values["pose"][rows.frame]
    found = follow(bundle.matches, rows, T, values["lane"], bundle.lane_count)
    point = found.points(values["lane"], bundle.lane_count)
    on_spline = (T[:, :3, 2] * (point - T[:, :3, 3])).sum(-1)
    ray = torch.nn.functional.pad(rows.ideal, (0, 1), value=1.0)
    measured = rows.camera_height / (rows.normal_camera * ray).sum(-1)
    assert on_spline.max() < reach
    # Near the border points lie beyond it as often as before it, wherever the spline is: nothing is cut off.
    border = (on_spline > reach - 2) & (on_spline < reach - 0.5)
    assert int(border.sum()) > 50
    assert bool((measured[border] > reach).any())
    missed = (measured - on_spline)[border]
    assert abs(float(missed.median())) < 0.2


def test_judging_asks_the_equations_that_were_solved_and_not_for_others(
    build: Callable[[], Bundle], monkeypatch: pytest.MonkeyPatch
):
    bundle = build()
    # Scales are to rest, and detections to be judged, before the cost no longer falls.
    lm_config = replace(bundle.config.lm, cost_tolerance=1e-7, move_tolerance=1e-3)
    bundle.config = replace(bundle.config, lm=lm_config)
    backend, made, solved = bundle.backend(), [], []
    assemble = backend.assemble

    def counted(*args):
        made.append(assemble(*args))
        return made[-1]

    monkeypatch.setattr(backend, "assemble", counted)
    for step, state, _ in adjust.steps(bundle, adjust.start(bundle)):
        solved.append(state)
        assert len(made) == step + 1
    assert int(bundle.judged) == 2 and solved[-1].done
    # The last detections that were given up are told apart from the map by a correction, where that is all it takes.
    assert solved[-1].linearizations == len(solved)


def test_detectors_that_see_markers_aside_and_markers_that_lie_aside_are_alike(
    build: Callable[[], Bundle],
):
    bundle = build()
    bundle.refresh()
    term, values = bundle.problem().terms["lane_reprojection"], bundle.values()
    config = bundle.fleet.config
    number = columns("optics", config)["lane_m"].start
    seen = values["optics"].clone()
    seen[:, number] += 0.1 / config.lane_m
    # The street is straight, and all drive it one way: what is to the left of one is so of all.
    left = bundle.lane_axes[:, :, 1]
    left = left * -torch.sign(left @ values["pose"][0, :3, 0])[:, None]
    lies = {**values, "lane": values["lane"] + 0.1 * left}
    found = residuals(term, {**values, "optics": seen})
    torch.testing.assert_close(found, residuals(term, lies), rtol=0, atol=1e-9)
    assert (found - residuals(term, values)).abs().median() > 0.1


def test_rows_are_relinearised_piece_by_piece_to_the_same_bits(
    build: Callable[[], Bundle], monkeypatch: pytest.MonkeyPatch
):
    bundle = build()
    bundle.refresh()
    terms, before = bundle.problem().terms, bundle.values()
    names = ("sign_reprojection", "lane_reprojection", "lane_height")
    expected = {
        name: [of.clone() for of in (residuals(terms[name], before), *terms[name].constants)]
        for name in names
    }
    # Somewhere else first: it is done in place.
    moved = dict(before, pose=se3.retract(before["pose"], torch.full((1, 6), 0.01).double()))
    bundle.fold(moved)
    bundle.relinearise()
    assert not torch.equal(bundle.problem().terms[names[0]].constants[-1], expected[names[0]][-1])
    bundle.fold(before)
    # Within a piece boxes need all corners of a detection: a bound that parts most of them if any is parted.
    monkeypatch.setattr(relinearisation, "_AT_ONCE", 7)
    bundle.relinearise()
    terms = bundle.problem().terms
    for name in names:
        pairs = zip(
            (residuals(terms[name], before), *terms[name].constants), expected[name], strict=True
        )
        assert all(torch.equal(found, of) for found, of in pairs)


def test_bundles_of_the_same_observations_take_lenses_anew_each_by_itself(
    build: Callable[[], Bundle],
):
    one = build()
    bent = torch.tensor([-0.1, 0.01, 0.0, 0.0]).double()
    lenses = tuple(replace(lens, distortion=bent) for lens in one.lenses)
    observed = Observations(one.corners, one.lane_points, one.matches, lenses)
    other = Bundle(
        Unknowns(one.values(), one.frame, one.lane_count),
        observed,
        Priors(one.prior, one.fixed, one.beside, one.fleet, one.course),
        one.config,
    )
    before = observed.corners.matrix.clone(), observed.lane_points.matrix.clone()
    pose = se3.retract(other.values()["pose"], torch.full((1, 6), 0.01).double())
    other.fold(dict(other.values(), pose=pose))
    other.relinearise()
    assert not torch.equal(other.corners.matrix, before[0])
    assert torch.equal(one.corners.matrix, before[0])
    assert torch.equal(one.lane_points.matrix, before[1])


def test_what_only_the_prior_holds_stays_where_that_has_it(tiny_result: MapResult):
    # All drive one way: nothing tells where detectors see markers, beside what they differ in from car to car.
    cars = tiny_result.uncertainty.calibration.values()
    shift = torch.tensor([car.estimate["lane_m"][0] for car in cars])
    sigma = min(car.sigma["lane_m"][0] for car in cars)
    assert float(shift.mean().abs()) < 0.1 * sigma


def test_detectors_have_a_left_along_their_road_alone(build: Callable[[], Bundle]):
    bundle = build()
    bundle.refresh()
    pose, rows = bundle.values()["pose"], bundle.lane_points
    right, _, ahead = pose[rows.frame, :3, :3].unbind(2)
    point = bundle.matches.points(bundle.values()["lane"], bundle.lane_count)
    seen = se3.transform(se3.inverse(pose)[rows.frame], point)
    for across, expected in (
        (right, -right),
        (-right, -right),
        (0.8 * right + 0.6 * ahead, -0.8 * right - 0.6 * ahead),
        (0.3 * right + 0.95 * ahead, torch.zeros_like(right)),
    ):
        found = bundle.fleet.by_optics(rows, bundle.lenses, seen, pose, across).left
        torch.testing.assert_close(found, expected)


def test_across_a_marker_is_along_the_road(street: Street):
    lean = 0.01
    turn = se3.so3_exp(torch.tensor([0.0, 0.0, lean], dtype=torch.float64))
    leaning = [replace(road, normal_camera=road.normal_camera @ turn.mT) for road in street.roads]
    as_it_is, banked = street.bundle(), replace(street, roads=tuple(leaning)).bundle()
    before, after = (bundle.lane_axes[:, 2, 1].asin() for bundle in (as_it_is, banked))
    expected = torch.full_like(after, lean)
    torch.testing.assert_close((after - before).abs(), expected, atol=5e-4, rtol=0)


@pytest.mark.parametrize(
    ("scale", "moves", "few", "rest"),
    [
        (1, 0.92, 0.0, AtRest(False, False)),
        (1, 0.92, 0.5, AtRest(False, True)),
        (WANDER_SCALE, 0.92, 0.0, AtRest(True, True)),
        (WANDER_SCALE, 0.85, 0.0, AtRest(False, True)),
    ],
)
def test_scales_that_one_drive_or_the_wander_of_biases_moves_keep_no_detection_from_being_judged(
    street: Street,
    monkeypatch: pytest.MonkeyPatch,
    scale: int,
    moves: float,
    few: float,
    rest: AtRest,
):
    bundle = street.bundle(positioning=PositioningNoise(wander_length_m=60.0))
    assert bundle.prior.wander is not None
    monkeypatch.setattr(PosePrior, "rescaled", lambda *_: bundle.prior_scale.clone())
    # Pixels narrow first.
    assert any(bundle.refresh().scales for _ in range(10))
    factor = torch.ones_like(bundle.prior_scale)
    factor[0, scale] = moves
    assert 2 <= len(factor) < 10
    monkeypatch.setattr(PosePrior, "rescaled", lambda *_: factor * bundle.prior_scale)
    monkeypatch.setattr(bundle_module, "_FEW", few)
    assert bundle.refresh() == rest


@pytest.mark.parametrize(("scale", "judging"), [(0, False), (1, True), (2, True)])
def test_detections_may_be_judged_while_what_they_are_not_judged_by_moves(
    street: Street, monkeypatch: pytest.MonkeyPatch, scale: int, judging: bool
):
    bundle = street.bundle()
    monkeypatch.setattr(PosePrior, "rescaled", lambda *_: bundle.prior_scale.clone())
    assert any(bundle.refresh().scales for _ in range(10))
    # Of corners, of lane points, and of what lane points of a detection have wrong together.
    bundle.scale[scale] *= 1.5
    assert bundle.refresh() == AtRest(scales=False, judging=judging)
    assert bundle.refresh() == AtRest(scales=True, judging=True)
