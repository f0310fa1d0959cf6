"""The camera mount from a URDF."""

from __future__ import annotations

import math
import re

import pytest
import pytorch_kinematics as pk
import torch

from crowdmap_torch.geometry import se3
from crowdmap_torch.geometry.rig import camera_in_link

LINKS = '<link name="base_link"/><link name="mast"/><link name="camera_optical"/><link name="imu"/>'


def joint(name: str, parent: str, child: str, origin: str = "", kind: str = "fixed") -> str:
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f"{origin}</joint>"
    )


MAST = joint("j_mast", "base_link", "mast", '<origin xyz="1.2 0 1.4" rpy="0.01 -0.02 0.03"/>')
OPTICAL = joint(
    "j_optical",
    "mast",
    "camera_optical",
    '<origin xyz="0.05 -0.3 0" rpy="-1.5707963267948966 0 -1.5707963267948966"/>',
)
IMU = joint("j_imu", "base_link", "imu", '<origin xyz="-0.4 0.1 0.2" rpy="0 0 1.0"/>')


def urdf(body: str) -> bytes:
    return f'<?xml version="1.0" encoding="utf-8"?><robot name="car">{body}</robot>'.encode()


GOOD = urdf(LINKS + MAST + OPTICAL + IMU)


def rotation_rpy(roll: float, pitch: float, yaw: float) -> torch.Tensor:
    """URDF: fixed axes, roll about x, then pitch about y, then yaw about z."""
    about = torch.diag(torch.tensor([roll, pitch, yaw], dtype=torch.float64))
    x, y, z = se3.so3_exp(about)
    return z @ y @ x


def transform(xyz: list[float], rpy: list[float]) -> torch.Tensor:
    return se3.make(rotation_rpy(*rpy), torch.tensor(xyz, dtype=torch.float64))


BASE_MAST = transform([1.2, 0, 1.4], [0.01, -0.02, 0.03])
MAST_OPTICAL = transform([0.05, -0.3, 0], [-math.pi / 2, 0, -math.pi / 2])
BASE_IMU = transform([-0.4, 0.1, 0.2], [0, 0, 1.0])


def test_chain_is_the_product_of_its_joints_in_float64():
    T = camera_in_link(GOOD, "base_link", "camera_optical")
    assert T.dtype == torch.float64
    torch.testing.assert_close(T, BASE_MAST @ MAST_OPTICAL, atol=1e-14, rtol=0)


def test_an_optical_frame_looks_forward():
    T = camera_in_link(GOOD, "mast", "camera_optical")
    # columns: the camera's right, down and forward in the vehicle's forward-left-up
    expected = torch.tensor([[0.0, 0, 1], [-1.0, 0, 0], [0.0, -1, 0]], dtype=torch.float64)
    torch.testing.assert_close(T[:3, :3], expected, atol=1e-14, rtol=0)


def test_pose_link_need_not_be_an_ancestor():
    T = camera_in_link(GOOD, "imu", "camera_optical")
    expected = se3.inverse(BASE_IMU) @ BASE_MAST @ MAST_OPTICAL
    torch.testing.assert_close(T, expected, atol=1e-14, rtol=0)
    back = camera_in_link(GOOD, "camera_optical", "imu")
    torch.testing.assert_close(back, se3.inverse(expected), atol=1e-14, rtol=0)


def test_a_link_in_itself_is_the_identity():
    T = camera_in_link(GOOD, "mast", "mast")
    torch.testing.assert_close(T, torch.eye(4, dtype=torch.float64))


def test_agrees_with_the_forward_kinematics_of_pytorch_kinematics():
    poses = pk.build_chain_from_urdf(GOOD).forward_kinematics([])
    T_root = {name: poses[name].get_matrix()[0].double() for name in ("imu", "camera_optical")}
    expected = torch.linalg.inv(T_root["imu"]) @ T_root["camera_optical"]
    # theirs is float32
    T = camera_in_link(GOOD, "imu", "camera_optical")
    torch.testing.assert_close(T, expected, atol=1e-6, rtol=0)


def test_several_fixed_joints_are_one_transform():
    numbers = torch.rand(2, 7, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    numbers = 6 * numbers - 3  # metres and radians, all digits of a double
    links, joints, ends = '<link name="base_link"/>', "", []
    for arm, origins in zip("ab", numbers.tolist(), strict=True):
        parent, T = "base_link", torch.eye(4, dtype=torch.float64)
        for k, (x, y, z, *rpy) in enumerate(origins):
            name = f"{arm}{k}"
            xyz, angles = f"{x!r} {y!r} {z!r}", " ".join(map(repr, rpy))
            links += f'<link name="{name}"/>'
            joints += joint(f"j_{name}", parent, name, f'<origin xyz="{xyz}" rpy="{angles}"/>')
            parent, T = name, T @ transform([x, y, z], rpy)
        ends.append(T)
    content = urdf(links + joints)
    T = camera_in_link(content, "base_link", "a6")
    torch.testing.assert_close(T, ends[0], atol=1e-12, rtol=0)
    T = camera_in_link(content, "a6", "b6")
    torch.testing.assert_close(T, se3.inverse(ends[0]) @ ends[1], atol=1e-12, rtol=0)


def test_a_mast_of_more_joints_than_anybody_builds_is_no_trouble():
    count = 499
    links = "".join(f'<link name="l{k}"/>' for k in range(count + 1))
    step = '<origin xyz="0.01 0 0"/>'
    joints = "".join(joint(f"j{k}", f"l{k}", f"l{k + 1}", step) for k in range(count))
    T = camera_in_link(urdf(links + joints), "l0", f"l{count}")
    expected = torch.tensor([4.99, 0, 0], dtype=torch.float64)
    torch.testing.assert_close(T[:3, 3], expected, atol=1e-12, rtol=0)
    one_more = joint("more", f"l{count}", "more", step) + '<link name="more"/>'
    with pytest.raises(ValueError, match="URDF has 501 links; expected 500 at most"):
        camera_in_link(urdf(links + joints + one_more), "l0", "l1")


def test_rotation_is_orthonormal_to_float64():
    R = camera_in_link(GOOD, "imu", "camera_optical")[:3, :3]
    torch.testing.assert_close(R @ R.T, torch.eye(3, dtype=torch.float64), atol=1e-15, rtol=0)


def test_reads_a_file(tmp_path):
    path = tmp_path / "rig.urdf"
    path.write_bytes(GOOD)
    for given in (path, str(path)):
        T = camera_in_link(given, "base_link", "camera_optical")
        assert torch.equal(T, camera_in_link(GOOD, "base_link", "camera_optical"))


def test_tags_that_are_not_urdf_are_ignored_in_silence(capfd):
    noisy = urdf('<sensor name="x"/><!-- note -->' + LINKS + MAST + OPTICAL + IMU)
    T = camera_in_link(noisy, "base_link", "camera_optical")
    assert torch.equal(T, camera_in_link(GOOD, "base_link", "camera_optical"))
    assert capfd.readouterr() == ("", "")


def test_a_moving_joint_elsewhere_does_no_harm():
    wheel = '<link name="wheel"/>' + joint("axle", "base_link", "wheel", kind="continuous")
    T = camera_in_link(urdf(LINKS + MAST + OPTICAL + IMU + wheel), "imu", "camera_optical")
    assert torch.equal(T, camera_in_link(GOOD, "imu", "camera_optical"))


@pytest.mark.parametrize("kind", ["revolute", "continuous", "prismatic", "floating", "planar"])
def test_a_moving_joint_on_the_way_is_refused(kind):
    limit = '<limit lower="-1" upper="1" effort="1" velocity="1"/>'
    moving = joint("j_mast", "base_link", "mast", limit, kind=kind)
    content = urdf(LINKS + moving + OPTICAL + IMU)
    for links in (("base_link", "camera_optical"), ("mast", "imu")):
        with pytest.raises(ValueError, match=f"'j_mast' .* is '{kind}'; expected 'fixed'"):
            camera_in_link(content, *links)
    camera_in_link(content, "mast", "camera_optical")


FAULTS = {
    "unknown link": (GOOD, "no link 'gps'; its links are: base_link, camera_optical, imu, mast"),
    "two roots": (urdf(LINKS + MAST + OPTICAL), r"2 roots \(base_link, imu\)"),
    "loop": (
        urdf(LINKS + MAST + OPTICAL + IMU + joint("l", "camera_optical", "base_link")),
        "loop",
    ),
    "two parents": (
        urdf(LINKS + MAST + OPTICAL + IMU + joint("again", "imu", "mast")),
        "'mast' hangs on two joints, 'j_mast' and 'again'",
    ),
    "joint to nowhere": (
        urdf(LINKS + MAST + OPTICAL + IMU + joint("odd", "imu", "nowhere")),
        "'odd' names 'nowhere'",
    ),
    "same name twice": (urdf(LINKS + '<link name="imu"/>' + MAST + OPTICAL + IMU), "'imu'"),
    "nan": (GOOD.replace(b'xyz="1.2 0 1.4"', b'xyz="nan 0 1.4"'), "'j_mast' .* not finite"),
    "infinite angle": (GOOD.replace(b"0 0 1.0", b"0 0 inf"), "'j_imu' .* not finite"),
    "two numbers": (GOOD.replace(b'xyz="1.2 0 1.4"', b'xyz="1.2 0"'), "cannot be read"),
    "no number": (GOOD.replace(b'xyz="1.2 0 1.4"', b'xyz="1.2 0 a"'), "cannot be read"),
    "unknown joint type": (GOOD.replace(b'type="fixed"', b'type="glued"'), "cannot be read"),
    "joint without a child": (GOOD.replace(b'<child link="imu"/>', b""), "cannot be read"),
    "not xml": (b"links: [a, b]", "cannot be read"),
    "cut off": (GOOD[:100], "cannot be read"),
    "empty": (b"", "cannot be read"),
    "no links": (urdf(""), "no links"),
    "not utf-8": (GOOD.replace(b"car", b"c\xe4r"), "cannot be read"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_are_named_in_one_line(fault, capfd):
    content, message = FAULTS[fault]
    camera_link = "gps" if fault == "unknown link" else "camera_optical"
    with pytest.raises(ValueError, match="URDF") as caught:
        camera_in_link(content, "base_link", camera_link)
    assert re.search(message, str(caught.value))
    assert "\n" not in str(caught.value)
    assert capfd.readouterr() == ("", "")
