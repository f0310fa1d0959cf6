"""What signs of a detector's classes look like: names to shapes, traffic-sign codes and sizes.

The package's own table is `sign_names.csv` beside this file; `--sign-names FILE` adds to it and changes it. Columns (or, in
YAML, keys under each name): `name`, `shape` (one of `polygon.SHAPES`, or `none` for plates that cannot be mapped, such as
round ones), and optionally `code`, `width_m`, `height_m`. Without a code the name itself is the code, `-` is none. The
package's table holds Mapillary's names of plates that look the same wherever they stand, numbers of the US and of Germany,
and the shapes by their own names.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib import resources
from pathlib import Path

from crowdmap_torch.geometry import polygon
from crowdmap_torch.io.documents import Document, read_yaml
from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.formats.composing.lines import Line, read_table

NO_SHAPE, NO_CODE = "none", "-"
_COLUMNS = ("name", "shape", "code", "width_m", "height_m")
_LARGEST_M = 100.0


@dataclass(frozen=True)
class SignName:
    """What a name stands for."""

    shape: int | None
    """Index into `polygon.SHAPES`; None for plates that cannot be mapped."""
    code: str | None = None
    size_m: tuple[float, float] | None = None
    """Width and height in which it is made."""


def read_sign_names(extra: Path | None = None) -> dict[str, SignName]:
    """The package's table, with a user's CSV or YAML over it."""
    with resources.as_file(
        resources.files("crowdmap_torch.io.formats.composing") / "sign_names.csv"
    ) as own:
        names = _read_csv(own)
    if extra is not None:
        is_yaml = extra.suffix.lower() in (".yaml", ".yml")
        names |= _read_yaml(extra) if is_yaml else _read_csv(extra)
    return names


def _read_csv(path: Path) -> dict[str, SignName]:
    head, lines = read_table(path)
    for column in head:
        if column not in _COLUMNS:
            raise InputError(
                f"{path}: column {column!r} is unknown; expected {', '.join(_COLUMNS)}"
            )
    for column in _COLUMNS[:2]:
        if column not in head:
            raise InputError(f"{path}: column {column!r} is missing; expected name and shape")
    found: dict[str, SignName] = {}
    for line in lines:
        cells = dict(zip(head, line.cells, strict=True))
        if cells["name"] in found:
            raise line.fault(f"name {cells['name']!r} is there twice; expected it once")
        shape = cells["shape"]
        if shape not in (*polygon.SHAPES, NO_SHAPE):
            raise line.fault(_shape_rule(shape))
        size = [_csv_size(line, head, column) for column in _COLUMNS[3:] if cells.get(column)]
        if len(size) == 1:
            raise line.fault("expected both width_m and height_m, or neither")
        found[cells["name"]] = _sign_name(cells["name"], shape, cells.get("code") or None, size)
    return found


def _csv_size(line: Line, head: tuple[str, ...], column: str) -> float:
    value = line.real(head.index(column), column)
    if not 0 < value <= _LARGEST_M:
        raise line.fault(f"{column}: expected metres above 0, {_LARGEST_M:g} at most")
    return value


def _read_yaml(path: Path) -> dict[str, SignName]:
    document = read_yaml(path)
    found = {}
    for name in document.content:
        if not isinstance(name, str):
            raise document.fault(f"name {name!r} is no text; put it into quotes")
        entry = document.part(name)
        entry.allow(("shape",), ("code", "width_m", "height_m"))
        shape = entry.text("shape")
        if shape not in (*polygon.SHAPES, NO_SHAPE):
            raise entry.fault(_shape_rule(shape), "shape")
        found[name] = _sign_name(name, shape, _yaml_code(entry), _yaml_size(entry))
    return found


def _yaml_code(entry: Document) -> str | None:
    return entry.text("code") if entry.content.get("code") is not None else None


def _yaml_size(entry: Document) -> list[float]:
    given = [name for name in _COLUMNS[3:] if entry.content.get(name) is not None]
    if len(given) == 1:
        raise entry.fault("expected both width_m and height_m, or neither")
    return [entry.number(name, low=1e-3, high=_LARGEST_M) for name in given]


def _sign_name(name: str, shape: str, code: str | None, size: list[float]) -> SignName:
    place = None if shape == NO_SHAPE else polygon.SHAPES.index(shape)
    shown = None if code == NO_CODE else code or name
    return SignName(place, shown, (size[0], size[1]) if size else None)


def _shape_rule(found: str) -> str:
    return f"shape {found!r} is unknown; expected one of {', '.join(polygon.SHAPES)}, {NO_SHAPE}"
