"""What is not read at all: what is no file, leads elsewhere, or asks for more than the budget has."""

from __future__ import annotations

import os
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from crowdmap_torch.io.budget import ReadingBudget, budget_now, read_text, reading
from crowdmap_torch.io.columns import Sheet
from crowdmap_torch.io.datasets import load_dataset
from crowdmap_torch.io.documents import read_json, read_yaml
from crowdmap_torch.io.errors import InputError


def merge_bomb(levels: int) -> str:
    """Ten aliases of the level before in each: ten to the power of the levels when unfolded."""
    lines = ["a0: &a0 {x: 1}"]
    for k in range(1, levels):
        lines.append(f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 10)}]")
    return "\n".join(lines)


BOMBS = {
    "aliases unfold": (read_yaml, merge_bomb(12), "more than 500000 nodes"),
    "merges unfold": (
        read_yaml,
        "a: &a {x: 1, y: 2}\n" + "".join(f"b{k}: {{<<: *a}}\n" for k in range(2000)),
        "more than 1000 aliases",
    ),
    "an alias of itself": (read_yaml, "a: &a [*a]", "stands before or inside its anchor"),
    "yaml too deep": (read_yaml, "[" * 10_000, "more than 64 levels"),
    "json too deep": (read_json, "[" * 100_000, "more than 64 levels"),
    "json too much": (read_json, '{"a": [' + "0," * 600_000 + "0]}", "more than 500000 values"),
    "a number of thousands of digits": (read_json, '{"a": ' + "9" * 5000 + "}", "as JSON"),
    "the same in yaml": (read_yaml, "a: " + "9" * 5000, "as YAML"),
    "no utf-8": (read_json, b"\xff\xfe", "is no UTF-8 text"),
}


@pytest.mark.parametrize("bomb", BOMBS)
def test_a_bomb_is_refused_before_it_unfolds(tmp_path: Path, bomb: str) -> None:
    read, content, rule = BOMBS[bomb]
    path = tmp_path / "file"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(InputError, match=rule) as error:
        read(path)
    assert "\n" not in str(error.value) and str(path) in str(error.value)


def test_brackets_in_a_text_are_no_levels(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text('{"a": "' + "[" * 1000 + '\\"{"}')
    assert read_json(tmp_path / "a.json").text("a").startswith("[[")


def test_a_pipe_a_device_and_a_link_to_itself_are_not_opened(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "circle").symlink_to("circle")
    (tmp_path / "nothing").symlink_to("nowhere")
    (tmp_path / "zero").symlink_to("/dev/zero")
    words = {
        "pipe": "a pipe is there instead",
        "zero": "a device is there instead",
        "circle": "cannot be read",
        "nothing": "a link to nothing",
    }
    for name, rule in words.items():
        with pytest.raises(InputError, match=rule):
            read_text(tmp_path / name)
        with pytest.raises(InputError, match=f"{rule}.*; expected a Parquet file"):
            Sheet(tmp_path / name, ("frame",))


def test_a_file_of_more_bytes_than_the_budget_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text("{}" + " " * 100)
    with reading(ReadingBudget(text_bytes=64)):
        with pytest.raises(InputError, match="has 102 bytes; expected 64 at most"):
            read_json(tmp_path / "a.json")
        assert budget_now().text_bytes == 64
    assert read_json(tmp_path / "a.json").content == {}


def test_a_table_that_unfolds_in_memory_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "zeros.parquet"
    # A constant column costs nothing on disk: 160 MB in a file of a few kB.
    rows = pa.DictionaryArray.from_arrays(pa.repeat(pa.scalar(0, pa.int32()), 10_000_000), [0.0])
    columns = {name: rows.cast(pa.float64()) for name in ("x", "y")}
    pq.write_table(pa.table(columns), path)
    with pytest.raises(InputError, match="claim to hold 160000000 bytes"):
        Sheet(path, ("x", "y"))
    assert len(Sheet(path, (), ())) == 10_000_000
    with (
        reading(ReadingBudget(rows=9_999)),
        pytest.raises(InputError, match="claims 10000000 rows"),
    ):
        Sheet(path, ("x",))


def test_a_text_that_repeats_until_it_fills_the_memory_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "texts.parquet"
    texts = pa.DictionaryArray.from_arrays(pa.repeat(pa.scalar(0, pa.int32()), 5000), ["x" * 10**6])
    pq.write_table(pa.table({"type": texts}), path)
    with pytest.raises(InputError, match="column 'type': 5000000000 bytes of text"):
        Sheet(path, ("type",)).strings("type")


def test_a_footer_that_contradicts_itself_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "cut.parquet"
    pq.write_table(pa.table({"x": [0.0] * 1000}), path)
    content = path.read_bytes()
    end = int.from_bytes(content[-8:-4], "little") + 8
    # The footer of the whole file behind a part of its pages.
    path.write_bytes(content[:4] + content[-end:])
    with pytest.raises(InputError, match="cannot be read as Parquet"):
        Sheet(path, ("x",))


@pytest.mark.parametrize("way", ["journeys/a", "journeys/a/poses.parquet", "rigs/a", "journeys"])
def test_no_link_leads_out_of_a_data_set(sound, tmp_path: Path, way: str) -> None:
    folder = sound.write()
    outside = tmp_path / "outside"
    (folder / way).rename(outside)
    (folder / way).symlink_to(outside)
    if way == "journeys":
        with pytest.raises(InputError, match="a link leads out of"):
            load_dataset(folder)
        return
    (rejected,) = load_dataset(folder).rejected
    assert rejected.journey_id == "a" and "a link leads out of" in rejected.reason


def test_links_inside_a_data_set_and_to_it_are_followed(sound, tmp_path: Path) -> None:
    folder = sound.write()
    (folder / "rigs" / "a").rename(folder / "rigs" / "other")
    (folder / "rigs" / "a").symlink_to("other")
    (tmp_path / "link").symlink_to(folder)
    assert load_dataset(tmp_path / "link").rejected == ()


def test_a_journey_that_is_a_link_to_itself_is_named(sound) -> None:
    folder = sound.write()
    (folder / "journeys" / "c").symlink_to("c")
    (rejected,) = load_dataset(folder).rejected
    assert rejected.journey_id == "c" and "\n" not in rejected.reason


def test_a_name_of_a_journey_is_shown_on_one_line(sound) -> None:
    folder = sound.write()
    (folder / "journeys" / "a").rename(folder / "journeys" / "a\nb")
    (rejected,) = load_dataset(folder).rejected
    assert rejected.journey_id == "a\\nb"


@pytest.mark.parametrize("size", [250, 255, 5000])
def test_long_names_of_rigs_and_mounts_are_refused(sound, size: int) -> None:
    sound.journeys["b"].head["rig"] = "x" * size
    sound.rigs["a"]["mount"]["urdf"] = "x" * size
    reasons = [r.reason for r in load_dataset_all_aside(sound)]
    assert all(f"a name of {size} bytes; expected 200 at most" in r for r in reasons)


def load_dataset_all_aside(sound):
    sound.journeys["c"] = type(sound.journeys["a"])(
        {"format": "crowdmap-journey", "version": 1, "journey_id": "c", "rig": "c"}
    )
    sound.rigs["c"] = {k: v for k, v in sound.rigs["a"].items() if k != "mount"}
    return load_dataset(sound.write()).rejected
