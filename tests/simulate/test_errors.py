from __future__ import annotations

from dataclasses import asdict, replace

import pytest

from crowdmap_torch.simulate.dataset import SimulationConfig
from crowdmap_torch.simulate.errors import ALL, ERRORS, VEHICLES, with_errors

RIGHT = SimulationConfig()


def _changes(config: SimulationConfig) -> dict[tuple[str, str], object]:
    """Options that differ from a fleet of as many vehicles without errors."""
    base = asdict(replace(RIGHT, fleet=replace(RIGHT.fleet, vehicles=VEHICLES)))
    return {
        (section, option): value
        for section, options in asdict(config).items()
        if isinstance(options, dict)
        for option, value in options.items()
        if value != base[section][option]
    }


def test_no_error_is_a_fleet_without_errors():
    assert _changes(with_errors(RIGHT, [])) == {}


def test_the_fleet_has_every_error_at_the_size_that_it_has_alone():
    alone: dict[tuple[str, str], object] = {}
    for name in ERRORS:
        changes = _changes(with_errors(RIGHT, [name]))
        assert changes and not changes.keys() & alone.keys()
        alone |= changes
    assert _changes(with_errors(RIGHT, [ALL])) == alone
    assert alone["fleet", "mount_error_deg"] == 0.2 and alone["signs", "jitter_px"] == 0.7


@pytest.mark.parametrize("name", ERRORS)
def test_an_error_twice_as_large_is_another_one_of_the_same_kind(name: str):
    once, twice = (with_errors(RIGHT, [name], factor) for factor in (1.0, 2.0))
    for error in ERRORS[name]:
        sizes = [getattr(getattr(config, error.section), error.option) for config in (once, twice)]
        assert sizes[1] == (sizes[0] ** 2 if error.is_ratio else 2 * sizes[0])
    assert _changes(once).keys() >= _changes(twice).keys() - {("positioning", "outage_m")}


def test_a_number_of_vehicles_that_was_asked_for_stays():
    few = replace(RIGHT, fleet=replace(RIGHT.fleet, vehicles=3))
    assert with_errors(few, [ALL]).fleet.vehicles == 3


def test_an_unknown_error_is_refused():
    with pytest.raises(ValueError, match="'rust': expected some of fleet, mounts"):
        with_errors(RIGHT, ["rust"])
