"""The pages as a site: links of the repository's pages lead to the site's, and mkdocs finds nothing to complain of."""

from __future__ import annotations

import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest
import site_pages
import yaml

ROOT = Path(__file__).parents[1]
KNOWN = {"FIRST_MAP.md", "CONTRIBUTING.md", "FORMAT.md", "map.png"}


def test_links_between_docs_and_the_root_lead_to_pages():
    said = (
        "[a](../CONTRIBUTING.md#x) ![m](map.png) [b](FORMAT.md) [c](https://a.b/c) [d](../Makefile)"
    )
    assert site_pages.with_links(said, "OWN_DATA.md", KNOWN) == (
        "[a](CONTRIBUTING.md#x) ![m](map.png) [b](FORMAT.md) [c](https://a.b/c) d"
    )
    said = "![m](docs/map.png) [b](docs/FORMAT.md#y) [l](LICENSE) [p](#part)"
    assert site_pages.with_links(said, "FIRST_MAP.md", KNOWN) == (
        "![m](map.png) [b](FORMAT.md#y) l [p](#part)"
    )


def test_lists_and_tables_are_set_off_from_text():
    said = "a\nb\n- one\n  more\n- two\n\nc\n| t |\n| - |\n```\nd\n- e\n```\n"
    assert site_pages.set_off(said) == (
        "a\nb\n\n- one\n  more\n- two\n\nc\n\n| t |\n| - |\n```\nd\n- e\n```\n"
    )
    assert site_pages.set_off(site_pages.set_off(said)) == site_pages.set_off(said)


def test_every_page_is_in_the_navigation():
    told = yaml.safe_load((ROOT / "mkdocs.yml").read_text("utf-8"))["nav"]

    def pages(entries) -> set[str]:
        found = set()
        for entry in entries:
            for value in entry.values():
                found |= {value} if isinstance(value, str) else pages(value)
        return found

    there = {page.name for page in (ROOT / "docs").glob("*.md")} | {*site_pages.FROM_ROOT.values()}
    assert pages(told) == there


@pytest.mark.skipif(
    any(find_spec(name) is None for name in ("mkdocs", "material", "mkdocstrings")),
    reason="mkdocs-material and mkdocstrings (extra [docs]) are not installed",
)
def test_the_site_is_built_without_a_complaint(tmp_path: Path):
    call = [sys.executable, "-m", "mkdocs", "build", "--strict", "-q", "-d", str(tmp_path / "site")]
    done = subprocess.run(call, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    site = tmp_path / "site"
    assert 'id="where-to-go"' in (site / "index.html").read_text("utf-8")
    assert "<title>First map" in (site / "FIRST_MAP.html").read_text("utf-8")
    for page in site.glob("*.html"):
        words = re.sub(r"<pre.*?</pre>|<code>.*?</code>", "", page.read_text("utf-8"), flags=re.S)
        told = "\n".join(re.findall(r"<p>(.*?)</p>", words, flags=re.S))
        assert not re.search(r"^(- |\d+\. |\| )", told, flags=re.M), page.name
    api = (site / "API.html").read_text("utf-8")
    assert "build_map" in api and "crowdmap_torch.mapper" in api
    assert "http://fonts" not in api and "https://fonts" not in api
