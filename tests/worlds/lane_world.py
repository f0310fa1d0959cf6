"""A synthetic road with markers, and the lane pieces that journeys with drift, noise and faults make of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import KDTree

from crowdmap_torch.geometry import spline_length
from crowdmap_torch.tables import LANE_TYPES, ControlPoints, Lanes


@dataclass(frozen=True)
class Marker:
    """A marker at an offset to the left of the road's centre line, over a range of stations."""

    type: str
    first: float
    last: float
    offset: float
    end_offset: float | None = None


SUBURB = (
    Marker("solid", 0, 1000, -7.0),
    Marker("dashed", 0, 1000, -3.5),
    Marker("double", 0, 1000, 0.0),
    Marker("dashed", 0, 600, 3.5),
    Marker("solid", 600, 1000, 3.5),
    Marker("curb", 0, 1000, 7.0),
    Marker("solid", 350, 480, -7.0, -13.0),  # splits off
    Marker("dashed", 700, 800, 10.5, 7.0),  # merges into the kerb
)
DOUBLE = (*SUBURB[:5], Marker("solid", 0, 1000, 6.6), Marker("curb", 0, 1000, 7.1))


@dataclass(frozen=True)
class LaneWorld:
    """True markers, and what journeys made of them."""

    truth: list[np.ndarray]
    """Points of each marker every half metre."""
    seen: list[np.ndarray]
    """How many journeys saw each of them."""
    markers: tuple[Marker, ...]
    lanes: Lanes
    marker_of_piece: np.ndarray
    """-1 for pieces across two markers."""
    drift: dict[int, np.ndarray]
    """Error of each journey at every half metre of the road [n, 3]."""
    left: np.ndarray
    """Unit vector to the left of the road there [n, 2]."""


def build(
    seed: int,
    journeys: int,
    *,
    markers: tuple[Marker, ...] = SUBURB,
    length: float = 1000.0,
    drift: float = 0.15,
    wrong_share: float = 0.01,
    both_ways: bool = False,
    wrong_type: float = 0.1,
) -> LaneWorld:
    """Pieces of about 40 m, a new one every 20 m, of tracklets that begin and end at random."""
    rng = np.random.default_rng(seed)
    markers = tuple(m for m in markers if m.first < length - 20)
    station = np.arange(0, length + 0.5, 0.5)
    phase = rng.uniform(0, 2 * np.pi, 4)
    heading = (
        rng.uniform(0, 2 * np.pi)
        + 0.5 * np.sin(station / 70 + phase[0])
        + (0.3 * np.sin(station / 31 + phase[1]))
    )
    step = 0.5 * np.stack((np.cos(heading), np.sin(heading)), 1)
    centre = np.concatenate((np.zeros((1, 2)), np.cumsum(step[:-1], 0)))
    height = 4 * np.sin(station / 80 + phase[2])
    left = np.stack((-np.sin(heading), np.cos(heading)), 1)

    def offset_at(marker: Marker, s: np.ndarray) -> np.ndarray:
        share = np.clip((s - marker.first) / (marker.last - marker.first), 0, 1)
        end = marker.offset if marker.end_offset is None else marker.end_offset
        return marker.offset + (end - marker.offset) * share**2 * (3 - 2 * share)

    def place(s: np.ndarray, offset: np.ndarray) -> np.ndarray:
        columns = (*centre.T, height, *left.T)
        x, y, z, nx, ny = (np.interp(s, station, column) for column in columns)
        return np.stack((x + offset * nx, y + offset * ny, z), 1)

    truth = [
        place(s := np.arange(m.first, min(m.last, length) + 0.25, 0.5), offset_at(m, s))
        for m in markers
    ]
    seen = [np.zeros(len(t), dtype=np.int64) for t in truth]
    rows: dict[str, list] = {k: [] for k in ("type", "journey", "tracklet", "frame", "marker")}
    control: list[np.ndarray] = []
    drifts = {}
    for j in range(journeys):
        backwards = both_ways and j % 2 == 1
        error = np.stack([_correlated(rng, len(station), drift, 300) for _ in range(3)], 1)
        drifts[j] = error
        tracklet = 0
        for k, m in enumerate(markers):
            last = min(m.last, length)
            begin = m.first + rng.exponential(15)
            while begin < last - 10:
                end = min(begin + 30 + rng.exponential(200), last)
                seen[k][round(2 * (begin - m.first)) : round(2 * (end - m.first))] += 1
                wobble = _correlated(rng, len(station), 0.05, 40) + 0.03 * rng.normal()
                kind = m.type if rng.uniform() > wrong_type else str(rng.choice(LANE_TYPES))
                first = begin
                while first < end - 5:
                    stop = min(first + 40, end)
                    count = max(2, round((stop - first) / 8) + 1)
                    s = np.linspace(first, stop, count)
                    offset = offset_at(m, s) + np.interp(s, station, wobble)
                    offset = offset + 0.03 * rng.normal(size=count)
                    wrong = count > 3 and rng.uniform() < wrong_share
                    if wrong:
                        offset = offset + np.linspace(0, rng.choice((-3.5, 3.5)), count)
                    p = place(s, offset)
                    p += np.stack([np.interp(s, station, c) for c in error.T], 1)
                    p[:, 2] += 0.05 * rng.normal(size=count)
                    at = 0.5 * (first + stop)
                    control.append(p[::-1] if backwards else p)
                    rows["type"].append(LANE_TYPES.index(kind))
                    rows["journey"].append(j)
                    rows["tracklet"].append(tracklet)
                    rows["frame"].append(int(length - at if backwards else at))
                    rows["marker"].append(-1 if wrong else k)
                    first += 20
                tracklet += 1
                begin = end + rng.exponential(8)
    order = rng.permutation(len(control))
    rows = {k: [v[i] for i in order] for k, v in rows.items()}
    lanes = pieces(
        [control[i] for i in order],
        type=rows["type"],
        journey=rows["journey"],
        tracklet=rows["tracklet"],
        frame=rows["frame"],
    )
    return LaneWorld(truth, seen, markers, lanes, np.array(rows["marker"]), drifts, left)


def pieces(
    control: list[np.ndarray],
    *,
    type: list[int],
    journey: list[int],
    tracklet: list[int],
    frame: list[int],
    sigma: float = 0.06,
) -> Lanes:
    """A table of lane pieces from the control points of each."""
    n = len(control)
    count = torch.tensor([len(c) for c in control], dtype=torch.int64)
    seen = torch.tensor(frame, dtype=torch.int64) * 10**8
    points = np.concatenate([np.zeros((0, 3)), *control])
    return Lanes(
        type=torch.tensor(type, dtype=torch.int64),
        control_start=count.cumsum(0) - count,
        control_count=count,
        journey=torch.tensor(journey, dtype=torch.int64),
        tracklet=torch.tensor(tracklet, dtype=torch.int64),
        frame=torch.tensor(frame, dtype=torch.int64),
        n_journeys=torch.ones(n, dtype=torch.int64),
        n_observations=torch.full((n,), 40),
        first_seen_ns=seen,
        last_seen_ns=seen + 10**9,
        confidence=torch.ones(n, dtype=torch.float64),
        control=ControlPoints(
            torch.from_numpy(points), torch.full((len(points),), sigma, dtype=torch.float64)
        ),
    )


def _correlated(rng: np.random.Generator, n: int, sigma: float, steps: float) -> np.ndarray:
    keep = np.exp(-1 / steps)
    noise = rng.normal(size=n) * sigma * np.sqrt(1 - keep**2)
    value = np.empty(n)
    value[0] = sigma * rng.normal()
    for i in range(1, n):
        value[i] = keep * value[i - 1] + noise[i]
    return value


@dataclass(frozen=True)
class Figures:
    """The figures of METRICS.md for lanes."""

    recall: float
    precision: float
    duplicates: float
    lateral: float
    lateral_95: float
    longest_gap: float
    """Of the true markers seen by three or more journeys, after the first and before the last found point [m]."""


def figures(world: LaneWorld, result: Lanes) -> Figures:
    """Recall, precision, duplicates and lateral error of lanes against the truth."""
    lines, _, line = spline_length.sample_flat(
        result.control.point_world, result.control_count, 0.25
    )
    lines, line = lines.numpy(), line.numpy()
    found, twice, errors, total, gap = 0, 0, [], 0, 0.0
    # Markers that the truth itself lays within the gate of each other are covered twice by right.
    others = [
        KDTree(np.concatenate([t for o, t in enumerate(world.truth) if o != k]))
        for k in range(len(world.truth))
    ]
    tree = KDTree(lines)
    for k, (points, seen) in enumerate(zip(world.truth, world.seen, strict=True)):
        normal = _normals(points)
        hits = np.zeros(len(points), dtype=bool)
        alone = others[k].query(points)[0] > 1.1
        for i, near in enumerate(tree.query_ball_point(points, 0.6)):
            delta = lines[near] - points[i]
            across = delta[:, :2] @ normal[i]
            along = np.abs(delta[:, 0] * normal[i, 1] - delta[:, 1] * normal[i, 0])
            ok = (np.abs(across) < 0.5) & (along < 0.2)
            if seen[i] < 3:
                continue
            total += 1
            hits[i] = ok.any()
            found += ok.any()
            if ok.any():
                errors.append(np.abs(across[ok]).min())
                which = np.unique(line[np.asarray(near)[ok]])
                twice += alone[i] and len(which) > 1
        where = np.flatnonzero(hits)
        if len(where) > 1:
            missing = ~hits[where[0] : where[-1]] & (seen[where[0] : where[-1]] >= 3)
            runs = np.diff(np.flatnonzero(np.concatenate(([True], ~missing, [True])))) - 1
            gap = max(gap, 0.5 * runs.max())
    truth = np.concatenate(world.truth)
    normal = np.concatenate([_normals(t) for t in world.truth])
    _, nearest = KDTree(truth).query(lines, k=4)
    delta = lines[:, None, :2] - truth[nearest][..., :2]
    across = np.abs((delta * normal[nearest]).sum(-1))
    along = np.abs(
        delta[..., 0] * normal[nearest][..., 1] - delta[..., 1] * normal[nearest][..., 0]
    )
    precise = ((across < 0.5) & (along < 0.5)).any(1).mean()
    return Figures(
        recall=found / max(total, 1),
        precision=float(precise),
        duplicates=twice / max(total, 1),
        lateral=float(np.mean(errors)),
        lateral_95=float(np.quantile(errors, 0.95)),
        longest_gap=gap,
    )


def _normals(points: np.ndarray) -> np.ndarray:
    tangent = np.gradient(points[:, :2], axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    return np.stack((-tangent[:, 1], tangent[:, 0]), 1)
