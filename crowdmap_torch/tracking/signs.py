"""IV-A: sign detections of one journey -> tracklets, frame after frame.

The epipolar cost of two detections depends on nothing but the two, so all pairs within the association window are one
batched kernel (`sign_features.sign_pair_costs`). The causal loop (`SignAssociator`) looks costs up, predicts where each
tracklet should appear, and matches. `SingleJourneyMapper` steps the same associator with one frame's costs at a time.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.clustering.assignment import gated_matching, matching_of_near
from crowdmap_torch.geometry import depth_filter, polygon
from crowdmap_torch.noise.positioning import PositioningNoise
from crowdmap_torch.noise.white_noise import white_noise_along
from crowdmap_torch.tables import Journey, SignDetections, Tracklets
from crowdmap_torch.tracking.causal import (
    ActiveTracklets,
    CausalAssociator,
    CostLookup,
    costs_on_demand,
    rows_of_frames,
    window_costs,
)
from crowdmap_torch.tracking.sign_features import (
    SignAssociationConfig,
    SignFeatureArrays,
    SignFeatures,
    sign_features,
    sign_pair_costs,
)

TRUSTED_SIGMAS = 3.0
"""A sighting further from its prediction than this moves the estimate no more than one that is just so far."""
_ONE_VOTE = np.eye(len(polygon.SHAPES), dtype=np.int64)
SURE_EPIPOLAR_COST = 5.0
"""Most that the epipolar cost can add where the tracklet is known well enough to be predicted."""
_LARGE, _RARE = 4.64, 0.2
"""A squared distance from its prediction that a fifth of all sightings exceeds (chi squared, three degrees of freedom)."""
_ALONG = 8.0
"""What is so many times nearer to where it was in the image than to where it would be if it stood moves with the car."""
_STEP = 0.1
"""Of the logarithm of the noise's variance, for one sighting."""
_SLACK = 0.3
"""So much of that logarithm is chance."""


@dataclass(frozen=True)
class ActiveSigns(ActiveTracklets):
    """Sign tracklets that may still be continued."""

    votes: Int[np.ndarray, "n s"]
    """Measurements by shape."""
    shift: Int[np.ndarray, " n"]
    """Corner shift of the last measurement."""
    mean: Float[np.ndarray, "n 4"]
    """State of the `depth_filter`."""
    covariance: Float[np.ndarray, "n 4 4"]


class SignAssociator(CausalAssociator[ActiveSigns, SignFeatures]):
    """Links the sign detections of one frame after another into tracklets (IV-A); never looks ahead."""

    def __init__(self, positioning: PositioningNoise, config: SignAssociationConfig) -> None:
        none = np.zeros(0, dtype=np.int64)
        votes = none.reshape(0, len(polygon.SHAPES))
        state = np.zeros((0, 4)), np.zeros((0, 4, 4))
        super().__init__(ActiveSigns(none, none, votes, none, *state))
        self.positioning = positioning
        self.config = config
        self._log_noise = 0.0
        """Logarithm of the noise's variance over what is expected, as sightings so far have it."""

    def state_dict(self) -> dict[str, Any]:
        """Everything that the next step needs."""
        return {**super().state_dict(), "log_noise": self._log_noise}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on where another associator with the same configuration stopped."""
        super().load_state_dict(state)
        self._log_noise = state["log_noise"]

    def advance(
        self,
        features: SignFeatureArrays,
        rows: Int[np.ndarray, " m"],
        pair_costs: CostLookup,
        white_sigma_m: float,
    ) -> tuple[Int[np.ndarray, " m"], Int[np.ndarray, " m"]]:
        """Tracklet and corner shift of each of the detections `rows` of `features`, which are those of one frame.

        `features` must also hold every active tracklet's last measurement. Positions jump by `white_sigma_m` [m] from
        frame to frame.
        """
        if not len(rows):
            return rows, rows
        old = self.active
        silent_for = features.frame[rows[0]] - features.frame[old.last]
        if silent_for.max(initial=0) > self.config.window:
            old = old[silent_for <= self.config.window]
        sighting, variance = features.sighting[rows], self._noise * features.variance[rows]
        prediction = self._predict(old, features, int(rows[0]), white_sigma_m)
        epipolar_px2 = pair_costs(old.last[:, None], rows[None])
        if self.config.method == "paper2017":
            row, column = matching_of_near(epipolar_px2, self.config.paper.max_cost_px2)
        else:
            innovation = depth_filter.innovation(prediction, sighting, variance)
            seen = prediction, innovation, epipolar_px2
            cost = self._costs(old, features, rows, *seen, white_sigma_m)
            row, column = gated_matching(cost, self.config.unmatched_cost)
            sure = old.votes[row].sum(-1) >= self.config.sure_after
            last, new = old.last[row[sure]], column[sure]
            off = innovation.distance_sq[row[sure], new]
            both = variance[new] + self._noise * features.variance[last]
            moved = (np.square(sighting[new] - features.sighting[last]) / both).sum(-1)
            # Plates of cars ahead stay where they are in the image: by them all noise would seem large.
            self._learn(off[(off <= _LARGE) | (_ALONG * moved >= off)])

        label = self._labels(old, row, column, len(rows))
        shift = features.shift[rows]
        shift[column] = _corner_order(features, rows[column], old.last[row], old.shift[row])
        votes = _ONE_VOTE[features.shape[rows]]
        votes[column] += old.votes[row]
        state = depth_filter.initial(
            sighting,
            variance,
            log_height=math.log(self.config.typical_height_m),
            sigma_log_height=self.config.sigma_log_height,
        )
        if len(row):
            updated = depth_filter.update(
                prediction[row], sighting[column], variance[column], trusted=TRUSTED_SIGMAS
            )
            state.mean[column], state.covariance[column] = updated.mean, updated.covariance
        now = ActiveSigns(label, rows, votes, shift, state.mean, state.covariance)
        self.active = old.without(row).followed_by(now)
        return label, shift

    @torch.no_grad()
    def step(
        self,
        frame: int,
        T_world_camera: Float[Tensor, "4 4"],
        detections: SignDetections,
        white_sigma_m: float | None = None,
    ) -> tuple[Int[Tensor, " m"], Int[Tensor, " m"]]:
        """Tracklet and corner shift of each of one frame's detections; frame indices must increase.

        Positions jump by `white_sigma_m` [m] from frame to frame (None: as configured). Keeps the last measurement of the
        active tracklets and nothing else.
        """
        if white_sigma_m is None:
            white_sigma_m = self.positioning.white_sigma_m
        device = detections.frame.device
        detections = replace(detections, frame=torch.full_like(detections.frame, frame))
        pose = T_world_camera.expand(len(detections), 4, 4)
        features, rows = self._behind_recent(sign_features(detections, pose, self.config))
        costs = costs_on_demand(features, partial(sign_pair_costs, config=self.config))
        label, shift = self.advance(SignFeatureArrays.of(features), rows, costs, white_sigma_m)
        self._keep_last(features)
        return torch.from_numpy(label).to(device), torch.from_numpy(shift).to(device)

    @property
    def _noise(self) -> float:
        """The variance of sightings as a multiple of what is expected, at least 1."""
        return math.exp(max(self._log_noise - _SLACK, 0.0))

    def _learn(self, distance_sq: Float[np.ndarray, " k"]) -> None:
        """Follows the noise by how far sightings are from their predictions, such that few are far."""
        for is_large in (distance_sq > _LARGE).tolist():
            step = _STEP * (1 - _RARE if is_large else -_RARE)
            self._log_noise = max(self._log_noise + step, 0.0)

    def _predict(
        self, old: ActiveSigns, features: SignFeatureArrays, now: int, white_sigma_m: float
    ) -> depth_filter.Prediction:
        """Where the tracklets should appear in the frame of row `now`."""
        T_now, T_last = features.T_world_camera[now], features.T_world_camera[old.last]
        R_t = T_now[:3, :3].T
        t = (T_last[:, :3, 3] - T_now[:3, 3]) @ R_t.T
        travel = np.sqrt((t * t).sum(-1))
        p = self.positioning
        return depth_filter.predict(
            depth_filter.DepthState(old.mean, old.covariance),
            R_t @ T_last[:, :3, :3],
            t,
            variance_position=2 * white_sigma_m**2 + p.walk_m**2 * travel,
            variance_rotation=2 * p.white_sigma_rad**2 + p.walk_rad**2 * travel,
        )

    def _costs(
        self,
        old: ActiveSigns,
        features: SignFeatureArrays,
        rows: Int[np.ndarray, " m"],
        prediction: depth_filter.Prediction,
        innovation: depth_filter.Innovation,
        epipolar_px2: Float[np.ndarray, "n m"],
        white_sigma_m: float,
    ) -> Float[np.ndarray, "n m"]:
        """Cost of continuing each tracklet with each detection."""
        c = self.config
        depth = prediction.depth[:, None]
        other_shape = old.votes.argmax(-1)[:, None] != features.shape[rows]
        refused = innovation.distance_sq > c.max_distance**2
        refused |= (depth < c.min_depth_m) | (depth > c.max_depth_m)
        # The poses' own noise moves the epipolar lines of near signs.
        pose_px2 = (features.focal[rows] / np.maximum(depth, c.min_depth_m)) ** 2
        pose_variance = white_sigma_m**2 + self.positioning.walk_m**2 / 2
        epipolar = epipolar_px2 / (self._noise * c.sigma_px**2 + pose_px2 * pose_variance)
        # A tracklet that is known well enough to be predicted may break the epipolar gate: its last measurement may
        # have been the wrong one.
        count = old.votes.sum(-1)[:, None]
        sure = count >= c.sure_after
        refused |= ~sure & (epipolar > (c.max_epipolar_px / c.sigma_px) ** 2)
        epipolar = np.where(sure, np.minimum(epipolar, SURE_EPIPOLAR_COST), epipolar)
        track = features.track[rows]
        hinted = (features.track[old.last][:, None] == track) & (track >= 0)
        cost = innovation.distance_sq + innovation.vagueness + epipolar + c.young_penalty / count
        cost += c.shape_penalty * other_shape
        cost -= c.track_bonus * hinted
        cost[refused] = np.inf
        return cost


def _corner_order(
    features: SignFeatureArrays,
    now: Int[np.ndarray, " k"],
    last: Int[np.ndarray, " k"],
    last_shift: Int[np.ndarray, " k"],
) -> Int[np.ndarray, " k"]:
    """Corner shift of each detection: as an upright sign has it or, where that is unclear, as the last measurement."""
    shift = features.shift[now]
    unclear = (~features.clear[now] & (features.shape[now] == features.shape[last])).nonzero()[0]
    if len(unclear):
        outline, before = (torch.from_numpy(features.outline[r[unclear]]) for r in (now, last))
        count = polygon.corner_count(torch.from_numpy(features.shape[now[unclear]]))
        before = polygon.roll(before, torch.from_numpy(last_shift[unclear]), count)
        shift[unclear] = polygon.best_shift(before, outline, count)[0].numpy()
    return shift


@torch.no_grad()
def associate_signs(
    journey: Journey, positioning: PositioningNoise, config: SignAssociationConfig
) -> Tracklets:
    """Tracklets of a journey's sign detections, exactly those that one frame after another gives (IV-A).

    Every detection is in a tracklet, if only in its own; never are two of one frame in the same.
    """
    detections = journey.signs
    order = torch.argsort(detections.frame, stable=True)
    detections = detections[order]
    features = sign_features(detections, journey.T_world_camera[detections.frame], config)
    pair_costs = partial(sign_pair_costs, config=config)
    costs = window_costs(features, pair_costs, window=config.window, chunk=config.chunk_pairs)
    associator = SignAssociator(positioning, config)
    arrays = SignFeatureArrays.of(features.to("cpu"))
    label, shift = np.full(len(order), -1), np.zeros(len(order), dtype=np.int64)
    white_sigma_m = white_noise_along(journey, positioning)
    for rows in rows_of_frames(arrays.frame):
        white = float(white_sigma_m[arrays.frame[rows[0]]])
        label[rows], shift[rows] = associator.advance(arrays, rows, costs, white)
    back = torch.argsort(order)
    label, shift = (torch.from_numpy(column).to(order.device)[back] for column in (label, shift))
    return Tracklets(label, associator.count, shift)
