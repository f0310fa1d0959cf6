"""A street of sign posts as many biased journeys triangulate it, with the truth: for tests of V-A and V-B."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from crowdmap_torch.crowd_signs.gather import CrowdSigns, pairs_seen_together
from crowdmap_torch.geometry import polygon, se3
from crowdmap_torch.tables import Signs

_SEEN_FROM_M, _SEEN_TO_M = 55.0, 8.0
"""A sign is seen while it is between these distances ahead."""


@dataclass(frozen=True)
class World:
    """Signs of a crowd with what nobody but a test may know."""

    crowd: CrowdSigns
    sign: Tensor
    """True sign of each triangulation; -1 for a false one."""
    center: Tensor
    """True centres of the signs."""
    post: Tensor
    """Post of each true sign."""
    bias: Tensor
    """True bias of each journey, drift left out."""
    error: Tensor
    """True pose error behind each triangulation."""


def make_world(
    seed: int,
    *,
    journeys: int,
    bias_m: float = 0.85,
    length_m: float = 1000.0,
    posts: int = 30,
    spacing_m: float = 0.7,
    drift_m: float = 0.25,
    missed: float = 0.12,
    fragments: float = 0.03,
    ghosts: float = 0.05,
    wrong_shape: float = 0.02,
    noise_m: float = 0.05,
    back_to_back: bool = False,
) -> World:
    """A straight street along east with `posts` posts of one to three signs, driven by `journeys` journeys."""
    g = torch.Generator().manual_seed(seed)

    def normal(*size: int) -> Tensor:
        return torch.randn(*size, generator=g, dtype=torch.float64)

    def uniform(*size: int) -> Tensor:
        return torch.rand(*size, generator=g, dtype=torch.float64)

    # The signs: one to three on a post, one above the other.
    along = torch.linspace(30, length_m - 30, posts, dtype=torch.float64) + 8 * uniform(posts) - 4
    side = torch.where(uniform(posts) < 0.8, -5.0, 5.0)
    number = torch.bucketize(uniform(posts), torch.tensor([0.6, 0.9])) + 1
    post = torch.repeat_interleave(torch.arange(posts), number)
    level = torch.arange(len(post)) - torch.repeat_interleave(number.cumsum(0) - number, number)
    center = torch.stack((along[post], side[post], 2.4 + spacing_m * level), dim=1)
    shape = torch.randint(0, 6, (len(post),), generator=g)
    size = torch.full((len(post), 2), 0.6, dtype=torch.float64) + 0.05 * normal(len(post), 2)
    kind = torch.randint(0, 4, (len(post),), generator=g)
    heading = 0.08 * normal(len(post))  # every driver sees the signs from the west
    faces = torch.zeros(len(post), dtype=torch.int64)
    if back_to_back:
        post, center, shape, size, kind, heading = (
            torch.cat((t, t)) for t in (post, center, shape, size, kind, heading)
        )
        faces = torch.arange(len(post)) // (len(post) // 2)
        center = center + torch.where(faces[:, None] == 1, 0.04, 0.0) * torch.eye(3)[0]

    bias = normal(journeys, 3) * bias_m * torch.tensor([1.0, 1.0, 1.41])
    drift = _drift(normal(journeys, int(length_m) + 1, 3), drift_m, 150.0)
    turn = _drift(normal(journeys, int(length_m) + 1, 1), 0.0026, 100.0)[..., 0]

    # Who sees what: a journey drives east, or west where there are signs for it.
    journey, sign = torch.cartesian_prod(torch.arange(journeys), torch.arange(len(post))).T
    direction = torch.zeros(journeys, dtype=torch.int64)
    if back_to_back:
        direction = torch.arange(journeys) % 2
    seen = (uniform(len(sign)) > missed) & (faces[sign] == direction[journey])
    journey, sign = journey[seen], sign[seen]
    again = uniform(len(sign)) < fragments
    part = torch.cat((torch.where(again, 1, 0), torch.full((int(again.sum()),), 2)))
    journey = torch.cat((journey, journey[again]))
    sign = torch.cat((sign, sign[again]))
    false = torch.randint(0, len(post), (int(ghosts * len(sign)),), generator=g)
    ghost_journey = torch.randint(0, journeys, (len(false),), generator=g)
    false = false[faces[false] == direction[ghost_journey]]
    ghost_journey = ghost_journey[: len(false)]
    is_ghost = torch.arange(len(sign) + len(false)) >= len(sign)
    journey, sign = torch.cat((journey, ghost_journey)), torch.cat((sign, false))
    part = torch.cat((part, torch.zeros_like(false)))

    n = len(sign)
    forward = torch.where(direction[journey] == 0, 1.0, -1.0).double()
    place = center[sign] + is_ghost[:, None] * 4 * normal(n, 3)
    driven = torch.where(direction[journey] == 0, center[sign, 0], length_m - center[sign, 0])
    closest = driven - _SEEN_TO_M
    at = closest.round().long().clamp(0, int(length_m))
    lateral = 15 * turn[journey, at]
    error = bias[journey] + drift[journey, at]
    error = error + lateral[:, None] * torch.tensor([0.0, 1.0, 0.0])
    sigma = noise_m * torch.tensor([4.0, 1.0, 1.0], dtype=torch.float64)
    sigma = sigma * torch.where(part > 0, 1.5, 1.0)[:, None] * (0.7 + 0.6 * uniform(n))[:, None]
    measured = place + error + sigma * normal(n, 3)

    yaw = heading[sign] + torch.where(faces[sign] == 1, torch.pi, 0.0) + 0.06 * normal(n)
    x, y, z = torch.zeros(3, n, 3, dtype=torch.float64)
    z[:, 0], z[:, 1] = -yaw.cos(), -yaw.sin()  # faces the driver, who comes from the west
    y[:, 2] = 1
    x = torch.linalg.cross(y, z)
    wrong = uniform(n) < wrong_shape
    signs = Signs(
        shape=torch.where(wrong, torch.randint(0, 6, (n,), generator=g), shape[sign]),
        type=torch.where(uniform(n) < 0.7, kind[sign], -1),
        T_world_sign=se3.make(torch.stack((x, y, z), dim=2), measured),
        size=size[sign] * (1 + 0.05 * normal(n, 2)),
        covariance=torch.diag_embed(sigma.square()),
        journey=journey,
        tracklet=torch.arange(n),
        frame=at,
        n_journeys=torch.ones(n, dtype=torch.int64),
        n_observations=torch.randint(5, 40, (n,), generator=g),
        first_seen_ns=journey * 10**12,
        last_seen_ns=journey * 10**12 + 10**9,
        confidence=torch.ones(n, dtype=torch.float64),
    )

    # Frames are a metre apart. The halves of a fragmented track share no frame.
    first = (driven - _SEEN_FROM_M + (part == 2) * 25).clamp_min(0).long()
    last = (driven - _SEEN_TO_M - (part == 1) * 25).clamp_min(0).long()
    length = (last - first).clamp_min(1)
    rows = torch.repeat_interleave(torch.arange(n), length)
    rank = torch.arange(len(rows)) - torch.repeat_interleave(length.cumsum(0) - length, length)
    frame = journey[rows] * (int(length_m) + 100) + first[rows] + rank
    step = torch.arange(0, int(length_m), 4).double()
    path = torch.stack((step, -1.5 + 0 * step, 1.4 + 0 * step), dim=1).repeat(journeys, 1, 1)
    path[direction == 1] = path[direction == 1].flip(1) * torch.tensor([1.0, -1.0, 1.0])
    ahead = torch.where(direction == 0, 1.0, -1.0).double()[:, None, None] * torch.eye(3)[0]
    east = torch.eye(3, dtype=torch.float64)[0]
    view = torch.stack((measured[:, 0] - forward * _SEEN_TO_M, error[:, 1], error[:, 2]), dim=1)
    crowd = CrowdSigns(
        signs=signs,
        station=closest,
        view_position=view + torch.tensor([0.0, -1.5, 1.4]),
        view_direction=forward[:, None] * east,
        seen_together=pairs_seen_together(
            rows, frame, rows[:, None] * torch.tensor([1.0, 0.0]), torch.ones(len(rows)), n
        ),
        leap=torch.zeros(journeys, dtype=torch.float64),
        bias_sigma=torch.tensor([bias_m, bias_m, 1.41 * bias_m]).double().repeat(journeys, 1),
        path_journey=torch.repeat_interleave(torch.arange(journeys), len(step)),
        path_position=(path + bias[:, None]).reshape(-1, 3),
        path_direction=ahead.expand(-1, len(step), -1).reshape(-1, 3).double(),
    )
    order = torch.randperm(n, generator=g)
    return _reordered(
        World(
            crowd=crowd,
            sign=torch.where(is_ghost, -1, sign),
            center=center,
            post=post,
            bias=bias,
            error=error,
        ),
        order,
    )


def pair_scores(world: World, label: Tensor) -> tuple[float, float]:
    """Precision and recall of pairs of triangulations of one true sign being in one cluster."""
    signs = int(world.sign.max()) + 1
    clusters = int(label.max()) + 2
    table = torch.zeros(clusters, signs + 1)
    table.index_put_((label + 1, world.sign + 1), torch.ones(len(label)), accumulate=True)

    def pairs(count: Tensor) -> float:
        return float((count * (count - 1) / 2).sum())

    true_pairs = pairs(table[:, 1:].sum(0))
    found_pairs = pairs(table[1:].sum(1))
    both = pairs(table[1:, 1:])
    return both / max(found_pairs, 1), both / max(true_pairs, 1)


def _drift(noise: Tensor, sigma: float, length: float) -> Tensor:
    """Ornstein-Uhlenbeck processes sampled every metre, along the second axis."""
    decay = torch.exp(torch.tensor(-1 / length, dtype=torch.float64))
    value = noise[:, 0] * sigma
    values = [value]
    for k in range(1, noise.shape[1]):
        value = decay * value + sigma * (1 - decay**2).sqrt() * noise[:, k]
        values.append(value)
    return torch.stack(values, dim=1)


def _reordered(world: World, order: Tensor) -> World:
    inverse = order.argsort()
    crowd = world.crowd
    return replace(
        world,
        sign=world.sign[order],
        error=world.error[order],
        crowd=replace(
            crowd,
            signs=crowd.signs[order],
            station=crowd.station[order],
            view_position=crowd.view_position[order],
            view_direction=crowd.view_direction[order],
            seen_together=inverse[crowd.seen_together],
        ),
    )


def shuffled(world: World, seed: int) -> tuple[World, Tensor]:
    """The same world with its rows in another order, and that order."""
    generator = torch.Generator().manual_seed(seed)
    order = torch.randperm(len(world.sign), generator=generator)
    return _reordered(world, order), order


def signs_at(place: list[tuple[float, float, float]], journey: list[int]) -> Signs:
    """Equal octagons that face west."""
    n = len(place)
    one = torch.ones(n, dtype=torch.int64)
    R = torch.tensor([[0.0, 0, -1], [-1, 0, 0], [0, 1, 0]]).double()
    return Signs(
        shape=one * polygon.OCTAGON,
        type=-one,
        T_world_sign=se3.make(R.expand(n, 3, 3), torch.tensor(place, dtype=torch.float64)),
        size=torch.full((n, 2), 0.6, dtype=torch.float64),
        covariance=0.01 * torch.eye(3).double().expand(n, 3, 3),
        journey=torch.tensor(journey),
        tracklet=torch.arange(n),
        frame=0 * one,
        n_journeys=one,
        n_observations=10 * one,
        first_seen_ns=0 * one,
        last_seen_ns=0 * one,
        confidence=one.double(),
    )


def turned_round(signs: Signs) -> Signs:
    """The same signs seen from behind: facing the other way."""
    half = torch.diag(torch.tensor([-1.0, 1, -1, 1])).double()
    return replace(signs, T_world_sign=signs.T_world_sign @ half)


def wandering_world(
    seed: int,
    *,
    wander_m: float,
    length_m: float = 2000.0,
    bias_sigma_m: float = 1.5,
    ghosts: float = 0.05,
) -> World:
    """Six drives whose bias goes from one side to the other: by twice `wander_m` from end to end."""
    world = make_world(
        seed, journeys=6, length_m=length_m, posts=round(0.03 * length_m), bias_m=0.5, ghosts=ghosts
    )
    crowd = world.crowd
    phase = torch.arange(6).double()[crowd.signs.journey]
    angle = torch.pi * (crowd.station / length_m - 0.5) + 2 * phase
    wander = wander_m * torch.stack((angle.sin(), (angle + 1).sin(), 0 * angle), dim=1)
    T = crowd.signs.T_world_sign.clone()
    T[:, :3, 3] += wander
    signs = replace(crowd.signs, T_world_sign=T)
    sigma = torch.full_like(crowd.bias_sigma, bias_sigma_m)
    crowd = replace(crowd, signs=signs, bias_sigma=sigma)
    return replace(world, crowd=crowd, error=world.error + wander)
