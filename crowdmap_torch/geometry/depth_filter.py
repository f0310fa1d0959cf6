"""A running estimate of where an upright thing of unknown size is, from a moving camera: bearing, depth, height.

The state of each thing is `(x, y, lambda, eta)`: its bearing on the plane z = 1 and the logarithm of its inverse
depth in the camera of the last update, and the logarithm of its height [m]. A sighting measures the bearing and
`lambda + eta`, the logarithm of the height it appears with on z = 1. At a standstill the prediction is the
rotation-compensated image and its covariance is small; with a baseline it stretches along the epipolar line, as far
as the depth is unknown. One Mahalanobis distance is thus the pixel distance, the epipolar distance or the distance to
a predicted point, whichever the motion allows (compare Civera, Davison and Montiel 2008, inverse depth
parametrisation).

Arrays are NumPy's: the filter runs frame after frame on a handful of things, where the overhead of a call is all it
costs.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

_MEASURES = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 1.0]])
"""A sighting as a linear function of the state."""
_IDENTITY, _IDENTITY_3 = np.eye(4), np.eye(3)
_NEARER_OR_SMALLER = np.array([[1.0, -1.0], [-1.0, 1.0]])
_ON_DIAGONAL = slice(0, 11, 5)
"""The first three of the diagonal among the 16 entries of a covariance."""


@dataclass(frozen=True)
class DepthState:
    """Estimates of many things, each in the camera frame of its own last update."""

    mean: Float[np.ndarray, "n 4"]
    covariance: Float[np.ndarray, "n 4 4"]

    def __getitem__(self, index: np.ndarray) -> DepthState:
        """The estimates at `index`."""
        return DepthState(self.mean[index], self.covariance[index])


@dataclass(frozen=True)
class Prediction:
    """Where the things should appear in a later frame."""

    state: DepthState
    depth: Float[np.ndarray, " n"]
    """Along the optical axis of the later frame [m]; zero for things behind the camera, whose state means nothing."""
    expected: Float[np.ndarray, "n 3"]
    """Expected sighting `(x, y, log height)`."""
    spread: Float[np.ndarray, "n 3 3"]
    """Its covariance, the sighting's own noise left out."""

    def __getitem__(self, index: np.ndarray) -> Prediction:
        """The predictions at `index`."""
        return Prediction(
            self.state[index], self.depth[index], self.expected[index], self.spread[index]
        )


@dataclass(frozen=True)
class Innovation:
    """How far every sighting is from every prediction."""

    distance_sq: Float[np.ndarray, "n m"]
    """Mahalanobis distance squared, 3 degrees of freedom; infinite for things behind the camera."""
    vagueness: Float[np.ndarray, "n m"]
    """Logarithm of the squared volume that the prediction leaves open over that of the sighting's noise."""


def initial(
    sighting: Float[np.ndarray, "n 3"],
    variance: Float[np.ndarray, "n 3"],
    *,
    log_height: float,
    sigma_log_height: float,
) -> DepthState:
    """The state after one sighting `(x, y, log height on z = 1)`, with a prior of the log of the height [m]."""
    n = len(sighting)
    mean = np.empty((n, 4))
    mean[:, :2] = sighting[:, :2]
    mean[:, 2] = sighting[:, 2] - log_height
    mean[:, 3] = log_height
    covariance = np.zeros((n, 4, 4))
    covariance.reshape(n, 16)[:, _ON_DIAGONAL] = variance
    covariance[:, 2:, 2:] += sigma_log_height**2 * _NEARER_OR_SMALLER
    return DepthState(mean, covariance)


def predict(
    state: DepthState,
    R_b_a: Float[np.ndarray, "n 3 3"],
    t_b_a: Float[np.ndarray, "n 3"],
    *,
    variance_position: Float[np.ndarray, " n"],
    variance_rotation: Float[np.ndarray, " n"],
) -> Prediction:
    """The states carried from their frames a to frames b, `p_b = R_b_a p_a + t_b_a`.

    The variances are those of the relative motion's error, per axis [m^2, rad^2].
    """
    inverse_depth = np.exp(state.mean[:, 2:3])
    # The point and its derivatives, all scaled by its inverse depth in a: finite for things at infinity.
    by_state = R_b_a.copy()
    by_state[..., 2] = moved = inverse_depth * t_b_a
    ray = np.ones((len(moved), 3))
    ray[:, :2] = state.mean[:, :2]
    p = (R_b_a @ ray[..., None])[..., 0] + moved
    z = p[:, 2:]
    in_front = z > 1e-6
    z = np.where(in_front, z, 1.0)
    by_state /= z[..., None]
    bearing = p[:, :2] / z
    J = np.zeros_like(state.covariance)
    J[:, :2, :3] = by_state[:, :2] - bearing[..., None] * by_state[:, 2:]
    J[:, 2, :3] = -by_state[:, 2]
    J[:, 2, 2] += 1
    J[:, 3, 3] = 1

    mean = state.mean.copy()
    mean[:, :2] = bearing
    mean[:, 2:3] -= np.log(z)
    now = inverse_depth / z
    by_position = now * now * variance_position[:, None]
    covariance = J @ state.covariance @ J.transpose(0, 2, 1)
    diagonal = covariance.reshape(-1, 16)[:, _ON_DIAGONAL]
    diagonal[:, :2] += (by_position + variance_rotation[:, None]) * (1 + bearing * bearing)
    diagonal[:, 2:] += by_position
    return Prediction(
        state=DepthState(mean, covariance),
        depth=np.where(in_front, 1 / now, 0.0)[:, 0],
        expected=mean @ _MEASURES.T,
        spread=_MEASURES @ covariance @ _MEASURES.T,
    )


def innovation(
    prediction: Prediction, sighting: Float[np.ndarray, "m 3"], variance: Float[np.ndarray, "m 3"]
) -> Innovation:
    """Distances of all sightings from all predictions."""
    difference = sighting - prediction.expected[:, None]
    S = prediction.spread[:, None] + variance[:, :, None] * _IDENTITY_3
    determinant = np.linalg.det(S)
    solved = (np.linalg.inv(S) @ difference[..., None])[..., 0]
    distance_sq = (difference * solved).sum(-1)
    distance_sq[prediction.depth <= 0] = np.inf
    return Innovation(distance_sq, np.log(determinant / variance.prod(-1)))


def update(
    prediction: Prediction,
    sighting: Float[np.ndarray, "n 3"],
    variance: Float[np.ndarray, "n 3"],
    *,
    trusted: float,
) -> DepthState:
    """The states after each thing was sighted once.

    A sighting further than `trusted` standard deviations counts with its noise raised until it is about that far.
    """
    state = prediction.state
    difference = sighting - prediction.expected
    inverse = np.linalg.inv(prediction.spread + variance[:, :, None] * _IDENTITY_3)
    distance_sq = (difference * (inverse @ difference[..., None])[..., 0]).sum(-1)
    if (distance_sq > trusted**2).any():
        variance = variance * np.maximum(distance_sq / trusted**2, 1)[:, None]
        inverse = np.linalg.inv(prediction.spread + variance[:, :, None] * _IDENTITY_3)
    gain = state.covariance @ _MEASURES.T @ inverse
    # Joseph's form stays symmetric and positive however small the noise.
    keep = _IDENTITY - gain @ _MEASURES
    noise = (gain * variance[:, None, :]) @ gain.transpose(0, 2, 1)
    return DepthState(
        mean=state.mean + (gain @ difference[..., None])[..., 0],
        covariance=keep @ state.covariance @ keep.transpose(0, 2, 1) + noise,
    )
