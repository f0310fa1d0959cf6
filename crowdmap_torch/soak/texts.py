"""Mutations of JSON, YAML and URDF files: values, keys, bombs, and the text itself."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from crowdmap_torch.io.documents import read_yaml_content

VALUES: tuple[Any, ...] = (
    *(None, True, False, 0, -1, 1, 0.0, -0.5, 1e-300, 1e18, 1e300, 1e308, 10**400, 2**63),
    *("", "x", "x" * 300, "x" * 5000, "..", "../..", "a/b", "a\nb", "\x00", "💥", "\ud800", "nan"),
    *([], {}, [1], [[]], [0.0, 0.0, 0.0], {"a": {}}, [None] * 3, [1e300] * 5, "/etc/passwd"),
)
BOMBS = {
    "merge bomb": "a0: &a0 {x: 1}\n"
    + "".join(f"a{k}: &a{k} {{<<: [{', '.join([f'*a{k - 1}'] * 9)}]}}\n" for k in range(1, 12)),
    "alias bomb": "a0: &a0 [1]\n"
    + "".join(f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]\n" for k in range(1, 12)),
    "recursion": "a: &a {b: *a}\n",
    "code": "a: !!python/object/apply:os.system ['touch code-ran']\n",
    "deep": "[" * 5000,
    "digits": "a: " + "9" * 5000,
    "long line": "a: " + "x" * 2_000_000,
    "many documents": "---\na: 1\n" * 50,
    "tabs": "\ta: 1\n",
    "binary": "a: !!binary aGVsbG8=\n? [1, 2]\n: 3\n",
    "date": "a: 9999999-99-99\nb: 2001-01-01T00:00:00Z\n",
}
ENTITIES = (
    '<?xml version="1.0"?><!DOCTYPE r [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;&a;">]>'
    "<robot name='&b;'/>",
    '<!DOCTYPE r [<!ENTITY x SYSTEM "file:///etc/passwd">]><robot name="&x;"/>',
)


def mutate_document(path: Path, rng: np.random.Generator) -> str:
    """Changes one JSON or YAML file; what was done."""
    if rng.random() < 0.2:
        return mutate_text(path, rng)
    is_json = path.suffix == ".json"
    if rng.random() < (0.05 if is_json else 0.2):
        name = str(rng.choice(list(BOMBS)))
        text = path.read_text("utf-8", "replace")
        path.write_text(BOMBS[name] + text if rng.random() < 0.5 else text + BOMBS[name])
        return name
    try:
        text = path.read_text("utf-8")
        # Weighed before it is built: an earlier mutation may have left a bomb.
        content = json.loads(text) if is_json else read_yaml_content(path)
        done = _change(content, rng)
        text = json.dumps(content) if is_json else yaml.safe_dump(content)
    except (ValueError, RecursionError, yaml.YAMLError):
        # Not to be read, or too deep, as another mutation may have left it.
        return mutate_text(path, rng)
    path.write_text(text, "utf-8", "surrogatepass")
    return done


def mutate_text(path: Path, rng: np.random.Generator) -> str:
    """Changes the text of a file; what was done."""
    content = path.read_bytes()
    text = content.decode("utf-8", "replace")
    way = str(rng.choice(["bom", "utf-16", "cut", "doubled", "upper", "swap", "crlf", "entity"]))
    if way == "bom":
        content = b"\xef\xbb\xbf" + content
    elif way == "utf-16":
        content = text.encode("utf-16")
    elif way == "cut":
        content = content[: rng.integers(len(content) + 1)]
    elif way == "doubled":
        content += content
    elif way == "upper":
        content = text.upper().encode()
    elif way == "crlf":
        content = text.replace("\n", "\r\n").encode()
    elif way == "entity":
        content = str(rng.choice(ENTITIES)).encode()
    else:
        words = text.split(" ")
        a, b = rng.integers(len(words), size=2)
        words[a], words[b] = words[b], words[a]
        content = " ".join(words).encode()
    path.write_bytes(content)
    return way


def mutate_urdf(path: Path, rng: np.random.Generator) -> str:
    """Changes numbers or the text of a URDF file; what was done."""
    if rng.random() < 0.4:
        return mutate_text(path, rng)
    parts = path.read_text("utf-8", "replace").split('"')
    if len(parts) < 3:
        return mutate_text(path, rng)
    at = 1 + 2 * int(rng.integers(len(parts) // 2))
    old = parts[at]
    numbers = ("nan nan nan", "1e300 0 0", "1e18 1 1", "0 0", "inf 0 0", "0 0 0 0", "1e-300 0 0")
    choices = (*numbers, "", "x" * 5000, "base_link", "revolute", old + " ", "\u202e")
    parts[at] = str(rng.choice(np.array(choices, dtype=object)))
    path.write_text('"'.join(parts), "utf-8")
    return f"{old[:40]!r} to {parts[at][:40]!r}"


def _change(content: Any, rng: np.random.Generator) -> str:
    """Changes one place of a nested content."""
    places = list(_places(content))
    if not places:
        return "nothing: it is empty"
    inside, key, way = places[rng.integers(len(places))]
    old = inside[key]
    kind = rng.integers(5)
    if kind == 0 and isinstance(inside, dict):
        del inside[key]
        return f"{way} deleted"
    if kind == 1 and isinstance(inside, dict):
        inside[str(rng.choice([f"{key} ", str(key).upper(), "x" * 300, "more"]))] = old
        return f"a key beside {way}"
    if kind == 2 and isinstance(old, int | float) and not isinstance(old, bool):
        factor = float(rng.choice([-1, 0, 1e-6, 1e-3, 0.5, 1.1, 2, 100, 1e4, 1e9, 1e200]))
        inside[key] = old * factor
        return f"{way} times {factor:g}"
    inside[key] = VALUES[rng.integers(len(VALUES))]
    return f"{way} to {str(inside[key])[:40]!r}"


def _places(content: Any) -> Iterator[tuple[Any, Any, str]]:
    """Every place of a nested content: what it is in, its key there, and its name; what stands in many places once."""
    seen: set[int] = set()
    left = [(content, "")]
    while left:
        inside, way = left.pop()
        if id(inside) in seen or not isinstance(inside, dict | list):
            continue
        seen.add(id(inside))
        items = list(inside.items() if isinstance(inside, dict) else enumerate(inside))
        for key, value in items:
            name = f"{way}.{key}" if way else str(key)
            yield inside, key, name
            left.append((value, name))
