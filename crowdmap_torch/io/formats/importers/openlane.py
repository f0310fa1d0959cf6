"""Lane markers of OpenLane: a folder with a JSON file for each image, in which lines have `uv` and `category`.

Pixels `uv` are two lists, columns and rows. What the data set has in 3D (`xyz`, `extrinsic`, `pose`) is not used: maps are
made of what the camera saw.
"""

from __future__ import annotations

from pathlib import Path

from crowdmap_torch.io.documents import Document, read_json
from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.formats.composing.marker_rows import MarkerCollector
from crowdmap_torch.io.formats.composing.parts import Asked, Importer, Parts
from crowdmap_torch.io.formats.composing.sources import the_one
from crowdmap_torch.tables import LANE_TYPES

_TYPES = {
    **dict.fromkeys((1, 7), "dashed"),
    **dict.fromkeys((2, 8), "solid"),
    **dict.fromkeys((3, 4, 5, 6, 9, 10, 11, 12), "double"),
    **dict.fromkeys((20, 21), "curb"),
}
"""White and yellow ones alike, by `category`; what is not here is unknown."""
_MOST_PX = 1e6


def read(sources: tuple[Path, ...], asked: Asked) -> Parts:
    """The lane markers of a folder and those below."""
    folder = the_one(sources, "a folder with a JSON file for each image")
    files = sorted(folder.rglob("*.json"))
    if not files:
        raise InputError(f"{folder}: has no JSON files; expected one for each image")
    collector = MarkerCollector(folder, asked.pixel_origin)
    for path in files:
        head = read_json(path)
        name = head.text("file_path")
        if name in collector.images:
            raise head.fault(
                f"{name!r} is that of another file too; expected each once", "file_path"
            )
        image = collector.image(name)
        listed = head.take("lane_lines")
        if not isinstance(listed, list):
            raise head.fault("expected a list", "lane_lines")
        for number, one in enumerate(listed):
            line = Document(path, one, f"lane_lines[{number}]")
            kind = _TYPES.get(line.integer("category", low=0, high=1000))
            code = -1 if kind is None else LANE_TYPES.index(kind)
            collector.add(image, _points(line), type_code=code)
    markers, notes = collector.rows()
    return Parts(lanes=markers, notes=notes)


def _points(line: Document) -> list[tuple[float, float]]:
    pair = line.take("uv")
    if not isinstance(pair, list) or len(pair) != 2:
        raise line.fault("expected two lists, columns and rows", "uv")
    sides = Document(line.path, {"uv[0]": pair[0], "uv[1]": pair[1]}, line.section)
    u, v = (sides.numbers(key, most=_MOST_PX) for key in ("uv[0]", "uv[1]"))
    if len(u) != len(v):
        raise line.fault(f"{len(u)} columns and {len(v)} rows; expected as many", "uv")
    return list(zip(u, v, strict=True))


IMPORTER = Importer(
    summary="lane markers of OpenLane: a folder of JSON files with lane_lines",
    gives=("lanes",),
    tested_on="small files after the published layout",
    read=read,
)
