from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch

from crowdmap_torch.io.documents import Document, plain, read_json, read_yaml, write_json
from crowdmap_torch.io.errors import InputError


@dataclass(frozen=True)
class Pair:
    first: float
    second: object


def test_plain_content_is_what_json_holds(tmp_path: Path):
    content = {
        "tensor": torch.tensor([1.0, math.nan]),
        "array": np.array([[1, 2]]),
        "scalar": np.float64(0.5),
        "nested": {"tuple": (1, "two", None, True), "infinite": math.inf},
        "path": Path("map"),
        "fields": Pair(math.nan, Pair(1.0, ())),
    }
    write_json(tmp_path / "plain.json", plain(content))
    assert json.loads((tmp_path / "plain.json").read_text()) == {
        "tensor": [1.0, None],
        "array": [[1, 2]],
        "scalar": 0.5,
        "nested": {"tuple": [1, "two", None, True], "infinite": None},
        "path": "map",
        "fields": {"first": None, "second": {"first": 1.0, "second": []}},
    }


def test_what_is_written_is_what_is_read(tmp_path: Path):
    content = {"a": [1, 2.5, None], "b": {"c": "text"}}
    write_json(tmp_path / "some" / "a.json", content)
    assert read_json(tmp_path / "some" / "a.json").content == content


def test_a_number_that_is_not_finite_is_never_written(tmp_path: Path):
    path = tmp_path / "a.json"
    write_json(path, {"a": 1})
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_json(path, {"a": math.inf})
    assert json.loads(path.read_text()) == {"a": 1}


@pytest.mark.parametrize("text", ["NaN", "Infinity", "-Infinity"])
def test_constants_beyond_json_are_refused(tmp_path: Path, text: str):
    (tmp_path / "a.json").write_text(f'{{"a": {text}}}')
    with pytest.raises(InputError, match=f"cannot be read as JSON .{text} is not allowed"):
        read_json(tmp_path / "a.json")


@pytest.mark.parametrize(
    ("read", "text"), [(read_json, '{"a": 1, "b": 2, "a": 3}'), (read_yaml, "a: 1\nb: 2\na: 3\n")]
)
def test_a_key_given_twice_is_refused_by_name(tmp_path: Path, read, text: str):
    (tmp_path / "file").write_text(text)
    with pytest.raises(InputError, match="key 'a' is given twice"):
        read(tmp_path / "file")


def test_exponents_without_a_point_are_numbers_in_yaml(tmp_path: Path):
    (tmp_path / "a.yaml").write_text("values: [1e-5, -2E+3, 1.5e2, 3]")
    assert read_yaml(tmp_path / "a.yaml").numbers("values") == [1e-5, -2000.0, 150.0, 3.0]


@pytest.mark.parametrize("read", [read_json, read_yaml])
def test_a_file_that_is_missing_or_no_mapping_is_named(tmp_path: Path, read):
    with pytest.raises(InputError, match=r"nowhere: the file is missing"):
        read(tmp_path / "nowhere")
    (tmp_path / "list").write_text("[1, 2]")
    with pytest.raises(InputError, match="expected a mapping of keys to values, found a list of 2"):
        read(tmp_path / "list")


BAD_VALUES = {
    "text": (lambda d: d.text("a"), 1, "a: expected a text that is not empty, found 1"),
    "empty text": (lambda d: d.text("a"), "", "a: expected a text that is not empty"),
    "folder": (lambda d: d.name("a"), "../b", "a: expected the plain name of a folder"),
    "boolean": (lambda d: d.number("a"), True, "a: expected a number, found True"),
    "fraction": (
        lambda d: d.integer("a", low=0, high=9),
        1.5,
        "a: expected a whole number in 0 to 9",
    ),
    "too large": (
        lambda d: d.integer("a", low=0, high=9),
        10,
        "a: expected a whole number in 0 to 9",
    ),
    "beyond float": (lambda d: d.number("a"), 10**400, "a: expected a finite number"),
    "out of range": (
        lambda d: d.number("a", high=1.0),
        2,
        "a: expected a number in -inf to 1, found 2.0",
    ),
    "zero": (lambda d: d.numbers("a", most=1.0), [0, 2], r"a\[1\]: expected a number in -1 to 1"),
    "short": (
        lambda d: d.numbers("a", 3),
        [1, 2],
        "a: expected a list of 3 numbers, found 2 values",
    ),
    "inside": (lambda d: d.numbers("a"), [1, None], r"a\[1\]: expected a number, found nothing"),
    "missing": (lambda d: d.take("b"), 1, "b: is missing"),
    "mapping": (lambda d: d.part("a"), 1, "a: expected a mapping of keys to values, found 1"),
    "format": (lambda d: d.require_format("map"), 1, "format: is missing"),
}


@pytest.mark.parametrize("case", BAD_VALUES)
def test_a_bad_value_is_refused_with_its_key(case: str):
    take, value, rule = BAD_VALUES[case]
    with pytest.raises(InputError, match=f"^head.json: {rule}"):
        take(Document(Path("head.json"), {"a": value}))


def test_a_section_is_named_by_its_way_through_the_file():
    document = Document(Path("rig.yaml"), {"camera": {"lens": {"k": "x"}}})
    with pytest.raises(InputError, match=r"camera\.lens\.k: expected a number, found 'x'"):
        document.part("camera").part("lens").number("k")


def test_keys_that_are_missing_or_unknown_are_refused():
    document = Document(Path("a"), {"one": 1, "two": 2})
    document.allow(("one",), ("two", "three"))
    with pytest.raises(InputError, match=r"key 'three' is missing; expected one, three, two"):
        document.allow(("one", "three"), ("two",))
    with pytest.raises(InputError, match=r"key 'two' is unknown; expected one, three \(optional\)"):
        document.allow(("one",), ("three",))
    document = Document(Path("a"), {"format": "x", "version": True})
    with pytest.raises(InputError, match="version: expected version 1, found True; convert"):
        document.require_format("x")
