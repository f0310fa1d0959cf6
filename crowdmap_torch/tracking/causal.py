"""IV-A, what signs and lanes share: costs of pairs ahead of the causal loop, and tracklets that go on frame after frame."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Generic, TypeVar

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.clustering.assignment import window_pairs
from crowdmap_torch.tables import concatenate
from crowdmap_torch.tracking.lane_features import LaneFeatures
from crowdmap_torch.tracking.sign_features import SignFeatures

Active = TypeVar("Active", bound="ActiveTracklets")
Features = TypeVar("Features", SignFeatures, LaneFeatures)
PairCosts = Callable[[Features, Features], Float[Tensor, " p"]]
"""Cost of each detection of the first table with the later one in the same row of the second."""
CostLookup = Callable[[Int[np.ndarray, "n 1"], Int[np.ndarray, "1 m"]], Float[np.ndarray, "n m"]]
"""`(rows of last measurements, rows of new detections) -> costs` of every pair."""


@dataclass(frozen=True)
class ActiveTracklets:
    """Tracklets that may still be continued, and what the next frame needs to know of them."""

    label: Int[np.ndarray, " n"]
    last: Int[np.ndarray, " n"]
    """Row of the last measurement."""

    def __len__(self) -> int:
        return len(self.label)

    def __getitem__(self: Active, index: np.ndarray) -> Active:
        """The tracklets at `index`."""
        return type(self)(*(column[index] for column in vars(self).values()))

    def followed_by(self: Active, other: Active) -> Active:
        """These tracklets, then those of `other`."""
        columns = zip(vars(self).values(), vars(other).values(), strict=True)
        return type(self)(*map(np.concatenate, columns))

    def without(self: Active, rows: Int[np.ndarray, " k"]) -> Active:
        """All but the tracklets in these rows."""
        kept = np.ones(len(self), dtype=bool)
        kept[rows] = False
        return self[kept]


class CausalAssociator(Generic[Active, Features]):
    """What a step hands to the next: the tracklets so far, and the features of their last measurements."""

    def __init__(self, active: Active) -> None:
        self.active = active
        self.count = 0
        """Tracklets so far."""
        self._recent: Features | None = None

    def state_dict(self) -> dict[str, Any]:
        """Everything that the next step needs; no step changes any of it in place."""
        return {"count": self.count, "active": self.active, "recent": self._recent}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on where another associator with the same configuration stopped."""
        self.count, self.active, self._recent = state["count"], state["active"], state["recent"]

    def _labels(
        self,
        old: Active,
        row: Int[np.ndarray, " k"],
        column: Int[np.ndarray, " k"],
        detections: int,
    ) -> Int[np.ndarray, " m"]:
        """Labels of a frame's detections: of the tracklets they are matched with, else new ones."""
        label = np.full(detections, -1)
        label[column] = old.label[row]
        fresh = (label < 0).nonzero()[0]
        label[fresh] = self.count + np.arange(len(fresh))
        self.count += len(fresh)
        return label

    def _behind_recent(self, new: Features) -> tuple[Features, Int[np.ndarray, " m"]]:
        """Features of the last measurements and those of a new frame, and the rows of the new ones."""
        new = new.to("cpu")
        features = new if self._recent is None else concatenate((self._recent, new))
        return features, np.arange(len(features) - len(new), len(features))

    def _keep_last(self, features: Features) -> None:
        """Forgets all features but those of the last measurements."""
        self._recent = features[torch.from_numpy(self.active.last)]
        self.active = replace(self.active, last=np.arange(len(self.active)))


def window_costs(
    features: Features, pair_costs: PairCosts, *, window: int, chunk: int
) -> CostLookup:
    """Costs of all pairs within the association window, computed `chunk` at a time; frames must not decrease."""
    pairs = window_pairs(features.frame, window)
    costs = [pair_costs(features[a], features[b]) for a, b in pairs.chunks(chunk)]
    cost = torch.cat([*costs, features.focal[:0]]).cpu().numpy()
    first, start = pairs.first.cpu().numpy(), pairs.start.cpu().numpy()
    return lambda last, rows: cost[start[rows] + last - first[rows]]


def costs_on_demand(features: Features, pair_costs: PairCosts) -> CostLookup:
    """Costs of pairs, computed when they are asked for."""

    def lookup(last: np.ndarray, rows: np.ndarray) -> np.ndarray:
        a, b = (torch.from_numpy(x.ravel()) for x in np.broadcast_arrays(last, rows))
        return pair_costs(features[a], features[b]).reshape(len(last), rows.shape[1]).numpy()

    return lookup


def rows_of_frames(frame: Int[np.ndarray, " d"]) -> Iterator[Int[np.ndarray, " m"]]:
    """The rows of one frame after another; `frame` must not decrease."""
    cuts = np.flatnonzero(np.diff(frame, prepend=-1, append=-1))
    for begin, end in pairwise(cuts.tolist()):
        yield np.arange(begin, end)
