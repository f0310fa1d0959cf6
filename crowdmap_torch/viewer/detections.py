"""Detections of a scene: of a run by sign, of a data set by frame; thinned evenly to what there is room for."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.clustering.groups import group_sum
from crowdmap_torch.geometry import polygon
from crowdmap_torch.io.sign_outcomes import SignOutcomes
from crowdmap_torch.tables import Journey
from crowdmap_torch.viewer.columns import Column, column
from crowdmap_torch.viewer.lines import simplified
from crowdmap_torch.viewer.scene import Scene, frame_quaternions

PIXEL_STEP = 0.1
"""Pixels are kept in tenths."""
_RESIDUAL_STEP = 0.02
_RESIDUAL_MOST = 600.0
_LANE_PIXEL_STEP = 1.0
_PATH_STEP_M = 1e-2
_QUATERNION_STEP = 1 / 32767
USED, GIVEN_UP, NEAR = range(3)
"""What a detection is to its sign: it counts, the adjustment took it for an outlier, or it only lies on it."""


@dataclass(frozen=True)
class OutcomeRows:
    """Detections that have to do with a sign of the map, by sign, drive and frame."""

    rows: SignOutcomes
    """`sign` is the row of the map's sign, also of those that only lie on it; `journey` that of the drive."""
    state: Int[Tensor, " d"]

    @classmethod
    def of(cls, scene: Scene) -> OutcomeRows:
        """Those of the scene's outcomes, which are there, as is its map."""
        found, hd_map = scene.outcomes, scene.hd_map
        if found is None or hd_map is None:
            raise ValueError("the scene has no outcomes of detections")
        place = {name: row for row, name in enumerate(hd_map.sign_id)}
        number = {drive.journey_id: k for k, drive in enumerate(scene.drives)}
        # The last entries are for -1.
        of_sign = torch.tensor([*(place.get(name, -1) for name in found.sign_id), -1])
        of_drive = torch.tensor([*(number.get(name, -1) for name in found.journey_id), -1])
        rows = found.rows
        shows, lies_on = of_sign[rows.sign], of_sign[rows.near_sign]
        sign, drive = torch.where(shows >= 0, shows, lies_on), of_drive[rows.journey]
        state = torch.where(rows.given_up, GIVEN_UP, USED).masked_fill(shows < 0, NEAR)
        order = np.lexsort((rows.frame.numpy(), drive.numpy(), sign.numpy()))
        index = torch.from_numpy(order)
        index = index[((sign >= 0) & (drive >= 0))[index]]
        changed = vars(rows) | {"sign": sign, "journey": drive}
        return cls(SignOutcomes(**changed)[index], state[index])


def outcome_columns(scene: Scene, of: OutcomeRows, most: int) -> tuple[int, dict[str, Column]]:
    """How many detections are drawn, `most` of each sign by each drive; and columns of them, and of all in numbers."""
    rows, state = of.rows, of.state
    pair, group, count = torch.unique_consecutive(
        torch.stack((rows.sign, rows.journey), dim=1),
        dim=0,
        return_inverse=True,
        return_counts=True,
    )
    mask = polygon.corner_mask(rows.shape)
    has = rows.residual_px.isfinite().all(-1).all(-1)
    residual = torch.where((mask & has[:, None])[..., None], rows.residual_px, 0.0)
    residual = residual.clamp(-_RESIDUAL_MOST, _RESIDUAL_MOST)
    used = has & (state == USED)
    squared = torch.where(used, residual.square().sum(-1).sum(-1), 0.0)
    corners = (mask.sum(1) * used).double()
    rms = (_sum(squared, group, count) / _sum(corners, group, count).clamp_min(1)).sqrt()
    kept = torch.from_numpy(_evenly(group.numpy(), state.numpy() != USED, most))
    columns = {
        "pair.sign": column(pair[:, 0], difference="rows"),
        "pair.drive": column(pair[:, 1], difference="rows"),
        "pair.rms": column(rms, 0.01),
        **{
            f"pair.{name}": column(_sum((state == code).double(), group, count))
            for name, code in (("used", USED), ("given_up", GIVEN_UP), ("near", NEAR))
        },
    }
    some = rows[kept]
    near = _camera_from_sign(scene, some)
    columns |= {
        "seen.pair": column(group[kept], difference="rows"),
        "seen.frame": column(some.frame, difference="rows"),
        "seen.state": column(state[kept]),
        "seen.fate": column(some.fate),
        "seen.shape": column(some.shape),
        "seen.has": column(has[kept].long()),
        "seen.corner": column(some.corners_px, PIXEL_STEP, "pairs"),
        "seen.residual": column(residual[kept], _RESIDUAL_STEP),
        "seen.from": column(near, 0.05, "rows"),
    }
    return len(some), columns


def _sum(values: Tensor, group: Tensor, count: Tensor) -> Float[Tensor, " g"]:
    return group_sum(values[:, None], group, len(count))[:, 0]


def _camera_from_sign(scene: Scene, rows: SignOutcomes) -> Float[np.ndarray, "d 3"]:
    """Where the drive was when it saw the sign, from the sign [m]; zero where its frame is unknown."""
    away = np.zeros((len(rows), 3))
    if scene.hd_map is None:
        return away
    center = scene.hd_map.signs.center_world.numpy()
    for number, drive in enumerate(scene.drives):
        mine = np.flatnonzero(rows.journey.numpy() == number)
        if not len(drive.frame_number) or not len(mine):
            continue
        frame = rows.frame.numpy()[mine]
        at = np.searchsorted(drive.frame_number.numpy(), frame).clip(0, len(drive.path_world) - 1)
        known = drive.frame_number.numpy()[at] == frame
        place = drive.path_world.numpy()[at] - center[rows.sign.numpy()[mine]]
        away[mine] = np.where(known[:, None], place, 0.0)
    return away


def _evenly(group: Int[np.ndarray, " d"], first: np.ndarray, most: int) -> Int[np.ndarray, " k"]:
    """Up to `most` rows of each group, ascending: half of them of those that go `first`, the rest evenly spread."""
    if not most or not len(group):
        return np.zeros(0, dtype=np.int64)
    kept = np.zeros(len(group), dtype=bool)
    room = np.full(int(group.max()) + 1, most)
    for chosen, share in ((first, (most + 1) // 2), (~first, most)):
        rows = np.flatnonzero(chosen)
        of, start, count = np.unique(group[rows], return_index=True, return_counts=True)
        wanted = np.minimum(np.minimum(room[of], share), count)
        room[of] -= wanted
        each = np.repeat(np.arange(len(of)), count)
        rank = np.arange(len(rows)) - start[each]
        step = count[each] / np.maximum(wanted[each], 1)
        # A row is kept where its share of what is wanted passes a whole number.
        taken = (rank / step).astype(int) != ((rank - 1) / step).astype(int)
        taken |= rank == 0
        kept[rows[taken & (wanted[each] > 0)]] = True
    return np.flatnonzero(kept)


def frame_columns(scene: Scene, most: int) -> tuple[int, dict[str, Column]]:
    """How many frames of a data set are drawn, `most` of every 64; and columns of them, with what was detected."""
    parts = [_frames(number, journey, most) for number, journey in enumerate(scene.journeys)]
    names = parts[0].keys() if parts else ()
    joined = {name: np.concatenate([part[name] for part in parts]) for name in names}
    steps = {
        "frame.place": (_PATH_STEP_M, "rows"),
        "frame.quaternion": (_QUATERNION_STEP, "rows"),
        "frame.sigma": (_PATH_STEP_M, "rows"),
        "frame.sign_corner": (PIXEL_STEP, "pairs"),
        "frame.lane_point": (_LANE_PIXEL_STEP, "rows"),
    }
    columns = {
        name: column(values, *steps.get(name, (1.0, "rows" if name == "frame.number" else None)))
        for name, values in joined.items()
    }
    return len(joined["frame.number"]), columns


def _frames(number: int, journey: Journey, most: int) -> dict[str, np.ndarray]:
    share = most / 64
    index = np.arange(journey.frame_count)
    kept = np.floor((index + 1) * share) != np.floor(index * share)
    if len(kept):
        # Without room for any other, the first one tells at least how the car looks.
        kept[0] = True
    frames = np.flatnonzero(kept)
    sigma = journey.sigma_position
    signs = journey.signs[torch.from_numpy(kept)[journey.signs.frame]]
    lane = torch.nonzero(torch.from_numpy(kept)[journey.lanes.frame])[:, 0].numpy()
    px, of = journey.lane_points.px.numpy(), journey.lane_points.detection.numpy()
    first, last = np.searchsorted(of, lane), np.searchsorted(of, lane, side="right")
    lines = [px[a:b] for a, b in zip(first, last, strict=True)]
    lines = [line[simplified(line, _LANE_PIXEL_STEP)] for line in lines]
    place = np.full(journey.frame_count, -1)
    place[frames] = np.arange(len(frames))
    return {
        "frame.drive": np.full(len(frames), number),
        "frame.number": journey.frame_number.numpy()[frames],
        "frame.ms": ((journey.t_ns - journey.t_ns[:1]) // 10**6).numpy()[frames],
        "frame.place": journey.T_world_camera[:, :3, 3].numpy()[frames],
        "frame.quaternion": frame_quaternions(journey).numpy()[frames],
        "frame.sigma": np.zeros((len(frames), 3)) if sigma is None else sigma.numpy()[frames],
        "frame.signs": np.bincount(place[signs.frame.numpy()], minlength=len(frames)),
        "frame.lanes": np.bincount(place[journey.lanes.frame.numpy()[lane]], minlength=len(frames)),
        "frame.sign_shape": signs.shape.numpy(),
        "frame.sign_type": signs.type.numpy(),
        "frame.sign_corner": signs.corners_px.reshape(len(signs), 16).numpy(),
        "frame.lane_type": journey.lanes.type.numpy()[lane],
        "frame.lane_count": np.array([len(line) for line in lines], dtype=int),
        "frame.lane_point": np.concatenate([np.zeros((0, 2)), *lines]),
    }
