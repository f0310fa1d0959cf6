from __future__ import annotations

import base64
import re
from importlib.resources import files
from pathlib import Path

import pytest

from crowdmap_torch.viewer.columns import unpacked
from crowdmap_torch.viewer.page import CODE_BYTES, SCRIPTS, page_html, script, style, write_page
from crowdmap_torch.viewer.scene import Scene


@pytest.fixture(scope="module")
def text(scene: Scene) -> str:
    return page_html(scene)


def payload(text: str) -> str:
    found = re.search(r'id="crowdmap-payload">([^<]*)<', text)
    assert found
    return found.group(1)


def test_nothing_is_loaded_from_elsewhere(text: str) -> None:
    code = text.replace(payload(text), "")
    assert not re.search(r"https?:|//[a-z]|@import|url\(|fetch\(|XMLHttp|import\(|src=", code)
    assert "default-src 'none'" in code
    assert len(code.encode()) < CODE_BYTES


def test_ids_and_titles_end_no_script_and_no_title(scene: Scene, text: str) -> None:
    assert text.count("<script") == text.count("</script>") == 2
    assert "&lt;/title&gt;&lt;script&gt;" in text
    head, _ = unpacked(base64.b64decode(payload(text)))
    assert scene.hd_map is not None
    assert head["sign_id"] == list(scene.hd_map.sign_id) and head["title"] == scene.title
    assert "<b>" not in text and "<i>drive" not in text


def test_the_code_puts_no_text_into_the_page_as_markup() -> None:
    assert not re.search(r"innerHTML|outerHTML|insertAdjacent|document\.write|eval\(", script())


def test_every_source_is_used_and_closed() -> None:
    folder = files("crowdmap_torch.viewer") / "assets"
    assert {p.name for p in folder.iterdir()} == {f"{n}.js" for n in SCRIPTS} | {"viewer.css"}
    for text in (script(), style()):
        assert "</" not in text
        assert text.count("{") == text.count("}")


def test_the_style_stays_inside_the_viewer() -> None:
    rules = re.sub(r"/\*.*?\*/|@media[^{]*", "", style(), flags=re.DOTALL)
    for selectors in re.findall(r"([^{}]+)\{", rules):
        for selector in selectors.split(","):
            if selector.strip():
                assert selector.strip().startswith(".cmv"), selector


def test_every_colour_is_named(text: str) -> None:
    for name in set(re.findall(r"var\((--[\w-]+)\)", style())):
        assert style().count(f"{name}:") == 2, name  # in the light and in the dark


def test_a_page_is_whole_or_not_there(scene: Scene, tmp_path: Path) -> None:
    path = tmp_path / "view.html"
    write_page(path, scene)
    assert path.read_text("utf-8") == page_html(scene)
    with pytest.raises(OSError):
        write_page(path / "beneath.html", scene)
    assert [p.name for p in tmp_path.iterdir()] == ["view.html"]
