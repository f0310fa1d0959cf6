"""The formats that can be read: the package's own, and those of entry points that other packages bring."""

from __future__ import annotations

import importlib
import pkgutil

from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.formats import importers
from crowdmap_torch.io.formats.composing.parts import Importer
from crowdmap_torch.io.formats.plugins import brought, loaded

GROUP = "crowdmap_torch.importers"
"""Entry points with the name of a format lead to an `Importer`."""
OWN = tuple(module.name.replace("_", "-") for module in pkgutil.iter_modules(importers.__path__))
"""A name with hyphens is a module with underscores."""


def names() -> tuple[str, ...]:
    """All formats, the package's own first."""
    return (*OWN, *sorted(brought(GROUP).keys() - set(OWN)))


def find(name: str) -> Importer:
    """The importer of a format; InputError if there is none, or if it cannot be loaded."""
    if name in OWN:
        module = importlib.import_module(f"{importers.__name__}.{name.replace('-', '_')}")
        return module.IMPORTER
    if name in (others := brought(GROUP)):
        return loaded(others[name], Importer)
    raise InputError(f"format {name!r} is unknown; expected one of {', '.join(names())}")
