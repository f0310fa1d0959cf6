from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from crowdmap_torch.geometry import se3
from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.formats.composing.frames import find_frames
from crowdmap_torch.io.formats.composing.parts import Track


def track_of(t_ns: list[int]) -> Track:
    """A drive along x, a metre a second, that turns a radian a second."""
    s = torch.tensor(t_ns, dtype=torch.float64) * 1e-9
    zero = torch.zeros_like(s)
    T = se3.exp(torch.stack((s, zero, zero, zero, zero, s), dim=-1)).numpy()
    sigma = np.array(t_ns) * 1e-9
    return Track(Path("drive.txt"), np.array(t_ns), T, sigma_rotation=sigma)


SECOND = 10**9
TRACK = track_of([0, SECOND, 2 * SECOND, 5 * SECOND, 6 * SECOND])


def test_the_last_number_of_a_name_counts_rows():
    frames = find_frames(
        TRACK, ["cam2/img_0007.png", "cam2/img_9.png"], key="number", first_frame=5
    )
    assert frames.of_image == {"cam2/img_0007.png": 7, "cam2/img_9.png": 9}
    assert frames.track.frame_number is not None
    assert frames.track.frame_number.tolist() == [5, 6, 7, 8, 9]


@pytest.mark.parametrize(
    ("images", "expected"),
    [
        (["7.jpg"], r"frame 7, but the poses of drive\.txt are frames 0 to 4"),
        (["a/1.jpg", "b/1.jpg"], "both are frame 1"),
        (["front.jpg"], "no number in its name"),
    ],
)
def test_numbers_that_lead_nowhere_are_refused(images: list[str], expected: str):
    with pytest.raises(InputError, match=expected):
        find_frames(TRACK, images, key="number")


@pytest.mark.parametrize(
    ("key", "names"),
    [
        ("ns", ["a_500000000.jpg", "a_1500000000.jpg"]),
        ("us", ["500000.jpg", "1500000.jpg"]),
        ("ms", ["500.jpg", "1500.jpg"]),
        ("s", ["0.500.jpg", "1.5.png"]),
    ],
)
def test_poses_are_interpolated_at_the_times_of_images(key: str, names: list[str]):
    frames = find_frames(TRACK, names[::-1], key=key)
    assert [frames.of_image[name] for name in names] == [0, 1]
    assert frames.track.t_ns.tolist() == [SECOND // 2, 3 * SECOND // 2]
    expected = track_of(frames.track.t_ns.tolist())
    np.testing.assert_allclose(frames.track.T_world_link, expected.T_world_link, atol=1e-12)
    assert frames.track.sigma_rotation == pytest.approx([0.5, 1.5])


def test_images_that_no_pose_covers_are_left_out_and_counted():
    # In the long gap and after the last pose; those at poses of the gap's borders stay.
    names = ["1000.jpg", "3000.jpg", "5000.jpg", "7000.jpg"]
    frames = find_frames(TRACK, names, key="ms")
    assert frames.of_image == {"1000.jpg": 0, "5000.jpg": 2}
    assert frames.notes[0].startswith("2 of 4 images left out")


def test_another_clock_is_named():
    with pytest.raises(InputError, match=r"100\.000 s after the first pose.*--time-offset"):
        find_frames(TRACK, ["100000.jpg"], key="ms")
    frames = find_frames(TRACK, ["100000.jpg"], key="ms", time_offset_s=-99.0)
    assert frames.track.t_ns.tolist() == [SECOND]


def test_a_file_says_the_times(tmp_path: Path):
    listed = tmp_path / "images.txt"
    listed.write_text("#timestamp [ns],filename\n1000000000,a.png\n1500000000,b.png\n")
    frames = find_frames(TRACK, ["cam0/b.png"], key=str(listed))
    # Images in which nothing was detected are frames too.
    assert frames.track.t_ns.tolist() == [SECOND, 3 * SECOND // 2]
    assert frames.of_image == {"cam0/b.png": 1}
    listed.write_text("1.0 rgb/1.0.png\n1.5 rgb/b.png\n1.25 depth/b.png\n")
    assert find_frames(TRACK, ["rgb/b.png"], key=str(listed)).of_image == {"rgb/b.png": 2}
    with pytest.raises(InputError, match=r"there as 'rgb/b\.png' and 'depth/b\.png'"):
        find_frames(TRACK, ["b.png"], key=str(listed))
    with pytest.raises(InputError, match=r"'c\.png' is not there"):
        find_frames(TRACK, ["c.png"], key=str(listed))
    listed.write_text("1.0 a.png\n2.0 a.png\n")
    with pytest.raises(InputError, match=r"line 2: image 'a\.png' is there twice"):
        find_frames(TRACK, ["a.png"], key=str(listed))


@pytest.mark.parametrize("key", [None, "number", "ns"])
def test_without_detections_rows_are_frames(key: str | None):
    frames = find_frames(TRACK, [], key=key)
    assert frames.track.frame_number is not None
    assert len(frames.track.frame_number) == len(TRACK.t_ns) and not frames.of_image
