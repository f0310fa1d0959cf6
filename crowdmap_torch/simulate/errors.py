"""What real fleets get wrong, error by error, at the sizes that real vehicles have."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

from crowdmap_torch.simulate.dataset import SimulationConfig

VEHICLES = 8
"""Of a fleet with errors, if the configuration says nothing of their number."""


@dataclass(frozen=True)
class ErrorSize:
    """One error: the option of a section of `SimulationConfig` that sets its size, with what else belongs to it."""

    section: str
    option: str
    size: float
    others: tuple[tuple[str, float], ...] = ()
    """Options that do not grow with the size."""
    is_ratio: bool = False
    """True: twice the error is the square of the size."""

    def put_into(self, config: SimulationConfig, factor: float) -> SimulationConfig:
        """The configuration with this error, `factor` times as large."""
        size = self.size**factor if self.is_ratio else self.size * factor
        changes = {**dict(self.others), self.option: size}
        return replace(config, **{self.section: replace(getattr(config, self.section), **changes)})


ERRORS: Mapping[str, tuple[ErrorSize, ...]] = {
    "mounts": (ErrorSize("fleet", "mount_error_deg", 0.2),),
    "focals": (ErrorSize("fleet", "focal_error", 0.002),),
    "principals": (ErrorSize("fleet", "principal_error_px", 1.5),),
    "heights": (ErrorSize("fleet", "height_error_m", 0.03),),
    "clocks": (ErrorSize("fleet", "clock_error_s", 0.015),),
    "shutters": (ErrorSize("fleet", "read_out_s", 0.02),),
    "jitter": (ErrorSize("signs", "jitter_px", 0.7, (("jitter_s", 0.3),)),),
    "boxes": (ErrorSize("fleet", "box_error_mean", 0.01), ErrorSize("fleet", "box_error", 0.002)),
    "lane-offsets": (ErrorSize("fleet", "lane_error_m", 0.03),),
    "sigmas": (ErrorSize("positioning", "sigma_spread", 1.5, is_ratio=True),),
    "outages": (ErrorSize("positioning", "outage_m", 3.0, (("outages", 0.1),)),),
}
"""By name; all of them together are the preset `fleet`."""
ALL = "fleet"


def with_errors(
    config: SimulationConfig, names: Iterable[str], factor: float = 1.0
) -> SimulationConfig:
    """The same drives with some of `ERRORS`, `factor` times as large; `fleet` stands for all.

    ValueError names one that there is not.
    """
    wanted = [name for asked in names for name in (ERRORS if asked == ALL else (asked,))]
    if unknown := [name for name in wanted if name not in ERRORS]:
        raise ValueError(f"error {unknown[0]!r}: expected some of {', '.join((ALL, *ERRORS))}")
    if not config.fleet.vehicles:
        config = replace(config, fleet=replace(config.fleet, vehicles=VEHICLES))
    for name in wanted:
        for error in ERRORS[name]:
            config = error.put_into(config, factor)
    return config
