"""Sign detections to tracklets: what belongs together, whatever the car does, and frame by frame as in the batch."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from worlds.drives import shuffled
from worlds.partitions import same_partition
from worlds.sign_drive import (
    F64,
    drive_past,
    moved_corners,
    signs_at,
    straight_poses,
    taken_for,
    tracklets_per_sign,
    with_rows,
    with_signs,
)

from crowdmap_torch.geometry import polygon, se3
from crowdmap_torch.noise.positioning import PositioningNoise
from crowdmap_torch.tracking.sign_features import SignAssociationConfig
from crowdmap_torch.tracking.signs import SignAssociator, associate_signs

NOISE, CONFIG = PositioningNoise(), SignAssociationConfig()
SHAPES = list(range(len(polygon.SHAPES)))
ALONG_THE_ROAD = [(3.5 * (-1) ** i, 30.0 + 6.0 * i, 2.0 + 0.3 * i) for i in SHAPES]
ON_ONE_POST = [(4.0, 60.0, 2.0), (4.0, 60.0, 2.7), (4.1, 60.0, 3.4)]


def noisy_poses(poses: torch.Tensor, seed: int = 1) -> torch.Tensor:
    """White noise of positioning: 1.5 cm and 0.02 degrees."""
    generator = torch.Generator().manual_seed(seed)
    xi = torch.randn(len(poses), 6, dtype=F64, generator=generator)
    return se3.retract(poses, xi * torch.tensor([0.015] * 3 + [3.5e-4] * 3, dtype=F64))


def assert_one_tracklet_each(label: torch.Tensor, sign: torch.Tensor) -> None:
    found = tracklets_per_sign(label, sign)
    assert all(len(labels) == 1 for labels in found), found
    assert len(set.union(*found)) == len(found), found


@pytest.mark.parametrize("centers", [ALONG_THE_ROAD, ON_ONE_POST])
@pytest.mark.parametrize("method", ["predicted", "paper2017"])
def test_every_sign_is_one_tracklet(centers, method):
    poses = straight_poses(60)
    shape = [SHAPES[i % 6] for i in range(len(centers))]
    drive = drive_past(poses, signs_at(centers), shape=shape, noise_px=0.5)
    journey = replace(drive.journey, T_world_camera=noisy_poses(poses))
    tracklets = associate_signs(journey, NOISE, replace(CONFIG, method=method))
    assert_one_tracklet_each(tracklets.label, drive.sign)
    assert tracklets.count == len(centers)


def test_the_papers_cost_does_not_know_how_far_a_sign_moves():
    """The next sign along the road comes into sight when one is passed: on its epipolar line, and taken for it."""
    centers = [(3.0, 45.0, 2.0), (3.0, 57.0, 2.0)]
    drive = drive_past(straight_poses(60), signs_at(centers), noise_px=0.5, depth_m=(20.0, 80.0))
    frame = drive.journey.signs.frame
    is_late = frame > frame[drive.sign == 0].max()
    drive = with_rows(drive, ((drive.sign == 0) | is_late).nonzero()[:, 0])
    config = replace(CONFIG, method="paper2017")
    assert associate_signs(drive.journey, NOISE, config).count == 1
    predicted = associate_signs(drive.journey, NOISE, CONFIG)
    assert_one_tracklet_each(predicted.label, drive.sign)


def test_the_papers_cost_is_gated_by_shape(generator):
    poses = straight_poses(60)
    drive = drive_past(poses, signs_at(ALONG_THE_ROAD), noise_px=0.5)
    wrong = torch.rand(len(drive.sign), generator=generator) < 0.1
    shape = torch.where(wrong, polygon.SHAPES.index("diamond"), drive.journey.signs.shape)
    journey = replace(drive.journey, signs=replace(drive.journey.signs, shape=shape))
    label = associate_signs(journey, NOISE, replace(CONFIG, method="paper2017")).label
    for tracklet in label.unique():
        assert len(shape[label == tracklet].unique()) == 1


def test_signs_of_one_shape_on_one_post_stay_apart():
    poses = straight_poses(60)
    drive = drive_past(poses, signs_at(ON_ONE_POST), noise_px=0.5)
    journey = replace(drive.journey, T_world_camera=noisy_poses(poses))
    assert_one_tracklet_each(associate_signs(journey, NOISE, CONFIG).label, drive.sign)


@pytest.mark.parametrize("seed", range(2))
def test_noise_is_learnt_from_what_is_seen(seed: int):
    """With what is usual 5 px broke twenty signs into more than a hundred tracklets."""
    places = [(3.5 * (-1) ** i, 45.0 + 12.0 * i, 2.5) for i in range(20)]
    drive = drive_past(straight_poses(280), signs_at(places), noise_px=5.0, seed=seed)
    label = associate_signs(drive.journey, NOISE, CONFIG).label
    long = torch.bincount(label)[label] >= 20
    assert int(label.max()) < 40 and float(long.double().mean()) > 0.95
    # Signs that are far away are a few pixels apart.
    together = torch.bincount(20 * label + drive.sign, minlength=20 * (int(label.max()) + 1))
    assert int(together.view(-1, 20).amax(1).sum()) > 0.97 * len(label)


def winding_poses(frames: int) -> tuple[torch.Tensor, torch.Tensor]:
    """A level drive that turns by 29 degrees to either side within 186 m, and its headings [rad]."""
    way = 0.8 * torch.arange(frames, dtype=F64)
    heading = 0.5 * torch.sin(2 * torch.pi * way / 186.0)
    turn = torch.zeros(frames, 6, dtype=F64)
    turn[:, 5] = heading
    poses = straight_poses(frames)
    poses[:, :3, :3] = se3.exp(turn)[:, :3, :3] @ poses[:, :3, :3]
    step = 0.8 * torch.stack((-heading.sin(), heading.cos()), dim=1)
    poses[:, :2, 3] = step.cumsum(0) - step[:1]
    return poses, heading


@pytest.mark.parametrize("seed", range(3))
def test_what_goes_along_with_the_car_teaches_no_noise(seed: int):
    """The plate of a car ahead in bends, where it is in every image: noise of a hundred times the variance was learnt."""
    poses, heading = winding_poses(300)
    at = torch.arange(40, 280, 50)
    beside = 4.0 * torch.stack((heading[at].cos(), heading[at].sin()), dim=1)
    places = torch.nn.functional.pad(poses[at, :2, 3] + beside, (0, 1), value=2.5)
    facing = torch.rad2deg(heading[at]).tolist()
    drive = drive_past(poses, signs_at(places, yaw_deg=facing), noise_px=0.8, seed=seed)
    seen, plates = len(drive.sign), torch.zeros(300, dtype=torch.long)
    drive = with_rows(drive, torch.cat((torch.arange(seen), plates)))
    frame, px = drive.journey.signs.frame.clone(), drive.journey.signs.corners_px.clone()
    outline = torch.tensor([[270.0, 97], [330, 97], [330, 143], [270, 143]], dtype=F64)
    generator = torch.Generator().manual_seed(seed)
    px[seen:, :4] = outline + 0.8 * torch.randn(300, 4, 2, generator=generator, dtype=F64)
    px[seen:, 4:] = px[seen:, 3:4]
    frame[seen:] = torch.arange(300)
    drive = with_signs(drive, frame=frame, corners_px=px)
    drive = moved_corners(drive, torch.arange(len(frame)), (0.0, 0.0))
    signs, associator, noise = drive.journey.signs, SignAssociator(NOISE, CONFIG), []
    label = torch.full_like(drive.sign, -1)
    for number, pose in enumerate(noisy_poses(poses)):
        now = (signs.frame == number).nonzero()[:, 0]
        label[now], _ = associator.step(number, pose, signs[now])
        noise.append(associator.state_dict()["log_noise"])
    assert max(noise) < 0.5
    assert_one_tracklet_each(label[:seen], drive.sign[:seen])


@pytest.mark.parametrize("seeds", [(0, 1, 2), (3, 4, 5)])
def test_tracklets_stay_whole_where_positions_tremble(seeds: tuple[int, ...]):
    """Five frames a second on a motorway, of which a third is missed; as configured, positions are good to 2 cm."""
    poses = straight_poses(400, step_m=6.0)
    drive = drive_past(poses, signs_at([(3.5, 60.0 * i, 2.0) for i in range(1, 40)]), noise_px=1.0)
    broken, broken_as_configured = 0, 0
    for seed in seeds:
        g = torch.Generator().manual_seed(seed)
        noisy = poses.clone()
        noisy[:, :3, 3] += 0.15 * torch.randn(400, 3, generator=g, dtype=F64)
        rows = (torch.rand(len(drive.sign), generator=g) > 0.3).nonzero()[:, 0]
        signs, true = drive.journey.signs[rows], drive.sign[rows]
        journey = replace(drive.journey, T_world_camera=noisy, signs=signs)
        label = associate_signs(journey, NOISE, CONFIG).label
        associator, as_configured = SignAssociator(NOISE, CONFIG), torch.full_like(label, -1)
        for frame, pose in enumerate(noisy):
            now = (signs.frame == frame).nonzero()[:, 0]
            as_configured[now], _ = associator.step(frame, pose, signs[now])
        # The first come before the noise is known.
        late = signs.frame >= 40
        count = len(true[late].unique())
        broken += len((40 * label + true)[late].unique()) - count
        broken_as_configured += len((40 * as_configured + true)[late].unique()) - count
    assert broken_as_configured >= 30
    assert 2 * broken <= broken_as_configured


@pytest.mark.parametrize("noise_px", [0.6, 4.0])
def test_stepping_gives_exactly_the_batch(noise_px: float):
    drive = drive_past(
        straight_poses(50), signs_at(ALONG_THE_ROAD), shape=SHAPES, noise_px=noise_px
    )
    batch = associate_signs(drive.journey, NOISE, CONFIG)
    associator = SignAssociator(NOISE, CONFIG)
    for frame in range(drive.journey.frame_count):
        rows = (drive.journey.signs.frame == frame).nonzero()[:, 0]
        label, shift = associator.step(
            frame, drive.journey.T_world_camera[frame], drive.journey.signs[rows]
        )
        assert torch.equal(label, batch.label[rows])
        assert batch.shift is not None
        assert torch.equal(shift, batch.shift[rows])
    assert associator.count == batch.count


def test_chunks_change_nothing():
    drive = drive_past(straight_poses(30), signs_at(ALONG_THE_ROAD), noise_px=0.6)
    whole = associate_signs(drive.journey, NOISE, CONFIG)
    pieces = associate_signs(drive.journey, NOISE, replace(CONFIG, chunk_pairs=7))
    assert torch.equal(whole.label, pieces.label)


@pytest.mark.parametrize("noise_px", [0.6, 4.0])
def test_an_interrupted_drive_goes_on(noise_px: float):
    drive = drive_past(straight_poses(30), signs_at(ALONG_THE_ROAD), noise_px=noise_px)
    signs, poses = drive.journey.signs, drive.journey.T_world_camera
    whole, resumed = SignAssociator(NOISE, CONFIG), SignAssociator(NOISE, CONFIG)
    for frame in range(30):
        now = signs[signs.frame == frame]
        label, _ = whole.step(frame, poses[frame], now)
        if frame == 14:
            resumed.load_state_dict(whole.state_dict())
        if frame > 14:
            assert torch.equal(resumed.step(frame, poses[frame], now)[0], label)


def test_memory_is_bounded_by_what_is_in_sight():
    centers = [(3.5, 40.0 * i, 2.0) for i in range(1, 12)]
    drive = drive_past(straight_poses(500), signs_at(centers), noise_px=0.3)
    associator = SignAssociator(NOISE, CONFIG)
    most = 0
    for frame in range(500):
        now = drive.journey.signs[drive.journey.signs.frame == frame]
        associator.step(frame, drive.journey.T_world_camera[frame], now)
        state = associator.state_dict()
        most = max(most, len(state["active"]), len(state["recent"]))
    assert associator.count == len(centers)
    # At most three signs are in sight or were within the window.
    assert most <= 3


def test_row_order_does_not_matter(generator):
    drive = drive_past(straight_poses(40), signs_at(ALONG_THE_ROAD), noise_px=0.6)
    label = associate_signs(drive.journey, NOISE, CONFIG).label
    other = shuffled(drive.journey, generator)
    again = associate_signs(other, NOISE, CONFIG).label
    back = torch.empty_like(again)
    back[other.signs.row] = again
    assert same_partition(label, back)


@pytest.mark.parametrize("turning", [0.0, 0.01])
def test_a_standing_car_loses_no_tracklet(turning):
    """Standing, and turning on the spot: no baseline, so epipolar lines say nothing."""
    poses = straight_poses(60)
    halt = poses[20].expand(100, 4, 4)
    yaw = turning * torch.arange(100, dtype=F64).clamp_max(20)
    turn = torch.zeros(100, 6, dtype=F64)
    turn[:, 4] = yaw
    after = se3.retract(poses[20:], turn[-1:].expand(40, 6))
    poses = torch.cat((poses[:20], se3.retract(halt, turn), after))
    drive = drive_past(poses, signs_at(ON_ONE_POST + ALONG_THE_ROAD[:3]), noise_px=0.5)
    journey = replace(drive.journey, T_world_camera=noisy_poses(poses))
    assert_one_tracklet_each(associate_signs(journey, NOISE, CONFIG).label, drive.sign)


def test_two_seconds_without_frames_do_not_split_a_sign():
    kept = torch.cat((torch.arange(25), torch.arange(55, 75)))
    poses = straight_poses(75)[kept]
    drive = drive_past(poses, signs_at([(4.0, 78.0, 2.5), (-4.0, 76.0, 2.0)]), noise_px=0.4)
    assert_one_tracklet_each(associate_signs(drive.journey, NOISE, CONFIG).label, drive.sign)


def test_an_occlusion_within_the_window_does_not_split_a_sign():
    drive = drive_past(straight_poses(60), signs_at(ON_ONE_POST), noise_px=0.4)
    frame = drive.journey.signs.frame
    drive = with_rows(drive, ((frame < 20) | (frame > 40)).nonzero()[:, 0])
    assert_one_tracklet_each(associate_signs(drive.journey, NOISE, CONFIG).label, drive.sign)


def test_a_silence_longer_than_the_window_ends_a_tracklet():
    drive = drive_past(straight_poses(60), signs_at([(4.0, 65.0, 2.0)]))
    frame = drive.journey.signs.frame
    drive = with_rows(drive, ((frame < 10) | (frame > 40)).nonzero()[:, 0])
    assert associate_signs(drive.journey, NOISE, replace(CONFIG, window_frames=20)).count == 2


def test_two_detections_of_a_frame_are_never_in_one_tracklet():
    drive = drive_past(straight_poses(50), signs_at([(4.0, 60.0, 2.0)]), noise_px=0.3)
    every = torch.arange(len(drive.sign))
    drive = with_rows(drive, torch.cat((every, every[::5])))
    label, frame = associate_signs(drive.journey, NOISE, CONFIG).label, drive.journey.signs.frame
    pairs = torch.stack((label, frame), dim=-1)
    assert len(pairs.unique(dim=0)) == len(pairs)
    # The tracklet goes on with one of the two; the second stays alone and takes nothing over.
    counts = label.bincount().sort(descending=True).values
    assert int(counts[0]) == len(every)


def test_a_wrong_shape_does_not_end_a_tracklet():
    drive = drive_past(straight_poses(50), signs_at([(4.0, 60.0, 2.0)]), noise_px=0.3)
    for frame, shape in ((12, polygon.TRIANGLE), (20, polygon.DIAMOND), (21, polygon.OCTAGON)):
        row = int((drive.journey.signs.frame == frame).nonzero()[0, 0])
        drive = taken_for(drive, row, shape)
    assert associate_signs(drive.journey, NOISE, CONFIG).count == 1


def test_a_gross_outlier_does_not_end_a_tracklet():
    drive = drive_past(straight_poses(50), signs_at([(4.0, 60.0, 2.0)]), noise_px=0.3)
    row = int((drive.journey.signs.frame == 20).nonzero()[0, 0])
    drive = moved_corners(drive, row, (35.0, -25.0))
    label = associate_signs(drive.journey, NOISE, CONFIG).label
    assert len(set(label[torch.arange(len(label)) != row].tolist())) == 1


def test_wrong_track_numbers_change_nothing(generator):
    drive = drive_past(straight_poses(50), signs_at(ALONG_THE_ROAD), noise_px=0.4)
    track = torch.randint(-1, 4, (len(drive.sign),), generator=generator)
    drive = with_signs(drive, track=track)
    assert_one_tracklet_each(associate_signs(drive.journey, NOISE, CONFIG).label, drive.sign)


def test_shifts_bring_corners_to_the_order_of_the_sign():
    drive = drive_past(straight_poses(40), signs_at(ALONG_THE_ROAD), shape=SHAPES, noise_px=0.3)
    signs = drive.journey.signs
    tracklets = associate_signs(drive.journey, NOISE, CONFIG)
    assert tracklets.shift is not None
    count = polygon.corner_count(signs.shape)
    ordered = polygon.roll(signs.corners_ideal, tracklets.shift, count)
    T = se3.inverse(drive.journey.T_world_camera[signs.frame])
    exact = se3.transform(T[:, None], drive.corners_world[drive.sign])
    error = (exact[..., :2] / exact[..., 2:] - ordered).norm(dim=-1)
    # A wrong corner would be off by a side of the sign, some ten pixels; the noise is 0.3 px.
    assert float(error.max()) * 1000 < 3.0


def test_no_detections_make_no_tracklets():
    drive = drive_past(straight_poses(3), signs_at([(4.0, -30.0, 2.0)]))
    tracklets = associate_signs(drive.journey, NOISE, CONFIG)
    assert tracklets.count == 0 and len(tracklets.label) == 0
    label, shift = SignAssociator(NOISE, CONFIG).step(
        0, torch.eye(4, dtype=F64), drive.journey.signs
    )
    assert len(label) == len(shift) == 0
