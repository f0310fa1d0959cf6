from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from worlds import foreign

from crowdmap_torch.geometry import polygon
from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.formats.composing.parts import Asked, Parts
from crowdmap_torch.io.formats.importers import openlabel
from crowdmap_torch.tables import LANE_TYPES

OBJECTS = {
    "a": {"name": "sign1", "type": "regulatory--stop--g1"},
    "b": {"name": "sign2", "type": "diamond"},
    "c": {"name": "line1", "type": "dashed"},
}


def frame(**data: Any) -> dict[str, Any]:
    return {"objects": {uid: {"object_data": inside} for uid, inside in data.items()}}


def poly(*val: float, closed: bool, **more: Any) -> dict[str, Any]:
    return {"poly2d": [{"name": "p", "val": list(val), "closed": closed} | more]}


def content(frames: dict[str, Any]) -> dict[str, Any]:
    return {
        "openlabel": {"metadata": {"schema_version": "1.0.0"}, "objects": OBJECTS, "frames": frames}
    }


def read(folder: Path, frames: dict[str, Any], **asked: Any) -> Parts:
    path = foreign.write_json(folder / "labels.json", content(frames))
    return openlabel.read((path,), Asked(**asked))


def test_boxes_polygons_and_lines_become_detections(tmp_path: Path):
    streams = {"front": {"stream_properties": {}, "uri": "front/0007.png"}}
    frames = {
        "0": frame(
            a={"bbox": [{"name": "box", "val": [115.5, 220.5, 30, 40]}]},
            c=poly(1, 2, 3, 4, closed=False),
        ),
        "7": {
            "frame_properties": {"streams": streams},
            **frame(b=poly(5, 0, 0, 5, 5, 10, 10, 5, closed=True)),
        },
        "8": {},
    }
    parts = read(tmp_path, frames)
    signs, lanes = parts.signs, parts.lanes
    assert signs is not None and lanes is not None
    assert signs.images == lanes.images == ("0", "front/0007.png", "8")
    assert signs.image.tolist() == [0, 1]
    assert signs.shape.tolist() == [polygon.OCTAGON, polygon.DIAMOND]
    np.testing.assert_allclose(
        (signs.corners_px[0].min(0), signs.corners_px[0].max(0)), ((100, 200), (130, 240))
    )
    # It ran anticlockwise.
    assert signs.corners_px[1, :4].tolist() == [[10, 5], [5, 10], [0, 5], [5, 0]]
    assert signs.track.tolist() == [0, 1]
    assert lanes.px.tolist() == [[1, 2], [3, 4]]
    assert lanes.type.tolist() == [LANE_TYPES.index("dashed")]


def test_cameras_are_told_apart(tmp_path: Path):
    lines = {
        "poly2d": [
            {"name": "p", "val": [1, 2, 3, 4], "closed": False, "coordinate_system": camera}
            for camera in ("front", "rear")
        ]
    }
    frames = {"0": frame(c=lines)}
    with pytest.raises(
        InputError, match="2 coordinate systems; say whose by --camera, one of front, rear"
    ):
        read(tmp_path, frames)
    parts = read(tmp_path, frames, camera="rear")
    assert parts.lanes is not None and len(parts.lanes.image) == 1


@pytest.mark.parametrize(
    ("frames", "expected"),
    [
        ({"0": frame(z={})}, r"frames.0.objects.z: no such object"),
        ({"0": frame(a=poly(1, 2, 3, closed=True))}, r"poly2d\[0\].val: 3 numbers; expected pairs"),
        (
            {"0": frame(a=poly(1, 2, 3, 4, closed=True))},
            "2 corners of a regulatory--stop--g1, whose shape has 8",
        ),
        (
            {"0": frame(a=poly(1, 2, closed=True, mode="MODE_POLY2D_SRF6DCC"))},
            "expected MODE_POLY2D_ABSOLUTE",
        ),
        (
            {"0": frame(c={"poly2d": [{"val": [1, 2], "closed": 1}]})},
            "closed: expected true or false",
        ),
        (
            {"0": frame(a={"bbox": [{"val": [1, 2, 0, 4]}]})},
            "expected a width and a height above 0",
        ),
        ({"0": frame(a={"bbox": {}})}, "bbox: expected a list"),
    ],
)
def test_a_file_with_a_mistake_is_refused(tmp_path: Path, frames: dict, expected: str):
    with pytest.raises(InputError, match=expected):
        read(tmp_path, frames)
