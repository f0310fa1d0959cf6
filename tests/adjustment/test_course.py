"""What the way of cars says of their poses: positions that slide sideways are drift, wherever in a bundle a drive is."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor
from worlds.drives import make_journey
from worlds.sign_drive import F64, RIG, straight_poses

from crowdmap_torch.adjustment import adjust
from crowdmap_torch.adjustment.calibration import CalibrationConfig
from crowdmap_torch.adjustment.config import AdjustConfig, CourseConfig
from crowdmap_torch.adjustment.course import Course, course_of
from crowdmap_torch.adjustment.observations import frame_offsets
from crowdmap_torch.geometry import se3
from crowdmap_torch.geometry.trajectory import station
from crowdmap_torch.noise.drift_nodes import DriftNodes, drift_nodes
from crowdmap_torch.noise.pose_prior import PosePriorConfig, pose_prior
from crowdmap_torch.noise.positioning import PositioningNoise
from crowdmap_torch.optim.linearize import residuals
from crowdmap_torch.optim.problem import Problem, Variable, euclidean
from crowdmap_torch.optim.solvers.dense import DenseBackend
from crowdmap_torch.tables import Journey

CONFIG, NOISE = CourseConfig(), PositioningNoise()


def slid(wave: Tensor, *, lever: float = 0.0, yaw: float = 0.0) -> tuple[Tensor, Tensor]:
    """A car through bends, its positions off to the right by `wave`; and the way to its right, in the world.

    The camera is `lever` metres ahead of the axle that does not steer, and looks `yaw` to the left of the way.
    """
    frames = len(wave)
    poses = straight_poses(frames, step_m=0.5)
    heading = (4e-3 * torch.sin(torch.arange(frames, dtype=F64) / 30)).cumsum(0)
    ahead = torch.stack((-heading.sin(), heading.cos()), dim=-1)
    middle = torch.nn.functional.normalize(ahead[1:] + ahead[:-1], dim=-1)
    place = poses[:, :3, 3].clone()
    place[1:, :2] = (0.5 * middle).cumsum(0)
    place[:, :2] += lever * ahead
    right = torch.stack((heading.cos(), heading.sin(), 0 * heading), dim=-1)
    angle, zero = -(heading + yaw), torch.zeros_like(heading)
    R = poses[:, :3, :3] @ se3.so3_exp(torch.stack((zero, angle, zero), dim=-1))
    return se3.make(R, place + wave[:, None] * right), right


WAVES = [
    0.15 * torch.sin(torch.arange(240, dtype=F64) / 13),
    0.10 * torch.cos(torch.arange(160, dtype=F64) / 11),
]
SIDES = ("before", "behind")
LEVERS = [{"lever": 1.6, "yaw": 0.02}, {"lever": -0.4, "yaw": -0.03}]


def drives() -> tuple[list[Journey], list[Tensor]]:
    made = [slid(wave, **how) for wave, how in zip(WAVES, LEVERS, strict=True)]
    journeys = [
        replace(make_journey(RIG, poses), journey_id=f"journey-{k}")
        for k, (poses, _) in enumerate(made)
    ]
    return journeys, [right for _, right in made]


def nodes_of(journeys: list[Journey], frame: Tensor, spacing: float = 1.0) -> DriftNodes:
    ends = torch.tensor(frame_offsets(journeys)[1:])
    way = torch.cat([station(journey.T_world_camera) for journey in journeys])[frame]
    return drift_nodes(torch.searchsorted(ends, frame, right=True), way, spacing)


def bound(
    journeys: list[Journey], frame: Tensor, cut: Tensor | None = None
) -> tuple[Course, DriftNodes, Problem, dict]:
    """The course of drives, and the problem that it makes with the prior of their poses."""
    nodes = nodes_of(journeys, frame)
    pose = torch.cat([journey.T_world_camera for journey in journeys])[frame]
    prior = pose_prior(journeys, pose, nodes, NOISE, PosePriorConfig(), cut)
    course = course_of(journeys, frame, nodes, prior.cut, CONFIG)
    ones = torch.ones(len(journeys), 6, dtype=F64)
    terms = course.terms(prior.white_sigma, ones) | prior.terms(ones[:, : prior.scale_count], ones)
    del terms["pose_white"]
    kinds = {"drift": prior.numbers, "bias": 6, "stance": 2}
    counts = {"drift": len(nodes.first), "bias": len(journeys), "stance": len(journeys)}
    values = {name: torch.zeros(counts[name], k, dtype=F64) for name, k in kinds.items()}
    problem = Problem({name: Variable(k, euclidean) for name, k in kinds.items()}, terms)
    return course, nodes, problem, values


def test_positions_that_slide_sideways_are_drift_in_every_drive():
    journeys, right = drives()
    # Frames of the second drive's beginning are not in the bundle, and of the others two in three.
    frame = torch.arange(sum(journey.frame_count for journey in journeys))
    frame = frame[(frame % 3 > 0) & ((frame < 240) | (frame > 260))]
    _, nodes, problem, values = bound(journeys, frame)
    for _ in range(2):
        normal = DenseBackend().assemble(problem, values)
        step = normal.solve(torch.zeros(1, dtype=F64)).delta
        values = {name: value + step[name] for name, value in values.items()}
    across = torch.cat(right)[frame][nodes.first]
    wave = torch.cat(WAVES)[frame][nodes.first]
    found = (values["drift"][:, :3] * across).sum(-1)
    for number in range(2):
        mine = nodes.journey == number
        # The drift takes the given pose to the true one; where all of a drive is, nothing here tells. What is left is
        # what a camera that looks aside, and noise from frame to frame, would show as well.
        left = (found + wave)[mine] - (found + wave)[mine].mean()
        rms = wave[mine].square().mean().sqrt()
        assert left.square().mean().sqrt() < 0.6 * rms, (number, left.square().mean().sqrt(), rms)


def test_how_the_camera_stands_in_its_car_costs_nothing():
    """Neither a lever nor a camera that looks aside is taken for drift."""
    still = [slid(torch.zeros(200, dtype=F64), **how)[0] for how in LEVERS]
    journeys = [
        replace(make_journey(RIG, poses), journey_id=f"journey-{k}")
        for k, poses in enumerate(still)
    ]
    _, nodes, problem, values = bound(journeys, torch.arange(400))
    step = DenseBackend().assemble(problem, values).solve(torch.zeros(1, dtype=F64)).delta
    assert len(nodes.first) > 150
    assert step["drift"][:, :2].abs().max() < 0.02


def test_a_leap_of_positions_has_no_say():
    poses, right = slid(torch.zeros(200, dtype=F64))
    leapt = poses.clone()
    leapt[100:, :3, 3] += 2.0 * right[100:]
    course, _, problem, values = bound([make_journey(RIG, leapt)], torch.arange(200))
    term = problem.terms["course"]
    parted = residuals(term, values)[:, 0].abs()
    assert course.seen.abs().max() > 1.0
    assert int((parted > CONFIG.tukey_c).sum()) == 1
    alone = replace(problem, terms={"course": term})
    step = DenseBackend().assemble(alone, values).solve(torch.ones(1, dtype=F64)).delta["drift"]
    assert step.abs().max() < 0.1


def test_noise_from_frame_to_frame_binds_less():
    journeys, _ = drives()
    course = bound(journeys, torch.arange(400))[0]
    sigma = torch.full((6,), 0.02, dtype=F64)
    ones = torch.ones(2, 6, dtype=F64)
    noisy = ones.clone()
    noisy[1, :2] = 5.0
    quiet, loud = (course.terms(sigma, scale)["course"].weight for scale in (ones, noisy))
    assert quiet is not None and loud is not None
    assert torch.equal(quiet[course.journey == 0], loud[course.journey == 0])
    second = course.journey == 1
    assert bool((loud[second] < 0.4 * quiet[second]).all())


def test_a_car_that_stands_under_poses_without_noise_weighs_no_more_than_a_number():
    journeys, _ = drives()
    course = bound(journeys, torch.arange(400))[0]
    standing = replace(course, variance=torch.zeros_like(course.variance))
    none = torch.zeros(6, dtype=F64)
    weight = standing.terms(none, torch.ones(2, 6, dtype=F64))["course"].weight
    assert weight is not None and bool((weight == 1e3).all())


def test_drives_of_which_nothing_is_in_the_bundle_have_none():
    journeys, _ = drives()
    short = replace(make_journey(RIG, straight_poses(1, step_m=0.5)), journey_id="journey-2")
    course, nodes, _, _ = bound(
        [*journeys, short], torch.cat((torch.arange(240), torch.tensor([400])))
    )
    assert course.journey.unique().tolist() == [0]
    assert nodes.journey[-1] == 2 and course.journeys.tolist() == [0, 1, 2]


def test_stretches_that_are_far_apart_are_not_bound():
    journeys, _ = drives()
    # Fifteen metres of the first drive show nothing, three of the second.
    frame = torch.cat((torch.arange(100), torch.arange(130, 300), torch.arange(306, 400)))
    course, nodes, _, _ = bound(journeys, frame)
    gap = nodes.way[1:] - nodes.way[:-1]
    one_drive = nodes.journey[1:] == nodes.journey[:-1]
    near = torch.nonzero(one_drive & (gap < CONFIG.reach_m))[:, 0]
    assert torch.equal(course.before, near) and float(gap[near].max()) > 2.5
    assert int((one_drive & (gap >= CONFIG.reach_m)).sum()) == 1


def test_the_parting_at_a_cut_is_in_two_halves():
    """Each half as far off, and both together as much as the whole."""
    journeys, _ = drives()
    frame = torch.arange(400)
    whole, nodes, problem, values = bound(journeys, frame)
    cut = torch.tensor([40, 150])
    course, _, in_two, _ = bound(journeys, frame, cut)
    generator = torch.Generator().manual_seed(3)
    for name in ("drift", "stance"):
        shape = values[name].shape
        values[name] = 0.02 * torch.randn(shape, generator=generator, dtype=F64)
    number = course.at_cuts(values["drift"], values["stance"])
    state = torch.zeros(2, values["drift"].shape[1], dtype=F64)
    values["cut"] = torch.cat((state, number), dim=1)
    before, behind = (
        residuals(in_two.terms[f"course_{side}_cut"], values) for side in ("before", "behind")
    )
    torch.testing.assert_close(before, behind)
    at_cut = torch.isin(whole.before, cut - 1)
    expected = residuals(problem.terms["course"], values)[at_cut]
    torch.testing.assert_close(before.square() + behind.square(), expected.square())
    kept = residuals(in_two.terms["course"], values)
    torch.testing.assert_close(kept, residuals(problem.terms["course"], values)[~at_cut])
    assert len(nodes.first) > 190 and course.cut[at_cut].tolist() == [0, 1]


def test_parts_of_all_drives_have_their_own_course():
    journeys, _ = drives()
    course, nodes, _, _ = bound(journeys, torch.arange(400))
    begin = int((nodes.journey == 0).sum())
    second = course.of_nodes(begin, len(nodes.first), torch.tensor([1]))
    mine = course.journey == 1
    assert torch.equal(second.before, course.before[mine] - begin)
    assert torch.equal(second.seen, course.seen[mine])
    assert second.journeys.tolist() == [1] and len(second.before) > 50
    ones = torch.ones(2, 6, dtype=F64)
    terms = second.terms(torch.full((6,), 0.02, dtype=F64), ones)
    assert terms["stance"].slots[0][1].tolist() == [1]
    # A leader has no drive of its own.
    none = course.of_nodes(0, 0, torch.tensor([], dtype=torch.long))
    assert len(none.before) == 0


@pytest.mark.parametrize(
    ("change", "is_bound"),
    [({}, True), ({"course": CourseConfig(reach_m=0.0)}, False), ({"method": "paper2017"}, False)],
)
def test_a_bundle_has_it_unless_it_is_switched_off(street, change, is_bound):
    bundle = street.bundle(config=replace(AdjustConfig(), **change))
    assert (bundle.course is not None) == is_bound
    assert ("course" in bundle.problem().terms) == is_bound
    assert ("stance" in bundle.plan.border) == is_bound
    assert len(bundle.values()["stance"]) == (len(bundle.prior_scale) if is_bound else 0)


def test_poses_that_are_said_to_have_no_noise_are_adjusted(street):
    """A car that stands at a node has neither a way that it could part from nor noise beside its drift."""
    quiet = PositioningNoise(white_sigma_m=0.0, white_sigma_deg=0.0)
    bundle = street.bundle(positioning=quiet, calibration=CalibrationConfig())
    begun = adjust.start(bundle)
    taken = adjust.steps(bundle, begun)
    states = [state for _, (_, state, _) in zip(range(2), taken, strict=False)]
    taken.close()
    assert bool(states[0].accepted.all()) and states[0].cost < begun.cost
    assert all(bool(value.isfinite().all()) for value in bundle.values().values())
    assert bool(bundle.white_scale.isfinite().all())


def test_a_leap_where_a_drive_is_cut_leaves_the_rest_as_it_is(street):
    """Nothing else holds the number that the cut has of the parting there."""
    config = replace(AdjustConfig(), cut_unknowns=60)
    bundle = street.bundle(config=config)
    leapt = (bundle.course.cut >= 0) & (bundle.course.before % 2 == 0)
    assert int(leapt.sum()) > 2
    bundle.course = replace(bundle.course, seen=bundle.course.seen + 5.0 * leapt)
    values = bundle.values()
    bundle.base_cut[:, -1:] = bundle.course.at_cuts(values["drift"], values["stance"])
    taken = adjust.steps(bundle, adjust.start(bundle))
    states = [state for _, (_, state, _) in zip(range(3), taken, strict=False)]
    taken.close()
    assert bool(states[-1].accepted.all())
    sides = [residuals(bundle.problem().terms[f"course_{x}_cut"], bundle.values()) for x in SIDES]
    parted = (sides[0] + sides[1])[leapt[bundle.course.cut >= 0]]
    # Neither half draws what lies before the leap to what lies behind it.
    assert bool((parted.abs() > 100).all()), parted
