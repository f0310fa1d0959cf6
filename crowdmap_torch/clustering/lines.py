"""Lines of several sources as samples with a direction, and points on the ridges that they make."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree
from torch import Tensor

from crowdmap_torch.clustering.groups import group_sum

_WITNESS_WEIGHT = 0.25
MAX_ANGLE_COS = 0.94
"""Cosine of the largest angle (20 degrees) between the directions of lines that are one."""


@dataclass(frozen=True)
class LineSamples:
    """Samples of lines, those of one track adjacent and tracks of one owner adjacent."""

    point: Float[Tensor, "n 3"]
    direction: Float[Tensor, "n 2"]
    """Unit vector in the plane."""
    slope: Float[Tensor, " n"]
    """Rise along the direction."""
    kind: Int[Tensor, " n"]
    """-1 unknown."""
    track: Int[Tensor, " n"]
    """Line that the sample belongs to, not decreasing."""
    owner: Int[Tensor, " n"]
    """Source of the track, not decreasing."""
    weight: Float[Tensor, " n"]
    """0 to 1: how far a sample is to be believed."""

    @property
    def is_witness(self) -> Bool[Tensor, " n"]:
        """True for the samples that are believed enough to say that a line exists."""
        return self.weight >= _WITNESS_WEIGHT

    def __len__(self) -> int:
        return len(self.track)

    def __getitem__(self, index: Tensor) -> LineSamples:
        """The samples at `index`."""
        return LineSamples(**{f.name: getattr(self, f.name)[index] for f in fields(self)})


@dataclass(frozen=True)
class RidgePoints:
    """Points on ridges, and what supports them."""

    point: Float[Tensor, "n 3"]
    direction: Float[Tensor, "n 2"]
    """An axis: the sign has no meaning."""
    slope: Float[Tensor, " n"]
    kind: Int[Tensor, " n"]
    density: Float[Tensor, " n"]
    """Number of tracks at the mode, those at its flanks counted in part."""
    owners: Int[Tensor, " n"]
    """Number of owners with a sample near the mode."""
    votes: Float[Tensor, "n kinds"]
    """Weight of the samples near the mode by kind."""

    def __len__(self) -> int:
        return len(self.kind)

    def __getitem__(self, index: Tensor) -> RidgePoints:
        """The points at `index`."""
        return RidgePoints(**{f.name: getattr(self, f.name)[index] for f in fields(self)})


def merged(samples: LineSamples, cell: float) -> tuple[LineSamples, Int[Tensor, " n"]]:
    """One sample for all samples of a track in a cell of a grid, and which one each sample went to."""
    angle = torch.atan2(samples.direction[:, 1], samples.direction[:, 0])
    key = torch.stack(
        (
            samples.track,
            (samples.point[:, 0] / cell).floor().long(),
            (samples.point[:, 1] / cell).floor().long(),
            (samples.point[:, 2] / 4.0).floor().long(),
            (angle / (torch.pi / 4)).round().long() % 8,
            samples.kind,
        ),
        dim=1,
    )
    _, cell_of = torch.unique(scalar_key(key), return_inverse=True)
    count = int(cell_of.max()) + 1 if len(cell_of) else 0
    total = group_sum(samples.weight, cell_of, count)
    share = samples.weight / total[cell_of]
    first = torch.zeros(count, dtype=torch.int64, device=cell_of.device)
    first[cell_of] = torch.arange(len(cell_of), device=cell_of.device)
    sums = group_sum(
        share[:, None]
        * torch.cat((samples.point, samples.direction, samples.slope[:, None]), dim=1),
        cell_of,
        count,
    )
    number = torch.bincount(cell_of, minlength=count).to(total)
    result = LineSamples(
        point=sums[:, :3],
        direction=torch.nn.functional.normalize(sums[:, 3:5], dim=1),
        slope=sums[:, 5],
        kind=samples.kind[first],
        track=samples.track[first],
        owner=samples.owner[first],
        weight=total / number,
    )
    return result, cell_of


def owners_around(
    point: Float[Tensor, "n 3"], samples: LineSamples, radius: float
) -> Int[Tensor, " n"]:
    """How many owners have samples within about `radius` of each point: who could have supported it [m]."""
    key = torch.stack(
        (
            samples.owner,
            (samples.point[:, 0] / radius).floor().long(),
            (samples.point[:, 1] / radius).floor().long(),
        ),
        dim=1,
    )
    _, cell_of = torch.unique(scalar_key(key), return_inverse=True)
    count = int(cell_of.max()) + 1
    number = torch.bincount(cell_of, minlength=count)
    centre = group_sum(samples.point[:, :2], cell_of, count) / number[:, None]
    owner = torch.zeros(count, dtype=torch.int64, device=number.device)
    owner[cell_of] = samples.owner
    near = KDTree(point[:, :2].detach().cpu().numpy()).sparse_distance_matrix(
        KDTree(centre.detach().cpu().numpy()), radius, output_type="ndarray"
    )
    i, k = (torch.from_numpy(near[name].astype(np.int64)).to(number.device) for name in ("i", "j"))
    owners = int(samples.owner.max()) + 1
    seen = torch.unique(i * owners + owner[k]) // owners
    return torch.bincount(seen, minlength=len(point))


def scalar_key(key: Int[Tensor, "n k"]) -> Int[Tensor, " n"]:
    """One number per row that is equal only for equal rows."""
    low = key.amin(0)
    size = key.amax(0) - low + 1
    result = torch.zeros_like(key[:, 0])
    for column in range(key.shape[1]):
        result = result * size[column] + key[:, column] - low[column]
    return result


def dot(a: Float[Tensor, "n _"], b: Float[Tensor, "n _"]) -> Float[Tensor, " n"]:
    """Scalar products of the first two columns."""
    return a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1]
