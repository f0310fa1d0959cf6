"""Sign shapes, corner orders, and signs fitted to corners."""

from __future__ import annotations

import math

import pytest
import torch

from crowdmap_torch.geometry import polygon, se3

ALL = torch.arange(len(polygon.SHAPES))


@pytest.fixture
def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def box(shape: torch.Tensor, size: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    xy = polygon.corners(shape, size)[..., :2]
    return xy.amin(-2), xy.amax(-2)


def upright_signs(count: int, generator: torch.Generator, max_tilt_deg: float):
    """Signs of all shapes in turn, kilometres from the origin, tilted by up to an angle."""
    shape = torch.arange(count) % len(polygon.SHAPES)
    size = 0.4 + torch.rand(count, 2, generator=generator, dtype=torch.float64)
    octagon = (shape == polygon.OCTAGON)[:, None]
    size = torch.where(octagon, size.mean(-1, keepdim=True), size)
    heading = 2 * math.pi * torch.rand(count, generator=generator, dtype=torch.float64)
    zero = torch.zeros_like(heading)
    toward = torch.stack((heading.cos(), heading.sin(), zero), dim=-1)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand_as(toward)
    R = torch.stack((torch.linalg.cross(up, toward), up, toward), dim=-1)
    centre = 3000 * torch.randn(count, 3, generator=generator, dtype=torch.float64)
    tilt = 2 * torch.rand(count, 3, generator=generator, dtype=torch.float64) - 1
    w = math.radians(max_tilt_deg) / math.sqrt(3) * tilt
    T = se3.retract(se3.make(R, centre), torch.cat((torch.zeros_like(w), w), dim=-1))
    return shape, size, T, toward


def corners_world(shape, size, T):
    return se3.transform(T[:, None], polygon.corners(shape, size))


def test_origin_is_the_mean_of_the_corners():
    mask = polygon.corner_mask(ALL)[..., None]
    total = torch.where(mask, polygon.template(ALL), 0.0).sum(-2)
    torch.testing.assert_close(total, torch.zeros_like(total), atol=1e-15, rtol=0)


def test_shapes_fill_their_box():
    size = torch.tensor([[0.7, 1.1]], dtype=torch.float64).expand(len(ALL), 2)
    low, high = box(ALL, size)
    torch.testing.assert_close(high - low, size)


EXPECTED_IN_BOX = {
    # fractions of width (to the right) and height (upwards) of the box, in FORMAT.md's order
    "triangle": [(0.5, 1), (1, 0), (0, 0)],
    "inverted_triangle": [(0, 1), (1, 1), (0.5, 0)],
    "rectangle": [(0, 1), (1, 1), (1, 0), (0, 0)],
    "diamond": [(0.5, 1), (1, 0.5), (0.5, 0), (0, 0.5)],
    "pentagon": [(0.5, 1), (1, 0.5), (1, 0), (0, 0), (0, 0.5)],
    "octagon": [
        *((0.2929, 1), (0.7071, 1), (1, 0.7071), (1, 0.2929)),
        *((0.7071, 0), (0.2929, 0), (0, 0.2929), (0, 0.7071)),
    ],
}


def test_corner_counts_are_those_of_the_format():
    counts = [len(EXPECTED_IN_BOX[name]) for name in polygon.SHAPES]
    assert polygon.corner_count(ALL).tolist() == counts
    assert polygon.corner_mask(ALL).sum(-1).tolist() == counts


@pytest.mark.parametrize("name", polygon.SHAPES)
def test_corners_are_those_of_the_format(name):
    shape = torch.tensor(polygon.SHAPES.index(name))
    xy = polygon.template(shape)
    expected = torch.tensor(EXPECTED_IN_BOX[name], dtype=torch.float64)
    # the format gives four decimals
    torch.testing.assert_close(xy[: len(expected)] - xy.amin(0), expected, atol=5e-5, rtol=0)
    assert (xy[len(expected) :] == xy[len(expected) - 1]).all()


def test_octagon_of_equal_sides_is_regular():
    shape = torch.tensor(polygon.OCTAGON)
    xy = polygon.corners(shape, torch.tensor([2.0, 2.0], dtype=torch.float64))[:, :2]
    side = (xy.roll(-1, 0) - xy).norm(dim=-1)
    torch.testing.assert_close(side, side[:1].expand(8))
    torch.testing.assert_close(xy.norm(dim=-1), xy.norm(dim=-1)[:1].expand(8))


def test_templates_run_clockwise_as_the_driver_sees_them():
    mask = polygon.corner_mask(ALL)
    as_seen = polygon.template(ALL) * torch.tensor([1.0, -1.0], dtype=torch.float64)
    area = polygon.signed_area(as_seen, mask)
    assert (area > 0).all()
    expected = [0.5, 0.5, 1.0, 0.5, 0.75, 4 * (math.sqrt(0.5) - 0.5)]
    torch.testing.assert_close(area[:6], torch.tensor(expected, dtype=torch.float64))
    assert polygon.is_simple(as_seen, mask).all()


def test_signed_area_changes_sign_with_the_direction_and_not_with_the_place():
    shape = torch.tensor(polygon.PENTAGON)
    mask = polygon.corner_mask(shape)
    xy = polygon.template(shape) + 1e6
    back = polygon.pad(xy[:5].flip(0).repeat(2, 1)[:8], polygon.corner_count(shape))
    torch.testing.assert_close(
        polygon.signed_area(back, mask), -polygon.signed_area(xy, mask), atol=1e-8, rtol=0
    )


def quad(*points: tuple[float, float]) -> torch.Tensor:
    return torch.tensor([*points, *[points[-1]] * (8 - len(points))], dtype=torch.float64)


NOT_SIMPLE = {
    "bow tie": quad((0, 0), (2, 2), (2, 0), (0, 2)),
    "corner on a far side": quad((0, 0), (4, 0), (2, 0), (0, 2)),
    "corner twice": quad((0, 0), (2, 0), (2, 0), (0, 2)),
    "first is last": quad((0, 0), (2, 0), (2, 2), (0, 0)),
    "all on one line": quad((0, 0), (1, 0), (2, 0), (3, 0)),
    "pentagram": quad(
        *((math.sin(4 * math.pi * k / 5), math.cos(4 * math.pi * k / 5)) for k in range(5))
    ),
}


@pytest.mark.parametrize("name", NOT_SIMPLE)
def test_outlines_that_meet_themselves_are_not_simple(name):
    corners = NOT_SIMPLE[name]
    mask = torch.arange(8) < (5 if name == "pentagram" else 4)
    for scale in (1.0, 1e-100, 1e6):
        assert not polygon.is_simple(corners * scale, mask)


def test_outlines_that_do_not_meet_themselves_are_simple(generator):
    # Star-shaped about the origin: no two sides can cross, convex or not.
    turn = torch.arange(8, dtype=torch.float64) * (2 * math.pi / 8)
    radius = 0.1 + torch.rand(500, 8, generator=generator, dtype=torch.float64)
    corners = radius[..., None] * torch.stack((turn.cos(), turn.sin()), dim=-1)
    assert polygon.is_simple(corners, torch.ones(500, 8, dtype=torch.bool)).all()


def test_roll_undoes_roll_and_keeps_the_padding(generator):
    shape = torch.arange(60) % 6
    count = polygon.corner_count(shape)
    corners = polygon.pad(torch.randn(60, 8, 2, generator=generator, dtype=torch.float64), count)
    shift = torch.randint(0, 8, (60,), generator=generator) % count
    rolled = polygon.roll(corners, shift, count)
    assert torch.equal(polygon.roll(rolled, -shift, count), corners)
    assert torch.equal(polygon.pad(rolled, count), rolled)


def test_best_shift_finds_the_cyclic_order(generator):
    shape = torch.arange(120) % 6
    count = polygon.corner_count(shape)
    a = polygon.pad(torch.randn(120, 8, 2, generator=generator, dtype=torch.float64), count)
    shift = torch.randint(0, 8, (120,), generator=generator) % count
    b = polygon.roll(a, -shift, count)
    found, cost = polygon.best_shift(a, b, count)
    assert torch.equal(found, shift)
    assert cost.max() == 0
    assert torch.equal(polygon.roll(b, found, count), a)


def test_best_shift_costs_the_least_of_all_shifts(generator):
    a, b = torch.randn(2, 8, 3, generator=generator, dtype=torch.float64)
    for count in (3, 4, 5, 8):
        by_hand = [
            sum((a[k] - b[(k + s) % count]).square().sum().item() for k in range(count))
            for s in range(count)
        ]
        shift, cost = polygon.best_shift(a, b, torch.tensor(count))
        assert shift.item() == min(range(count), key=by_hand.__getitem__)
        assert cost.item() == pytest.approx(min(by_hand))


@pytest.mark.parametrize("max_tilt_deg", [0.0, 10.0, 30.0])
def test_fit_sign_recovers_signs_from_corners_in_any_order(generator, max_tilt_deg):
    shape, size, T, toward = upright_signs(600, generator, max_tilt_deg)
    count = polygon.corner_count(shape)
    start = torch.randint(0, 8, (600,), generator=generator) % count
    world = corners_world(shape, size, T)
    T_fit, size_fit, shift = polygon.fit_sign(polygon.roll(world, start, count), shape, toward)
    assert torch.equal((shift + start) % count, torch.zeros_like(shift))
    # 1e-16 of kilometres, over half a metre of sign
    torch.testing.assert_close(size_fit, size, atol=1e-10, rtol=0)
    torch.testing.assert_close(T_fit, T, atol=1e-10, rtol=0)


def test_fit_sign_of_noisy_corners_is_near_and_is_not_upside_down(generator):
    shape, size, T, toward = upright_signs(600, generator, 8.0)
    count = polygon.corner_count(shape)
    start = torch.randint(0, 8, (600,), generator=generator) % count
    sigma = 0.02
    world = corners_world(shape, size, T)
    noise = sigma * torch.randn(world.shape, generator=generator, dtype=torch.float64)
    given = polygon.roll(polygon.pad(world + noise, count), start, count)
    T_fit, size_fit, _ = polygon.fit_sign(given, shape, toward)
    # In the plane no corner can be worse than some sigma; out of it the plane of a flat triangle
    # tilts by sigma over its height (5 sigma over 0.4 m: 14 degrees).
    found = corners_world(shape, size_fit, T_fit)
    assert ((found - world).norm(dim=-1) < 8 * sigma).all()
    R_error = se3.so3_log(T_fit[:, :3, :3].mT @ T[:, :3, :3]).norm(dim=-1)
    assert R_error.max() < math.radians(40)


def test_fit_sign_faces_the_viewer(generator):
    shape, size, T, toward = upright_signs(60, generator, 5.0)
    T_fit, *_ = polygon.fit_sign(corners_world(shape, size, T), shape, toward)
    assert ((T_fit[:, :3, 2] * toward).sum(-1) > 0).all()


def test_fit_sign_is_a_rotation_even_for_signs_that_lie_flat():
    shape = torch.tensor([polygon.RECTANGLE, polygon.RECTANGLE])
    size = torch.tensor([[0.6, 0.9], [0.6, 0.6]], dtype=torch.float64)
    T = torch.eye(4, dtype=torch.float64).expand(2, 4, 4)
    toward = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64).expand(2, 3)
    T_fit, size_fit, shift = polygon.fit_sign(corners_world(shape, size, T), shape, toward)
    # flat on the ground, its top is what points north
    torch.testing.assert_close(T_fit, T)
    torch.testing.assert_close(size_fit, size)
    assert shift.tolist() == [0, 0]


def test_fit_template_minimises_the_misfit_among_its_neighbours(generator):
    shape = torch.arange(60) % 6
    count = polygon.corner_count(shape)
    mask = polygon.corner_mask(shape)[..., None]
    corners = polygon.template(shape) + 0.05 * torch.randn(
        60, 8, 2, generator=generator, dtype=torch.float64
    )
    mean = torch.where(mask, corners, 0.0).sum(1, keepdim=True) / count[:, None, None]
    corners = polygon.pad(corners - mean, count)
    fit = polygon.fit_template(corners, shape)

    def misfit(parameters: torch.Tensor) -> torch.Tensor:
        angle, size = parameters[:, 0], parameters[:, 1:]
        R = torch.stack(
            (
                torch.stack((angle.cos(), -angle.sin()), -1),
                torch.stack((angle.sin(), angle.cos()), -1),
            ),
            -2,
        )
        fitted = polygon.corners(shape, size)[..., :2] @ R.mT
        error = torch.where(mask, fitted - polygon.roll(corners, fit.shift, count), 0.0)
        return error.square().sum((1, 2))

    best = torch.cat((fit.angle[:, None], fit.size), dim=-1)
    gradient = torch.func.grad(lambda x: misfit(x).sum())(best)
    assert gradient.abs().max() < 1e-12
    torch.testing.assert_close((misfit(best) / count).sqrt(), fit.rms)


def turned(T: torch.Tensor, eighths: torch.Tensor) -> torch.Tensor:
    zero = torch.zeros(len(T), 5, dtype=T.dtype)
    return se3.retract(T, torch.cat((zero, eighths.to(T)[:, None] * (math.pi / 4)), dim=-1))


def test_canonical_undoes_every_turn_that_the_shape_allows(generator):
    shape, size, T, _ = upright_signs(600, generator, 15.0)
    # shapes with one up axis are given as they are, the others turned by quarters, octagons by
    # eighths
    step = torch.zeros(len(ALL), dtype=torch.long)
    step[[polygon.RECTANGLE, polygon.DIAMOND, polygon.OCTAGON]] = torch.tensor([2, 2, 1])
    step = step[shape]
    eighths = step * torch.randint(0, 8, (600,), generator=generator)
    swap = (eighths % 4 == 2)[:, None]
    given = turned(T, eighths), torch.where(swap, size.flip(-1), size)
    T_found, size_found = polygon.canonical(*given, shape)
    torch.testing.assert_close(T_found, T, atol=1e-9, rtol=0)
    torch.testing.assert_close(size_found, size)


def test_canonical_keeps_the_corners_and_tells_their_order(generator):
    shape, size, T, _ = upright_signs(600, generator, 300.0)
    count = polygon.corner_count(shape)
    T_found, size_found, shift = polygon.canonical_with_shift(T, size, shape)
    before = corners_world(shape, size, T)
    after = corners_world(shape, size_found, T_found)
    assert shift.unique().numel() > 4
    torch.testing.assert_close(after, polygon.roll(before, shift, count), atol=1e-9, rtol=0)
    assert (T_found[:, 2, 1] >= T[:, 2, 1] - 1e-9).all()


def test_canonical_of_canonical_changes_nothing(generator):
    shape, size, T, _ = upright_signs(120, generator, 100.0)
    once = polygon.canonical(T, size, shape)
    twice = polygon.canonical(*once, shape)
    torch.testing.assert_close(twice[0], once[0], atol=1e-9, rtol=0)
    assert torch.equal(twice[1], once[1])


@pytest.mark.parametrize("lying", [False, True])
def test_canonical_settles_ties_the_same_way_from_every_side(lying):
    # A square on its corner has two axes at 45 degrees; one that lies flat has none that points up
    # at all.
    shape = torch.full((4,), polygon.RECTANGLE)
    size = torch.full((4, 2), 0.6, dtype=torch.float64)
    facing_east = torch.tensor([[0.0, 0, 1], [1.0, 0, 0], [0, 1.0, 0]], dtype=torch.float64)
    R = torch.eye(3, dtype=torch.float64) if lying else facing_east
    T = se3.make(R, torch.zeros(3, dtype=torch.float64)).expand(4, 4, 4)
    for jitter in (0.0, 1e-12, -1e-12):
        T_turned = turned(T, torch.tensor([1.0, 3.0, 5.0, 7.0], dtype=torch.float64) + jitter)
        T_found, _ = polygon.canonical(T_turned, size, shape)
        torch.testing.assert_close(T_found, T_found[:1].expand(4, 4, 4), atol=1e-9, rtol=0)
        # of two top corners the left one is first: the right axis points up (north)
        assert T_found[0, 1 if lying else 2, 0] > 0.7


def test_octagons_that_are_not_regular_turn_by_quarters_only():
    shape = torch.tensor([polygon.OCTAGON])
    size = torch.tensor([[0.6, 0.7]], dtype=torch.float64)
    R = torch.tensor([[0.0, 0, 1], [1.0, 0, 0], [0, 1.0, 0]], dtype=torch.float64)
    T = se3.make(R, torch.zeros(3, dtype=torch.float64))[None]
    eighth = turned(T, torch.tensor([0.9], dtype=torch.float64))
    T_found, size_found, shift = polygon.canonical_with_shift(eighth, size, shape)
    torch.testing.assert_close(T_found, eighth)
    torch.testing.assert_close(size_found, size)
    assert shift.item() == 0


def test_an_octagon_regular_within_measurement_gets_one_size():
    shape = torch.tensor([polygon.OCTAGON])
    size = torch.tensor([[0.75, 0.76]], dtype=torch.float64)
    R = torch.tensor([[0.0, 0, 1], [1.0, 0, 0], [0, 1.0, 0]], dtype=torch.float64)
    T = se3.make(R, torch.zeros(3, dtype=torch.float64))[None]
    T_found, size_found = polygon.canonical(turned(T, torch.tensor([3.0])), size, shape)
    torch.testing.assert_close(T_found, T, atol=1e-12, rtol=0)
    torch.testing.assert_close(size_found, torch.full((1, 2), 0.755, dtype=torch.float64))


def test_corners_work_one_by_one_under_vmap(generator):
    shape, size, *_ = upright_signs(12, generator, 0.0)
    together = polygon.corners(shape, size)
    torch.testing.assert_close(torch.func.vmap(polygon.corners)(shape, size), together)


def test_no_signs_are_no_fault():
    none = torch.zeros(0, dtype=torch.long)
    corners = torch.zeros(0, 8, 3, dtype=torch.float64)
    T, size, shift = polygon.fit_sign(corners, none, corners[:, 0])
    assert (T.shape, size.shape, shift.shape) == ((0, 4, 4), (0, 2), (0,))
    assert polygon.canonical(T, size, none)[0].shape == (0, 4, 4)
    assert polygon.best_shift(corners, corners, none)[0].shape == (0,)


def test_a_box_has_its_shape_drawn_into_it_as_float32_has_it():
    shape = torch.arange(len(polygon.SHAPES))
    # Far to the right, corners beginning anywhere.
    low = torch.tensor([1800.3, 700.7]).expand(len(shape), 2)
    drawn = polygon.in_box(low, low + torch.tensor([60.2, 20.1]), shape).double()
    count = polygon.corner_count(shape)
    slot = (torch.arange(polygon.MAX_CORNERS) + 2).expand(len(shape), -1) % count[:, None]
    turned = drawn.gather(1, slot[..., None].expand(-1, -1, 2))
    assert polygon.is_box(turned, shape).all()
    assert not polygon.is_box(turned, shape.roll(1)).any()
    for corner in range(3):
        beside = drawn.clone()
        beside[:, corner] += 0.1
        assert not polygon.is_box(beside, shape).any()
