"""`poses.parquet`, of the vehicle's pose link: as given, and as the map refined it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.geometry import se3
from crowdmap_torch.io.columns import MAX_PLACE_M, Sheet
from crowdmap_torch.io.rigs import UNIT_TOLERANCE
from crowdmap_torch.io.writing import write_parquet

_POSITION = ("x", "y", "z")
_QUATERNION = ("qx", "qy", "qz", "qw")
_SIGMA_POSITION = ("sigma_e", "sigma_n", "sigma_u")
_SIGMA_ROTATION = "sigma_rot"


MAX_SPEED_MPS = 150.0
"""No car on a road is faster over a second, noise and small jumps of its positioning included."""
MAX_SIGMA = 1e6
"""Of a position [m] or rotation [rad]: who knows less knows nothing, and leaves the column out."""
_MOST_COUNTED = 2**61
"""Frame numbers and times whose differences are numbers still."""


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
        raise sheet.fault("has no rows; expected one for each camera frame", code="no-rows")
    frame, t_ns = (_increasing(sheet, name) for name in ("frame", "t_ns"))
    position = np.stack([sheet.numbers(name) for name in _POSITION], axis=-1)
    _refuse_far(sheet, position)
    _refuse_leaps(sheet, frame, t_ns, position)
    quaternion = np.stack([sheet.numbers(name) for name in _QUATERNION], axis=-1)
    with np.errstate(over="ignore"):
        # The length of what is far from a quaternion may well be infinite: it is refused below.
        length = np.sqrt(np.square(quaternion).sum(-1))
    sheet.refuse(
        np.abs(length - 1) > UNIT_TOLERANCE,
        lambda row: (
            f"quaternion qx qy qz qw has length {length[row]:.6g}; "
            f"expected 1 within {UNIT_TOLERANCE}"
        ),
        *_QUATERNION,
        code="quaternion-length",
    )
    R = se3.from_quaternion(torch.from_numpy(quaternion))
    sigmas = [_sigma(sheet, name) for name in _SIGMA_POSITION]
    known = [s for s in sigmas if s is not None]
    sigma_rotation = _sigma(sheet, _SIGMA_ROTATION)
    sheet.require_sound()
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


def _refuse_far(sheet: Sheet, position: Float[np.ndarray, "f 3"]) -> None:
    def rule(row: int) -> str:
        place = ", ".join(f"{x:.7g}" for x in position[row])
        return (
            f"the position ({place}) is over {MAX_PLACE_M / 1000:,.0f} km from the origin; expected "
            "metres east, north and up of dataset.json's. Are they UTM or earth-centred coordinates?"
        )

    far = np.abs(position).max(axis=-1, initial=0.0) > MAX_PLACE_M
    sheet.refuse(far, rule, *_POSITION, code="far-away")


def _refuse_leaps(
    sheet: Sheet,
    frame: Int[np.ndarray, " f"],
    t_ns: Int[np.ndarray, " f"],
    position: Float[np.ndarray, "f 3"],
) -> None:
    """Refuses what no car drives within a second or between two frames: another second's jump is noise."""
    before = np.arange(len(frame))
    if (np.diff(t_ns) <= 0).any():
        # That is refused by itself.
        return
    # The first frame a second later, the next one if that is later still, or the last of all.
    after = np.searchsorted(t_ns, t_ns + 10**9)
    after = np.clip(after, before, len(frame) - 1)
    seconds = np.maximum((t_ns[after] - t_ns[before]) * 1e-9, 1.0)
    way = np.sqrt(np.square(position[after] - position[before]).sum(-1))
    sheet.refuse(
        way > MAX_SPEED_MPS * seconds,
        lambda row: (
            f"from frame {frame[row]} to frame {frame[after[row]]} the car moves {way[row]:.0f} m in "
            f"{(t_ns[after[row]] - t_ns[row]) * 1e-9:.3g} s; expected {MAX_SPEED_MPS:g} m/s at most. "
            "Are positions in metres and t_ns in nanoseconds? Cut the journey where it jumps"
        ),
        *("frame", "t_ns", *_POSITION),
        code="leap",
    )


def _increasing(sheet: Sheet, name: str) -> Int[np.ndarray, " f"]:
    values = sheet.integers(name)
    sheet.refuse(
        np.abs(values.astype(float)) > _MOST_COUNTED,
        lambda row: f"column {name!r}: {values[row]}; expected {_MOST_COUNTED:g} at most",
        name,
        code="range",
    )
    stays = np.concatenate(([False], values[1:] <= values[:-1]))
    sheet.refuse(
        stays,
        lambda row: (
            f"column {name!r}: {values[row]} after {values[row - 1]}; "
            "expected strictly increasing values, sort the file by frame"
        ),
        name,
        code="order",
    )
    return values


def _sigma(sheet: Sheet, name: str) -> Float[np.ndarray, " f"] | None:
    sigma = sheet.numbers(name, optional=True)
    known = ~np.isnan(sigma)
    sheet.refuse(
        known & ~((sigma >= 0) & (sigma <= MAX_SIGMA)),
        lambda row: (
            f"column {name!r}: expected 0 or more, {MAX_SIGMA:g} at most, found {sigma[row]}; "
            "leave it null if it is unknown"
        ),
        name,
        code="range",
    )
    return np.where(known, sigma, np.median(sigma[known])) if known.any() else None
