from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.formats.composing import headings
from crowdmap_torch.io.formats.composing.parts import Asked
from crowdmap_torch.io.formats.geodesy import ecef_from_geodetic
from crowdmap_torch.tables import Origin


def test_angles_turn_as_they_are_named():
    angle = np.radians([[90.0, 0, 0], [0, 10, 0], [0, 0, 10]])
    R = headings.rotation(*angle.T)
    # Heading 90 degrees is east; at heading 0 left is west.
    np.testing.assert_allclose(R[0] @ (1, 0, 0), (1, 0, 0), atol=1e-12)
    np.testing.assert_allclose(R[0] @ (0, 1, 0), (0, 1, 0), atol=1e-12)
    assert (R[1] @ (1, 0, 0))[2] == pytest.approx(np.sin(np.radians(10)))  # nose up
    assert (R[2] @ (0, 1, 0))[2] == pytest.approx(np.sin(np.radians(10)))  # right side down
    np.testing.assert_allclose(R @ R.mT, np.tile(np.eye(3), (3, 1, 1)), atol=1e-12)


def test_the_course_is_the_direction_of_travel_also_while_standing():
    angle = np.linspace(0, np.pi / 2, 60)
    # A quarter of a circle, from east to north, then a stop.
    arc = 20 * np.stack((np.sin(angle), 1 - np.cos(angle), 0 * angle), axis=-1)
    position = np.concatenate((arc, np.repeat(arc[-1:], 5, axis=0)))
    expected = np.pi / 2 - np.concatenate((angle, np.full(5, angle[-1])))
    # Over two metres of this circle a chord turns by 0.1 rad; at its ends half of it is missing.
    assert np.abs(headings.course(position) - expected).max() < 0.05
    with pytest.raises(ValueError, match=r"moves 0\.0 m; expected 2 m at least"):
        headings.course(arc[:1].repeat(3, axis=0))


def test_fixes_are_in_the_frame_of_the_origin_that_is_asked_for():
    place = np.array([[48.0, 11.0, 500.0], [48.0001, 11.0, 500.0]])
    t_ns = np.array([0, 10**9])
    north = np.zeros(2)
    track, origin, notes = headings.fixes(Path("a"), t_ns, place, Asked(), heading=north)
    assert origin == Origin(48.0, 11.0, 500.0)
    np.testing.assert_allclose(track.T_world_link[0, :3, 3], 0, atol=1e-8)
    # A ten-thousandth of a degree is 11.12 m on the meridian here.
    assert track.T_world_link[1, 1, 3] == pytest.approx(11.12, abs=0.01)
    assert notes == (headings.LEVEL_NOTE,)
    other = Asked(origin=Origin(48.0001, 11.0, 500.0))
    moved, origin, _ = headings.fixes(Path("a"), t_ns, place, other, heading=north)
    assert origin == other.origin
    np.testing.assert_allclose(moved.T_world_link[1, :3, 3], 0, atol=1e-8)


def test_headings_that_nobody_has_are_asked_for():
    place = np.array([[48.0, 11.0, 500.0]])
    with pytest.raises(InputError, match=r"a: has no headings; .* --heading course"):
        headings.fixes(Path("a"), np.zeros(1, dtype=np.int64), place, Asked(), heading=None)
    with pytest.raises(InputError, match="a: no heading from the way"):
        asked = Asked(heading=headings.COURSE)
        headings.fixes(Path("a"), np.zeros(1, dtype=np.int64), place, asked, heading=None)


def test_earth_centred_poses_turn_with_the_earth():
    origin = Origin(0.0, 90.0, 0.0)
    T = np.eye(4)[None].copy()
    T[0, :3, 3] = ecef_from_geodetic(np.array([0.0, 90.0, 7.0]))
    track = headings.earth_centred(Path("a"), np.zeros(1, dtype=np.int64), T, origin, "mount")
    np.testing.assert_allclose(track.T_world_link[0, :3, 3], (0, 0, 7), atol=1e-8)
    # There the earth's x points west, its y up, its z north.
    np.testing.assert_allclose(track.T_world_link[0, :3, 0], (-1, 0, 0), atol=1e-12)
    np.testing.assert_allclose(track.T_world_link[0, :3, 1], (0, 0, 1), atol=1e-12)
