"""The viewer in a browser: no complaint, no request, and what a user does has its effect. Skipped where none is."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from crowdmap_torch.benchmark.browser import NAMES, Page, browser, browser_path
from crowdmap_torch.tables import Dataset
from crowdmap_torch.viewer.page import write_page
from crowdmap_torch.viewer.scene import Scene, scene_of_dataset

pytestmark = pytest.mark.skipif(
    browser_path() is None, reason=f"no browser is installed: none of {', '.join(NAMES)}"
)
V = "document.querySelector('.cmv').viewer"
DETAIL = "document.querySelector('.cmv-detail').textContent"
PAINTED = """(() => { const c = document.querySelector('.cmv-stage canvas'), d = c.getContext('2d')
  .getImageData(0, 0, c.width, c.height).data, n = new Set();
  for (let k = 0; k < d.length; k += 4) n.add((d[k] << 16) | (d[k + 1] << 8) | d[k + 2]); return n.size; })()"""


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    with browser(tmp_path_factory.mktemp("browser")) as opened:
        yield opened


@pytest.fixture(scope="module")
def file(scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("page") / "view.html"
    write_page(path, scene)
    return path


def show(page: Page, file: Path, width: int = 1000, height: int = 700, *, dark: bool = False):
    page.events.clear()
    page.resize(width, height, dark=dark)
    page.open(file)


@pytest.mark.parametrize("dark", [False, True])
def test_it_opens_without_complaint_or_request(page: Page, file: Path, dark: bool) -> None:
    show(page, file, dark=dark)
    page.ask(f"{V}.tilt(); {V}.now(); {V}.setLayer('given', true); {V}.setLayer('before', true)")
    page.ask(
        f"{V}.setLayer('sigma', true); {V}.setLayer('biases', true); {V}.setMagnify(10); {V}.now()"
    )
    assert page.ask(PAINTED) > 20
    said = [c for c in page.complaints() if "willReadFrequently" not in c]
    assert said == []
    assert page.requests() == [file.resolve().as_uri()]


def test_a_click_on_a_sign_tells_its_numbers_and_detections(page: Page, file: Path) -> None:
    show(page, file)
    x, y = page.ask(
        f"(() => {{ const v = {V}, s = v.model.signs[4], b = v.canvas.getBoundingClientRect();"
        "const p = v.view.project(s.x, s.y, s.z); return [b.left + p[0], b.top + p[1]]; })()"
    )
    page.click(x, y)
    told = page.ask(DETAIL)
    for words in ("pentagon", "rests on", "error e, n, u", "Its drives", "<i>drive", "given up"):
        assert words in told
    rows = "document.querySelectorAll('.cmv-detail tr[data-row]')"
    assert page.ask(f"{rows}.length") == page.ask(f"{V}.model.seen.get(4).length") > 0
    page.ask(f"{rows}[1].click()")
    assert "largest residual 0.7" in page.ask(DETAIL)
    assert page.ask(f"{V}.state.detection.sign") == 4


def test_numbers_of_the_page_are_those_of_the_scene(page: Page, file: Path, scene: Scene) -> None:
    show(page, file)
    assert scene.hd_map is not None
    corners = page.ask(f"{V}.model.signs.map((s) => s.corners)")
    mask = scene.hd_map.signs.corner_mask
    for k, own in enumerate(scene.hd_map.signs.corners_world):
        for found, true in zip(corners[k], own[mask[k]].tolist(), strict=True):
            assert found == pytest.approx(true, abs=1.5e-3)
    assert page.ask(f"{V}.model.lanes.length") == 2
    assert page.ask(f"{V}.model.signs[0].ground") == pytest.approx(0.0, abs=0.05)


def test_keys_move_search_and_step(page: Page, file: Path) -> None:
    show(page, file)
    page.ask(f"{V}.canvas.focus()")
    before = page.ask(f"{V}.view.x")
    page.press("ArrowRight")
    assert page.ask(f"{V}.view.x") != before
    page.press("n")
    assert page.ask(f"{V}.state.chosen") == {"kind": "sign", "row": 0}
    page.press("Escape")
    assert page.ask(f"{V}.state.chosen") is None
    page.press("/")
    assert page.ask("document.activeElement.type") == "search"
    page.ask(f"{V}.search.value = 's5'; {V}.search.dispatchEvent(new Event('input'))")
    page.press("Enter")
    assert page.ask(f"{V}.model.signs[{V}.state.chosen.row].id") == "s5"


def test_signs_are_a_table_beside_the_canvas(page: Page, file: Path, scene: Scene) -> None:
    show(page, file)
    names = page.ask(
        "[...document.querySelectorAll('.cmv-list tbody th')].map((t) => t.textContent)"
    )
    assert scene.hd_map is not None and names == list(scene.hd_map.sign_id)
    assert "9 signs" in page.ask("document.querySelector('canvas').getAttribute('aria-label')")
    unnamed = page.ask(
        "[...document.querySelectorAll('.cmv button, .cmv input, .cmv select')].filter((e) =>"
        " !(e.textContent || e.getAttribute('aria-label') || e.closest('label'))).length"
    )
    assert unnamed == 0


def test_a_narrow_page_does_not_scroll_sideways(page: Page, file: Path) -> None:
    show(page, file, 400, 800)
    page.ask(f"{V}.chooseSign('a&b')")
    assert page.ask("document.documentElement.scrollWidth") <= 400


@pytest.mark.parametrize("width", [400, 1200])
def test_long_names_of_signs_leave_room_for_numbers(
    page: Page, scene: Scene, tmp_path: Path, width: int
) -> None:
    """Names as Mapillary has them, in the list of a map that a survey is beside."""
    assert scene.hd_map is not None
    names = tuple(f"regulatory--no-{k}-turn-on-red--g{k}" for k in ("left", "right", "u"))
    kinds = scene.hd_map.signs.type.new_tensor([k % 3 for k in range(len(scene.hd_map.signs))])
    hd_map = replace(
        scene.hd_map,
        signs=replace(scene.hd_map.signs, type=kinds),
        sign_id=tuple(f"sign-7b1a2d01b95{k}" for k in range(len(kinds))),
        type_names=names,
    )
    path = tmp_path / "view.html"
    write_page(path, replace(scene, hd_map=hd_map, outcomes=None))
    show(page, path, width)
    assert names[0] in page.ask("document.querySelector('.cmv-list').textContent")
    cut = "(() => { const l = document.querySelector('.cmv-list'); return l.scrollWidth - l.clientWidth; })()"
    assert page.ask(cut) <= 0


def test_frames_of_a_data_set_are_gone_through(page: Page, tiny: Dataset, tmp_path: Path) -> None:
    path = tmp_path / "drives.html"
    write_page(path, scene_of_dataset(tiny, "drives", None))
    show(page, path)
    page.ask(f"{V}.choose({{ kind: 'frame', row: 0 }}, {{ fly: true }})")
    page.ask(f"{V}.canvas.focus()")
    page.press("n")
    assert page.ask(f"{V}.state.chosen.row") == 1
    assert "sigma as stated" in page.ask(DETAIL)
    assert page.complaints() == []


def test_what_is_left_out_is_out_of_sight(page: Page, file: Path) -> None:
    """Boxes that the view does not see have no point on the canvas, from above and in 3D; and it leaves some out."""
    show(page, file)
    counts = page.ask(
        f"(() => {{ const v = {V}.view; let left = 0, wrong = 0, seed = 1;"
        "const random = () => (seed = (seed * 16807) % 2147483647) / 2147483647;"
        "for (let k = 0; k < 4000; k++) { v.solid = k % 2 > 0; v.turn = 6.3 * random(); v.pitch = 1.5 * random();"
        " v.look(40, 0, 0, 0.5 + 40 * random());"
        " const b = [0, 1].map(() => 400 * random() - 200), s = 20 * random(), z = 8 * random() - 4;"
        " if (v.sees([b[0], b[1], b[0] + s, b[1] + s, z, z + 2])) continue; left++;"
        " for (let j = 0; j < 20; j++) { const p = v.project(b[0] + s * random(), b[1] + s * random(), z + 2 * random());"
        " if (p[2] > 0.4 && (!v.solid || p[2] < 0.7 * v.far)"
        " && p[0] > 0 && p[1] > 0 && p[0] < v.width && p[1] < v.height) wrong++; } }"
        " return [left, wrong]; })()"
    )
    assert counts[0] > 1000 and counts[1] == 0
