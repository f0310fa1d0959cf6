"""The checks of annotations that `CROWDMAP_CHECK_SHAPES=1` puts on the functions of the package."""

from __future__ import annotations

import functools
from collections.abc import Callable
from types import FunctionType
from typing import Any

import jaxtyping
from beartype import BeartypeConf, beartype

CALLS = 10
"""Calls of a function that are checked in each file of tests: checks of all of them take as long as the tests."""

_typed = beartype(conf=BeartypeConf(is_pep484_tower=True))
"""Types and shapes of arguments and results; an int will do for a float, as for every type checker."""

_files = 0
"""Files of tests that were begun."""


def checked(stub: Callable[..., Any]) -> Callable[..., Any]:
    """What looks at a call's arguments, or at its result: jaxtyping makes a stub of the function for each of them.

    That of the result is given the arguments as well, which were looked at before the call.
    """
    result = stub.__annotations__.get("return", Any)
    if result is not Any:
        stub.__annotations__ = {"return": result}
    return _typed(stub)


def begin_file() -> None:
    """From now on the first calls of every function are checked again."""
    global _files
    _files += 1


def install(package: str) -> None:
    """Checks the functions of a package that are imported from now on, and what its dataclasses are made of.

    Not those that are made within functions, which would be compiled anew at every call.
    """
    decorate = jaxtyping.jaxtyped

    def jaxtyped(*context: Any, typechecker: Any = None) -> Any:
        if context:
            return decorate(*context)
        outermost = decorate(typechecker=typechecker)

        def decorated(made: Any) -> Any:
            if "<locals>" in made.__qualname__:
                return made
            return (
                _at_first(made, outermost) if type(made) is FunctionType else _made(made, outermost)
            )

        return decorated

    # What is imported looks the decorator up by this name.
    setattr(jaxtyping, "jaxtyped", jaxtyped)  # noqa: B010
    jaxtyping.install_import_hook(package, "shape_checks.checked")


def _made(kind: Any, checks: Callable[[Any], Any]) -> Any:
    """A dataclass of which the first ones that are made are checked."""
    plain = kind.__init__
    kind = checks(kind)
    looked_at = kind.__init__
    if looked_at is not plain:
        kind.__init__ = _at_first(plain, lambda _: looked_at)
    return kind


def _at_first(
    function: Callable[..., Any], checks: Callable[[Callable[..., Any]], Callable[..., Any]]
) -> Callable[..., Any]:
    """A function whose first calls are checked; what checks it is made when it is called, if it ever is."""
    file, left, with_checks = -1, 0, None

    @functools.wraps(function)
    def called(*args: Any, **options: Any) -> Any:
        nonlocal file, left, with_checks
        if file != _files:
            file, left = _files, CALLS
        if not left:
            return function(*args, **options)
        left -= 1
        with_checks = with_checks or checks(function)
        return with_checks(*args, **options)

    return called
