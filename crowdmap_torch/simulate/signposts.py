"""Traffic signs of a world: on posts of their own, on shared posts, back to back, on gantries."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int

from crowdmap_torch.geometry import polygon
from crowdmap_torch.ranges import Angle, Degrees, LengthOrNone, Rate, Settings, Share, Span
from crowdmap_torch.simulate.roads import Road

CODES: dict[str, tuple[str, ...]] = {
    "triangle": ("DE:101", "DE:103", "DE:114"),
    "inverted_triangle": ("US:R1-2",),
    "rectangle": ("US:R2-1", "US:R3-7", "US:R7-1", "US:D1-1", "US:M1-4", "US:R4-7"),
    "diamond": ("US:W1-2", "US:W3-3", "US:W11-2", "US:W2-1"),
    "pentagon": ("US:S1-1",),
    "octagon": ("US:R1-1",),
}
SHARES = {
    "rectangle": 0.42,
    "diamond": 0.22,
    "octagon": 0.1,
    "triangle": 0.09,
    "inverted_triangle": 0.09,
    "pentagon": 0.08,
}
"""How common shapes are, before they are scaled to 1."""
NAME_CODE = "US:D3-1"
"""Of the name of a street."""
PANEL_CODES = ("US:E1-5", "US:E5-1", "US:E6-2")
"""Of the large panels of a gantry."""


@dataclass(frozen=True)
class SignConfig(Settings):
    """Where signs stand and how they look."""

    posts_per_km: Rate = 32.0
    """Posts for the traffic of one direction."""
    shared_share: Share = 0.25
    """Share of the posts that carry two or three signs, 0.7 m apart."""
    opposite_share: Share = 0.25
    """Posts for oncoming traffic, as a share of `posts_per_km`."""
    back_to_back_share: Share = 0.0
    """Share of the posts that carry a sign on their back too."""
    gantries_per_km: Rate = 0.0
    wide_boards_per_km: Rate = 0.0
    """Single boards across all lanes."""
    wide_board_m: Span = (9.0, 15.0)
    """Least and largest width of those."""
    beside_m: Span = (1.5, 4.5)
    """Least and largest distance of a post from the edge of the road."""
    left_share: Share = 0.15
    """Share of the posts on the left of their traffic."""
    yaw_deg: Angle = 4.0
    """1-sigma of a sign's turn about the vertical away from square to the road."""
    tilt_deg: Degrees = 1.5
    """1-sigma of its lean forwards and of its roll."""
    null_code_share: Share = 0.15
    """Share of the signs whose traffic-sign code nobody knows."""
    stack_m: LengthOrNone = 0.7
    """Distance between the centres of signs on a shared post."""


@dataclass(frozen=True)
class WorldSigns:
    """The signs of a world, exact."""

    sign_id: tuple[str, ...]
    shape: Int[np.ndarray, " n"]
    """Index into `polygon.SHAPES`."""
    code: tuple[str | None, ...]
    post: Int[np.ndarray, " n"]
    """Which signs share a post or a gantry."""
    center: Float[np.ndarray, "n 3"]
    """Mean of the corners."""
    R_world_sign: Float[np.ndarray, "n 3 3"]
    size: Float[np.ndarray, "n 2"]

    def __len__(self) -> int:
        return len(self.sign_id)

    @property
    def normal(self) -> Float[np.ndarray, "n 3"]:
        """Unit normals, pointing at the drivers."""
        return self.R_world_sign[:, :, 2]

    def corners(self) -> Float[np.ndarray, "n 8 3"]:
        """World corners, clockwise as drivers see them; further slots repeat the last one."""
        corners_sign = polygon.corners(
            torch.from_numpy(self.shape), torch.from_numpy(self.size)
        ).numpy()
        return self.center[:, None] + corners_sign @ self.R_world_sign.transpose(0, 2, 1)


@dataclass
class _Builder:
    """Signs as they are put up one after another."""

    road: Road
    config: SignConfig
    rng: np.random.Generator

    def __post_init__(self) -> None:
        self.rows: list[tuple[int, str | None, int, np.ndarray, np.ndarray, np.ndarray]] = []
        self.posts = 0

    def hang(
        self,
        shape: str,
        code: str | None,
        base: np.ndarray,
        travel: np.ndarray,
        rise: float,
        aside: float,
        size: tuple[float, float],
        *,
        wear: float = 1.0,
    ) -> None:
        """One sign `rise` metres above `base` and `aside` to the right, for those who `travel`."""
        level = travel * np.array([1.0, 1.0, 0.0])
        level = level / np.linalg.norm(level)
        right = np.array([level[1], -level[0], 0.0])
        yaw, lean, roll = np.radians(
            wear
            * self.rng.normal(size=3)
            * (self.config.yaw_deg, self.config.tilt_deg, self.config.tilt_deg)
        )
        R = np.stack((right, np.array([0.0, 0.0, 1.0]), -level), axis=-1)
        R = R @ _turn_about(1, yaw) @ _turn_about(0, lean) @ _turn_about(2, roll)
        center = base + np.array([0.0, 0.0, rise]) + aside * right
        if code is not None and self.rng.random() < self.config.null_code_share:
            code = None
        self.rows.append((polygon.SHAPES.index(shape), code, self.posts, center, R, np.array(size)))

    def post(self, station: float, offset: float, direction: int) -> None:
        """A post with one to three signs, and sometimes one on its back."""
        rng, config = self.rng, self.config
        base = self.road.surface(np.array(station), np.array(offset))
        travel = direction * self.road.tangent_frame(np.array(station), np.array(offset))[:, 0]
        count = 1
        if rng.random() < config.shared_share:
            count = 2 + int(rng.random() < 0.3)
        side_by_side = count == 2 and rng.random() < 0.25
        low = rng.uniform(2.0, 2.6)
        for k in range(count):
            shape, code, size = _pick(rng, shared=count > 1)
            rise = low if side_by_side else low + config.stack_m * k
            aside = (k - 0.5) * config.stack_m if side_by_side else 0.0
            self.hang(shape, code, base, travel, rise, aside, size)
        if rng.random() < config.back_to_back_share:
            shape, code, size = _pick(rng, shared=count > 1)
            self.hang(shape, code, base - 0.05 * travel, -travel, low, 0.0, size)
        self.posts += 1

    def gantry(self, station: float, lane_centres: tuple[float, ...], direction: int) -> None:
        """Wide panels side by side, or signals 2 m apart, above the road."""
        rng = self.rng
        middle = float(np.mean(lane_centres))
        base = self.road.surface(np.array(station), np.array(middle))
        travel = direction * self.road.tangent_frame(np.array(station), np.array(middle))[:, 0]
        if rng.random() < 0.5:
            widths = rng.uniform(2.0, 4.0, rng.integers(2, 4))
            gap = 0.4
            left = np.cumsum(widths + gap) - widths - gap
            places = left + widths / 2 - (widths.sum() + gap * (len(widths) - 1)) / 2
            for place, width in zip(places, widths, strict=True):
                height = rng.uniform(1.6, 2.6)
                code = str(rng.choice(PANEL_CODES))
                rise = 5.6 + height / 2
                size = (float(width), height)
                self.hang("rectangle", code, base, travel, rise, float(place), size, wear=0.2)
        else:
            count = int(rng.integers(3, 6))
            for k in range(count):
                aside = 2.0 * (k - (count - 1) / 2)
                self.hang("rectangle", "US:R3-7", base, travel, 6.2, aside, (1.2, 1.2), wear=0.2)
        self.posts += 1

    def wide_board(self, station: float, lane_centres: tuple[float, ...], direction: int) -> None:
        """One board above all lanes."""
        rng = self.rng
        middle = np.array(float(np.mean(lane_centres)))
        base = self.road.surface(np.array(station), middle)
        travel = direction * self.road.tangent_frame(np.array(station), middle)[:, 0]
        size = (float(rng.uniform(*self.config.wide_board_m)), float(rng.uniform(2.5, 4.0)))
        rise = 5.6 + size[1] / 2
        code = str(rng.choice(PANEL_CODES))
        self.hang("rectangle", code, base, travel, rise, 0.0, size, wear=0.2)
        self.posts += 1

    def signs(self) -> WorldSigns:
        """All that were put up so far."""
        rows = self.rows
        return WorldSigns(
            sign_id=tuple(f"sign-{k:03d}" for k in range(len(rows))),
            shape=np.array([row[0] for row in rows], dtype=np.int64),
            code=tuple(row[1] for row in rows),
            post=np.array([row[2] for row in rows], dtype=np.int64),
            center=np.array([row[3] for row in rows]).reshape(-1, 3),
            R_world_sign=np.array([row[4] for row in rows]).reshape(-1, 3, 3),
            size=np.array([row[5] for row in rows]).reshape(-1, 2),
        )


def put_up_signs(
    road: Road,
    config: SignConfig,
    rng: np.random.Generator,
    *,
    stations: tuple[float, float],
    edges: tuple[float, float],
    lane_centres: dict[int, tuple[float, ...]],
) -> WorldSigns:
    """The signs between two stations; `edges` are the offsets of the road's right and left side."""
    builder = _Builder(road, config, rng)
    first, last = stations
    right_edge, left_edge = edges
    for direction in (1, -1):
        share = 1.0 if direction == 1 else config.opposite_share
        count = round(share * config.posts_per_km * (last - first) / 1000)
        spacing = (last - first) / max(count, 1)
        for k in range(count):
            station = first + spacing * (k + rng.uniform(0.15, 0.85))
            beside = rng.uniform(*config.beside_m)
            on_right = (rng.random() >= config.left_share) == (direction == 1)
            offset = right_edge - beside if on_right else left_edge + beside
            builder.post(station, offset, direction)
        if direction in lane_centres:
            for per_km, put_up in (
                (config.gantries_per_km, builder.gantry),
                (config.wide_boards_per_km, builder.wide_board),
            ):
                count = round(per_km * (last - first) / 1000)
                spacing = (last - first) / max(count, 1)
                for k in range(count):
                    station = first + spacing * (k + rng.uniform(0.3, 0.7))
                    put_up(station, lane_centres[direction], direction)
    return builder.signs()


def put_up_corner_post(
    road: Road,
    config: SignConfig,
    rng: np.random.Generator,
    *,
    place: tuple[float, float],
    direction: int,
    must_stop: bool,
) -> WorldSigns:
    """A post at a street's corner, at a station and an offset: the name of the street that crosses, and a sign to stop."""
    builder = _Builder(road, config, rng)
    station, offset = (np.array(number) for number in place)
    base = road.surface(station, offset)
    travel = direction * road.tangent_frame(station, offset)[:, 0]
    if must_stop:
        builder.hang("octagon", "US:R1-1", base, travel, 2.2, 0.0, (0.75, 0.75))
    name_m = (float(rng.uniform(0.8, 1.2)), 0.3)
    builder.hang("rectangle", NAME_CODE, base, travel, 2.9, 0.0, name_m)
    return builder.signs()


def join_signs(parts: Sequence[WorldSigns]) -> WorldSigns:
    """The signs of many roads, numbered anew."""
    posts = [0, *np.cumsum([part.post.max(initial=-1) + 1 for part in parts])]
    count = sum(len(part) for part in parts)
    return WorldSigns(
        sign_id=tuple(f"sign-{k:03d}" for k in range(count)),
        shape=np.concatenate([part.shape for part in parts]),
        code=tuple(code for part in parts for code in part.code),
        post=np.concatenate([part.post + n for part, n in zip(parts, posts, strict=False)]),
        center=np.concatenate([part.center for part in parts]),
        R_world_sign=np.concatenate([part.R_world_sign for part in parts]),
        size=np.concatenate([part.size for part in parts]),
    )


def _pick(rng: np.random.Generator, *, shared: bool) -> tuple[str, str, tuple[float, float]]:
    """Shape, code and size of a sign; those on shared posts are small enough not to touch."""
    share = np.array([*SHARES.values()])
    shape = str(rng.choice([*SHARES], p=share / share.sum()))
    code = str(rng.choice(CODES[shape]))
    scale = rng.uniform(0.55, 0.66) if shared else rng.uniform(0.6, 0.9)
    if shape == "rectangle":
        aspect = rng.choice([0.8, 1.0, 1.25, 1.5])
        width, height = scale / max(aspect, 1.0), scale / max(aspect, 1.0) * aspect
        if shared:
            width, height = scale, scale * min(aspect, 1.0)
        return shape, code, (float(width), float(height))
    if shape in ("triangle", "inverted_triangle"):
        return shape, code, (scale, scale * 0.866)
    return shape, code, (scale, scale)


def _turn_about(axis: int, angle: float) -> Float[np.ndarray, "3 3"]:
    """Rotation about one of the axes."""
    c, s = np.cos(angle), np.sin(angle)
    R = np.eye(3)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    R[i, i], R[i, j], R[j, i], R[j, j] = c, -s, s, c
    return R
