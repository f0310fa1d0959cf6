from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from worlds import foreign

from crowdmap_torch.geometry import polygon
from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.formats.composing.parts import Asked, Parts
from crowdmap_torch.io.formats.importers import coco


def read(folder: Path, *contents: object, **asked: Any) -> Parts:
    paths = [foreign.write_json(folder / f"{k}.json", c) for k, c in enumerate(contents)]
    return coco.read(tuple(paths), Asked(**asked))


def annotation(**changes: Any) -> dict[str, Any]:
    return {"image_id": 10, "category_id": 1, "bbox": [100, 100, 20, 20]} | changes


def test_lists_of_detections_belong_to_the_images_of_the_first_file(tmp_path: Path):
    content = foreign.coco()
    del content["annotations"]
    parts = read(tmp_path, content, [annotation(score=0.25)], [annotation(image_id=15)])
    assert parts.signs is not None
    assert parts.signs.images == foreign.IMAGES
    assert parts.signs.image.tolist() == [0, 5]
    assert parts.signs.shape.tolist() == [polygon.OCTAGON] * 2
    assert parts.signs.size_px == (640, 480)


def test_what_is_no_whole_sign_is_left_out_and_counted(tmp_path: Path):
    annotations = [
        annotation(bbox=[0, 100, 20, 20]),
        annotation(bbox=[100, 459.5, 20, 20]),
        annotation(iscrowd=1),
        annotation(category_id=2, keypoints=[1, 1, 2, 2, 2, 0, 3, 3, 2]),
        annotation(category_id=3),
    ]
    categories = [*foreign.coco()["categories"], {"id": 3, "name": "regulatory--no-entry--g1"}]
    parts = read(tmp_path, foreign.coco(annotations=annotations, categories=categories))
    assert parts.signs is not None and not len(parts.signs.image)
    assert parts.notes == (
        "2 signs left out: whose boxes end at the border of the image",
        "1 signs left out: marked as crowds",
        "1 signs left out: without the place of every corner",
        "1 signs left out: of class 'regulatory--no-entry--g1', whose plate is none of the mapped shapes",
    )


def test_classes_that_no_table_has_are_asked_for_or_left_out(tmp_path: Path):
    categories = [{"id": 1, "name": "stop-ish"}, {"id": 2, "name": "regulatory--yield--g1"}]
    content = foreign.coco(categories=categories)
    with pytest.raises(InputError, match=r"class 'stop-ish' \(1\) look like.*--sign-names"):
        read(tmp_path, content)
    parts = read(tmp_path, content, skip_unknown_signs=True)
    assert parts.signs is not None and len(parts.signs.image) == 1
    assert parts.notes == ("1 signs left out: of 1 classes that no table has",)


@pytest.mark.parametrize(("origin", "left"), [(None, 100.0), ("corner", 100.0), ("centre", 100.5)])
def test_boxes_count_from_the_corner_of_the_first_pixel(
    tmp_path: Path, origin: str | None, left: float
):
    parts = read(tmp_path, foreign.coco(), pixel_origin=origin)
    assert parts.signs is not None
    assert parts.signs.corners_px[0, :, 0].min() == pytest.approx(left)


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ([], "a list of detections; expected the file with their images"),
        (foreign.coco(images={}), "images: expected a list"),
        (
            foreign.coco(annotations=[annotation(image_id=9)]),
            r"annotations\[0\].image_id: no such image",
        ),
        (foreign.coco(annotations=[annotation(category_id=9)]), "category_id: no such category"),
        (
            foreign.coco(annotations=[annotation(bbox=[1, 2, 3])]),
            "bbox: expected a list of 4 numbers",
        ),
        (
            foreign.coco(annotations=[annotation(bbox=[1, 2, 3, 0])]),
            "bbox: expected u v width height",
        ),
        (foreign.coco(annotations=[annotation(score=2)]), "score: expected a number in 0 to 1"),
        (
            foreign.coco(annotations=[annotation(keypoints=[1, 1, 2, 2, 2, 2, 3, 3, 2])]),
            "3 keypoints of class 'regulatory--stop--g1', whose shape has 8 corners",
        ),
        (
            foreign.coco(
                images=[
                    *foreign.coco()["images"],
                    {"id": 1, "file_name": "x", "width": 1, "height": 2},
                ]
            ),
            r"images\[6\]: an image of 1 x 2 px among others",
        ),
        (foreign.coco(images=foreign.coco()["images"] * 2), r"images\[6\].id: 10 is there twice"),
    ],
)
def test_a_file_with_a_mistake_is_refused(tmp_path: Path, content: object, expected: str):
    with pytest.raises(InputError, match=expected):
        read(tmp_path, content)
