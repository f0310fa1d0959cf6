from __future__ import annotations

import numpy as np
import pytest
from worlds.marked_roads import bend

from crowdmap_torch.io.formats.exporters.reference_line import cubics, reference_line

RADIUS = 25.0


@pytest.fixture
def arc():
    points = bend(RADIUS, 200, 0.0)
    return reference_line(points, 3, len(points) - 4), points


def test_the_line_passes_through_the_marker(arc):
    made, points = arc
    s, t = made.beside(points[3:-3, :2])
    np.testing.assert_allclose(t, 0, atol=2e-3)
    assert s[0] == pytest.approx(0, abs=1e-6) and s[-1] == pytest.approx(made.length, abs=1e-6)


def test_s_is_the_way_along_the_line(arc):
    made, _ = arc
    s = np.linspace(0, made.length, 5001)
    step = np.linalg.norm(np.diff(made.at(s)[0], axis=0), axis=1)
    assert step.sum() == pytest.approx(made.length, abs=1e-4)
    np.testing.assert_allclose(step, s[1], rtol=2e-3)


def test_tangents_are_shared_where_cubics_meet(arc):
    made, _ = arc
    for side in (-1e-7, 1e-7):
        point, first, _ = made.at(made.s[1:-1] + side)
        np.testing.assert_allclose(point, made.start[1:-1], atol=1e-6)
        np.testing.assert_allclose(
            np.arctan2(first[:, 1], first[:, 0]), made.heading[1:-1], atol=1e-6
        )


def test_places_beside_the_line_are_found(arc):
    made, _ = arc
    generator = np.random.default_rng(3)
    s = generator.uniform(0, made.length, 50)
    t = generator.uniform(-12, 12, 50)
    foot, first, _ = made.at(s)
    normal = np.stack((-first[:, 1], first[:, 0]), axis=1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    found = made.beside(foot + t[:, None] * normal)
    np.testing.assert_allclose(found, (s, t), atol=1e-6)


def test_the_line_runs_straight_on_beyond_its_ends(arc):
    made, _ = arc
    point, first, _ = made.at(np.array([-2.0, made.length + 3.0]))
    s, t = made.beside(point)
    np.testing.assert_allclose(s, [-2, made.length + 3], atol=1e-6)
    np.testing.assert_allclose(t, 0, atol=1e-6)
    assert first.shape == (2, 2)


def test_cubics_have_the_values_and_slopes_that_they_are_given():
    s = np.array([0.0, 2.0, 5.0, 9.0])
    rows = cubics(s, np.sin(s), np.cos(s))
    assert rows[:, 0].tolist() == [0, 2, 5]
    for (s0, a, b, c, d), end in zip(rows, s[1:], strict=True):
        p = end - s0
        assert a + b * p + c * p**2 + d * p**3 == pytest.approx(np.sin(end))
        assert b + 2 * c * p + 3 * d * p**2 == pytest.approx(np.cos(end))


def test_cubics_that_only_go_on_are_left_out():
    s = np.linspace(0, 8, 5)
    assert len(cubics(s, 1 + 0.5 * s - 0.1 * s**3, 0.5 - 0.3 * s**2)) == 1
