"""Lane markers in the form of TuSimple: a JSON object a line, columns of each marker at common rows of the image.

`{"raw_file": NAME, "lanes": [[u, ...], ...], "h_samples": [v, ...]}`; a negative u says that the marker is not at that row.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

from crowdmap_torch.io.budget import read_text
from crowdmap_torch.io.documents import Document
from crowdmap_torch.io.errors import InputError, one_line
from crowdmap_torch.io.formats.composing.marker_rows import MarkerCollector
from crowdmap_torch.io.formats.composing.parts import Asked, Importer, Parts
from crowdmap_torch.io.formats.composing.sources import the_one

_MOST_PX = 1e6


def read(sources: tuple[Path, ...], asked: Asked) -> Parts:
    """The lane markers of one file."""
    path = the_one(sources, "a file with a JSON object a line")
    collector = MarkerCollector(path, asked.pixel_origin)
    for entry in _objects(path):
        name = entry.text("raw_file")
        if name in collector.images:
            raise entry.fault(f"{name!r} is there twice; expected each image once", "raw_file")
        image = collector.image(name)
        rows = entry.numbers("h_samples", most=_MOST_PX)
        lanes = entry.take("lanes")
        if not isinstance(lanes, list):
            raise entry.fault("expected a list of lists", "lanes")
        for number, marker in enumerate(lanes):
            key = f"lanes[{number}]"
            columns = Document(path, {key: marker}, entry.section).numbers(key, most=_MOST_PX)
            if len(columns) != len(rows):
                raise entry.fault(
                    f"{len(columns)} values for {len(rows)} rows of h_samples; expected as many",
                    key,
                )
            points = [(u, v) for u, v in zip(columns, rows, strict=True) if u >= 0]
            collector.add(image, points)
    markers, notes = collector.rows()
    return Parts(lanes=markers, notes=notes)


def _objects(path: Path) -> Iterator[Document]:
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        if not line.strip():
            continue
        try:
            content = json.loads(line)
        except (ValueError, RecursionError) as error:
            raise InputError(
                f"{path}: line {number}: cannot be read as JSON ({one_line(error)}); expected one object "
                "a line"
            ) from error
        yield Document(path, content, f"line {number}")


IMPORTER = Importer(
    summary="lane markers of TuSimple: a JSON object a line with raw_file, lanes, h_samples",
    gives=("lanes",),
    tested_on="small files after the published layout",
    read=read,
)
