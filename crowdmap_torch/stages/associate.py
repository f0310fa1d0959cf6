"""IV-A: sign detections of one journey -> tracklets, frame after frame.

The epipolar cost of two detections depends on nothing but the two, so all pairs within the association window are one
batched kernel (`sign_sights.sign_pair_costs`). The causal loop (`SignAssociator`) looks costs up, predicts where each
tracklet should appear, and matches. `SingleJourneyMapper` steps the same associator with one frame's costs at a time.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.clustering.assignment import match_arrays, window_pairs
from crowdmap_torch.geometry import depth_filter, polygon
from crowdmap_torch.sign_sights import (
    SightArrays,
    SignAssociationConfig,
    SignSights,
    no_sights,
    sign_pair_costs,
    sign_sights,
)
from crowdmap_torch.tables import Journey, SignDetections, Tracklets, concatenate

TRUSTED_SIGMAS = 3.0
"""A sighting further from its prediction than this moves the estimate no more than one that is just so far."""
SURE_EPIPOLAR_COST = 5.0
"""Most that the epipolar cost can add where the tracklet is known well enough to be predicted."""


@dataclass(frozen=True)
class ActiveTracklets:
    """Tracklets that may still be continued, and what the next frame needs to know of them."""

    label: Int[np.ndarray, " n"]
    last: Int[np.ndarray, " n"]
    """Row of the last measurement."""
    votes: Int[np.ndarray, "n 6"]
    """Measurements by shape."""
    shift: Int[np.ndarray, " n"]
    """Corner shift of the last measurement."""
    mean: Float[np.ndarray, "n 4"]
    """State of the `depth_filter`."""
    covariance: Float[np.ndarray, "n 4 4"]

    def __len__(self) -> int:
        return len(self.label)

    def __getitem__(self, index: np.ndarray) -> ActiveTracklets:
        """The tracklets at `index`."""
        return ActiveTracklets(*(getattr(self, f.name)[index] for f in fields(self)))


CostLookup = Callable[[Int[np.ndarray, "n 1"], Int[np.ndarray, "1 m"]], Float[np.ndarray, "n m"]]
"""`(rows of last measurements, rows of new detections) -> sign_pair_costs` of every pair."""


class SignAssociator:
    """Links the sign detections of one frame after another into tracklets (IV-A); never looks ahead."""

    def __init__(self, config: SignAssociationConfig) -> None:
        self.config = config
        self.count = 0
        """Tracklets so far."""
        self.active = _no_tracklets()
        self._recent = no_sights()
        self._pose_variance = config.pose_sigma_m**2 + config.drift_m**2 / 2

    def advance(
        self, sights: SightArrays, rows: Int[np.ndarray, " m"], pair_costs: CostLookup
    ) -> tuple[Int[np.ndarray, " m"], Int[np.ndarray, " m"]]:
        """Tracklet and corner shift of each of the detections `rows` of `sights`, which are those of one frame.

        `sights` must also hold every active tracklet's last measurement.
        """
        if not len(rows):
            return rows, rows
        old = self.active
        silent_for = sights.frame[rows[0]] - sights.frame[old.last]
        old = old[silent_for <= self.config.window_frames]
        sighting, variance = sights.sighting[rows], sights.variance[rows]
        prediction = self._predict(old, sights, int(rows[0]))
        epipolar_px2 = pair_costs(old.last[:, None], rows[None])
        cost, gate = self._costs(old, sights, rows, prediction, epipolar_px2)
        row, column = match_arrays(cost, gate)

        label = np.full(len(rows), -1)
        label[column] = old.label[row]
        fresh = (label < 0).nonzero()[0]
        label[fresh] = self.count + np.arange(len(fresh))
        self.count += len(fresh)
        shift = sights.shift[rows]
        shift[column] = _corner_order(sights, rows[column], old.last[row], old.shift[row])
        votes = _ONE_VOTE[sights.shape[rows]]
        votes[column] += old.votes[row]
        state = depth_filter.initial(
            sighting,
            variance,
            log_height=math.log(self.config.typical_height_m),
            sigma_log_height=self.config.sigma_log_height,
        )
        updated = depth_filter.update(
            prediction[row], sighting[column], variance[column], trusted=TRUSTED_SIGMAS
        )
        state.mean[column], state.covariance[column] = updated.mean, updated.covariance
        silent = np.ones(len(old), dtype=bool)
        silent[row] = False
        before = old[silent]
        self.active = ActiveTracklets(
            label=np.concatenate((before.label, label)),
            last=np.concatenate((before.last, rows)),
            votes=np.concatenate((before.votes, votes)),
            shift=np.concatenate((before.shift, shift)),
            mean=np.concatenate((before.mean, state.mean)),
            covariance=np.concatenate((before.covariance, state.covariance)),
        )
        return label, shift

    @torch.no_grad()
    def step(
        self, frame: int, T_world_camera: Float[Tensor, "4 4"], detections: SignDetections
    ) -> tuple[Int[Tensor, " m"], Int[Tensor, " m"]]:
        """Tracklet and corner shift of each of one frame's detections; frame indices must increase.

        Keeps the last measurement of the active tracklets and nothing else.
        """
        m = len(detections)
        device = detections.frame.device
        at = torch.full((m,), frame, device=device)
        new = sign_sights(detections, T_world_camera.expand(m, 4, 4), self.config, frame=at)
        sights = concatenate((self._recent, new.to("cpu")))

        def pair_costs(last: np.ndarray, rows: np.ndarray) -> np.ndarray:
            a, b = (torch.from_numpy(x.ravel()) for x in np.broadcast_arrays(last, rows))
            cost = sign_pair_costs(sights[a], sights[b], self.config)
            return cost.reshape(len(last), m).numpy()

        rows = np.arange(len(self._recent), len(sights))
        label, shift = self.advance(SightArrays.of(sights), rows, pair_costs)
        self._recent = sights[torch.from_numpy(self.active.last)]
        self.active = replace(self.active, last=np.arange(len(self.active)))
        return torch.from_numpy(label).to(device), torch.from_numpy(shift).to(device)

    def state_dict(self) -> dict[str, Tensor]:
        """Everything that the next step needs."""
        active = {
            f"active.{f.name}": torch.from_numpy(getattr(self.active, f.name).copy())
            for f in fields(ActiveTracklets)
        }
        recent = {
            f"recent.{f.name}": getattr(self._recent, f.name).clone() for f in fields(SignSights)
        }
        return {"count": torch.tensor(self.count), **active, **recent}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Go on where another associator with the same configuration stopped."""
        self.count = int(state["count"])
        active = {f.name: state[f"active.{f.name}"].numpy() for f in fields(ActiveTracklets)}
        recent = {f.name: state[f"recent.{f.name}"].clone() for f in fields(SignSights)}
        self.active = ActiveTracklets(**{name: a.copy() for name, a in active.items()})
        self._recent = SignSights(**recent)

    def _predict(
        self, old: ActiveTracklets, sights: SightArrays, now: int
    ) -> depth_filter.Prediction:
        """Where the tracklets should appear in the frame of row `now`."""
        T_now, T_last = sights.T_world_camera[now], sights.T_world_camera[old.last]
        R_t = T_now[:3, :3].T
        t = (T_last[:, :3, 3] - T_now[:3, 3]) @ R_t.T
        travel = np.sqrt((t * t).sum(-1))
        c = self.config
        return depth_filter.predict(
            depth_filter.DepthState(old.mean, old.covariance),
            R_t @ T_last[:, :3, :3],
            t,
            variance_position=2 * c.pose_sigma_m**2 + c.drift_m**2 * travel,
            variance_rotation=2 * c.pose_sigma_rad**2 + c.drift_rad**2 * travel,
        )

    def _costs(
        self,
        old: ActiveTracklets,
        sights: SightArrays,
        rows: Int[np.ndarray, " m"],
        prediction: depth_filter.Prediction,
        epipolar_px2: Float[np.ndarray, "n m"],
    ) -> tuple[Float[np.ndarray, "n m"], float]:
        """Cost of continuing each tracklet with each detection, and the cost of leaving both alone."""
        c = self.config
        innovation = depth_filter.innovation(
            prediction, sights.sighting[rows], sights.variance[rows]
        )
        depth = prediction.depth[:, None]
        other_shape = old.votes.argmax(-1)[:, None] != sights.shape[rows]
        refused = innovation.distance_sq > c.max_distance**2
        refused |= (depth < c.min_depth_m) | (depth > c.max_depth_m)
        if c.method == "epipolar":
            return np.where(refused | other_shape, np.inf, epipolar_px2), c.max_epipolar_px**2
        # The poses' own noise moves the epipolar lines of near signs.
        pose_px2 = (sights.focal[rows] / np.maximum(depth, c.min_depth_m)) ** 2
        epipolar = epipolar_px2 / (c.sigma_px**2 + pose_px2 * self._pose_variance)
        # A tracklet that is known well enough to be predicted may break the epipolar gate: its last measurement may
        # have been the wrong one.
        count = old.votes.sum(-1)[:, None]
        sure = count >= c.sure_after
        refused |= ~sure & (epipolar > (c.max_epipolar_px / c.sigma_px) ** 2)
        epipolar = np.where(sure, np.minimum(epipolar, SURE_EPIPOLAR_COST), epipolar)
        track = sights.track[rows]
        hinted = (sights.track[old.last][:, None] == track) & (track >= 0)
        cost = innovation.distance_sq + innovation.vagueness + epipolar + c.young_penalty / count
        cost += c.shape_penalty * other_shape
        cost -= c.track_bonus * hinted
        cost[refused] = np.inf
        return cost, c.unmatched_cost


def _corner_order(
    sights: SightArrays,
    now: Int[np.ndarray, " k"],
    last: Int[np.ndarray, " k"],
    last_shift: Int[np.ndarray, " k"],
) -> Int[np.ndarray, " k"]:
    """Corner shift of each detection: as an upright sign has it or, where that is unclear, as the last measurement."""
    shift = sights.shift[now]
    unclear = (~sights.clear[now] & (sights.shape[now] == sights.shape[last])).nonzero()[0]
    if len(unclear):
        outline, before = (torch.from_numpy(sights.outline[r[unclear]]) for r in (now, last))
        count = polygon.corner_count(torch.from_numpy(sights.shape[now[unclear]]))
        before = polygon.roll(before, torch.from_numpy(last_shift[unclear]), count)
        shift[unclear] = polygon.best_shift(before, outline, count)[0].numpy()
    return shift


@torch.no_grad()
def associate_signs(journey: Journey, config: SignAssociationConfig) -> Tracklets:
    """Tracklets of a journey's sign detections, exactly those that one frame after another gives (IV-A).

    Every detection is in a tracklet, if only in its own; never are two of one frame in the same.
    """
    detections = journey.signs
    order = torch.argsort(detections.frame, stable=True)
    detections = detections[order]
    sights = sign_sights(detections, journey.T_world_camera[detections.frame], config)
    pairs = window_pairs(sights.frame, config.window_frames)
    costs = [
        sign_pair_costs(sights[a], sights[b], config) for a, b in pairs.chunks(config.chunk_pairs)
    ]
    device = detections.frame.device
    cost = torch.cat([*costs, sights.focal[:0]]).cpu().numpy()
    first, start = pairs.first.cpu().numpy(), pairs.start.cpu().numpy()

    def pair_costs(last: np.ndarray, rows: np.ndarray) -> np.ndarray:
        return cost[start[rows] + last - first[rows]]

    associator = SignAssociator(config)
    arrays = SightArrays.of(sights.to("cpu"))
    frames = np.flatnonzero(np.diff(arrays.frame, prepend=-1, append=-1))
    label = np.full(len(order), -1)
    shift = np.zeros(len(order), dtype=np.int64)
    for begin, end in pairwise(frames.tolist()):
        rows = np.arange(begin, end)
        label[rows], shift[rows] = associator.advance(arrays, rows, pair_costs)
    back = torch.argsort(order)
    return Tracklets(
        label=torch.from_numpy(label).to(device)[back],
        count=associator.count,
        shift=torch.from_numpy(shift).to(device)[back],
    )


_ONE_VOTE = np.eye(len(polygon.SHAPES), dtype=np.int64)


def _no_tracklets() -> ActiveTracklets:
    none = np.zeros(0, dtype=np.int64)
    return ActiveTracklets(
        label=none,
        last=none,
        votes=none.reshape(0, len(polygon.SHAPES)),
        shift=none,
        mean=np.zeros((0, 4)),
        covariance=np.zeros((0, 4, 4)),
    )
