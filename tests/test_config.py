from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest

from crowdmap_torch.config import MapperConfig, as_dict, config_hash, dump, load_config

ROOT = Path(__file__).parent.parent


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
        ("seed: [1, 2", ["is not YAML"]),
        ("seed: 1\n\tadjust: 2", ["is not YAML"]),
    ],
)
def test_mistakes_are_one_line_that_names_file_key_and_rule(load, text: str, words: list[str]):
    with pytest.raises(ValueError) as error:
        load(text)
    line = str(error.value)
    assert "\n" not in line and "some.yaml" in line
    assert [word for word in words if word not in line] == []


def test_a_missing_file_is_one_line(tmp_path: Path):
    with pytest.raises(ValueError, match=r"none\.yaml: cannot be read \(No such file"):
        load_config(tmp_path / "none.yaml")


def test_bytes_that_are_no_text_are_refused(tmp_path: Path):
    path = tmp_path / "some.yaml"
    path.write_bytes(b"\xff\xfe\x00seed")
    with pytest.raises(ValueError, match="is not YAML"):
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
    assert methods.pop("sign_association") == methods.pop("lane_association") == "epipolar"
    assert methods and set(methods.values()) == {"paper2017"}
    assert config.adjust.lane_height_sigma_m == math.inf


def test_our_method_leaves_the_stages_alone():
    config = MapperConfig()
    assert config.resolved() == config
    assert MapperConfig(method="paper2017").resolved().resolved().crowd.method == "paper2017"


@pytest.mark.parametrize("path", sorted((ROOT / "configs").glob("*.yaml")), ids=lambda p: p.stem)
def test_every_configuration_of_the_repository_can_be_read(path: Path):
    assert load_config(path) != MapperConfig()
