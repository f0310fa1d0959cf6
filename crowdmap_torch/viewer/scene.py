"""What a viewer shows: a map, a run or a data set, in the tables of the package."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.geometry import se3
from crowdmap_torch.io.sign_outcomes import NamedOutcomes
from crowdmap_torch.tables import Dataset, HdMap, Journey, Origin, Survey


@dataclass(frozen=True)
class Drive:
    """One drive: where it went, and what is known of its errors."""

    journey_id: str
    frame_number: Int[Tensor, " f"]
    t_ns: Int[Tensor, " f"]
    path_world: Float[Tensor, "f 3"]
    """After the adjustment; of a data set as given."""
    given_world: Float[Tensor, "g 3"] | None = None
    """As the positioning module had it, where that is known and another."""
    vehicle: str = ""
    image: tuple[int, int] | None = None
    """Width and height [px]."""
    bias: Sequence[float] | None = None
    """East, north, up: what is to be added to the given positions, in the mean [m]."""
    bias_sigma: Sequence[float] | None = None
    remark: str = ""
    """What is wrong with it."""


@dataclass(frozen=True)
class Scene:
    """Everything that a viewer shows; what is not known is left out."""

    kind: str
    """`map`, `run` or `dataset`."""
    title: str
    origin: Origin
    subtitle: str = ""
    hd_map: HdMap | None = None
    map_before: HdMap | None = None
    """The cluster heads, before the adjustment."""
    survey: Survey | None = None
    drives: tuple[Drive, ...] = ()
    outcomes: NamedOutcomes | None = None
    """What became of every sign detection of a run."""
    journeys: tuple[Journey, ...] = ()
    """What the drives detected, in the order of `drives`: of a data set, of a run where `with_journeys` was asked."""
    type_names: tuple[str, ...] = ()
    """Codes of the detections in `journeys`."""
    notes: tuple[str, ...] = ()
    """What is missing, and why."""


def scene_of_dataset(dataset: Dataset, title: str, survey: Survey | None) -> Scene:
    """The raw drives of a data set, each as its poses are given."""
    return Scene(
        kind="dataset",
        title=title,
        origin=dataset.origin,
        survey=survey,
        drives=tuple(_raw_drive(journey) for journey in dataset.journeys),
        journeys=dataset.journeys,
        type_names=dataset.type_names,
        notes=tuple(f"{r.journey_id} was set aside: {r.reason}" for r in dataset.rejected),
    )


def _raw_drive(journey: Journey) -> Drive:
    camera = journey.rig.camera
    return Drive(
        journey_id=journey.journey_id,
        frame_number=journey.frame_number,
        t_ns=journey.t_ns,
        path_world=journey.T_world_camera[:, :3, 3],
        vehicle=journey.vehicle,
        image=(camera.width, camera.height),
    )


def frame_quaternions(journey: Journey) -> Float[Tensor, "f 4"]:
    """`R_world_camera` of every frame as qx qy qz qw."""
    return se3.to_quaternion(journey.T_world_camera[:, :3, :3])


def empty_path() -> Float[Tensor, "0 3"]:
    """The way of a drive that is nowhere."""
    return torch.zeros(0, 3, dtype=torch.float64)
