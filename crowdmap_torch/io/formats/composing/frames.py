"""Which camera frame each image is, and the poses of the frames.

`--images` says how. `number`: the last whole number in an image's name is the frame's, and the rows of the trajectory are
the frames, counted from `--first-frame`. `s`, `ms`, `us` or `ns`: the last number in the name is the image's time. A file:
lines of a time and an image's name, times written with a point being seconds, without one nanoseconds. Where images have
times they are the frames, and poses are interpolated between those of the trajectory.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

import numpy as np
import torch
from jaxtyping import Int

from crowdmap_torch.geometry import se3
from crowdmap_torch.io.errors import InputError, one_line
from crowdmap_torch.io.formats.composing.lines import TIME_UNITS, read_numbers, time_ns
from crowdmap_torch.io.formats.composing.parts import Track

NUMBER = "number"
MAX_GAP_S = 1.0
"""Nobody knows where a car was in the middle of a longer gap of its trajectory."""


@dataclass(frozen=True)
class Frames:
    """The frames of a journey with their poses, and which of them each image is."""

    track: Track
    """A row for each frame, with its number."""
    of_image: dict[str, int]
    """Frame numbers; an image without a pose is not in it."""
    notes: tuple[str, ...] = ()


def find_frames(
    track: Track,
    images: Sequence[str],
    *,
    key: str | None,
    first_frame: int = 0,
    time_offset_s: float = 0.0,
) -> Frames:
    """The frames of a trajectory in whose images something was detected; `key` is what `--images` says."""
    numbered = track
    if track.frame_number is None:
        numbered = replace(track, frame_number=np.arange(len(track.t_ns)) + first_frame)
    if not images and key in (None, NUMBER, *TIME_UNITS):
        return Frames(numbered, {})
    if key is None:
        raise InputError(
            f"which frame is image {images[0]!r}? Say it by --images number (the last number in its "
            f"name), --images ns (or s, ms, us: a time), or --images FILE (lines of time and name)"
        )
    if key == NUMBER:
        return Frames(numbered, _by_number(numbered, images))
    if key in TIME_UNITS:
        listed = {name: _time_in(name, key) for name in dict.fromkeys(images)}
        t_of = listed
    else:
        listed = _read_times(Path(key))
        t_of = _found(listed, images, Path(key))
    return _at_times(track, listed, t_of, round(time_offset_s * 1e9), first_frame)


def _by_number(track: Track, images: Sequence[str]) -> dict[str, int]:
    assert track.frame_number is not None
    there = set(track.frame_number.tolist())
    of_image: dict[str, int] = {}
    owner: dict[int, str] = {}
    for name in dict.fromkeys(images):
        digits = re.findall(r"\d+", PurePosixPath(name).stem)
        if not digits:
            raise InputError(f"image {name!r} has no number in its name; give --images FILE")
        frame = int(digits[-1])
        if frame not in there:
            raise InputError(
                f"image {name!r} is frame {frame}, but the poses of {track.source} are frames "
                f"{min(there)} to {max(there)}; give --first-frame, or --images FILE"
            )
        if (other := owner.setdefault(frame, name)) != name:
            raise InputError(
                f"images {other!r} and {name!r} both are frame {frame}; give --images FILE with the "
                "time of each"
            )
        of_image[name] = frame
    return of_image


def _time_in(name: str, unit: str) -> int:
    pattern = r"\d+(?:\.\d+)?" if unit == "s" else r"\d+"
    stem = PurePosixPath(name)
    text = stem.name.removesuffix(stem.suffix) if not stem.suffix[1:].isdigit() else stem.name
    digits = re.findall(pattern, text)
    if not digits:
        raise InputError(f"image {name!r} has no time in its name; give --images FILE")
    try:
        return time_ns(digits[-1], unit)
    except ValueError as error:
        raise InputError(f"image {name!r}: {one_line(error)}; give --images FILE") from error


def _read_times(path: Path) -> dict[str, int]:
    """Times [ns] by image, in the order of the file."""
    times: dict[str, int] = {}
    for line in read_numbers(path, (2,), "a time and the name of an image"):
        text, name = line.cells
        if not re.search(r"\d", text):
            # A line of names of columns.
            continue
        if name in times:
            raise line.fault(f"image {name!r} is there twice; expected each once")
        times[name] = line.time_ns(0, "s" if re.search(r"[.eE]", text) else "ns")
    if not times:
        raise InputError(f"{path}: has no times; expected lines of a time and an image's name")
    return times


def _found(listed: dict[str, int], images: Sequence[str], path: Path) -> dict[str, int]:
    """Times of images, by their names as detections have them: with or without the folders before."""
    bare: dict[str, list[str]] = {}
    for name in listed:
        bare.setdefault(PurePosixPath(name).name, []).append(name)
    found = {}
    for image in dict.fromkeys(images):
        same = [image] if image in listed else bare.get(PurePosixPath(image).name, [])
        if len(same) != 1:
            many = "not there" if not same else f"there as {same[0]!r} and {same[1]!r}"
            raise InputError(f"{path}: image {image!r} is {many}; expected it once")
        found[image] = listed[same[0]]
    return found


def _at_times(
    track: Track, listed: dict[str, int], t_of: dict[str, int], offset_ns: int, first_frame: int
) -> Frames:
    """Frames at the images' times, numbered in order of time."""
    t_ns = np.unique(np.array(list(listed.values()), dtype=np.int64)) + offset_ns
    number = np.arange(len(t_ns)) + first_frame
    frames, notes = at_times(track, t_ns, number)
    assert frames.frame_number is not None
    frame_at = dict(zip(frames.t_ns.tolist(), frames.frame_number.tolist(), strict=True))
    of_image = {name: frame_at.get(t + offset_ns, -1) for name, t in t_of.items()}
    of_image = {name: frame for name, frame in of_image.items() if frame >= 0}
    return Frames(frames, of_image, notes)


def at_times(
    track: Track, t_ns: Int[np.ndarray, " f"], number: Int[np.ndarray, " f"]
) -> tuple[Track, tuple[str, ...]]:
    """The trajectory at the times of images with these numbers, and how many of them it does not cover, in words."""
    known = _is_covered(track, t_ns)
    if not known.any():
        seconds = ((t_ns[0] - track.t_ns[0]) * 1e-9, (t_ns[-1] - track.t_ns[-1]) * 1e-9)
        raise InputError(
            f"{track.source}: no image was taken while poses are known: the first {seconds[0]:.3f} s "
            f"after the first pose, the last {seconds[1]:.3f} s after the last. Are both clocks the same "
            "(--time-offset) and times in the unit said?"
        )
    notes = ()
    if lost := int((~known).sum()):
        notes = (
            f"{lost} of {len(t_ns)} images left out: before the first pose, after the last, or in a "
            f"gap of more than {MAX_GAP_S:g} s",
        )
    return _interpolated(track, t_ns[known], number[known]), notes


def _is_covered(track: Track, t_ns: Int[np.ndarray, " f"]) -> np.ndarray:
    after = np.searchsorted(track.t_ns, t_ns)
    inside = after < len(track.t_ns)
    after = np.minimum(after, len(track.t_ns) - 1)
    exact = track.t_ns[after] == t_ns
    before = np.maximum(after - 1, 0)
    gap = track.t_ns[after] - track.t_ns[before]
    return inside & (exact | ((track.t_ns[before] < t_ns) & (gap <= MAX_GAP_S * 1e9)))


def _interpolated(
    track: Track, t_ns: Int[np.ndarray, " f"], number: Int[np.ndarray, " f"]
) -> Track:
    """The trajectory at times within it: straight between its rows, turning evenly."""
    after = np.clip(np.searchsorted(track.t_ns, t_ns), 1, max(len(track.t_ns) - 1, 1))
    after = np.minimum(after, len(track.t_ns) - 1)
    before = np.maximum(after - 1, 0)
    span = np.maximum(track.t_ns[after] - track.t_ns[before], 1)
    share = (t_ns - track.t_ns[before]) / span

    def mixed(values: np.ndarray) -> np.ndarray:
        weight = share.reshape(-1, *(1,) * (values.ndim - 1))
        return (1 - weight) * values[before] + weight * values[after]

    R = torch.from_numpy(track.T_world_link[:, :3, :3])
    turn = se3.so3_log(R[before].mT @ R[after])
    R_between = R[before] @ se3.so3_exp(turn * torch.from_numpy(share)[:, None])
    T = np.tile(np.eye(4), (len(t_ns), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = R_between.numpy(), mixed(track.T_world_link[:, :3, 3])
    sigmas = (track.sigma_position, track.sigma_rotation)
    position, rotation = (None if s is None else mixed(s) for s in sigmas)
    return replace(
        track,
        t_ns=t_ns,
        T_world_link=T,
        frame_number=number,
        sigma_position=position,
        sigma_rotation=rotation,
    )
