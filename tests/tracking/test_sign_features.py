"""What association needs of sign detections, and what it costs to link two of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from worlds.sign_drive import (
    F64,
    SignDrive,
    drive_past,
    signs_at,
    straight_poses,
    taken_for,
    with_rows,
    with_signs,
)

from crowdmap_torch.geometry import polygon, se3
from crowdmap_torch.geometry.epipolar import epipolar_cost, fundamental
from crowdmap_torch.tracking.sign_features import (
    SignAssociationConfig,
    SignFeatureArrays,
    SignFeatures,
    sign_features,
    sign_pair_costs,
)

CONFIG = SignAssociationConfig()


def features_of(drive: SignDrive) -> SignFeatures:
    signs = drive.journey.signs
    return sign_features(signs, drive.journey.T_world_camera[signs.frame], CONFIG)


@pytest.fixture(scope="module")
def drive() -> SignDrive:
    shape = [polygon.RECTANGLE, polygon.TRIANGLE, polygon.OCTAGON]
    places = [(4.0, 60.0, 2.0), (4.0, 60.0, 2.7), (-4.0, 75.0, 2.5)]
    return drive_past(straight_poses(30), signs_at(places), shape=shape)


def test_features_of_a_detection_do_not_depend_on_the_others(drive: SignDrive, generator):
    order = torch.randperm(len(drive.sign), generator=generator)
    whole, part = features_of(drive)[order[:7]], features_of(with_rows(drive, order[:7]))
    for column in ("corners", "box", "sighting", "variance", "focal", "outline", "shift", "clear"):
        assert torch.equal(getattr(whole, column), getattr(part, column)), column


def test_where_an_outline_begins_changes_its_shift_alone(drive: SignDrive):
    signs = drive.journey.signs
    count = polygon.corner_count(signs.shape)
    one = torch.ones_like(count)
    turned = with_signs(
        drive,
        corners_px=polygon.roll(signs.corners_px, one, count),
        corners_ideal=polygon.roll(signs.corners_ideal, one, count),
    )
    before, after = features_of(drive), features_of(turned)
    assert torch.equal((after.shift + 1) % count, before.shift)
    assert before.clear.all() and after.clear.all()
    for column in ("box", "sighting", "variance", "focal"):
        assert torch.equal(getattr(before, column), getattr(after, column)), column


def test_outlines_are_those_of_upright_signs(drive: SignDrive):
    features = features_of(drive)
    count = polygon.corner_count(features.shape)
    outline = polygon.roll(features.outline, features.shift, count)
    low, high = outline.amin(1), outline.amax(1)
    # In units of width and height about the centre of the box.
    assert torch.allclose(low, torch.full_like(low, -0.5)) and torch.allclose(high, -low)
    # The first corner is the top-left one, or the top: v points down.
    assert bool((outline[:, 0, 1] < -0.4).all())


def test_sightings_are_the_centre_and_the_height(drive: SignDrive):
    features = features_of(drive)
    signs = drive.journey.signs
    T = se3.inverse(drive.journey.T_world_camera[signs.frame])
    in_camera = se3.transform(T[:, None], drive.corners_world[drive.sign])
    depth = in_camera[..., 2].mean(1)
    height = in_camera[..., 1].amax(1) - in_camera[..., 1].amin(1)
    # Signs that face the camera's axis have all corners at one depth.
    torch.testing.assert_close(features.sighting[:, 2].exp(), height / depth, rtol=1e-9, atol=0)
    torch.testing.assert_close(features.focal, torch.full_like(depth, 1000.0), rtol=1e-9, atol=0)


def test_larger_outlines_have_noisier_corners_yet_better_known_heights(drive: SignDrive):
    features = features_of(with_rows(drive, torch.nonzero(drive.sign == 0)[:, 0]))
    order = features.frame.argsort()
    centre, height = features.variance[order, 0], features.variance[order, 2]
    assert (centre.diff() > 0).all() and (height.diff() < 0).all()


def test_arrays_are_the_columns(drive: SignDrive):
    features = features_of(drive)
    arrays = SignFeatureArrays.of(features)
    assert np.array_equal(arrays.shift, features.shift.numpy())
    assert np.array_equal(arrays.T_world_camera, features.T_world_camera.numpy())


def test_other_shapes_are_compared_by_their_boxes(drive: SignDrive):
    frame = drive.journey.signs.frame
    rows = torch.nonzero(drive.sign == 0)[:, 0]
    rows = rows[frame[rows].argsort()]
    a, b = rows[:1], rows[5:6]
    known, taken = features_of(drive), features_of(taken_for(drive, int(b), polygon.OCTAGON))
    cost = sign_pair_costs(known[a], taken[b], CONFIG)
    # The same box. A few metres of baseline: a little of the rotation-compensated distance is blended in.
    assert float(cost) < 0.1


def test_costs_do_not_change_with_the_world(drive: SignDrive):
    features = features_of(drive)
    T = se3.retract(torch.eye(4, dtype=F64), torch.tensor([400.0, -70, 9, 0, 0, 1.1], dtype=F64))
    moved = replace(features, T_world_camera=T @ features.T_world_camera)
    a, b = torch.arange(10), torch.arange(20, 30)
    cost, again = (sign_pair_costs(f[a], f[b], CONFIG) for f in (features, moved))
    # Poses hundreds of metres from the origin, seen at a thousand pixels a unit.
    torch.testing.assert_close(cost, again, rtol=1e-6, atol=1e-6)


def test_no_detections_have_no_features_and_no_costs(drive: SignDrive):
    none = features_of(with_rows(drive, torch.zeros(0, dtype=torch.int64)))
    assert len(none) == len(sign_pair_costs(none, none, CONFIG)) == 0


def test_pair_costs_are_the_papers_epipolar_costs():
    poses = straight_poses(10)
    drive = drive_past(poses, signs_at([(4.0, 30.0, 2.0)]), noise_px=0.5)
    signs = drive.journey.signs[torch.argsort(drive.journey.signs.frame)]
    features = sign_features(signs, poses[signs.frame], CONFIG)
    a, b = torch.tensor([0, 2]), torch.tensor([6, 9])
    cost = sign_pair_costs(features[a], features[b], CONFIG)
    count = polygon.corner_count(signs.shape)
    p, q = (polygon.roll(features.corners[i], features.shift[i], count[i])[:, :4] for i in (a, b))
    F = fundamental(features.T_world_camera[a], features.T_world_camera[b])
    expected = epipolar_cost(F[:, None], p, q).mean(-1) * 1e6
    # A few metres of baseline: what is blended in of the rotation-compensated distance is small, not zero.
    torch.testing.assert_close(cost, expected, rtol=0, atol=1.0)


def test_without_a_baseline_pair_costs_are_pixel_distances():
    poses = straight_poses(1).expand(2, 4, 4)
    drive = drive_past(poses, signs_at([(4.0, 30.0, 2.0), (4.0, 30.0, 2.7)]))
    features = sign_features(drive.journey.signs, poses[drive.journey.signs.frame], CONFIG)
    first, second = ((features.frame == f).nonzero()[:, 0] for f in (0, 1))
    a, b = first.repeat_interleave(2), second.repeat(2)
    cost = sign_pair_costs(features[a], features[b], CONFIG)
    same = drive.sign[a] == drive.sign[b]
    assert float(cost[same].max()) < 1e-9
    # 0.7 m at 30 m is 23 pixels.
    assert float(cost[~same].min()) == pytest.approx((0.7 / 30.0 * 1000) ** 2, rel=1e-6)


def test_detections_of_other_shapes_have_no_printed_cost(drive: SignDrive):
    features = features_of(drive)
    other = replace(features, shape=(features.shape + 1) % len(polygon.SHAPES))
    paper = replace(CONFIG, method="paper2017")
    assert torch.isinf(sign_pair_costs(features, other, paper)).all()


def test_unknown_choices_are_refused():
    with pytest.raises(ValueError, match="expected one of"):
        SignAssociationConfig(method="nearest")
