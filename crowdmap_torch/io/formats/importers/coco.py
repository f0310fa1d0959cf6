"""Signs in the form of COCO: boxes, or keypoints where they are the corners of the plate.

The first source holds `images`, `categories` and, if it is an annotation file, `annotations`; further ones are lists of
detections (COCO's results format). A class' name says the shape (`sign_names`). Keypoints are the corners, in either sense
of rotation; a box is filled by the upright shape, which is right for signs that face the camera and nearly so for others.
Boxes are counted from the corner of the first pixel, keypoints from its centre, unless `--pixel-origin` says otherwise.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float

from crowdmap_torch.io.documents import Document, read_json_content
from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.formats.composing.outlines import (
    BORDER_PX,
    HALF_PIXEL,
    SignCollector,
    clockwise,
    corner_count,
    in_box,
)
from crowdmap_torch.io.formats.composing.parts import Asked, Importer, Parts
from crowdmap_torch.io.formats.composing.sign_names import SignName, read_sign_names

_MOST_ID = 2**61
_MOST_PX = 1e6


def read(sources: tuple[Path, ...], asked: Asked) -> Parts:
    """The signs of an annotation file, and of lists of detections in its images."""
    content = read_json_content(sources[0])
    if isinstance(content, list):
        raise InputError(
            f"{sources[0]}: a list of detections; expected the file with their images and categories "
            "before it: --from coco IMAGES.json DETECTIONS.json"
        )
    head = Document(sources[0], content)
    reader = _Reader(head, asked)
    if len(sources) == 1 or "annotations" in head.content:
        for entry in _entries(head, "annotations"):
            reader.take(entry)
    for path in sources[1:]:
        listed = read_json_content(path)
        if not isinstance(listed, list):
            raise InputError(f"{path}: expected a list of detections (COCO's results format)")
        for number, one in enumerate(listed):
            reader.take(Document(path, one, f"[{number}]"))
    rows, notes = reader.collector.rows(reader.size_px)
    if reader.in_boxes:
        notes = (f"{reader.in_boxes} outlines are their shapes drawn into boxes", *notes)
    return Parts(signs=rows, notes=notes)


class _Reader:
    """Takes annotations one by one."""

    def __init__(self, head: Document, asked: Asked) -> None:
        names = read_sign_names(asked.sign_names)
        self.collector = SignCollector(head.path, names, asked.skip_unknown_signs)
        self.asked = asked
        self.in_boxes = 0
        self.size_px: tuple[int, int] | None = None
        self._image: dict[int, int] = {}
        for entry in _entries(head, "images"):
            self._add_image(entry)
        self._category = {
            entry.integer("id", low=-_MOST_ID, high=_MOST_ID): entry.text("name")
            for entry in _entries(head, "categories")
        }

    def take(self, entry: Document) -> None:
        """Takes one annotation or detection in, or counts why not."""
        image = self._image.get(entry.integer("image_id", low=-_MOST_ID, high=_MOST_ID))
        if image is None:
            raise entry.fault("no such image in `images`", "image_id")
        category = self._category.get(entry.integer("category_id", low=-_MOST_ID, high=_MOST_ID))
        if category is None:
            raise entry.fault("no such category in `categories`", "category_id")
        name = self.collector.shape_of(category)
        if name is None:
            return
        if entry.content.get("iscrowd"):
            self.collector.leave_out("marked as crowds")
            return
        corners = self._corners(entry, name, category)
        if corners is None:
            return
        score, track = float("nan"), -1
        if entry.content.get("score") is not None:
            score = entry.number("score", low=0, high=1)
        if entry.content.get("track_id") is not None:
            track = entry.integer("track_id", low=-1, high=_MOST_ID)
        self.collector.add(image, name, corners, score=score, track=track)

    def _add_image(self, entry: Document) -> None:
        size = (
            entry.integer("width", low=1, high=10**6),
            entry.integer("height", low=1, high=10**6),
        )
        if self.size_px not in (None, size):
            raise entry.fault(
                f"an image of {size[0]} x {size[1]} px among others of {self.size_px}; expected those of "
                "one camera: give each camera's images a file of their own"
            )
        self.size_px = size
        number = entry.integer("id", low=-_MOST_ID, high=_MOST_ID)
        if number in self._image:
            raise entry.fault(f"{number} is there twice; expected each image once", "id")
        name = entry.text("file_name")
        if name in self.collector.images:
            raise entry.fault(f"{name!r} is there twice; expected each image once", "file_name")
        self._image[number] = self.collector.image(name)

    def _corners(
        self, entry: Document, name: SignName, category: str
    ) -> Float[np.ndarray, "8 2"] | None:
        """Corners as FORMAT.md has pixels; None, counted, for what is no whole sign."""
        assert name.shape is not None and self.size_px is not None
        if entry.content.get("keypoints") and entry.content.get("num_keypoints", 1):
            points = np.array(entry.numbers("keypoints", most=_MOST_PX))
            if len(points) != 3 * corner_count(name.shape):
                raise entry.fault(
                    f"{len(points) / 3:g} keypoints of class {category!r}, whose shape has "
                    f"{corner_count(name.shape)} corners; expected u v visibility for each of them, or "
                    "no keypoints and a bbox",
                    "keypoints",
                )
            points = points.reshape(-1, 3)
            if (points[:, 2] == 0).any():
                self.collector.leave_out("without the place of every corner")
                return None
            shift = HALF_PIXEL if self.asked.pixel_origin == "corner" else 0.0
            return clockwise(points[:, :2] - shift)
        box = np.array(entry.numbers("bbox", 4, most=_MOST_PX))
        if not (box[2:] > 0).all():
            raise entry.fault(f"expected u v width height with a size above 0, found {box}", "bbox")
        if self.asked.pixel_origin != "centre":
            box[:2] -= HALF_PIXEL
        low, high = box[:2] + 0.5, box[:2] + box[2:] + 0.5
        if (low < BORDER_PX).any() or (high > np.array(self.size_px) - BORDER_PX).any():
            self.collector.leave_out("whose boxes end at the border of the image")
            return None
        self.in_boxes += 1
        return in_box(name.shape, box)


def _entries(head: Document, key: str) -> list[Document]:
    listed = head.take(key)
    if not isinstance(listed, list):
        raise head.fault("expected a list", key)
    return [Document(head.path, one, f"{key}[{number}]") for number, one in enumerate(listed)]


IMPORTER = Importer(
    summary="signs as COCO's boxes or keypoints, classes named as by Mapillary or in your own table",
    gives=("signs",),
    tested_on="small files after the published layout",
    read=read,
)
