"""Maps of roads with markers and signs, drawn by hand: lanes are known."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch

from crowdmap_torch.geometry import polygon, se3
from crowdmap_torch.tables import LANE_TYPES, ControlPoints, HdMap, Lanes, Origin, Signs

ORIGIN = Origin(32.9, -117.2, 120.0)


def line(start: tuple[float, float], end: tuple[float, float], z: float = 0.0) -> np.ndarray:
    """Points of a straight marker, a metre apart."""
    count = round(math.dist(start, end)) + 1
    xy = np.linspace(start, end, count)
    return np.column_stack((xy, z + 0.01 * xy[:, 0]))


def bend(radius: float, degrees: float, aside: float) -> np.ndarray:
    """Points of a marker `aside` metres to the left of an arc to the left, a metre apart, on a banked hill."""
    length = (radius - aside) * math.radians(degrees)
    angle = np.linspace(0, math.radians(degrees), math.ceil(length) + 1)
    r = radius - aside
    height = 0.03 * radius * angle - 0.03 * aside
    return np.column_stack((r * np.sin(angle), radius - r * np.cos(angle), height))


def marked_map(
    markers: Sequence[tuple[str | None, np.ndarray]], signs: Sequence[tuple[str | None, tuple]] = ()
) -> HdMap:
    """A map of markers, given by type and points, and of signs, given by code and (x, y, z, direction faced [deg])."""
    points = [np.asarray(p, dtype=np.float64) for _, p in markers]
    count = torch.tensor([len(p) for p in points], dtype=torch.int64)
    control = torch.from_numpy(np.concatenate([*points, np.empty((0, 3))]))
    n, m = len(signs), len(markers)
    codes = tuple(sorted({code for code, _ in signs if code is not None}))
    place = torch.tensor([s for _, s in signs], dtype=torch.float64).reshape(n, 4)
    turn = torch.deg2rad(place[:, 3])
    z = torch.stack((turn.cos(), turn.sin(), torch.full_like(turn, 0.1)), dim=-1)
    z = torch.nn.functional.normalize(z, dim=-1)
    x = torch.stack((-turn.sin(), turn.cos(), torch.zeros_like(turn)), dim=-1)
    R = torch.stack((x, torch.linalg.cross(z, x), z), dim=-1)
    T, size = polygon.canonical(
        se3.make(R, place[:, :3]),
        torch.tensor([[0.6, 0.8]], dtype=torch.float64).repeat(n, 1),
        torch.arange(n) % len(polygon.SHAPES),
    )

    def support(rows: int) -> dict:
        none, number = torch.full((rows,), -1), torch.arange(rows)
        return {
            **dict.fromkeys(("journey", "tracklet", "frame"), none),
            "n_journeys": number + 2,
            "n_observations": number + 20,
            "first_seen_ns": number + 10**18,
            "last_seen_ns": number + 2 * 10**18,
            "confidence": torch.linspace(0.6, 1, rows, dtype=torch.float64),
        }

    return HdMap(
        origin=ORIGIN,
        signs=Signs(
            shape=torch.arange(n) % len(polygon.SHAPES),
            type=torch.tensor([-1 if c is None else codes.index(c) for c, _ in signs]).long(),
            T_world_sign=T,
            size=size,
            covariance=0.01 * torch.eye(3, dtype=torch.float64).repeat(n, 1, 1),
            **support(n),
        ),
        lanes=Lanes(
            type=torch.tensor(
                [-1 if t is None else LANE_TYPES.index(t) for t, _ in markers]
            ).long(),
            control_start=count.cumsum(0) - count,
            control_count=count,
            **support(m),
            control=ControlPoints(control, torch.full((len(control),), 0.05, dtype=torch.float64)),
        ),
        sign_id=tuple(f"sign-{k}" for k in range(n)),
        lane_id=tuple(f"lane-{k}" for k in range(m)),
        type_names=codes,
        shared_covariance=torch.zeros(3, 3, dtype=torch.float64),
        provenance={"version": "0.1.0", "note": '<&> "drawn"'},
    )


def crossing() -> HdMap:
    """Four roads of 40 m that end 12 m before the middle of a crossing, one lane each way; the crossing has no markers."""
    markers = []
    for turn in (0.0, 90.0, 180.0, 270.0):
        c, s = math.cos(math.radians(turn)), math.sin(math.radians(turn))

        def along(left: float, begin: float, end: float, c: float = c, s: float = s) -> np.ndarray:
            first, last = ((c * r - s * left, s * r + c * left) for r in (begin, end))
            return line(first, last)

        # Seen from the middle: those who leave keep to the right.
        markers += [
            ("solid", along(3.5, 52, 12)),
            ("double", along(0.0, 12, 52)),
            ("solid", along(-3.5, 12, 52)),
        ]
    return marked_map(markers)


def two_way_road() -> HdMap:
    """120 m of road to the east: two lanes that way, one back; the middle line in two pieces, signs for both ways."""
    markers = [
        ("curb", line((120, 7.0), (0, 7.0))),
        ("double", line((0, 3.5), (60, 3.5))),
        ("double", line((60, 3.5), (120, 3.5))),
        ("dashed", line((0, 0), (120, 0))),
        ("solid", line((0, -3.5), (120, -3.5))),
        (None, line((0, -30), (40, -30))),
    ]
    signs = [
        ("US:R1-1", (100.0, -6.0, 2.0, 180.0)),
        ("DE:274", (30.0, 9.0, 2.2, 0.0)),
        (None, (50.0, -6.0, 2.0, 170.0)),
        ("US:R1-1", (60.0, 200.0, 2.0, 180.0)),
    ]
    return marked_map(markers, signs)
