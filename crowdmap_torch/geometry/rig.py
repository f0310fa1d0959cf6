"""Where the camera sits on the vehicle: a fixed kinematic chain from a URDF file.

The only file that imports pytorch_kinematics: its parser reads the description, its chain gives the
forward kinematics. Not used is what makes the one from the other: it builds in float32 (rotations
off by 5e-8), silently takes the first of two roots, and a joint that moves stands at zero.
"""

from __future__ import annotations

import contextlib
import io
import math
from os import PathLike
from pathlib import Path

import torch
from jaxtyping import Float
from pytorch_kinematics import Chain, Transform3d, frame
from pytorch_kinematics.transforms import quaternion_from_euler
from pytorch_kinematics.urdf_parser_py.urdf import URDF, Joint, Pose
from pytorch_kinematics.urdf_parser_py.xml_reflection.core import ParseError
from torch import Tensor

from crowdmap_torch.geometry import se3


def camera_in_link(
    urdf: bytes | str | PathLike[str], pose_link: str, camera_link: str
) -> Float[Tensor, "4 4"]:
    """T_link_camera: the camera's frame in that of the link whose pose is known.

    `urdf` is the file's content as bytes, or its path. Any two links will do, neither need be the
    root. The description must be one tree, finite, and every joint between the two links `fixed`;
    what is not raises ValueError in one line.
    """
    robot = _parse(urdf)
    parent_joint = _tree(robot)
    for link in (pose_link, camera_link):
        if link not in parent_joint:
            there = ", ".join(sorted(parent_joint))
            raise ValueError(f"URDF has no link {link!r}; its links are: {there}")
    to_pose, to_camera = (_joints_to_root(parent_joint, n) for n in (pose_link, camera_link))
    while to_pose and to_camera and to_pose[-1] is to_camera[-1]:
        to_pose.pop()
        to_camera.pop()
    for joint in (*to_pose, *to_camera):
        if joint.type != "fixed":
            raise ValueError(
                f"URDF joint {joint.name!r} between {pose_link!r} and {camera_link!r} is "
                f"{joint.type!r}; expected 'fixed': the camera must not move on the vehicle"
            )
    T_top_link, T_top_camera = _forward_kinematics(to_pose, to_camera)
    T_link_camera = se3.inverse(T_top_link) @ T_top_camera
    R = se3.orthonormalise(T_link_camera[:3, :3])
    return se3.make(R, T_link_camera[:3, 3])


_MOST_LINKS = 500
"""A humanoid has a hundred."""


def _parse(urdf: bytes | str | PathLike[str]) -> URDF:
    # Bytes, not text: the parser refuses a str that names its encoding in the first line.
    content = urdf if isinstance(urdf, bytes) else Path(urdf).read_bytes()
    # Entities may unfold without end, or name other files; nobody describes a robot with them.
    if b"<!" in content.replace(b"<!--", b"").replace(b"\0", b""):
        raise ValueError("URDF cannot be read: it has a DOCTYPE or entities; expected neither")
    try:
        # The parser reports tags it does not know on stderr; they are no fault.
        with contextlib.redirect_stderr(io.StringIO()), contextlib.redirect_stdout(io.StringIO()):
            return URDF.from_xml_string(content)
    except (ParseError, SyntaxError, AssertionError, AttributeError, LookupError, ValueError) as e:
        reason = " ".join(str(e).split())
        raise ValueError(f"URDF cannot be read: {reason}") from e


def _tree(robot: URDF) -> dict[str, Joint | None]:
    """The joint above each link, None above the root, of a description that is one tree."""
    names = [str(link.name) for link in robot.links]
    if max(len(names), len(robot.joints)) > _MOST_LINKS:
        raise ValueError(f"URDF has {len(names)} links; expected {_MOST_LINKS} at most")
    if not names:
        raise ValueError("URDF has no links; expected a <robot> with at least one <link>")
    if twice := sorted({n for n in names if names.count(n) > 1}):
        raise ValueError(f"URDF has more than one link {twice[0]!r}; names must be unique")
    parent_joint: dict[str, Joint | None] = dict.fromkeys(names)
    for joint in robot.joints:
        for link in (joint.parent, joint.child):
            if link not in parent_joint:
                raise ValueError(f"URDF joint {joint.name!r} names {link!r}, which is no link")
        if (other := parent_joint[joint.child]) is not None:
            raise ValueError(
                f"URDF link {joint.child!r} hangs on two joints, {other.name!r} and {joint.name!r}"
            )
        parent_joint[joint.child] = joint
        _check_finite(joint)
    roots = sorted(name for name, joint in parent_joint.items() if joint is None)
    if len(roots) > 1:
        raise ValueError(f"URDF has {len(roots)} roots ({', '.join(roots)}); expected one tree")
    for name in names:
        _joints_to_root(parent_joint, name)
    return parent_joint


def _check_finite(joint: Joint) -> None:
    numbers = (*_vector(joint.origin, "xyz"), *_vector(joint.origin, "rpy"))
    if not all(math.isfinite(number) for number in numbers):
        raise ValueError(f"URDF joint {joint.name!r} has an origin that is not finite: {numbers}")


def _joints_to_root(parent_joint: dict[str, Joint | None], link: str) -> list[Joint]:
    joints: list[Joint] = []
    while (joint := parent_joint[link]) is not None:
        joints.append(joint)
        if len(joints) > len(parent_joint):
            raise ValueError(f"URDF joints form a loop through link {link!r}; expected a tree")
        link = str(joint.parent)
    return joints


def _forward_kinematics(*paths: list[Joint]) -> Float[Tensor, "n 4 4"]:
    """The pose of the last link of each path in the first, which all share.

    A path is its fixed joints, listed from the last link upwards.
    """
    # Frames go by number: the chain takes names of links for the same that differ in line ends.
    top = frame.Frame("0", joint=frame.Joint(dtype=torch.float64))
    ends, count = [], 0
    for joints in paths:
        above = top
        for joint in reversed(joints):
            count += 1
            offset = _joint_transform(joint.origin)
            hinge = frame.Joint(str(joint.name), offset, dtype=torch.float64)
            below = frame.Frame(str(count), joint=hinge)
            above.children.append(below)
            above = below
        ends.append(above.name)
    chain = Chain(top, dtype=torch.float64)
    poses = chain.forward_kinematics_tensor(torch.zeros(1, 0, dtype=torch.float64))
    return poses[chain.get_frame_indices(*ends), 0]


def _joint_transform(origin: Pose | None) -> Transform3d:
    rpy = torch.tensor(_vector(origin, "rpy"), dtype=torch.float64)
    xyz = torch.tensor(_vector(origin, "xyz"), dtype=torch.float64)
    quaternion_wxyz = quaternion_from_euler(rpy, "sxyz")
    return Transform3d(rot=quaternion_wxyz, pos=xyz, dtype=torch.float64)


def _vector(origin: Pose | None, name: str) -> list[float]:
    values = None if origin is None else getattr(origin, name)
    return [0.0, 0.0, 0.0] if values is None else [float(value) for value in values]
