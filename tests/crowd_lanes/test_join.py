from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial import KDTree
from worlds import lane_world

from crowdmap_torch.crowd_lanes.join import JoinedLanes, LaneJoinConfig, join_lanes
from crowdmap_torch.crowd_lanes.trace import TraceConfig
from crowdmap_torch.geometry import spline_length
from crowdmap_torch.noise.positioning import PositioningNoise
from crowdmap_torch.tables import LANE_TYPES, Lanes

NOISE = PositioningNoise()

CONFIG = LaneJoinConfig()


@pytest.fixture(scope="module")
def world() -> lane_world.LaneWorld:
    return lane_world.build(0, 6, length=810.0, drift=0.2)


@pytest.fixture(scope="module")
def joined(world: lane_world.LaneWorld) -> JoinedLanes:
    return join_lanes(world.lanes, NOISE, CONFIG)


def ends(lanes: Lanes) -> tuple[torch.Tensor, torch.Tensor]:
    last = lanes.control_start + lanes.control_count - 1
    return lanes.control.point_world[lanes.control_start], lanes.control.point_world[last]


def sampled(lanes: Lanes) -> np.ndarray:
    return spline_length.sample_flat(lanes.control.point_world, lanes.control_count, 0.5)[0].numpy()


def line(
    offset: float,
    height: float = 0.0,
    *,
    first: float = 0.0,
    last: float = 200.0,
    north: bool = False,
) -> np.ndarray:
    """A straight line of control points 10 m apart, `offset` left of the axis it runs along."""
    s = np.arange(first, last + 1, 10.0)
    x, y = s, np.full_like(s, offset)
    return np.stack((y, x) if north else (x, y), 1) @ np.eye(2, 3) + np.array([0, 0, height])


def lanes_of(lines: list[tuple[np.ndarray, str]], journeys: int, noise: float = 0.03) -> Lanes:
    """Every journey sees every line as one piece each."""
    rng = np.random.default_rng(0)
    rows = [
        (points + noise * rng.normal(size=points.shape), LANE_TYPES.index(kind), j, k)
        for j in range(journeys)
        for k, (points, kind) in enumerate(lines)
    ]
    control, kind, journey, tracklet = (list(column) for column in zip(*rows, strict=True))
    frame = [50] * len(rows)
    return lane_world.pieces(control, type=kind, journey=journey, tracklet=tracklet, frame=frame)


@pytest.mark.parametrize(("seed", "journeys"), [(0, 8), (1, 4), (2, 10)])
def test_every_marker_is_covered_once(seed: int, journeys: int) -> None:
    world = lane_world.build(seed, journeys, length=420.0, drift=0.15, both_ways=seed == 2)
    figures = lane_world.figures(world, join_lanes(world.lanes, NOISE, CONFIG).lanes)
    assert figures.recall >= 0.99
    assert figures.precision >= 0.99
    assert figures.duplicates <= 0.005
    # The mean of the journeys' drifts (0.15 m each) is what nobody can take off.
    assert figures.lateral <= 1.2 * 0.15 * (2 / np.pi) ** 0.5 / journeys**0.5 + 0.03
    assert figures.longest_gap <= 2.0


def test_lines_side_by_side_are_kept_apart() -> None:
    # A solid line half a metre beside the kerb, half of the type votes of a few pieces wrong.
    world = lane_world.build(0, 8, length=300.0, markers=lane_world.DOUBLE, drift=0.15)
    figures = lane_world.figures(world, join_lanes(world.lanes, NOISE, CONFIG).lanes)
    assert figures.recall >= 0.99
    assert figures.lateral <= 0.1
    lanes = lanes_of([(line(0), "solid"), (line(0.5), "solid")], 5)
    assert len(join_lanes(lanes, NOISE, CONFIG).lanes) == 2


def test_lane_changes_type_where_the_marker_does(
    world: lane_world.LaneWorld, joined: JoinedLanes
) -> None:
    lanes = joined.lanes
    boundary = world.truth[4][0]  # dashed up to here, solid from here
    first, last = ends(lanes)
    before = (last[:, :2] - torch.from_numpy(boundary[:2])).norm(dim=1).argmin()
    after = (first[:, :2] - torch.from_numpy(boundary[:2])).norm(dim=1).argmin()
    assert LANE_TYPES[int(lanes.type[before])] == "dashed"
    assert LANE_TYPES[int(lanes.type[after])] == "solid"
    # Both end in the very same point, at most a tracklet's way from the truth.
    torch.testing.assert_close(last[before], first[after], rtol=0, atol=1e-12)
    assert float((last[before, :2] - torch.from_numpy(boundary[:2])).norm()) < 15.0


def test_types_are_those_of_the_markers(world: lane_world.LaneWorld, joined: JoinedLanes) -> None:
    truth = np.concatenate(world.truth)
    kind = np.concatenate(
        [
            np.full(len(t), LANE_TYPES.index(m.type))
            for t, m in zip(world.truth, world.markers, strict=True)
        ]
    )
    lanes = joined.lanes
    point, _, owner = spline_length.sample_flat(lanes.control.point_world, lanes.control_count, 2.0)
    _, nearest = KDTree(truth).query(point.numpy())
    assert (kind[nearest] == lanes.type[owner].numpy()).mean() > 0.95


def test_split_and_merge_are_lanes_of_their_own(
    world: lane_world.LaneWorld, joined: JoinedLanes
) -> None:
    tree = KDTree(sampled(joined.lanes))
    for marker in (6, 7):
        points = world.truth[marker]
        far = KDTree(world.truth[0 if marker == 6 else 5]).query(points)[0] > 0.8
        seen = world.seen[marker] >= 3
        assert (tree.query(points[far & seen])[0] < 0.5).mean() > 0.97


def test_wrong_pieces_across_two_markers_make_no_lane() -> None:
    world = lane_world.build(3, 10, length=300.0, wrong_share=0.03)
    figures = lane_world.figures(world, join_lanes(world.lanes, NOISE, CONFIG).lanes)
    assert figures.precision >= 0.99
    assert figures.recall >= 0.99


@pytest.mark.parametrize(
    ("detections", "agreeing", "lanes"), [(6, 0.9, 2), (16, 0.9, 3), (16, 0.4, 2), (40, 0.4, 3)]
)
def test_what_is_detected_now_and_then_beside_markers_is_none(
    detections: int, agreeing: float, lanes: int
) -> None:
    every = lanes_of([(line(0), "solid"), (line(3.5), "solid"), (line(1.6), "dashed")], 6)
    is_beside = every.tracklet == 2
    every = replace(
        every,
        n_observations=torch.where(is_beside, detections, 40),
        confidence=torch.where(is_beside, agreeing, 0.9).to(every.confidence),
    )
    joined = join_lanes(every, NOISE, CONFIG)
    assert len(joined.lanes) == lanes
    dropped = 200.0 if lanes == 2 else 0.0
    assert joined.report.seldom_m == pytest.approx(dropped, abs=5.0)
    # Its pieces are of no lane.
    assert bool((joined.piece_lane[every.tracklet == 2] < 0).all()) == (lanes == 2)


def test_control_points_are_about_equally_spaced(joined: JoinedLanes) -> None:
    lanes = joined.lanes
    chord = (lanes.control.point_world[1:] - lanes.control.point_world[:-1]).norm(dim=1)
    chord = chord[lanes.piece_of_control[1:] == lanes.piece_of_control[:-1]]
    assert 3.0 < float(chord.min()) and float(chord.max()) < 12.0
    mean = chord.new_zeros(len(lanes)).index_add(
        0,
        lanes.piece_of_control[1:][lanes.piece_of_control[1:] == lanes.piece_of_control[:-1]],
        chord,
    ) / (lanes.control_count - 1)
    spread = chord / torch.repeat_interleave(mean, lanes.control_count - 1)
    assert float((spread - 1).abs().max()) < 0.25


def test_lanes_run_in_the_direction_of_travel(
    world: lane_world.LaneWorld, joined: JoinedLanes
) -> None:
    first, last = (end.numpy() for end in ends(joined.lanes))
    centre = KDTree(world.truth[2])
    assert (centre.query(first)[1] < centre.query(last)[1]).all()


def test_pieces_name_the_true_marker(world: lane_world.LaneWorld, joined: JoinedLanes) -> None:
    truth = KDTree(np.concatenate(world.truth))
    marker = np.concatenate([np.full(len(t), k) for k, t in enumerate(world.truth)])
    lanes = joined.lanes
    point, _, owner = spline_length.sample_flat(lanes.control.point_world, lanes.control_count, 1.0)
    of_lane = np.array(
        [
            np.bincount(marker[truth.query(point[owner == k].numpy())[1]]).argmax()
            for k in range(len(lanes))
        ]
    )
    right = world.marker_of_piece >= 0
    lane = joined.piece_lane.numpy()
    assert (lane[right] >= 0).mean() > 0.98
    used = right & (lane >= 0)
    # Pieces about the split, the merge and the change of type have two lanes to choose from.
    assert (of_lane[lane[used]] == world.marker_of_piece[used]).mean() > 0.96


def test_samples_name_the_lane_that_they_lie_on(
    world: lane_world.LaneWorld, joined: JoinedLanes
) -> None:
    support, lanes = joined.support, joined.lanes
    used = support.lane >= 0
    assert used.double().mean() > 0.9
    point, _, owner = spline_length.sample_flat(lanes.control.point_world, lanes.control_count, 0.5)
    for lane in support.lane[used].unique().tolist():
        near = KDTree(point[owner == lane, :2].numpy())
        distance = near.query(support.point_world[support.lane == lane, :2].numpy())[0]
        # Journeys' own offsets are still in.
        assert np.median(distance) < 0.5
    of = {(int(j), int(t)) for j, t in zip(world.lanes.journey, world.lanes.tracklet, strict=True)}
    found = zip(support.journey.tolist(), support.tracklet.tolist(), strict=True)
    assert set(found) <= of


def test_nothing_depends_on_row_order(world: lane_world.LaneWorld, joined: JoinedLanes) -> None:
    order = torch.randperm(len(world.lanes), generator=torch.Generator().manual_seed(1))
    again = join_lanes(world.lanes.select(order), NOISE, CONFIG)
    assert len(again.lanes) == len(joined.lanes)
    distance = KDTree(sampled(joined.lanes)).query(sampled(again.lanes))[0]
    assert distance.max() < 0.3  # samples are half a metre apart
    same = again.piece_lane >= 0
    assert ((joined.piece_lane[order] >= 0) == same).float().mean() > 0.999


def test_lanes_move_with_the_world(world: lane_world.LaneWorld, joined: JoinedLanes) -> None:
    angle, shift = 0.7, np.array([1234.5, -987.6, 55.5])
    R = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    point = world.lanes.control.point_world.numpy() @ R.T + shift
    turned = replace(
        world.lanes, control=replace(world.lanes.control, point_world=torch.from_numpy(point))
    )
    again = sampled(join_lanes(turned, NOISE, CONFIG).lanes)
    back = (again - shift) @ R
    tree = KDTree(
        spline_length.sample_flat(
            joined.lanes.control.point_world, joined.lanes.control_count, 0.1
        )[0].numpy()
    )
    # The grid that start points come from is another one: curves agree to centimetres, not to rounding.
    assert np.quantile(tree.query(back)[0], 0.98) < 0.06


def test_roads_above_each_other_are_not_joined() -> None:
    lanes = lanes_of([(line(0), "solid"), (line(0.3, height=6.0), "solid")], 4)
    joined = join_lanes(lanes, NOISE, CONFIG)
    assert len(joined.lanes) == 2
    assert sorted(
        joined.lanes.control.point_world[joined.lanes.control_start, 2].round().tolist()
    ) == [0, 6]


def test_crossing_markers_are_not_joined() -> None:
    lanes = lanes_of(
        [(line(0), "solid"), (line(100, north=True, first=-100, last=100), "solid")], 4
    )
    joined = join_lanes(lanes, NOISE, CONFIG)
    assert len(joined.lanes) == 2
    assert (
        float(
            spline_length.arc_length_flat(
                joined.lanes.control.point_world, joined.lanes.control_count
            ).min()
        )
        > 195.0
    )


def test_a_ring_closes() -> None:
    s = np.linspace(0, 2 * np.pi, 181)
    circle = np.stack((40 * np.cos(s), 40 * np.sin(s), np.zeros_like(s)), 1)
    rng = np.random.default_rng(0)
    control, journey, tracklet, frame = [], [], [], []
    for j in range(4):
        for first in range(0, 180, 10):
            rows = np.arange(first, first + 25, 4) % 180
            control.append(circle[rows] + 0.03 * rng.normal(size=(len(rows), 3)))
            journey.append(j)
            tracklet.append(first // 60)
            frame.append(first)
    lanes = lane_world.pieces(
        control, type=[0] * len(control), journey=journey, tracklet=tracklet, frame=frame
    )
    joined = join_lanes(lanes, NOISE, CONFIG).lanes
    distance = KDTree(sampled(joined)).query(circle)[0]
    assert len(joined) == 1
    assert distance.max() < 0.5
    first, last = ends(joined)
    assert float((first - last).norm()) < 0.2


def test_gaps_are_bridged_where_a_journey_saw_the_marker() -> None:
    # Two journeys stop short of a gap of 30 m that one journey saw.
    parts = [(line(0, last=80.0), "dashed"), (line(0, first=110.0), "dashed")]
    lanes = lanes_of(parts, 3)
    whole = lanes_of([(line(0), "dashed")], 1)
    whole = replace(whole, journey=whole.journey + 3)
    merged = lane_world.pieces(
        [
            lanes.control.point_world[int(s) : int(s) + int(c)].numpy()
            for s, c in zip(lanes.control_start, lanes.control_count, strict=True)
        ]
        + [whole.control.point_world.numpy()],
        type=[*lanes.type.tolist(), 1],
        journey=[*lanes.journey.tolist(), 3],
        tracklet=[*lanes.tracklet.tolist(), 0],
        frame=[50] * 7,
    )
    assert len(join_lanes(merged, NOISE, CONFIG).lanes) == 1
    assert len(join_lanes(lanes, NOISE, CONFIG).lanes) == 2


def test_single_journey_lanes_need_permission() -> None:
    lanes = lanes_of([(line(0), "solid"), (line(3.5), "solid")], 4)
    alone = (lanes.tracklet == 0) | (lanes.journey == 0)
    lanes = lanes.select(alone.nonzero()[:, 0])
    assert len(join_lanes(lanes, NOISE, CONFIG).lanes) == 1
    permitted = replace(CONFIG, trace=TraceConfig(min_journeys=1))
    assert len(join_lanes(lanes, NOISE, permitted).lanes) == 2


def test_one_journey_is_a_map() -> None:
    world = lane_world.build(
        0, 1, length=300.0, drift=0.0, markers=lane_world.SUBURB[:3], wrong_share=0
    )
    lanes = join_lanes(world.lanes, NOISE, CONFIG).lanes
    truth = np.concatenate([t[s >= 1] for t, s in zip(world.truth, world.seen, strict=True)])
    assert (KDTree(sampled(lanes)).query(truth)[0] < 0.5).mean() > 0.97
    assert (lanes.n_journeys == 1).all()
    assert (lanes.confidence < 0.5).all()


def test_a_bad_journey_is_outvoted() -> None:
    lanes = lanes_of([(line(0), "solid"), (line(3.5), "dashed")], 6)
    offset = torch.where(lanes.journey[lanes.piece_of_control] == 0, 0.9, 0.0)
    point = lanes.control.point_world.clone()
    point[:, 1] += offset
    lanes = replace(lanes, control=replace(lanes.control, point_world=point))
    joined = join_lanes(lanes, NOISE, CONFIG)
    across = joined.lanes.control.point_world[:, 1]
    error = torch.minimum(across.abs(), (across - 3.5).abs())
    assert len(joined.lanes) == 2
    # The mean would be off by 0.15 m.
    assert float(error.mean()) < 0.05


def test_no_pieces_make_no_lanes() -> None:
    lanes = lanes_of([(line(0), "solid")], 1)
    joined = join_lanes(lanes.select(torch.zeros(0, dtype=torch.int64)), NOISE, CONFIG)
    assert len(joined.lanes) == len(joined.piece_lane) == 0


@pytest.mark.parametrize("length", [3.0, 20.0, 200.0])
def test_pieces_nobody_else_saw_make_no_lanes(length: float) -> None:
    lines = [np.array([[0, 0, 0], [length, 0, 0]]) + np.array([0, 50.0 * j, 0]) for j in range(3)]
    lanes = lane_world.pieces(
        lines, type=[-1, 0, 1], journey=[0, 1, 2], tracklet=[0, 0, 0], frame=[5, 5, 5]
    )
    joined = join_lanes(lanes, NOISE, CONFIG)
    assert len(joined.lanes) == 0
    assert (joined.piece_lane == -1).all()


def test_two_control_points_are_a_piece() -> None:
    line_of_two = np.array([[0, 0, 0], [60.0, 0, 0]])
    lanes = lane_world.pieces(
        [line_of_two] * 2, type=[-1, 0], journey=[0, 1], tracklet=[0, 0], frame=[5, 5]
    )
    joined = join_lanes(lanes, NOISE, CONFIG)
    assert joined.lanes.type.tolist() == [0]
    assert joined.lanes.control_count.tolist()[0] >= 4
    torch.testing.assert_close(ends(joined.lanes)[0][0], torch.zeros(3).double(), rtol=0, atol=1.5)


def test_config_needs_a_gate_for_every_round() -> None:
    with pytest.raises(ValueError, match="gates_m"):
        LaneJoinConfig(gates_m=(1.0,))
