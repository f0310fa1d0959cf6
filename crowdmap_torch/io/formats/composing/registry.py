"""The formats that can be read: the package's own, and those of entry points that other packages bring."""

from __future__ import annotations

import importlib
import pkgutil
from importlib.metadata import EntryPoint, entry_points

from crowdmap_torch.io.errors import InputError, one_line
from crowdmap_torch.io.formats import importers
from crowdmap_torch.io.formats.composing.parts import Importer

GROUP = "crowdmap_torch.importers"
"""Entry points with the name of a format lead to an `Importer`."""
OWN = tuple(module.name.replace("_", "-") for module in pkgutil.iter_modules(importers.__path__))
"""A name with hyphens is a module with underscores."""


def names() -> tuple[str, ...]:
    """All formats, the package's own first."""
    return (*OWN, *sorted({point.name for point in _others()} - set(OWN)))


def find(name: str) -> Importer:
    """The importer of a format; InputError if there is none, or if it cannot be loaded."""
    if name in OWN:
        module = importlib.import_module(f"{importers.__name__}.{name.replace('-', '_')}")
        return module.IMPORTER
    for point in _others():
        if point.name == name:
            return _loaded(point)
    raise InputError(f"format {name!r} is unknown; expected one of {', '.join(names())}")


def _others() -> list[EntryPoint]:
    return list(entry_points(group=GROUP))


def _loaded(point: EntryPoint) -> Importer:
    try:
        importer = point.load()
    except (ImportError, AttributeError) as error:
        raise InputError(
            f"format {point.name!r}: its entry point {point.value} cannot be loaded "
            f"({one_line(error)}); install or remove the package that brings it"
        ) from error
    if not isinstance(importer, Importer):
        raise InputError(
            f"format {point.name!r}: its entry point {point.value} is a {type(importer).__name__}; "
            f"expected a {Importer.__module__}.Importer"
        )
    return importer
