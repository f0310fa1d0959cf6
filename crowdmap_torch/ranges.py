"""Ranges of numbers, one for each kind of quantity, and configurations that hold to them.

A field says what kind of number it is where its default stands (`gate_m: Length = 3.0`), or gives a range of its own
(`Annotated[float, Range(1.0, 100.0, "why")]`). Whoever builds a configuration, from a file, the command line or
Python, is told in one line what is outside.
"""

from __future__ import annotations

import argparse
import ast
import inspect
import math
import types
import typing
from collections.abc import Callable
from dataclasses import dataclass, is_dataclass
from functools import cache
from itertools import pairwise
from numbers import Integral, Real
from typing import Annotated, Any


@dataclass(frozen=True)
class Range:
    """Numbers from `low` to `high`, both included."""

    low: float
    high: float
    why: str
    """Why numbers outside make no sense."""
    or_infinite: bool = False
    """Infinity too: what the number weighs is then switched off."""

    def fault(self, value: float) -> str | None:
        """What was expected, if a number is outside."""
        if self.low <= value <= self.high or (self.or_infinite and value == math.inf):
            return None
        also = " or .inf" if self.or_infinite else ""
        return f"expected {self.low:g} to {self.high:g}{also} ({self.why}), found {shown(value)}"


@dataclass(frozen=True)
class Rising:
    """Several numbers of which none is below the one before."""

    def fault(self, values: tuple[float, ...]) -> str | None:
        """What was expected, if they do not rise."""
        if all(a <= b for a, b in pairwise(values)):
            return None
        return f"expected numbers of which none is below the one before, found {shown(values)}"


@dataclass(frozen=True)
class Filled:
    """One number at least."""

    def fault(self, values: tuple[Any, ...]) -> str | None:
        """What was expected, if there is none."""
        return None if values else "expected one number at least, found none"


RISING, FILLED = Rising(), Filled()

# ---- kinds of quantities: what a field's annotation names ----
Length = Annotated[float, Range(1e-3, 1e6, "metres: a millimetre to 1,000 km")]
LengthOrNone = Annotated[float, Range(0, 1e6, "metres: none to 1,000 km")]
Offset = Annotated[float, Range(-1e6, 1e6, "metres to either side, 1,000 km at most")]
Spacing = Annotated[float, Range(0.01, 1e6, "metres apart: what is closer fills the memory")]
Sigma = Annotated[float, Range(1e-9, 1e6, "a spread: its inverse square must be a finite weight")]
SigmaOrNone = Annotated[float, Range(0, 1e6, "a spread that others are added to, or none")]
SigmaOrOff = Annotated[
    float, Range(1e-9, 1e6, "a spread; without end it switches the term off", or_infinite=True)
]
Deviations = Annotated[float, Range(0.5, 1e12, "standard deviations: below, good measurements go")]
Pixels = Annotated[float, Range(1e-3, 1e5, "pixels: no image has more, no detector is finer")]
PixelsOrNone = Annotated[float, Range(0, 1e5, "pixels: no image has more")]
Focal = Annotated[float, Range(10, 1e5, "pixels: from a fisheye to a telescope")]
Side = Annotated[int, Range(16, 32_768, "pixels of an image's side")]
Place = Annotated[float, Range(-100, 100, "a place on the plane one metre ahead of a camera")]
Degrees = Annotated[float, Range(0, 360, "degrees: no more than a turn")]
Angle = Annotated[float, Range(-360, 360, "degrees to either side: no more than a turn")]
Radians = Annotated[float, Range(0, 2 * math.pi, "radians: no more than a turn")]
Seconds = Annotated[float, Range(0, 1e7, "seconds: none to some months")]
Duration = Annotated[float, Range(1e-6, 1e7, "seconds: something divides by them")]
FrameRate = Annotated[
    float, Range(0.1, 1000, "frames a second: a slide show to a slow-motion camera")
]
Speed = Annotated[float, Range(0.01, 150, "metres a second, or of change in one: what cars do")]
Rate = Annotated[float, Range(0, 1000, "how often in a kilometre or frame: none to everywhere")]
Share = Annotated[float, Range(0, 1, "a share or a probability")]
Cost = Annotated[float, Range(0, 1e9, "a cost beside squared residuals of some units")]
Factor = Annotated[float, Range(1e-6, 1e6, "a ratio of like things")]
Freedom = Annotated[float, Range(1, 1e9, "degrees of freedom: with less nothing has a variance")]
Damping = Annotated[float, Range(1e-30, 1e30, "beside a diagonal of one: what float64 still adds")]
Count = Annotated[int, Range(1, 10**7, "how many: one at least, and no more than memory holds")]
CountOrNone = Annotated[int, Range(0, 10**7, "how many: no more than memory holds")]
Workers = Annotated[int, Range(1, 4096, "processes or threads: one at least")]
Rounds = Annotated[int, Range(1, 100_000, "how often: once at least, and an end is wanted")]
RoundsOrNone = Annotated[int, Range(0, 100_000, "how often: an end is wanted")]
Span = Annotated[tuple[Length, Length], RISING]
SecondsSpan = Annotated[tuple[Seconds, Seconds], RISING]
PixelsSpan = Annotated[tuple[PixelsOrNone, PixelsOrNone], RISING]
CountSpan = Annotated[tuple[CountOrNone, CountOrNone], RISING]
Seed = Annotated[int, Range(0, 2**63 - 1, "a seed has 63 bits")]


class Settings:
    """A frozen dataclass of settings: ValueError names the field that is outside its range, or of another type."""

    def __post_init__(self) -> None:
        """Checks every field."""
        for name, hint in hints(type(self)).items():
            if fault := _fault(hint, getattr(self, name)):
                raise ValueError(f"{name}{fault}")


@cache
def hints(settings: type) -> dict[str, Any]:
    """The annotations of a class with their ranges."""
    return typing.get_type_hints(settings, include_extras=True)


def field_texts(settings: type) -> dict[str, str]:
    """The docstrings under the fields of a dataclass, on one line each."""
    body = ast.parse(inspect.getsource(settings)).body[0]
    assert isinstance(body, ast.ClassDef)
    texts = {}
    for field, text in zip(body.body, body.body[1:], strict=False):
        if not isinstance(field, ast.AnnAssign) or not isinstance(field.target, ast.Name):
            continue
        if isinstance(text, ast.Expr) and isinstance(text.value, ast.Constant):
            texts[field.target.id] = " ".join(str(text.value.value).split())
    return texts


def argument(kind: Any) -> Callable[[str], Any]:
    """How argparse reads a number of a kind, such as `Count`."""
    number, within = typing.get_args(kind)[:2]

    def read(text: str) -> Any:
        try:
            value = number(text)
        except ValueError:
            word = "a whole number" if number is int else "a number"
            raise argparse.ArgumentTypeError(f"expected {word}, found {shown(text)}") from None
        if fault := within.fault(value):
            raise argparse.ArgumentTypeError(fault)
        return value

    return read


def shown(value: object) -> str:
    """A value in an error message: short and on one line, whatever it is."""
    try:
        text = " ".join(repr(value).split())
    except ValueError:
        # Python does not print integers of thousands of digits.
        return "a number of thousands of digits"
    return text if len(text) <= 60 else text[:57] + "..."


def _fault(hint: Any, value: Any) -> str | None:
    """What is wrong with a value, with the place inside it in front; None if nothing is."""
    origin = typing.get_origin(hint)
    if origin is Annotated:
        kind, *rules = typing.get_args(hint)
        if fault := _fault(kind, value):
            return fault
        faults = (rule.fault(value) for rule in rules if isinstance(rule, Range | Rising | Filled))
        return next((f": {fault}" for fault in faults if fault), None)
    if origin in (typing.Union, types.UnionType):
        kinds = typing.get_args(hint)
        if value is None and type(None) in kinds:
            return None
        return _fault(next(kind for kind in kinds if kind is not type(None)), value)
    if origin is tuple:
        return _tuple_fault(typing.get_args(hint), value)
    expected = _EXPECTED.get(hint, (hint, getattr(hint, "__name__", str(hint))))
    if hint not in _EXPECTED and not is_dataclass(hint):
        return None
    kind, word = expected
    if isinstance(value, kind) and not (isinstance(value, bool) and hint is not bool):
        return None
    return f": expected {word}, found {shown(value)}"


def _tuple_fault(kinds: tuple[Any, ...], value: object) -> str | None:
    if not isinstance(value, tuple):
        return f": expected a tuple, found {shown(value)}"
    if len(kinds) == 2 and kinds[1] is Ellipsis:
        kinds = (kinds[0],) * len(value)
    if len(kinds) != len(value):
        return f": expected {len(kinds)} values, found {len(value)}"
    faults = (
        (k, _fault(kind, item)) for k, (kind, item) in enumerate(zip(kinds, value, strict=True))
    )
    return next((f"[{k}]{fault}" for k, fault in faults if fault), None)


_EXPECTED: dict[type, tuple[type, str]] = {
    float: (Real, "a number"),
    int: (Integral, "a whole number"),
    bool: (bool, "true or false"),
    str: (str, "a text"),
}
