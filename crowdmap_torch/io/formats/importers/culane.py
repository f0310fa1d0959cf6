"""Lane markers in the form of CULane: for every image a file `NAME.lines.txt`, a line `u v u v ...` for each marker."""

from __future__ import annotations

from pathlib import Path

from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.formats.composing.lines import read_lines
from crowdmap_torch.io.formats.composing.marker_rows import MarkerCollector
from crowdmap_torch.io.formats.composing.parts import Asked, Importer, Parts
from crowdmap_torch.io.formats.composing.sources import the_one

_ENDING = ".lines.txt"


def read(sources: tuple[Path, ...], asked: Asked) -> Parts:
    """The lane markers of a folder and those below; an empty file is an image without any."""
    folder = the_one(sources, f"a folder with files NAME{_ENDING}")
    files = sorted(folder.rglob(f"*{_ENDING}"))
    if not files:
        raise InputError(f"{folder}: has no files NAME{_ENDING}; expected one for each image")
    collector = MarkerCollector(folder, asked.pixel_origin)
    for path in files:
        name = path.relative_to(folder).as_posix().removesuffix(_ENDING)
        image = collector.image(f"{name}.jpg")
        for line in read_lines(path):
            if len(line.cells) % 2:
                raise line.fault(f"{len(line.cells)} numbers; expected pairs u v")
            numbers = [line.real(k, "uv"[k % 2]) for k in range(len(line.cells))]
            collector.add(image, list(zip(numbers[::2], numbers[1::2], strict=True)))
    markers, notes = collector.rows()
    return Parts(lanes=markers, notes=notes)


IMPORTER = Importer(
    summary="lane markers of CULane: a folder of NAME.lines.txt with lines of u v u v ...",
    gives=("lanes",),
    tested_on="small files after the published layout",
    read=read,
)
