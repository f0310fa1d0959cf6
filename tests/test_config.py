from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any, get_args

import pytest
from jaxtyping import TypeCheckError

from crowdmap_torch.config import MapperConfig, as_dict, config_hash, dump, load_config
from crowdmap_torch.ranges import Range, hints

ROOT = Path(__file__).parent.parent
REFUSED = (ValueError, TypeCheckError)
"""With `CROWDMAP_CHECK_SHAPES=1` what is of another type is refused before a range is looked at."""


@pytest.fixture
def load(tmp_path: Path):
    def read(text: str) -> MapperConfig:
        path = tmp_path / "some.yaml"
        path.write_text(text, encoding="utf-8")
        return load_config(path)

    return read


def test_without_a_file_or_with_an_empty_one_everything_is_default(load):
    assert load_config(None) == MapperConfig()
    assert load("") == MapperConfig()
    assert load("# nothing but a comment\n") == MapperConfig()


def test_a_file_changes_what_it_names_and_nothing_else(load):
    config = load("seed: 3\nadjust: {lm: {max_iterations: 7}}\n")
    default = MapperConfig()
    lm = replace(default.adjust.lm, max_iterations=7)
    assert config == replace(default, seed=3, adjust=replace(default.adjust, lm=lm))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("sede: 3", ["unknown key 'sede'", "seed"]),
        ("adjust: {lm: {iterations: 3}}", ["adjust: lm", "unknown key 'iterations'"]),
        ("seed: three", ["seed", "expected int", "'three'"]),
        ("seed: 1.5", ["seed", "expected int", "1.5"]),
        ("seed: true", ["seed", "expected int", "True"]),
        ("seed: null", ["seed", "expected int", "None"]),
        ("method: 3", ["method", "expected str", "3"]),
        ("min_confidence: high", ["min_confidence", "expected float", "'high'"]),
        ("min_confidence: true", ["min_confidence", "expected float", "True"]),
        ("min_confidence: [0.5]", ["min_confidence", "expected float", "[0.5]"]),
        ("adjust: 3", ["adjust", "expected keys and values", "3"]),
        ("[1, 2]", ["expected keys and values"]),
        ("lane_association: {reach_m: 2.0}", ["reach_m", "expected a list", "2.0"]),
        ("lane_association: {reach_m: [2.0]}", ["reach_m", "expected 2 values, found 1"]),
        ("positioning: {bias_sigma_m: [1, 1, 1, 1]}", ["bias_sigma_m", "expected 3 values"]),
        ("lane_association: {reach_m: [2.0, far]}", ["reach_m[1]", "expected float", "'far'"]),
        ("method: best", ["method", "joint", "paper2017", "'best'"]),
        ("crowd: {method: best}", ["crowd", "method", "'best'"]),
        ("seed: [1, 2", ["cannot be read as YAML"]),
        ("seed: 1\n\tadjust: 2", ["cannot be read as YAML"]),
        ("seed: " + "9" * 5000, ["cannot be read as YAML"]),
        ("seed: 0x" + "f" * 5000, ["seed", "expected 0 to", "thousands of digits"]),
        ("seed: -1", ["seed", "expected 0 to", "-1"]),
        ("adjust: {sign_sigma_px: -3}", ["adjust: sign_sigma_px", "0.001 to", "pixels", "-3"]),
        ("adjust: {tukey_c: 0}", ["adjust: tukey_c", "expected 0.5 to", "found 0"]),
        ("adjust: {tukey_c: 1e300}", ["adjust: tukey_c", "expected 0.5 to", "found 1e+300"]),
        ("adjust: {tukey_c: .nan}", ["adjust: tukey_c", "found nan"]),
        ("adjust: {lm: {max_iterations: 100000000}}", ["adjust: lm: max_iterations", "an end"]),
        ("min_confidence: .inf", ["min_confidence", "found inf"]),
        ("min_confidence: 1.5", ["min_confidence", "expected 0 to 1", "a share"]),
        ("lane_association: {reach_m: [40, 2]}", ["reach_m", "none is below the one before"]),
        ("crowd: {shift_sigmas_m: []}", ["shift_sigmas_m", "expected one number at least"]),
        ("lane_join: {bandwidths_m: [0.6, -0.2]}", ["bandwidths_m[1]", "found -0.2"]),
        ("seed: 1\nseed: 2", ["'seed' is given twice"]),
    ],
)
def test_mistakes_are_one_line_that_names_file_key_and_rule(load, text: str, words: list[str]):
    with pytest.raises(ValueError) as error:
        load(text)
    line = str(error.value)
    assert "\n" not in line and "some.yaml" in line
    assert [word for word in words if word not in line] == []


def test_a_missing_file_is_one_line(tmp_path: Path):
    with pytest.raises(ValueError, match=r"none\.yaml: the file is missing"):
        load_config(tmp_path / "none.yaml")


def test_bytes_that_are_no_text_are_refused(tmp_path: Path):
    path = tmp_path / "some.yaml"
    path.write_bytes(b"\xff\xfe\x00seed")
    with pytest.raises(ValueError, match="is no UTF-8 text"):
        load_config(path)


def test_numbers_are_read_as_people_write_them(load):
    # YAML 1.1 takes 1e-6 for text and 1 for an integer.
    config = load("adjust: {lm: {cost_tolerance: 1e-6}, tukey_c: 5}\nmin_confidence: .25\n")
    assert config.adjust.lm.cost_tolerance == 1e-6
    assert config.adjust.tukey_c == 5.0 and isinstance(config.adjust.tukey_c, float)
    assert config.min_confidence == 0.25


def test_lists_become_tuples_of_numbers(load):
    config = load("crowd: {shift_sigmas_m: [1, 0.5]}\nlane_association: {reach_m: [3, 40]}\n")
    assert config.crowd.shift_sigmas_m == (1.0, 0.5)
    assert config.lane_association.reach_m == (3.0, 40.0)


def test_lists_of_lists_become_tuples_of_tuples(load):
    config = load("adjust: {size_classes_m: [[0.6, 0.6], [1, 0.75]]}")
    assert config.adjust.size_classes_m == ((0.6, 0.6), (1.0, 0.75))


@pytest.mark.parametrize("sizes", ["[0.6, 0.6]", "[[0.6]]", "[[0.6, -0.6]]"])
def test_size_classes_come_as_positive_pairs(load, sizes: str):
    with pytest.raises(ValueError, match=r"size_classes_m.*expected"):
        load(f"adjust: {{size_classes_m: {sizes}}}")


@pytest.mark.parametrize(
    "text",
    ["", "seed: 3", "method: paper2017", "lane: {}", "adjust: {size_classes_m: [[0.6, 0.6]]}"],
)
def test_dump_then_load_gives_the_same_configuration(load, text: str):
    config = load(text)
    assert load(dump(config)) == config


def test_the_hash_tells_configurations_apart_and_equal_ones_not(load):
    configs = [MapperConfig(), load("seed: 1"), load("adjust: {lm: {min_damping: 1e-9}}")]
    assert len({config_hash(c) for c in configs}) == 3
    assert config_hash(load(dump(configs[2]))) == config_hash(configs[2])


def test_methods_of_the_paper_reach_every_stage():
    config = MapperConfig(method="paper2017").resolved()
    methods = {
        name: part["method"]
        for name, part in as_dict(config).items()
        if isinstance(part, dict) and "method" in part
    }
    assert methods and set(methods.values()) == {"paper2017"}
    assert config.adjust.lane_height_sigma_m == math.inf


def test_our_method_leaves_the_stages_alone():
    config = MapperConfig()
    assert config.resolved() == config
    assert MapperConfig(method="paper2017").resolved().resolved().crowd.method == "paper2017"


@pytest.mark.parametrize("path", sorted((ROOT / "configs").glob("*.yaml")), ids=lambda p: p.stem)
def test_every_configuration_of_the_repository_can_be_read(path: Path):
    assert load_config(path) != MapperConfig()


def numbers_of(config: Any, way: str = "") -> Iterator[tuple[Any, str, str, Any]]:
    """Every field of a configuration that holds numbers: what it is in, its name, its way there, its annotation."""
    for field in fields(config):
        value, name = getattr(config, field.name), f"{way}{field.name}"
        if is_dataclass(value):
            yield from numbers_of(value, f"{name}.")
        elif not isinstance(value, str | bool):
            yield config, field.name, name, hints(type(config))[field.name]


def ranges_in(hint: Any) -> list[Range]:
    """The ranges of an annotation, those inside tuples too."""
    inside = [r for argument in get_args(hint) for r in ranges_in(argument)]
    return inside + [r for r in getattr(hint, "__metadata__", ()) if isinstance(r, Range)]


def instead(value: Any, number: float) -> Any:
    """A field's value with a number for each of its own."""
    if isinstance(value, tuple):
        return tuple(instead(item, number) for item in value) or (number,)
    return number


NUMBERS = {name: (inside, field, hint) for inside, field, name, hint in numbers_of(MapperConfig())}


@pytest.mark.parametrize("name", NUMBERS)
def test_every_number_has_a_range_with_a_reason_and_holds_to_it(name: str):
    inside, field, hint = NUMBERS[name]
    ranges = ranges_in(hint)
    assert ranges and all(r.why and math.isfinite(r.low) and math.isfinite(r.high) for r in ranges)
    value = getattr(inside, field)
    # The default lies inside: replacing it by itself is no error.
    replace(inside, **{field: value})
    beyond = (math.nan, -math.inf, 10 * ranges[0].high + 1, ranges[0].low - 1)
    for number in (*beyond, *(() if ranges[0].or_infinite else (math.inf,))):
        with pytest.raises(REFUSED, match=field):
            replace(inside, **{field: instead(value, number)})


def test_what_is_no_configuration_is_refused_from_python_too():
    with pytest.raises(REFUSED, match=r"adjust: expected AdjustConfig|parameter 'adjust'"):
        MapperConfig(adjust={"tukey_c": 5.0})  # type: ignore[arg-type]
    with pytest.raises(
        REFUSED, match=r"seed: expected a whole number, found 1\.5|parameter 'seed'"
    ):
        MapperConfig(seed=1.5)  # type: ignore[arg-type]
