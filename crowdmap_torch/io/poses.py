"""`poses.parquet`, of the vehicle's pose link: as given, and as the map refined it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.geometry import se3
from crowdmap_torch.io.columns import Sheet
from crowdmap_torch.io.rigs import UNIT_TOLERANCE
from crowdmap_torch.io.writing import write_parquet

_POSITION = ("x", "y", "z")
_QUATERNION = ("qx", "qy", "qz", "qw")
_SIGMA_POSITION = ("sigma_e", "sigma_n", "sigma_u")
_SIGMA_ROTATION = "sigma_rot"


@dataclass(frozen=True)
class LinkPoses:
    """Poses of the link that a rig's mount names, frame after frame."""

    frame_number: Int[Tensor, " f"]
    t_ns: Int[Tensor, " f"]
    T_world_link: Float[Tensor, "f 4 4"]
    sigma_position: Float[Tensor, "f 3"] | None
    """None unless the file says something in all three columns."""
    sigma_rotation: Float[Tensor, " f"] | None


def read_poses(path: Path) -> LinkPoses:
    """The poses of a journey, quaternions normalised; InputError for what breaks FORMAT.md.

    A sigma that is unknown (null) in some frames only holds the median of the others there.
    """
    required = ("frame", "t_ns", *_POSITION, *_QUATERNION)
    sheet = Sheet(path, required, (*_SIGMA_POSITION, _SIGMA_ROTATION))
    if not len(sheet):
        raise sheet.fault("has no rows; expected one for each camera frame")
    frame, t_ns = (_increasing(sheet, name) for name in ("frame", "t_ns"))
    position = np.stack([sheet.numbers(name) for name in _POSITION], axis=-1)
    quaternion = np.stack([sheet.numbers(name) for name in _QUATERNION], axis=-1)
    length = np.sqrt(np.square(quaternion).sum(-1))
    sheet.refuse(
        np.abs(length - 1) > UNIT_TOLERANCE,
        lambda row: (
            f"quaternion qx qy qz qw has length {length[row]:.6g}; "
            f"expected 1 within {UNIT_TOLERANCE}"
        ),
    )
    R = se3.from_quaternion(torch.from_numpy(quaternion))
    sigmas = [_sigma(sheet, name) for name in _SIGMA_POSITION]
    known = [s for s in sigmas if s is not None]
    sigma_rotation = _sigma(sheet, _SIGMA_ROTATION)
    return LinkPoses(
        frame_number=torch.from_numpy(frame),
        t_ns=torch.from_numpy(t_ns),
        T_world_link=se3.make(R, torch.from_numpy(position)),
        sigma_position=torch.from_numpy(np.stack(known, axis=-1)) if len(known) == 3 else None,
        sigma_rotation=None if sigma_rotation is None else torch.from_numpy(sigma_rotation),
    )


def write_poses(path: Path, poses: LinkPoses) -> None:
    """Writes poses in the form in which they are read; unknown sigmas have no columns."""
    T = poses.T_world_link.detach().cpu().to(torch.float64)
    quaternion = se3.to_quaternion(T[:, :3, :3]).numpy()
    columns: dict[str, np.ndarray] = {
        "frame": poses.frame_number.cpu().numpy(),
        "t_ns": poses.t_ns.cpu().numpy(),
    }
    columns |= {name: T[:, k, 3].numpy() for k, name in enumerate(_POSITION)}
    columns |= {name: quaternion[:, k] for k, name in enumerate(_QUATERNION)}
    if poses.sigma_position is not None:
        sigma = poses.sigma_position.detach().cpu().to(torch.float64).numpy()
        columns |= {name: sigma[:, k] for k, name in enumerate(_SIGMA_POSITION)}
    if poses.sigma_rotation is not None:
        columns[_SIGMA_ROTATION] = poses.sigma_rotation.detach().cpu().to(torch.float64).numpy()
    write_parquet(path, columns)


def _increasing(sheet: Sheet, name: str) -> Int[np.ndarray, " f"]:
    values = sheet.integers(name)
    stays = np.concatenate(([False], values[1:] <= values[:-1]))
    sheet.refuse(
        stays,
        lambda row: (
            f"column {name!r}: {values[row]} after {values[row - 1]}; "
            "expected strictly increasing values, sort the file by frame"
        ),
    )
    return values


def _sigma(sheet: Sheet, name: str) -> Float[np.ndarray, " f"] | None:
    sigma = sheet.numbers(name, optional=True)
    known = ~np.isnan(sigma)
    sheet.refuse(
        known & ~(sigma >= 0),
        lambda row: (
            f"column {name!r}: expected 0 or more, found {sigma[row]}; "
            "leave it null if it is unknown"
        ),
    )
    return np.where(known, sigma, np.median(sigma[known])) if known.any() else None
