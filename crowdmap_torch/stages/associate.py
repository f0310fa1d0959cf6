"""IV-A: sign detections of one journey -> tracklets, frame after frame.

The epipolar cost of two detections depends on nothing but the two, so all pairs within the association window are one
batched kernel (`sign_pair_costs`); the causal loop (`SignAssociator`) looks costs up, predicts where each tracklet
should appear, and matches. `SingleJourneyMapper` steps the same associator with the costs of one frame at a time.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from crowdmap_torch.clustering.assignment import match_arrays, window_pairs
from crowdmap_torch.geometry import correspondence, depth_filter, polygon, se3
from crowdmap_torch.geometry.epipolar import fundamental
from crowdmap_torch.tables import Journey, Rows, SignDetections, Tracklets, concatenate

METHODS = ("predicted", "epipolar")
CORNER_MATCHINGS = ("cyclic", "free")
TRUSTED_SIGMAS = 3.0
"""A sighting further from its prediction than this moves the estimate no more than one that is just so far."""
SURE_EPIPOLAR_COST = 5.0
"""Most that the epipolar cost can add where the tracklet is known well enough to be predicted."""
CLEAR_ORDER = 0.5
"""The corner order is clear where it misses the template by less than this share of what the second best order does."""


@dataclass(frozen=True)
class SignAssociationConfig:
    """How sign detections are linked across frames (IV-A)."""

    method: str = "predicted"
    """`predicted`: the epipolar cost to the last measurement, and the distance to where the tracklet is predicted to appear
    and how large; `epipolar`: the epipolar cost alone, as in the paper."""
    window_frames: int = 25
    """Association window w: tracklets silent for longer are ignored [frames]."""
    corner_matching: str = "cyclic"
    """Vertices are matched by the best cyclic `shift`; `free`: by any assignment, as the paper words it (slow)."""
    max_epipolar_px: float = 6.0
    """A detection starts a new tracklet where the root mean epipolar cost over vertices exceeds this [px]."""
    max_distance: float = 5.0
    """... or where it is this many standard deviations from every prediction; method `predicted`."""
    unmatched_cost: float = 24.0
    """What leaving a detection and a tracklet unmatched costs, as minus twice a log-likelihood; method `predicted`."""
    sure_after: int = 3
    """From so many measurements on, a tracklet that agrees with its prediction may break the epipolar gate: the last
    measurement may have been the wrong one; method `predicted`."""
    shape_penalty: float = 6.0
    """Added to the cost where a detection's shape is not the tracklet's shape by vote."""
    young_penalty: float = 4.0
    """Added to the cost of a tracklet with one measurement, half of it with two, and so on: of two tracklets of one sign,
    one begun by a second detection in a frame, the older goes on."""
    track_bonus: float = 2.0
    """Taken off where the perception module's track number agrees: a hint, which may be wrong."""
    sigma_px: float = 1.0
    """Noise of a sign's centre and of half its height [px]."""
    sigma_relative: float = 0.04
    """Further noise of the two, as a share of the sign's height."""
    pose_sigma_m: float = 0.02
    """White noise of positions from frame to frame."""
    pose_sigma_rad: float = 4e-4
    """White noise of rotations from frame to frame."""
    drift_m: float = 0.03
    """Drift of positions over one metre of travel; it grows with the square root of the way."""
    drift_rad: float = 4e-4
    """Drift of rotations over one metre of travel, likewise."""
    typical_height_m: float = 0.75
    """Median height of signs; gives a new tracklet its first depth."""
    sigma_log_height: float = 0.7
    """Spread of the logarithm of the height of signs."""
    min_depth_m: float = 1.0
    """Tracklets predicted nearer than this, or behind the camera, are not matched."""
    max_depth_m: float = 500.0
    """Nor are those whose depth would exceed this."""
    chunk_pairs: int = 1 << 15
    """Pairs whose costs are computed at once; bounds the memory."""

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise ValueError(f"sign association method {self.method!r}; expected one of {METHODS}")
        if self.corner_matching not in CORNER_MATCHINGS:
            raise ValueError(
                f"corner matching {self.corner_matching!r}; expected one of {CORNER_MATCHINGS}"
            )


@dataclass(frozen=True)
class SignSights(Rows):
    """What association needs of detections, computed ahead for all of them."""

    frame: Int[Tensor, " d"]
    shape: Int[Tensor, " d"]
    track: Int[Tensor, " d"]
    corners: Float[Tensor, "d 8 2"]
    """Ideal coordinates."""
    box: Float[Tensor, "d 4 2"]
    """Axis-aligned box of the corners: what detections of different shapes have in common."""
    sighting: Float[Tensor, "d 3"]
    """Centre of the box and logarithm of its height, ideal coordinates."""
    variance: Float[Tensor, "d 3"]
    """Noise of `sighting`."""
    focal: Float[Tensor, " d"]
    """Pixels per unit of the plane z = 1 at the detection: the local focal length, distortion included."""
    outline: Float[Tensor, "d 8 2"]
    """Corners relative to the box's centre, in units of its width and height; v down."""
    shift: Int[Tensor, " d"]
    """Cyclic order in which the outline is most like an upright sign of its shape."""
    clear: Bool[Tensor, " d"]
    """True where no other cyclic order is nearly as good."""
    T_world_camera: Float[Tensor, "d 4 4"]


@dataclass(frozen=True)
class SightArrays:
    """Those columns of `SignSights` that the causal loop reads, as NumPy's arrays."""

    frame: Int[np.ndarray, " d"]
    shape: Int[np.ndarray, " d"]
    track: Int[np.ndarray, " d"]
    sighting: Float[np.ndarray, "d 3"]
    variance: Float[np.ndarray, "d 3"]
    focal: Float[np.ndarray, " d"]
    outline: Float[np.ndarray, "d 8 2"]
    shift: Int[np.ndarray, " d"]
    clear: Bool[np.ndarray, " d"]
    T_world_camera: Float[np.ndarray, "d 4 4"]

    @classmethod
    def of(cls, sights: SignSights) -> SightArrays:
        """Views of a table that is on the CPU."""
        return cls(*(getattr(sights, f.name).numpy() for f in fields(cls)))


def sign_sights(
    detections: SignDetections,
    T_world_camera: Float[Tensor, "d 4 4"],
    config: SignAssociationConfig,
    *,
    frame: Int[Tensor, " d"] | None = None,
) -> SignSights:
    """Features of detections whose frames have the poses `T_world_camera`."""
    corners = detections.corners_ideal
    low, high = corners.amin(1), corners.amax(1)
    box = torch.stack(
        (
            low,
            torch.stack((high[:, 0], low[:, 1]), -1),
            high,
            torch.stack((low[:, 0], high[:, 1]), -1),
        ),
        dim=1,
    )
    extent_px = detections.corners_px.amax(1) - detections.corners_px.amin(1)
    extent = (high - low).clamp_min(1e-12)
    focal = (extent_px.clamp_min(1e-6) / extent).log().mean(-1).exp()
    sigma_px = (config.sigma_px**2 + (config.sigma_relative * extent_px[:, 1]).square()).sqrt()
    sigma_centre = sigma_px / focal
    sigma_log_height = 2 * sigma_px / extent_px[:, 1].clamp_min(1.0)
    outline = (corners - (low + high)[:, None] / 2) / extent[:, None]
    count = polygon.corner_count(detections.shape)
    template = _template_outlines().to(corners)[detections.shape]
    shift, best, second = correspondence.clearest_order(outline, template, count)
    sighting = torch.cat(((low + high) / 2, extent[:, 1:].log()), dim=-1)
    variance = torch.stack((sigma_centre, sigma_centre, sigma_log_height), dim=-1).square()
    return SignSights(
        frame=detections.frame if frame is None else frame,
        shape=detections.shape,
        track=detections.track,
        corners=corners,
        box=box,
        sighting=sighting,
        variance=variance,
        focal=focal,
        outline=outline,
        shift=shift,
        clear=best < CLEAR_ORDER * second,
        T_world_camera=T_world_camera,
    )


def sign_pair_costs(
    a: SignSights, b: SignSights, config: SignAssociationConfig
) -> Float[Tensor, " p"]:
    """The epipolar cost of pairs of detections, mean over vertices [px^2] (IV-A, Cost for sign association).

    Vertices are matched in the best cyclic order; detections of different shapes are compared by their boxes. Where the
    baseline is too short to move a sign of typical size by more than the noise, the epipolar lines say nothing, and the
    rotation-compensated pixel distance takes over. Unlike the paper, the cost is the mean and not the sum over
    vertices, so that one threshold serves all shapes.
    """
    F_ab = fundamental(a.T_world_camera, b.T_world_camera)
    T_a_b = se3.inverse(a.T_world_camera) @ b.T_world_camera
    height_px = (a.sighting[:, 2].exp() * a.focal + b.sighting[:, 2].exp() * b.focal) / 2
    motion_px = T_a_b[:, :3, 3].norm(dim=-1) * height_px / config.typical_height_m
    noise_sq = 4 * config.sigma_px**2
    epipolar_share = motion_px.square() / (motion_px.square() + noise_sq)
    scale = a.focal * b.focal
    same = a.shape == b.shape
    kind = torch.where(same, polygon.corner_count(a.shape), 0)
    cost = torch.full_like(scale, torch.inf)
    for corners in kind.unique().tolist():
        at = (kind == corners).nonzero()[:, 0]
        p, q = (a.corners, b.corners) if corners else (a.box, b.box)
        n = corners or p.shape[1]
        p, q = p[at, :n], q[at, :n]
        share = epipolar_share[at, None, None]
        moved = correspondence.rotation_compensated(T_a_b[at, :3, :3], p, q)
        # A point behind the other camera is infinitely far: the share of an infinite cost must not become NaN.
        moved = torch.where(share < 1, (1 - share) * moved, torch.zeros_like(moved))
        vertex = share * correspondence.vertex_costs(F_ab[at], p, q) + moved
        if corners == 0:
            total = vertex.diagonal(dim1=-2, dim2=-1).sum(-1)
        elif config.corner_matching == "free":
            total = correspondence.free_assignment(vertex)
        else:
            total = correspondence.cyclic_sums(vertex).amin(-1)
        cost[at] = total * scale[at] / n
    return cost


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
        self._recent = _no_sights()
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
        if c.method == "epipolar":
            return epipolar_px2, c.max_epipolar_px**2
        innovation = depth_filter.innovation(
            prediction, sights.sighting[rows], sights.variance[rows]
        )
        # The poses' own noise moves the epipolar lines of near signs.
        depth = prediction.depth[:, None]
        pose_px2 = (sights.focal[rows] / np.maximum(depth, c.min_depth_m)) ** 2
        epipolar = epipolar_px2 / (c.sigma_px**2 + pose_px2 * self._pose_variance)
        refused = innovation.distance_sq > c.max_distance**2
        refused |= (depth < c.min_depth_m) | (depth > c.max_depth_m)
        # A tracklet that is known well enough to be predicted may break the epipolar gate: its last measurement may
        # have
        # been the wrong one.
        count = old.votes.sum(-1)[:, None]
        sure = count >= c.sure_after
        refused |= ~sure & (epipolar > (c.max_epipolar_px / c.sigma_px) ** 2)
        epipolar = np.where(sure, np.minimum(epipolar, SURE_EPIPOLAR_COST), epipolar)
        shape, track = sights.shape[rows], sights.track[rows]
        hinted = (sights.track[old.last][:, None] == track) & (track >= 0)
        cost = innovation.distance_sq + innovation.vagueness + epipolar + c.young_penalty / count
        cost += c.shape_penalty * (old.votes.argmax(-1)[:, None] != shape)
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


def _no_sights() -> SignSights:
    none = torch.zeros(0, dtype=torch.int64)
    real = torch.zeros(0, dtype=torch.float64)
    return SignSights(
        frame=none,
        shape=none,
        track=none,
        corners=real.reshape(0, polygon.MAX_CORNERS, 2),
        box=real.reshape(0, 4, 2),
        sighting=real.reshape(0, 3),
        variance=real.reshape(0, 3),
        focal=real,
        outline=real.reshape(0, polygon.MAX_CORNERS, 2),
        shift=none,
        clear=none.bool(),
        T_world_camera=real.reshape(0, 4, 4),
    )


def _template_outlines() -> Float[Tensor, "6 8 2"]:
    """The outline of every shape's template, as `SignSights.outline` has it."""
    corners = polygon.template(torch.arange(len(polygon.SHAPES))).to(torch.float64)
    low, high = corners.amin(1, keepdim=True), corners.amax(1, keepdim=True)
    # The template's second axis points up, the image's down.
    return (corners - (low + high) / 2) / (high - low) * corners.new_tensor([1.0, -1.0])
