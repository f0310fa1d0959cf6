"""Signs and lane markers in the form of ASAM OpenLABEL 1.0: of the objects in frames, boxes and polygons of the image.

`bbox` (centre, width, height) and closed `poly2d` are signs, whose object's `type` says the shape (`sign_names`); open
`poly2d` are lane markers, of the type that the object's is if it is one of ours. An image's name is the `uri` of its stream
in the frame, else the frame's number. Objects keep their identity as tracks. Where a file has several cameras, `--camera`
says whose data are taken: their `coordinate_system`. Pixels count from centres, boxes from the corner of the first pixel,
unless `--pixel-origin` says otherwise.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from crowdmap_torch.io.documents import Document, read_json
from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.formats.composing.marker_rows import MarkerCollector
from crowdmap_torch.io.formats.composing.outlines import (
    HALF_PIXEL,
    SignCollector,
    clockwise,
    corner_count,
    in_box,
)
from crowdmap_torch.io.formats.composing.parts import Asked, Importer, Parts
from crowdmap_torch.io.formats.composing.sign_names import SignName, read_sign_names
from crowdmap_torch.io.formats.composing.sources import the_one
from crowdmap_torch.tables import LANE_TYPES

_MOST_PX = 1e6
_ABSOLUTE = "MODE_POLY2D_ABSOLUTE"


def read(sources: tuple[Path, ...], asked: Asked) -> Parts:
    """The signs and lane markers of one file."""
    path = the_one(sources, "an OpenLABEL file")
    head = read_json(path).part("openlabel")
    reader = _Reader(path, head, asked)
    frames = head.part("frames")
    for key in frames.content:
        reader.take(key, frames.part(key))
    if len(reader.cameras) > 1:
        raise InputError(
            f"{path}: has data of {len(reader.cameras)} coordinate systems; say whose by --camera, one of "
            f"{', '.join(sorted(reader.cameras))}"
        )
    signs, notes = reader.signs.rows(None)
    lanes, more = reader.markers.rows()
    return Parts(signs=signs, lanes=lanes, notes=notes + more)


class _Reader:
    """Takes frames one by one."""

    def __init__(self, path: Path, head: Document, asked: Asked) -> None:
        self.asked = asked
        self.signs = SignCollector(
            path, read_sign_names(asked.sign_names), asked.skip_unknown_signs
        )
        self.markers = MarkerCollector(path, asked.pixel_origin)
        self.cameras: set[str] = set()
        """Coordinate systems of what was taken, where it says one."""
        self._objects = head.part("objects")
        self._track = {uid: k for k, uid in enumerate(self._objects.content)}

    def take(self, key: str, frame: Document) -> None:
        """Takes in what stands in a frame."""
        name = self._image_name(key, frame)
        if name in self.signs.images:
            raise frame.fault(f"image {name!r} is that of another frame too; expected each once")
        image = self.signs.image(name), self.markers.image(name)
        if "objects" not in frame.content:
            return
        objects = frame.part("objects")
        for uid in objects.content:
            if uid not in self._objects.content:
                raise objects.fault("no such object in openlabel.objects", uid)
            kind = self._objects.part(uid).text("type")
            own = objects.part(uid)
            if "object_data" in own.content:
                self._take_object(image, kind, self._track[uid], own.part("object_data"))

    def _take_object(self, image: tuple[int, int], kind: str, track: int, inside: Document) -> None:
        of_signs, of_markers = image
        for box in self._own(inside, "bbox"):
            if (name := self.signs.shape_of(kind)) is not None:
                self._take_box(of_signs, name, track, box)
        for line in self._own(inside, "poly2d"):
            if line.content.get("mode", _ABSOLUTE) != _ABSOLUTE:
                raise line.fault(f"expected {_ABSOLUTE}, found {line.content['mode']!r}", "mode")
            numbers = line.numbers("val", most=_MOST_PX)
            if len(numbers) % 2:
                raise line.fault(f"{len(numbers)} numbers; expected pairs", "val")
            points = np.array(numbers).reshape(-1, 2)
            closed = line.take("closed")
            if not isinstance(closed, bool):
                raise line.fault("expected true or false", "closed")
            if not closed:
                code = LANE_TYPES.index(kind) if kind in LANE_TYPES else -1
                self.markers.add(of_markers, points.tolist(), type_code=code)
            elif (name := self.signs.shape_of(kind)) is not None:
                assert name.shape is not None
                if len(points) != corner_count(name.shape):
                    raise line.fault(
                        f"{len(points)} corners of a {kind}, whose shape has {corner_count(name.shape)}"
                    )
                shift = HALF_PIXEL if self.asked.pixel_origin == "corner" else 0.0
                self.signs.add(of_signs, name, clockwise(points - shift), track=track)

    def _take_box(self, image: int, name: SignName, track: int, box: Document) -> None:
        assert name.shape is not None
        u, v, width, height = box.numbers("val", 4, most=_MOST_PX)
        if not (width > 0 and height > 0):
            raise box.fault("expected a width and a height above 0", "val")
        shift = 0.0 if self.asked.pixel_origin == "centre" else HALF_PIXEL
        corner = np.array([u - width / 2 - shift, v - height / 2 - shift, width, height])
        self.signs.add(image, name, in_box(name.shape, corner), track=track)

    def _own(self, inside: Document, kind: str) -> Iterator[Document]:
        """Boxes or polygons of the camera that was asked for."""
        listed = inside.content.get(kind, [])
        if not isinstance(listed, list):
            raise inside.fault("expected a list", kind)
        for number, one in enumerate(listed):
            entry = Document(inside.path, one, f"{inside.section}.{kind}[{number}]")
            camera = entry.content.get("coordinate_system")
            if self.asked.camera is not None and camera != self.asked.camera:
                continue
            if isinstance(camera, str):
                self.cameras.add(camera)
            yield entry

    def _image_name(self, key: str, frame: Document) -> str:
        """The `uri` of the camera's stream, if the frame has one."""
        properties = frame.content.get("frame_properties")
        if not isinstance(properties, dict) or "streams" not in properties:
            return key
        streams = frame.part("frame_properties").part("streams")
        for stream in streams.content:
            if self.asked.camera in (None, stream):
                own = streams.part(stream).content
                inside = own.get("stream_properties", {})
                uri = own.get("uri", inside.get("uri") if isinstance(inside, dict) else None)
                if isinstance(uri, str) and uri:
                    return uri
        return key


IMPORTER = Importer(
    summary="signs and lane markers in ASAM OpenLABEL 1.0: bbox and poly2d of objects in frames",
    gives=("signs", "lanes"),
    tested_on="small files after the published layout",
    read=read,
)
