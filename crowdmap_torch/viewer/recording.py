"""A scene as a recording for the rerun viewer (extra `rerun`): the world in 3D, and what every camera saw, along time.

Entities are `world/map`, `world/before` and `world/survey` with `signs`, `plates`, `uncertainty` and `lanes`, and
`world/drives/ID` with `adjusted`, `given` and `camera`, whose children are `signs` and `lanes` in the image. Cameras have
the timelines `frame` (its number), `time` and `driven` (the time since the drive began).
"""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.evaluation.polyline import lane_samples
from crowdmap_torch.geometry import polygon, se3
from crowdmap_torch.io.atomic import atomic_file
from crowdmap_torch.io.errors import needing
from crowdmap_torch.tables import LANE_TYPES, HdMap, Journey, Survey
from crowdmap_torch.viewer.scene import Drive, Scene, frame_quaternions

_CHI95 = 7.815**0.5
"""Half axes of the ellipsoid that three numbers are in with 95 %, in sigmas."""
_LANE_STEP_M = 1.0
_NEAR_M = 20.0
"""How far the eye is from the middle at least."""
_AWAY = 1.6
"""How far, in lengths of the map: it shares the window with a picture and panels."""
_PLATES = {
    "octagon": 0xC3202FFF,
    "triangle": 0xE8505CFF,
    "inverted_triangle": 0xE8505CFF,
    "diamond": 0xF2C230FF,
    "pentagon": 0xD3E04AFF,
    "rectangle": 0x9DB2CFFF,
}
"""Colours of plates by shape, as red, green, blue and opacity."""
_LANES = {"curb": 0xC49F6FFF, "": 0x9AA7B6FF}
_MARKER, _GIVEN, _BEFORE, _SURVEY, _OFF = 0xE4E9EFFF, 0xF0A04BFF, 0xC9741AFF, 0x4FCA8BFF, 0xFF4438FF
_SEEN, _PATH = 0xFFE14DFF, 0x6EA5FFFF


def write_recording(path: Path, scene: Scene) -> None:
    """Writes `scene` as one .rrd file, complete or not at all.

    Pixels are those of a camera without distortion, so that they lie where the pinhole shows the world. InputError
    where rerun-sdk is not installed, OSError if the file cannot be written.
    """
    rerun = rerun_sdk()
    with atomic_file(path) as beside:
        stream = rerun.RecordingStream("crowdmap_torch")
        stream.save(beside, default_blueprint=_layout(rerun, scene))
        stream.send_recording_name(scene.title)
        try:
            _Recorder(rerun, stream).record(scene)
        finally:
            stream.flush()
            stream.disconnect()


def rerun_sdk() -> ModuleType:
    """The package `rerun`; InputError where it is not installed."""
    with needing("a recording", "'crowdmap_torch[rerun]'"):
        importlib.import_module("rerun.blueprint")
        return importlib.import_module("rerun")


def _layout(rerun: ModuleType, scene: Scene):
    """The world, from above, beside the picture of the first drive; all drives begin at once, days lie between them."""
    of = rerun.blueprint
    views = [of.Spatial3DView(origin="world", name="map", eye_controls=_eye(rerun, scene))]
    if scene.journeys:
        first = scene.journeys[0].journey_id
        origin = rerun.new_entity_path([*_of_drive(first), "camera"])
        views.append(of.Spatial2DView(origin=origin, name=first))
    return of.Blueprint(of.Horizontal(*views), of.TimePanel(timeline="driven"))


def _eye(rerun: ModuleType, scene: Scene):
    """An eye that looks down on the whole from the south, north ahead; by itself rerun begins amid the signs."""
    maps = [one for one in (scene.hd_map, scene.survey) if one is not None]
    places = [drive.path_world for drive in scene.drives]
    places += [place for one in maps for place in (one.signs.center_world, _lane_places(one))]
    points = torch.cat([torch.zeros(0, 3, dtype=torch.double), *places])
    if not len(points):
        return None
    low, high = points.amin(0), points.amax(0)
    middle, away = (low + high) / 2, max(_AWAY * float((high - low)[:2].max()), _NEAR_M)
    eye = middle + away * torch.tensor([0.0, -0.4, 0.9], dtype=torch.double)
    return rerun.blueprint.EyeControls3D(
        position=eye.tolist(), look_target=middle.tolist(), eye_up=(0.0, 0.0, 1.0)
    )


def _lane_places(of: HdMap | Survey) -> Float[Tensor, "n 3"]:
    return of.lanes.control.point_world if isinstance(of, HdMap) else of.lane_points.point_world


def _of_drive(journey_id: str) -> list[str]:
    """An entity of a drive, part by part: an id may hold any letter."""
    return ["world", "drives", journey_id]


@dataclass(frozen=True)
class _Recorder:
    """Writes parts of a scene into a stream of rerun."""

    rerun: ModuleType
    stream: object

    def record(self, scene: Scene) -> None:
        """Everything that the scene has."""
        self._log(["world"], self.rerun.ViewCoordinates.RIGHT_HAND_Z_UP)
        told = "\n".join(f"- {line}" for line in (scene.subtitle, *scene.notes) if line)
        place = f"# {scene.title}\n\nWorld: east, north, up in metres at {scene.origin}\n\n{told}"
        self._log(["about"], self.rerun.TextDocument(place, media_type="text/markdown"))
        if scene.hd_map is not None:
            self._map(["world", "map"], scene.hd_map, None)
        if scene.map_before is not None:
            self._map(["world", "before"], scene.map_before, _BEFORE)
        if scene.survey is not None:
            self._survey(scene.survey)
        for drive in scene.drives:
            self._paths(drive)
        colors = _colors_of_outcomes(scene)
        for journey in scene.journeys:
            self._camera(journey, scene.type_names, colors.get(journey.journey_id, {}))

    def _log(self, entity: list[str], *what: object) -> None:
        self.stream.log(entity, *what, static=True)  # pyright: ignore[reportAttributeAccessIssue]

    def _map(self, entity: list[str], hd_map: HdMap, color: int | None) -> None:
        samples = lane_samples(hd_map.lanes, _LANE_STEP_M)
        lines = _cut(samples.point_world.numpy(), samples.line.numpy(), len(hd_map.lanes))
        self._lanes([*entity, "lanes"], lines, hd_map.lane_id, hd_map.lanes.type, color)
        rerun, signs = self.rerun, hd_map.signs
        if not len(signs):
            return
        corners, count = signs.corners_world.numpy(), polygon.corner_count(signs.shape).numpy()
        codes = [_code(k, hd_map.type_names) for k in signs.type.tolist()]
        shapes = [polygon.SHAPES[k] for k in signs.shape.tolist()]
        colors = [_PLATES.get(s, _MARKER) if color is None else color for s in shapes]
        self._log(
            [*entity, "signs"],
            rerun.LineStrips3D(
                [_closed(c[:n]) for c, n in zip(corners, count, strict=True)],
                colors=_rgba(colors),
                radii=0.02,
                labels=[
                    f"{c or s} {i}" for c, s, i in zip(codes, shapes, hd_map.sign_id, strict=True)
                ],
                show_labels=False,
            ),
            rerun.AnyValues(
                sign_id=list(hd_map.sign_id),
                code=codes,
                shape=shapes,
                width_m=signs.size[:, 0].numpy(),
                height_m=signs.size[:, 1].numpy(),
                n_journeys=signs.n_journeys.numpy(),
                n_observations=signs.n_observations.numpy(),
                confidence=signs.confidence.numpy(),
            ),
        )
        if color is None:
            self._plates([*entity, "plates"], corners, count, _rgba(colors))
        half, rotation = _ellipsoids(signs.covariance)
        self._log(
            [*entity, "uncertainty"],
            rerun.Ellipsoids3D(
                centers=signs.center_world.numpy(),
                half_sizes=half,
                quaternions=rotation,
                colors=_rgba(colors),
            ),
        )

    def _plates(
        self, entity: list[str], corners: np.ndarray, count: np.ndarray, color: np.ndarray
    ) -> None:
        """One mesh of all plates: fans around their first corners, seen from both sides."""
        first = 8 * np.repeat(np.arange(len(count)), count - 2)
        second = np.concatenate([np.arange(1, n - 1) for n in count])
        fans = np.stack((first, first + second, first + second + 1), axis=-1)
        self._log(
            entity,
            self.rerun.Mesh3D(
                vertex_positions=corners.reshape(-1, 3),
                triangle_indices=np.concatenate((fans, fans[:, ::-1])),
                vertex_colors=np.repeat(color, 8),
            ),
        )

    def _lanes(
        self,
        entity: list[str],
        lines: Sequence[np.ndarray],
        lane_id: Sequence[str],
        kind: Tensor,
        color: int | None,
    ) -> None:
        if not lines:
            return
        names = [_code(k, LANE_TYPES) for k in kind.tolist()]
        colors = [_LANES.get(name, _MARKER) if color is None else color for name in names]
        self._log(
            entity,
            self.rerun.LineStrips3D(
                lines, colors=_rgba(colors), radii=0.05, labels=list(lane_id), show_labels=False
            ),
            self.rerun.AnyValues(lane_id=list(lane_id), type=names),
        )

    def _survey(self, survey: Survey) -> None:
        rerun, signs = self.rerun, survey.signs
        count = polygon.corner_count(signs.shape).numpy()
        has = signs.has_corners.numpy()
        named = list(zip(survey.sign_id, has, strict=True))
        rows = zip(signs.corners_world.numpy(), count, has, strict=True)
        outlines = rerun.LineStrips3D(
            [_closed(c[:n]) for c, n, known in rows if known],
            colors=_rgba([_SURVEY]),
            radii=0.015,
            labels=[name for name, known in named if known],
            show_labels=False,
        )
        centers = rerun.Points3D(
            signs.center_world.numpy()[~has],
            colors=_rgba([_SURVEY]),
            radii=0.2,
            labels=[name for name, known in named if not known],
            show_labels=False,
        )
        for name, what, some in (("signs", outlines, has), ("centers", centers, ~has)):
            if some.any():
                self._log(["world", "survey", name], what)
        points = survey.lane_points
        lines = _cut(points.point_world.numpy(), points.lane.numpy(), len(survey.lane_id))
        entity = ["world", "survey", "lanes"]
        self._lanes(entity, lines, survey.lane_id, survey.lane_type, _SURVEY)

    def _paths(self, drive: Drive) -> None:
        for name, path, color in (
            ("adjusted" if drive.given_world is not None else "way", drive.path_world, _PATH),
            ("given", drive.given_world, _GIVEN),
        ):
            if path is not None and len(path) > 1:
                strip = self.rerun.LineStrips3D([path.numpy()], colors=_rgba([color]), radii=0.03)
                self._log([*_of_drive(drive.journey_id), name], strip)

    def _camera(
        self, journey: Journey, type_names: Sequence[str], color_of: dict[int, int]
    ) -> None:
        """The camera of a drive, and what it detected in every frame."""
        rerun, camera = self.rerun, journey.rig.camera
        entity = [*_of_drive(journey.journey_id), "camera"]
        self._log(
            entity,
            rerun.Pinhole(
                image_from_camera=camera.K.numpy(),
                resolution=[camera.width, camera.height],
                camera_xyz=rerun.ViewCoordinates.RDF,
                image_plane_distance=2.0,
            ),
        )
        place = journey.T_world_camera[:, :3, 3].numpy()
        rotation = frame_quaternions(journey).numpy()
        self._send(
            journey, entity, rerun.Transform3D.columns(translation=place, quaternion=rotation)
        )
        signs, K = journey.signs, camera.K
        count = polygon.corner_count(signs.shape).numpy()
        outline = [
            _closed(c[:n]) for c, n in zip(_pixels(K, signs.corners_ideal), count, strict=True)
        ]
        shapes = [polygon.SHAPES[k] for k in signs.shape.tolist()]
        label = [
            _code(k, type_names) or s for k, s in zip(signs.type.tolist(), shapes, strict=True)
        ]
        color = [color_of.get(row, _SEEN) for row in signs.row.tolist()]
        self._strips(journey, [*entity, "signs"], signs.frame, outline, label, color)
        points, lanes = journey.lane_points, journey.lanes
        lines = _cut(_pixels(K, points.ideal), points.detection.numpy(), len(lanes))
        names = [_code(k, LANE_TYPES) for k in lanes.type.tolist()]
        color = [_LANES.get(name, _MARKER) for name in names]
        self._strips(journey, [*entity, "lanes"], lanes.frame, lines, names, color)

    def _strips(
        self,
        journey: Journey,
        entity: list[str],
        frame: Int[Tensor, " d"],
        strips: Sequence[np.ndarray],
        labels: Sequence[str],
        colors: Sequence[int],
    ) -> None:
        """Lines in the image, those of one frame together; a frame without any shows none."""
        order = np.argsort(frame.numpy(), kind="stable")
        lengths = np.bincount(frame.numpy(), minlength=journey.frame_count)
        columns = self.rerun.LineStrips2D.columns(
            strips=[strips[k] for k in order],
            labels=[labels[k] for k in order],
            colors=_rgba([colors[k] for k in order]),
        )
        self._send(journey, entity, columns.partition(lengths))

    def _send(self, journey: Journey, entity: list[str], columns) -> None:
        """Columns with a row for each frame, on all timelines."""
        time, ns = self.rerun.TimeColumn, journey.t_ns.numpy()
        index = [
            time("frame", sequence=journey.frame_number.numpy()),
            time("time", timestamp=ns.astype("datetime64[ns]")),
            time("driven", duration=(ns - ns[:1]).astype("timedelta64[ns]")),
        ]
        name = self.rerun.new_entity_path(entity)
        self.rerun.send_columns(name, indexes=index, columns=columns, recording=self.stream)


def _colors_of_outcomes(scene: Scene) -> dict[str, dict[int, int]]:
    """Of every drive of a run the colours of detections that are not in the map, by row."""
    if scene.outcomes is None:
        return {}
    rows, found = scene.outcomes.rows, scene.outcomes
    lost = (rows.sign < 0) | rows.given_up
    colors: dict[str, dict[int, int]] = {}
    for journey, row in zip(rows.journey[lost].tolist(), rows.row[lost].tolist(), strict=True):
        colors.setdefault(found.journey_id[journey], {})[row] = _OFF
    return colors


def _rgba(colors: Sequence[int]) -> np.ndarray:
    return np.array(colors, dtype=np.uint32)


def _code(code: int, names: Sequence[str]) -> str:
    return names[code] if code >= 0 else ""


def _closed(corners: np.ndarray) -> np.ndarray:
    return np.concatenate((corners, corners[:1]))


def _cut(points: np.ndarray, line: np.ndarray, count: int) -> list[np.ndarray]:
    """The points of each line; `line` does not decrease."""
    return np.split(points, np.searchsorted(line, np.arange(1, count))) if count else []


def _pixels(K: Float[Tensor, "3 3"], ideal: Float[Tensor, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
    """Where a camera without distortion has points of the plane z = 1."""
    return (ideal @ K[:2, :2].T + K[:2, 2]).numpy()


def _ellipsoids(covariance: Float[Tensor, "n 3 3"]) -> tuple[np.ndarray, np.ndarray]:
    """Half axes of the 95 % ellipsoids [m], and how they are turned, as quaternions."""
    variance, axes = torch.linalg.eigh(covariance)
    # Eigenvectors are free in sign: a rotation is right-handed.
    axes = axes * torch.linalg.det(axes)[:, None, None]
    return _CHI95 * variance.clamp_min(0).sqrt().numpy(), se3.to_quaternion(axes).numpy()
