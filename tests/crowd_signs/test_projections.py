"""Signs beside detections in the image: exact where poses are, and how far off where they are not."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor
from worlds.sign_drive import (
    F64,
    SignDrive,
    associated,
    drive_past,
    map_of,
    shift_of,
    signs_at,
    straight_poses,
    taken_for,
    with_rows,
)

from crowdmap_torch.crowd_signs.projections import (
    Candidates,
    box,
    candidates_nearby,
    candidates_of,
    misfit_px,
    projection_errors,
)
from crowdmap_torch.geometry import polygon

PLACES = [(4.0, 60.0, 3.0), (4.0, 60.0, 2.3), (-5.0, 75.0, 2.8)]


@pytest.fixture(scope="module")
def drive() -> SignDrive:
    return drive_past(straight_poses(60), signs_at(PLACES))


def own(drive: SignDrive, poses: Tensor | None = None) -> Candidates:
    """Every detection with the sign that it shows."""
    pose = drive.journey.T_world_camera if poses is None else poses
    return candidates_of(
        drive.journey, pose, map_of(drive), torch.arange(len(drive.sign)), drive.sign
    )


def shifted(drive: SignDrive) -> Tensor:
    """Poses that are 20 cm too far to the right."""
    pose = drive.journey.T_world_camera.clone()
    pose[:, 0, 3] += 0.2
    return pose


def test_detections_lie_on_the_projections_of_their_signs(drive: SignDrive):
    pairs = own(drive)
    assert len(pairs) == len(drive.sign)
    misfit, shift = misfit_px(
        drive.journey.signs, map_of(drive), pairs, torch.zeros(len(pairs), 2, dtype=F64)
    )
    # Rounding of pixels by way of the world.
    assert float(misfit.max()) < 1e-6
    assert torch.equal(shift, shift_of(drive)[pairs.row])


def test_signs_that_face_away_are_no_candidates(drive: SignDrive):
    behind = drive_past(straight_poses(60), signs_at(PLACES, yaw_deg=180.0))
    signs, rows = map_of(behind), torch.arange(len(drive.sign))
    found = candidates_of(drive.journey, drive.journey.T_world_camera, signs, rows, drive.sign)
    assert len(found) == 0


def test_candidates_nearby_are_of_detections_that_show_no_sign(drive: SignDrive):
    known = torch.arange(len(drive.sign)) % 3 > 0
    journey, signs = drive.journey, map_of(drive)
    found = candidates_nearby(
        journey, journey.T_world_camera, signs, associated(drive, known), reach_m=40.0, count=2
    )
    assert not known[found.row].any()
    camera = journey.T_world_camera[journey.signs.frame[found.row], :3, 3]
    assert float((signs.center_world[found.sign] - camera).norm(dim=1).max()) < 40.0
    assert int(torch.bincount(found.row).max()) <= 2


def test_errors_of_projections_are_those_of_detections_before_and_after(drive: SignDrive):
    pairs, pose = own(drive, shifted(drive)), shifted(drive)
    association = associated(drive, torch.ones(len(drive.sign), dtype=torch.bool))
    error = projection_errors(drive.journey, pose, map_of(drive), association, pairs, window_s=1.0)
    assert error.is_known.all() and error.is_shown.all()
    exact, _ = misfit_px(drive.journey.signs, map_of(drive), pairs, error.offset_px)
    plain, _ = misfit_px(drive.journey.signs, map_of(drive), pairs, 0 * error.offset_px)
    # 20 cm are 2.5 px at 80 m; the corners of one sign are nearly at one depth, so that one offset serves them.
    assert float(plain.min()) > 2.0 and float(exact.max()) < 0.2


def test_nothing_tells_beyond_the_window(drive: SignDrive):
    frame = drive.journey.signs.frame
    association = associated(drive, frame == 0)
    pairs = own(drive)
    error = projection_errors(
        drive.journey, drive.journey.T_world_camera, map_of(drive), association, pairs, window_s=0.5
    )
    t = drive.journey.t_ns - drive.journey.t_ns[0]
    # Signs that are in the first frame tell of those half a second after it, none of what is before it.
    first = torch.isin(pairs.sign, drive.sign[frame == 0])
    assert torch.equal(error.is_known, first & (t[frame[pairs.row]] <= 5e8))
    assert not error.offset_px[~error.is_known].any()
    assert torch.equal(error.is_shown, first & (frame[pairs.row] == 0))


def test_no_corner_tells_alone_how_a_projection_errs(drive: SignDrive):
    detections = drive.journey.signs
    association = associated(drive, torch.ones(len(drive.sign), dtype=torch.bool))
    for corner in range(4):
        px = detections.corners_px.clone()
        px[:, corner] += 50.0
        # The last corner fills the slots behind it.
        px[:, 4:] = px[:, 3:4]
        journey = replace(drive.journey, signs=replace(detections, corners_px=px))
        found = projection_errors(
            journey, journey.T_world_camera, map_of(drive), association, own(drive), window_s=1.0
        )
        assert float(found.offset_px.abs().max()) < 1e-6


@pytest.mark.parametrize("noise_px", [0.5, 2.0])
def test_what_is_usual_is_as_large_as_the_noise(noise_px: float):
    noisy = drive_past(straight_poses(200), signs_at(PLACES), noise_px=noise_px)

    def usual(known: Tensor, pose: Tensor) -> float:
        association, pairs = associated(noisy, known), own(noisy)
        found = projection_errors(
            noisy.journey, pose, map_of(noisy), association, pairs, window_s=1.0
        )
        return float(found.usual_px)

    every = torch.ones(len(noisy.sign), dtype=torch.bool)
    exact = noisy.journey.T_world_camera
    # The noise of a corner, and 0.3 of its variance for the median of four, in the plane; of four corners three are
    # within 1.38 sigmas in half of the detections.
    assert usual(every, exact) == pytest.approx(1.38 * 1.3**0.5 * noise_px, rel=0.2)
    # Poses that are off by the same all the way do not count.
    assert usual(every, shifted(noisy)) == pytest.approx(usual(every, exact), rel=0.2)
    # Nothing follows a single detection.
    assert usual(torch.arange(len(noisy.sign)) == 0, exact) == 0.0


def test_outlines_of_other_shapes_are_compared_by_their_boxes(drive: SignDrive):
    other = taken_for(drive, 0, polygon.OCTAGON)
    misfit, shift = misfit_px(
        other.journey.signs, map_of(drive), own(other), torch.zeros(len(drive.sign), 2, dtype=F64)
    )
    # Drawn into the same box.
    assert float(misfit[0]) < 1e-6 and int(shift[0]) == 0


def test_a_box_has_its_centre_and_extent():
    px = torch.tensor([[1.0, 2.0], [5.0, 2.0], [5.0, 4.0], [1.0, 4.0]]).double()
    centre, extent = box(torch.cat((px, px[-1:].expand(4, 2)))[None])
    assert centre.tolist() == [[3.0, 3.0]] and extent.tolist() == [[4.0, 2.0]]


def test_no_detections_have_no_candidates(drive: SignDrive):
    none = with_rows(drive, torch.zeros(0, dtype=torch.int64))
    pairs = own(none)
    association = associated(none, none.sign >= 0)
    error = projection_errors(
        none.journey, none.journey.T_world_camera, map_of(drive), association, pairs, window_s=1.0
    )
    assert len(pairs) == len(error.is_known) == 0
