"""Drives and surveys as features of geographic formats, beside those of maps (`features`)."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float

from crowdmap_torch.geometry import polygon
from crowdmap_torch.geometry.trajectory import station
from crowdmap_torch.io.formats.exporters.features import Layer, geographic, layers
from crowdmap_torch.tables import LANE_TYPES, Dataset, HdMap, Journey, Survey


def layers_of(what: HdMap | Dataset | Survey) -> tuple[Layer, ...]:
    """Layers of a map (`signs`, `plates`, `lanes`), of a dataset (`drives`, `frames`) or of a survey.

    TypeError for anything else.
    """
    if isinstance(what, HdMap):
        return layers(what)
    if isinstance(what, Dataset):
        return _drives(what), _frames(what)
    if isinstance(what, Survey):
        return _survey_layers(what)
    raise TypeError(f"expected a map, a dataset or a survey, found {type(what).__name__}")


def _drives(dataset: Dataset) -> Layer:
    """A line for each journey."""
    # A line has two points at least.
    positions = [_positions(j) for j in dataset.journeys]
    lines = [p if len(p) > 1 else p.repeat(2, axis=0) for p in positions]
    return Layer(
        "drives",
        "LineString",
        tuple(j.journey_id for j in dataset.journeys),
        geographic(lines, dataset.origin),
        {
            "journey_id": [j.journey_id for j in dataset.journeys],
            "vehicle": [j.vehicle for j in dataset.journeys],
            "rig": [j.rig.rig_id for j in dataset.journeys],
            "frames": [j.frame_count for j in dataset.journeys],
            "length_m": [float(station(j.T_world_camera)[-1]) for j in dataset.journeys],
            "first_ns": [int(j.t_ns[0]) for j in dataset.journeys],
            "last_ns": [int(j.t_ns[-1]) for j in dataset.journeys],
            "sign_detections": [len(j.signs) for j in dataset.journeys],
            "lane_detections": [len(j.lanes) for j in dataset.journeys],
        },
        {},
    )


def _frames(dataset: Dataset) -> Layer:
    """A point for each frame."""
    position = np.concatenate([_positions(j) for j in dataset.journeys])
    seen = {
        f"{kind}_detections": [
            count
            for j, table in ((j, getattr(j, f"{kind}s")) for j in dataset.journeys)
            for count in torch.bincount(table.frame.cpu(), minlength=j.frame_count).tolist()
        ]
        for kind in ("sign", "lane")
    }
    number = [n for j in dataset.journeys for n in j.frame_number.tolist()]
    journey = [j.journey_id for j in dataset.journeys for _ in range(j.frame_count)]
    return Layer(
        "frames",
        "Point",
        tuple(f"{name}:{n}" for name, n in zip(journey, number, strict=True)),
        geographic([*position[:, None]], dataset.origin),
        {
            "journey_id": journey,
            "frame": number,
            "t_ns": [t for j in dataset.journeys for t in j.t_ns.tolist()],
            **{a: position[:, k].tolist() for k, a in enumerate("xyz")},
            **seen,
        },
        {},
    )


def _survey_layers(survey: Survey) -> tuple[Layer, ...]:
    signs, points = survey.signs.to("cpu"), survey.lane_points.to("cpu")
    shapes = [polygon.SHAPES[code] for code in signs.shape.tolist()]
    center = signs.center_world.detach().numpy()
    rows = torch.nonzero(signs.has_corners)[:, 0].tolist()
    mask = polygon.corner_mask(signs.shape)
    corners = [signs.corners_world[k][mask[k]].numpy() for k in rows]
    lanes = range(len(survey.lane_id))
    lines = [points.point_world[points.lane == k].numpy() for k in lanes]
    of_signs = {
        "sign_id": list(survey.sign_id),
        "shape": shapes,
        "sigma_m": signs.sigma.tolist(),
        **{a: center[:, k].tolist() for k, a in enumerate("xyz")},
    }
    plates = tuple(f"{survey.sign_id[k]}:plate" for k in rows)
    of_plates = {"sign_id": [survey.sign_id[k] for k in rows], "shape": [shapes[k] for k in rows]}
    types = [None if code < 0 else LANE_TYPES[code] for code in survey.lane_type.tolist()]
    of_lanes = {"lane_id": list(survey.lane_id), "type": types}

    def layer(name: str, kind: str, ids: tuple[str, ...], place: list, columns: dict) -> Layer:
        return Layer(name, kind, ids, geographic(place, survey.origin), columns, {})

    return (
        layer("signs", "Point", survey.sign_id, [*center[:, None]], of_signs),
        layer("plates", "Polygon", plates, corners, of_plates),
        layer("lanes", "LineString", survey.lane_id, lines, of_lanes),
    )


def _positions(journey: Journey) -> Float[np.ndarray, "f 3"]:
    return journey.T_world_camera[:, :3, 3].cpu().numpy()
