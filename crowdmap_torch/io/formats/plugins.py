"""Formats that other packages bring: entry points, loaded when they are asked for."""

from __future__ import annotations

from importlib.metadata import EntryPoint, entry_points
from typing import TypeVar

from crowdmap_torch.io.errors import InputError, one_line

T = TypeVar("T")


def brought(group: str) -> dict[str, EntryPoint]:
    """Entry points of a group by the name of the format; of two of one name the first found."""
    found: dict[str, EntryPoint] = {}
    for point in entry_points(group=group):
        found.setdefault(point.name, point)
    return found


def loaded(point: EntryPoint, kind: type[T]) -> T:
    """What an entry point leads to; InputError if that cannot be loaded, or is of another kind."""
    try:
        thing = point.load()
    except (ImportError, AttributeError) as error:
        raise InputError(
            f"format {point.name!r}: its entry point {point.value} cannot be loaded "
            f"({one_line(error)}); install or remove the package that brings it"
        ) from error
    if not isinstance(thing, kind):
        raise InputError(
            f"format {point.name!r}: its entry point {point.value} is a {type(thing).__name__}; "
            f"expected a {kind.__module__}.{kind.__name__}"
        )
    return thing
