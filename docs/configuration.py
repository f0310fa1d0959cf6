"""The page docs/CONFIGURATION.md, made from the configuration's dataclasses: every key, its default, its range and its text.

`python docs/configuration.py` prints it, `--write` writes it; a test holds the page to it.
"""

from __future__ import annotations

import argparse
import math
import typing
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from pathlib import Path

from crowdmap_torch.config import MapperConfig
from crowdmap_torch.ranges import Range, field_texts, hints

PAGE = Path(__file__).parent / "CONFIGURATION.md"
HEAD = """# Configuration

Every key of the YAML file that `crowdmap optimize DATASET --out RUN --config FILE` takes. A file names only what differs
from these defaults; an unknown key, a value of another type or outside its range is refused in one line.
`RUN/config.yaml` has all of them as a run used them.
```yaml
adjust:
  size_classes_m: [[0.6, 0.6], [0.75, 0.75]]
```
Numbers have the units that names end in (`_m` metres, `_px` pixels, `_deg` degrees, `_s` seconds), else those of the text.
`.inf` switches off what a number weighs. This page is made from the dataclasses (`python docs/configuration.py --write`).
"""


def page() -> str:
    """The whole page."""
    return "\n".join([HEAD, *_section("", MapperConfig())])


def _section(name: str, settings: object) -> Iterator[str]:
    """The table of the keys of a section, then the sections within it."""
    texts, kinds = field_texts(type(settings)), hints(type(settings))
    rows, inner = [], []
    for key in fields(settings):  # pyright: ignore[reportArgumentType]
        value = getattr(settings, key.name)
        if is_dataclass(value):
            inner.append((f"{name}.{key.name}".lstrip("."), texts.get(key.name, ""), value))
        else:
            cells = (
                f"`{key.name}`",
                f"`{_yaml(value)}`",
                _range(kinds[key.name]),
                texts.get(key.name, ""),
            )
            rows.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    if rows:
        yield from ("| key | default | range | meaning |", "| --- | --- | --- | --- |", *rows, "")
    for path, text, value in inner:
        yield f"## {path}" if "." not in path else f"### {path}"
        about = " ".join((type(value).__doc__ or "").split())
        yield from (part + "\n" for part in dict.fromkeys((text, about)) if part)
        yield from _section(path, value)


def _yaml(value: object) -> str:
    """A value as a YAML file has it, on one line."""
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        if math.isinf(value):
            return ".inf" if value > 0 else "-.inf"
        return f"{value:g}" if float(f"{value:g}") == value else repr(value)
    if isinstance(value, tuple | list):
        return f"[{', '.join(map(_yaml, value))}]"
    if isinstance(value, dict):
        return "{" + ", ".join(f"{k}: {_yaml(v)}" for k, v in value.items()) + "}"
    return str(value)


def _range(kind: object) -> str:
    """The first range of numbers that an annotation holds."""
    for part in typing.get_args(kind):
        if isinstance(part, Range):
            also = " or .inf" if part.or_infinite else ""
            return f"{part.low:g} to {part.high:g}{also}"
        if found := _range(part):
            return found
    return ""


def main() -> int:
    """Prints the page, or writes it."""
    parser = argparse.ArgumentParser(description="Makes the reference of the configuration.")
    parser.add_argument("--write", action="store_true", help="into docs/CONFIGURATION.md")
    if parser.parse_args().write:
        PAGE.write_text(page(), encoding="utf-8")
    else:
        print(page())
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
