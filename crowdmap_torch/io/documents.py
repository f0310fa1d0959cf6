"""JSON and YAML files, taken apart key by key; complaints name the file and the key."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from torch import Tensor

from crowdmap_torch.io.atomic import atomic_file
from crowdmap_torch.io.errors import InputError, one_line


class Document:
    """A mapping of a file, or a section of it, whose values are checked as they are taken."""

    def __init__(self, path: Path, content: object, section: str = "") -> None:
        self.path = path
        self.section = section
        if not isinstance(content, dict):
            raise self.fault(f"expected a mapping of keys to values, found {_kind(content)}")
        self.content: dict = content

    def fault(self, rule: str, key: str | None = None) -> InputError:
        """The error that says where in which file a rule is broken."""
        place = ".".join(part for part in (self.section, key) if part)
        return InputError(f"{self.path}: {place + ': ' if place else ''}{rule}")

    def allow(self, required: Sequence[str], optional: Sequence[str] = ()) -> None:
        """Refuses keys that are missing and keys that nobody knows."""
        expected = ", ".join((*required, *(f"{key} (optional)" for key in optional)))
        for key in required:
            if key not in self.content:
                raise self.fault(f"key {key!r} is missing; expected {expected}")
        for key in self.content:
            if key not in required and key not in optional:
                raise self.fault(f"key {key!r} is unknown; expected {expected}")

    def take(self, key: str) -> object:
        """A value as it stands in the file."""
        if key not in self.content:
            raise self.fault("is missing", key)
        return self.content[key]

    def part(self, key: str) -> Document:
        """A mapping inside this one."""
        name = f"{self.section}.{key}" if self.section else key
        return Document(self.path, self.take(key), name)

    def text(self, key: str) -> str:
        """A string that is not empty."""
        value = self.take(key)
        if not isinstance(value, str) or not value:
            raise self.fault(f"expected a text that is not empty, found {_kind(value)}", key)
        return value

    def name(self, key: str) -> str:
        """A string that can be the name of one file or folder and nothing else."""
        value = self.text(key)
        if value in (".", "..") or any(c in value for c in "/\\\0"):
            raise self.fault(f"expected the plain name of a folder, found {value!r}", key)
        return value

    def integer(self, key: str, *, low: int, high: int) -> int:
        """A whole number in `low` to `high`."""
        value = self.take(key)
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
            rule = f"expected a whole number in {low} to {high}, found {_kind(value)}"
            raise self.fault(rule, key)
        return value

    def number(self, key: str, *, low: float = -math.inf, high: float = math.inf) -> float:
        """A finite number in `low` to `high`."""
        return self._finite(self.take(key), key, low, high)

    def positive(self, key: str) -> float:
        """A finite number above zero."""
        value = self.number(key)
        if value <= 0:
            raise self.fault(f"expected a number above 0, found {value!r}", key)
        return value

    def numbers(self, key: str, count: int | None = None) -> list[float]:
        """A list of finite numbers, `count` of them if that is given."""
        values = self.take(key)
        if not isinstance(values, list) or (count is not None and len(values) != count):
            found = _kind(values) if not isinstance(values, list) else f"{len(values)} values"
            much = "numbers" if count is None else f"{count} numbers"
            raise self.fault(f"expected a list of {much}, found {found}", key)
        return [self._finite(v, f"{key}[{k}]", -math.inf, math.inf) for k, v in enumerate(values)]

    def require_format(self, name: str) -> None:
        """Refuses a file that is of another kind or version."""
        if (found := self.take("format")) != name:
            raise self.fault(f"expected {name!r}, found {found!r}", "format")
        version = self.take("version")
        if isinstance(version, bool) or not isinstance(version, int) or version != 1:
            raise self.fault(f"expected version 1, found {version!r}; convert the file", "version")

    def _finite(self, value: object, key: str, low: float, high: float) -> float:
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise self.fault(f"expected a number, found {_kind(value)}", key)
        number = float(value) if abs(value) < 1e300 else math.inf
        if not math.isfinite(number):
            raise self.fault(f"expected a finite number, found {value!r}", key)
        if not low <= number <= high:
            raise self.fault(f"expected a number in {low:g} to {high:g}, found {number!r}", key)
        return number


def read_json(path: Path) -> Document:
    """The object that a JSON file holds; NaN, infinity and a key given twice are refused."""
    try:
        content = json.loads(
            _read_text(path), parse_constant=_refuse_constant, object_pairs_hook=_unique
        )
    except (ValueError, RecursionError) as error:
        raise _unreadable(path, "JSON", error) from error
    return Document(path, content)


def read_yaml(path: Path) -> Document:
    """The mapping that a YAML file holds; a key given twice is refused, `1e-5` is a number."""
    try:
        content = yaml.load(_read_text(path), Loader=_StrictLoader)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise _unreadable(path, "YAML", error) from error
    return Document(path, content)


def write_json(path: Path, content: dict) -> None:
    """Writes one JSON file, at once; numbers must be finite."""
    text = json.dumps(content, indent=2, allow_nan=False)
    with atomic_file(path) as beside:
        beside.write_text(text + "\n", encoding="utf-8")


def plain(value: object) -> Any:
    """The same content in the types that JSON has: null for what is not finite, lists for tensors and tuples."""
    if is_dataclass(value) and not isinstance(value, type):
        return {f.name: plain(getattr(value, f.name)) for f in fields(value)}
    if isinstance(value, Mapping):
        return {str(key): plain(inner) for key, inner in value.items()}
    if isinstance(value, Tensor | np.ndarray | np.generic):
        return plain(value.tolist())
    if isinstance(value, list | tuple):
        return [plain(inner) for inner in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return str(value) if isinstance(value, Path) else value


class _StrictLoader(yaml.SafeLoader):
    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict:
        seen = set()
        for key_node, _ in node.value:
            if key_node.tag == "tag:yaml.org,2002:merge":
                continue
            key = self.construct_object(key_node, deep=True)
            if isinstance(key, str) and key in seen:
                line = key_node.start_mark.line + 1
                raise yaml.YAMLError(f"line {line}: key {key!r} is given twice")
            seen.add(key if isinstance(key, str) else None)
        return super().construct_mapping(node, deep)


# YAML 1.1 reads 1e-5 as a text because it has no point; what Python's repr writes must be a number.
_StrictLoader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"^[-+]?[0-9]+(?:\.[0-9]*)?[eE][-+]?[0-9]+$"),
    list("-+0123456789"),
)


def _read_text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except FileNotFoundError as error:
        raise InputError(f"{path}: the file is missing") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error


def _unreadable(path: Path, kind: str, error: Exception) -> InputError:
    if isinstance(error, InputError):
        return error
    return InputError(f"{path}: cannot be read as {kind} ({one_line(error)})")


def _refuse_constant(name: str) -> float:
    raise ValueError(f"{name} is not allowed, every number must be finite")


def _unique(pairs: list[tuple[str, object]]) -> dict:
    content = dict(pairs)
    if len(content) < len(pairs):
        names = [key for key, _ in pairs]
        twice = next(key for key in names if names.count(key) > 1)
        raise ValueError(f"key {twice!r} is given twice")
    return content


def _kind(value: object) -> str:
    """What a value is, for an error message: short, on one line."""
    if value is None:
        return "nothing"
    if isinstance(value, dict | list):
        return f"a {'mapping' if isinstance(value, dict) else 'list'} of {len(value)}"
    text = one_line(repr(value))
    return text if len(text) <= 60 else text[:57] + "..."
