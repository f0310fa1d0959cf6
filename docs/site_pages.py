"""What mkdocs needs beside mkdocs.yml: the pages of the repository's root, and links between them and those of docs/.

Links to what is no page (sources, configurations) become plain text: the site stands by itself. Lists and tables may follow
a line of text at once, as elsewhere; to mkdocs they would be a part of it.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
FROM_ROOT = {
    "README.md": "FIRST_MAP.md",
    "CONTRIBUTING.md": "CONTRIBUTING.md",
    "CHANGELOG.md": "CHANGELOG.md",
}
"""Pages of the root by their names on the site, where a README.md would take the place of index.md."""
_BLOCKS = {"list": re.compile(r"- |\d+\. "), "table": re.compile(r"\|")}
"""How their lines begin."""


def on_files(files: Any, config: Any) -> Any:
    """The files of docs/ and those of the root."""
    from mkdocs.structure.files import File  # pyright: ignore[reportMissingImports]

    for name, page in FROM_ROOT.items():
        files.append(File.generated(config, page, content=(ROOT / name).read_text("utf-8")))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Any) -> str:
    """A page with its links as the site has them."""
    return with_links(set_off(markdown), page.file.src_uri, {file.src_uri for file in files})


def set_off(markdown: str) -> str:
    """The text with an empty line before every list and table; what stands in fences stays."""
    lines, inside, kind = [], False, ""
    for line in markdown.splitlines():
        if line.startswith("```"):
            inside = not inside
        began = "" if inside else next((k for k, v in _BLOCKS.items() if v.match(line)), "")
        if began and began != kind and lines and lines[-1].strip():
            lines.append("")
        # What is indented goes on with a list's last item.
        kind = began or (kind if line.startswith("  ") else "")
        lines.append(line)
    return "\n".join(lines) + "\n"


def with_links(markdown: str, name: str, known: set[str]) -> str:
    """The text of page `name`: links between docs/ and the root lead to the `known` files, others are their text alone."""
    folder = ROOT if name in FROM_ROOT.values() else ROOT / "docs"

    def there(match: re.Match[str]) -> str:
        bang, text, target, anchor = match.groups(default="")
        path, own = (folder / target).resolve(), ROOT / "docs"
        is_own = path.is_relative_to(own)
        inside = path.relative_to(own).as_posix() if is_own else FROM_ROOT.get(path.name, path.name)
        if inside in known:
            return f"{bang}[{text}]({inside}{anchor})"
        return "" if bang else text

    return re.sub(r"(!?)\[([^\]]*)\]\((?!https?:|#)([^)#\s]+)(#[^)\s]*)?\)", there, markdown)
