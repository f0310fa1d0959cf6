"""Signs in the cameras that they were surveyed from: errors that leave out where the world says these cameras were.

Reference poses of real drives disagree between two passes of one place, by more than a map of it may be off. A sign that was
measured from a camera, by LiDAR say, is compared in that camera's axes: the map's sign by the map's own pose of it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.geometry import se3
from crowdmap_torch.io.documents import Document, read_json


@dataclass(frozen=True)
class SurveyedFrom:
    """Where a surveyed sign is, from frames of a drive."""

    frame_number: Int[Tensor, " k"]
    p_camera: Float[Tensor, "k 3"]
    """The sign's centre in the camera [m]."""


def read_surveyed_from(path: Path) -> dict[str, dict[str, SurveyedFrom]]:
    """By data set and sign, of a JSON file `{DATASET: {SIGN: [{"frame": 84, "xyz_camera": [x, y, z]}, ...]}}`."""
    document = read_json(path)
    return {
        name: {sign: _sightings(of_dataset, sign) for sign in of_dataset.content}
        for name, of_dataset in ((name, document.part(name)) for name in document.content)
    }


def local_errors(
    center_world: Float[Tensor, "n 3"],
    T_world_camera: Float[Tensor, "f 4 4"],
    frame_number: Int[Tensor, " f"],
    surveyed: Mapping[str, SurveyedFrom],
    *,
    gate_m: float,
) -> dict[str, float]:
    """How far the nearest sign is from each surveyed one in the cameras of a drive, in the mean over its frames [m].

    Left out are signs that were surveyed from none of the frames, and those that have no sign within `gate_m`.
    """
    found = {}
    for name, seen in surveyed.items():
        sighting, frame = torch.nonzero(seen.frame_number[:, None] == frame_number, as_tuple=True)
        if not len(frame) or not len(center_world):
            continue
        T_camera_world = se3.inverse(T_world_camera[frame])[:, None]
        p_camera = se3.transform(T_camera_world, center_world[None])
        error = (p_camera - seen.p_camera[sighting][:, None]).norm(dim=-1).mean(0)
        if float(error.min()) < gate_m:
            found[name] = float(error.min())
    return found


def _sightings(of_dataset: Document, sign: str) -> SurveyedFrom:
    given = of_dataset.take(sign)
    if not isinstance(given, list) or not given:
        raise of_dataset.fault("expected a list of frames with xyz_camera", sign)
    frames, points = zip(*(_sighting(of_dataset, sign, one) for one in given), strict=True)
    return SurveyedFrom(torch.tensor(frames), torch.tensor(points, dtype=torch.float64))


def _sighting(of_dataset: Document, sign: str, given: object) -> tuple[int, Sequence[float]]:
    if not isinstance(given, dict):
        raise of_dataset.fault("expected a list of frames with xyz_camera", sign)
    one = Document(of_dataset.path, given, f"{of_dataset.section}.{sign}")
    return one.integer("frame", low=0, high=2**53), one.numbers("xyz_camera", 3)
