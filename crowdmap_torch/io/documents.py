"""JSON and YAML files, taken apart key by key; complaints name the file and the key."""

from __future__ import annotations

import json
import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from torch import Tensor

from crowdmap_torch.io.atomic import atomic_file
from crowdmap_torch.io.budget import budget_now, read_text
from crowdmap_torch.io.errors import Code, InputError, one_line
from crowdmap_torch.io.faults import Fault, FaultsGathered, gathered
from crowdmap_torch.ranges import shown


class Document:
    """A mapping of a file, or a section of it, whose values are checked as they are taken.

    Where faults are gathered, each key that is wrong is told once and another value stands for it: what rests on values
    asks for `require_sound` first.
    """

    def __init__(self, path: Path, content: object, section: str = "") -> None:
        self.path = path
        self.section = section
        self._wrong: set[str] = set()
        self._is_stand_in = False
        if not isinstance(content, dict):
            raise self.fault(f"expected a mapping of keys to values, found {_kind(content)}")
        self.content: dict = content

    def fault(self, rule: str, key: str | None = None, code: Code = "value") -> InputError:
        """The error that says where in which file a rule is broken."""
        place = ".".join(part for part in (self.section, key) if part)
        return InputError(f"{self.path}: {place + ': ' if place else ''}{rule}", code)

    def refuse(
        self, rule: str, key: str, code: Code = "value", *, of_mapping: bool = False
    ) -> None:
        """Raises that error, or gathers it; `of_mapping`: it is said of the whole mapping, not of the key."""
        faults = gathered()
        error = self.fault(rule, None if of_mapping else key, code)
        if faults is None:
            raise error
        name = str(key).split("[")[0]
        if not self._is_stand_in and name not in self._wrong:
            faults.append(Fault(self.path, str(error).removeprefix(f"{self.path}: "), code))
        self._wrong.add(name)

    def is_known(self, key: str) -> bool:
        """Whether nothing has been told of a key; False only where faults are gathered."""
        return not self._is_stand_in and key not in self._wrong

    def require_sound(self) -> None:
        """Where faults are gathered, ends the reading of a mapping that has some."""
        if self._wrong or self._is_stand_in:
            raise FaultsGathered(f"{self.path}: has faults")

    def allow(self, required: Sequence[str], optional: Sequence[str] = ()) -> None:
        """Refuses keys that are missing and keys that nobody knows."""
        expected = ", ".join((*required, *(f"{key} (optional)" for key in optional)))
        for key in required:
            if key not in self.content:
                rule = f"key {key!r} is missing; expected {expected}"
                self.refuse(rule, key, "missing-key", of_mapping=True)
        for key in self.content:
            if key not in required and key not in optional:
                rule = f"key {key!r} is unknown; expected {expected}"
                self.refuse(rule, key, "unknown-key", of_mapping=True)

    def take(self, key: str) -> object:
        """A value as it stands in the file."""
        if key not in self.content:
            self.refuse("is missing", key, "missing-key")
            return _NO_VALUE
        return self.content[key]

    def part(self, key: str) -> Document:
        """A mapping inside this one."""
        value = self.take(key)
        if not isinstance(value, dict):
            self.refuse(f"expected a mapping of keys to values, found {_kind(value)}", key)
        name = f"{self.section}.{key}" if self.section else key
        part = Document(self.path, value if isinstance(value, dict) else {}, name)
        part._is_stand_in = not isinstance(value, dict)
        return part

    def parts(self, key: str) -> list[Document]:
        """A list of mappings inside this one."""
        values = self.take(key)
        if not isinstance(values, list):
            raise self.fault(f"expected a list, found {_kind(values)}", key)
        name = f"{self.section}.{key}" if self.section else key
        return [Document(self.path, value, f"{name}[{k}]") for k, value in enumerate(values)]

    def text(self, key: str) -> str:
        """A string that is not empty."""
        value = self.take(key)
        if not isinstance(value, str) or not value:
            self.refuse(f"expected a text that is not empty, found {_kind(value)}", key)
            return ""
        return value

    def name(self, key: str) -> str:
        """A string that can be the name of one file or folder and nothing else."""
        value = self.text(key)
        if value in (".", "..") or any(c in value for c in "/\\") or not value.isprintable():
            self.refuse(f"expected the plain name of a folder, found {shown(value)}", key)
        return self._short(value, key)

    def place(self, key: str) -> str:
        """A string that can be the path of a file."""
        value = self.text(key)
        if not value.isprintable():
            self.refuse(f"expected the path of a file, found {shown(value)}", key)
        return self._short(value, key)

    def integer(self, key: str, *, low: int, high: int) -> int:
        """A whole number in `low` to `high`."""
        value = self.take(key)
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
            rule = f"expected a whole number in {low} to {high}, found {_kind(value)}"
            self.refuse(rule, key)
            return low
        return value

    def number(self, key: str, *, low: float = -math.inf, high: float = math.inf) -> float:
        """A finite number in `low` to `high`."""
        return self._finite(self.take(key), key, low, high)

    def numbers(self, key: str, count: int | None = None, *, most: float = math.inf) -> list[float]:
        """A list of finite numbers of size `most` at the most, `count` of them if that is given."""
        values = self.take(key)
        if not isinstance(values, list) or (count is not None and len(values) != count):
            found = _kind(values) if not isinstance(values, list) else f"{len(values)} values"
            much = "numbers" if count is None else f"{count} numbers"
            self.refuse(f"expected a list of {much}, found {found}", key)
            return [0.0] * (count or 0)
        return [self._finite(v, f"{key}[{k}]", -most, most) for k, v in enumerate(values)]

    def require_format(self, name: str) -> None:
        """Refuses a file that is of another kind or version."""
        if (found := self.take("format")) != name:
            self.refuse(f"expected {name!r}, found {_kind(found)}", "format", "other-version")
        version = self.take("version")
        if isinstance(version, bool) or not isinstance(version, int) or version != 1:
            rule = f"expected version 1, found {_kind(version)}; convert the file"
            self.refuse(rule, "version", "other-version")

    def _finite(self, value: object, key: str, low: float, high: float) -> float:
        if isinstance(value, bool) or not isinstance(value, int | float):
            self.refuse(f"expected a number, found {_kind(value)}", key)
            value = min(max(0.0, low), high)
        number = float(value) if abs(value) < 1e300 else math.inf
        if not math.isfinite(number):
            self.refuse(f"expected a finite number, found {shown(value)}", key, "range")
        elif not low <= number <= high:
            rule = f"expected a number in {low:g} to {high:g}, found {number!r}"
            self.refuse(rule, key, "range")
        return number

    def _short(self, value: str, key: str) -> str:
        size, most = len(value.encode()), budget_now().name_bytes
        if size > most:
            self.refuse(f"a name of {size} bytes; expected {most} at most", key, "too-large")
        return value


_NO_VALUE = object()
"""Stands for a value that is not there, while faults are gathered."""


def read_json(path: Path) -> Document:
    """The object that a JSON file holds; NaN, infinity and a key given twice are refused."""
    return Document(path, read_json_content(path))


def read_json_content(path: Path) -> object:
    """The same, whatever the file holds."""
    text = read_text(path)
    try:
        _weigh_json(text)
        return json.loads(text, parse_constant=_refuse_constant, object_pairs_hook=_unique)
    except ValueError as error:
        raise _unreadable(path, "JSON", error) from error


def read_yaml(path: Path) -> Document:
    """The mapping that a YAML file holds; a key given twice is refused, `1e-5` is a number."""
    return Document(path, read_yaml_content(path))


def read_yaml_content(path: Path) -> object:
    """The same, whatever the file holds; None for an empty one."""
    text = read_text(path)
    try:
        _weigh_yaml(text)
        return yaml.load(text, Loader=_StrictLoader)
    except (yaml.YAMLError, ValueError) as error:
        raise _unreadable(path, "YAML", error) from error


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


# libyaml's parser takes a tenth of the time, where it was built in.
_SafeLoader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class _StrictLoader(_SafeLoader):
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


_JSON_TEXT = re.compile(r'"(?:[^"\\]|\\.)*"', re.DOTALL)


def _weigh_json(text: str) -> None:
    """ValueError for more values, or values deeper in each other, than the budget has; nothing is built."""
    budget = budget_now()
    marks = np.frombuffer(_JSON_TEXT.sub("", text).encode("utf-8", "replace"), np.uint8)
    opened, closed = (np.isin(marks, list(pair)) for pair in (b"[{", b"]}"))
    _refuse_more("values", int(opened.sum() + (marks == ord(",")).sum()) + 1, budget.nodes)
    depth = np.cumsum(opened.astype(np.int64) - closed)
    _refuse_more("levels", int(depth.max(initial=0)), budget.depth)


def _weigh_yaml(text: str) -> None:
    """ValueError for more nodes, aliases or depth than the budget has, what aliases repeat counted; nothing is built."""
    budget = budget_now()
    nodes = aliases = 0
    sizes: dict[str, int] = {}
    open_: list[tuple[str | None, int]] = []
    for event in yaml.parse(text, Loader=_SafeLoader):
        if isinstance(event, yaml.AliasEvent):
            aliases += 1
            if event.anchor not in sizes:
                raise ValueError(f"alias {event.anchor!r} stands before or inside its anchor")
            nodes += sizes[event.anchor]
        elif isinstance(event, yaml.CollectionStartEvent):
            open_.append((event.anchor, nodes))
            nodes += 1
        elif isinstance(event, yaml.CollectionEndEvent):
            anchor, before = open_.pop()
            if anchor is not None:
                sizes[anchor] = nodes - before
        elif isinstance(event, yaml.ScalarEvent):
            nodes += 1
            if event.anchor is not None:
                sizes[event.anchor] = 1
        _refuse_more("nodes", nodes, budget.nodes)
        _refuse_more("aliases", aliases, budget.aliases)
        _refuse_more("levels", len(open_), budget.depth)


def _refuse_more(what: str, found: int, most: int) -> None:
    if found > most:
        raise ValueError(f"more than {most} {what}; expected a small file written by people")


def _unreadable(path: Path, kind: str, error: Exception) -> InputError:
    if isinstance(error, InputError):
        return error
    return InputError(f"{path}: cannot be read as {kind} ({one_line(error)})", "unreadable")


def _refuse_constant(name: str) -> float:
    raise ValueError(f"{name} is not allowed, every number must be finite")


def _unique(pairs: list[tuple[str, object]]) -> dict:
    content = dict(pairs)
    if len(content) < len(pairs):
        twice = Counter(key for key, _ in pairs).most_common(1)[0][0]
        raise ValueError(f"key {shown(twice)} is given twice")
    return content


def _kind(value: object) -> str:
    """What a value is, for an error message: short, on one line."""
    if value is None:
        return "nothing"
    if isinstance(value, dict | list):
        return f"a {'mapping' if isinstance(value, dict) else 'list'} of {len(value)}"
    return shown(value)
