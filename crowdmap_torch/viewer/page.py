"""The viewer as HTML: a page of its own, or an element of another page; code and numbers inside, nothing loaded."""

from __future__ import annotations

from functools import cache
from html import escape
from importlib.resources import files
from pathlib import Path

from crowdmap_torch.io.atomic import atomic_file
from crowdmap_torch.viewer.columns import encoded
from crowdmap_torch.viewer.payload import payload_of
from crowdmap_torch.viewer.scene import Scene

SCRIPTS = ("payload", "model", "camera", "draw", "picture", "panel", "controls", "main")
"""Sources under assets/, in the order in which they run: each defines what the later ones use."""
CODE_BYTES = 1_000_000
"""The most that a page may have without its payload."""
_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data: blob:"
)
"""What a browser may do with the page: nothing that needs a network."""


def write_page(path: Path, scene: Scene) -> None:
    """Writes `scene` as one HTML file, complete or not at all."""
    text = page_html(scene)
    with atomic_file(path) as beside:
        beside.write_text(text, encoding="utf-8")


def page_html(scene: Scene) -> str:
    """A page with nothing but the viewer."""
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">'
        '<meta name="viewport" content="width=device-width,initial-scale=1">'
        '<meta name="color-scheme" content="light dark"><link rel="icon" href="data:,">'
        f'<title>{escape(scene.title)}</title></head><body class="cmv-page">'
        f"{viewer_element(scene)}</body></html>\n"
    )


def viewer_element(scene: Scene) -> str:
    """The viewer for any page; one page holds one. Its script runs where it stands."""
    return (
        f"<style>{style()}</style>"
        '<div class="cmv" id="crowdmap-viewer"><noscript>The map is drawn by a script: '
        "allow scripts for this file.</noscript></div>"
        f'<script type="text/plain" id="crowdmap-payload">{encoded(payload_of(scene))}</script>'
        f"<script>{script()}</script>"
    )


@cache
def script() -> str:
    """The code, in one function of its own."""
    parts = (_asset(f"{name}.js") for name in SCRIPTS)
    return "(function () {\n'use strict';\n" + "\n".join(parts) + "\n})();"


@cache
def style() -> str:
    """The style sheet."""
    return _asset("viewer.css")


def _asset(name: str) -> str:
    return (files("crowdmap_torch.viewer") / "assets" / name).read_text(encoding="utf-8")
