"""Worlds at random of all that the simulator has: cities, bad drives, receivers that wander, detectors with habits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.random import Generator

from crowdmap_torch.simulate.faults import KINDS

_SEED = 99
_USUAL_PX = 1280
"""Noise is drawn in pixels of pictures of this width."""


@dataclass(frozen=True)
class _Drawn:
    """Options that come together, with this probability, and what their values are drawn between."""

    probability: float
    options: tuple[tuple[str, tuple[str, ...]], ...]
    """Each with the kinds and bounds of its values: `log 1 2`, `even 1 2` or `of a b c`, followed by `px` for pixels."""


def _drawn(probability: float, **options: str) -> _Drawn:
    named = ((f"--{name.replace('_', '-')}", tuple(of.split(", "))) for name, of in options.items())
    return _Drawn(probability, tuple(named))


_BIAS = dict.fromkeys(("bias_e_m", "bias_n_m", "bias_u_m"), "log 0.2 2")
_WHITE = dict.fromkeys(("white_e_m", "white_n_m", "white_u_m"), "log 0.005 0.1")
_OTHER_POSITIONING = _drawn(
    1, **_BIAS, drift_m="log 0.1 0.6", drift_length_m="log 50 600",
    drift_rot_deg="log 0.05 0.4", white_rot_deg="log 0.005 0.15", **_WHITE,
)  # fmt: skip
_WANDERING = (
    _drawn(0.3, drift_smooth_m="log 3 40"),
    _drawn(0.3, drift_freedom="of 3 4 6"),
    _drawn(0.2, bias_wander_m="log 0.3 2", bias_wander_length_m="log 300 4000"),
    _drawn(0.2, shared_bias_e_m="even -1 1"),
)
_ROADSIDE = _drawn(
    1, posts_per_km="log 8 60", opposite_share="even 0 1", left_share="even 0 0.6",
    back_to_back_share="even 0 0.5",
)  # fmt: skip
_HABITS = (
    _drawn(1, shared_share="even 0 0.7", yaw_deg="log 2 20", tilt_deg="log 0.5 6"),
    _drawn(0.3, stack_m="even 0.45 0.9"),
    _drawn(0.3, null_code_share="even 0 1", null_code="even 0 1"),
    _drawn(0.3, wrong_code="log 0.01 0.15", wrong_shape="log 0.01 0.15"),
    _drawn(0.3, duplicates="log 0.01 0.3"),
    _drawn(
        0.4, ghosts_per_frame="log 0.01 0.5", ghost_runs_per_frame="log 0.003 0.05",
        vehicle_signs_per_frame="log 0.003 0.05",
    ),
    _drawn(0.4, track_switches="log 0.005 0.2", track_errors="log 0.002 0.05"),
    _drawn(0.3, null_track="of 0.1 0.5 1.0"),
    _drawn(0.4, common_noise_px="log 0.1 1.5 px"),
    _drawn(0.4, jitter_px="log 0.2 2 px", jitter_s="log 0.1 1.5", jitter_scale="log 0.005 0.03"),
    _drawn(0.3, occlusions="even 0 0.8", lane_occlusions_per_km="even 0 20"),
    _drawn(0.3, range_m="of 4 8 12, of 30 50 80 120"),
    _drawn(0.3, lane_common_noise_px="log 0.3 4 px", lane_point_outliers="log 0.005 0.1"),
    _drawn(
        0.3, merged_lanes="log 0.01 0.2", false_lanes="log 0.02 0.5", missed_lanes="even 0 0.6"
    ),
    _drawn(0.3, load_deg="even 0 2", vibration_deg="log 0.05 0.6", squat_deg="even 0 1.5"),
    _drawn(0.3, lane_changes_per_km="even 0 6", wander_m="even 0 0.6", keeping_m="even 0 0.5"),
    _drawn(0.3, frame_loss="log 0.01 0.3", gap_s="even 0 8"),
    _drawn(0.2, heading_deg="even 0 60", heading_wavelength_m="log 150 800"),
    _drawn(0.2, grade="even 0 0.12", bank_deg="even 0 6"),
)  # fmt: skip
_SIGMAS = _drawn(0.5, sigma_scale="log 0.33 3", sigma_spread="log 1.05 2")
_ERRORS = "fleet fleet mounts clocks shutters boxes lane-offsets jitter focals"
_FLEET = _drawn(0.3, vehicles="of 2 3 5", errors=f"of {_ERRORS}")
_OUTAGES = _drawn(0.2, outages="even 0.1 0.5", outage_length_m="of 60, of 150", outage_m="log 1 6")
_NO_LANES = _drawn(0.15, max_lanes="of 0")


def drawn_wide_world(number: int) -> list[str]:
    """The options of `crowdmap simulate` of a world by its number."""
    rng = np.random.default_rng([_SEED, number])
    draw = partial(one_of, rng)
    kinds = ("suburb", "highway", "hills", "street", "motorway", "block", "city", "city")
    world, journeys = draw(*kinds), int(draw(5, 6, 8, 10, 12))
    drawn = ["--world", world, "--journeys", str(journeys), "--seed", str(number)]
    if world == "city":
        drawn += ["--street-shift-m", "10", "--corner-shift-m", "4"]
        drawn += ["--square-m", draw(250, 400), "--length-m", draw(500, 800)]
        drawn += _values(rng, _drawn(1, turn_share="even 0.1 0.6", street_every_m="of 100 120"), 1)
    elif world != "block":
        drawn += ["--length-m", draw(300, 400, 600)]
    camera = draw("brown", "brown", "pinhole", "fisheye")
    width = int(draw(1280, 1920, 640, 3840))
    height = int(width * float(draw(0.5625, 0.75)))
    drawn += ["--camera", camera, "--width", str(width), "--height", str(height)]
    drawn += ["--focal-px", str(round(width * float(_value(rng, "log 0.5 1.4", 1))))]
    rig = _drawn(
        1, camera_height_m="log 1.1 2.6", camera_pitch_deg="even -1 6",
        frame_rate_hz="of 5 10 15 30", rigs="of 1 1 2 3", pixel_noise_px="log 0.3 2 px",
        outliers="log 0.005 0.08", missed="log 0.02 0.5", lane_noise_px="log 0.5 2.5 px",
    )  # fmt: skip
    drawn += _values(rng, rig, width)
    preset = _drawn(1, positioning="of consumer paper")
    drawn += _values(rng, preset if rng.random() < 0.6 else _OTHER_POSITIONING, width)
    drawn += _several(rng, _WANDERING, width)
    if world != "city":
        drawn += _values(rng, _ROADSIDE, width)
    drawn += _several(rng, _HABITS, width)
    drawn += ["--no-sigmas"] if rng.random() < 0.3 else _several(rng, (_SIGMAS,), width)
    drawn += _several(rng, (_FLEET,), width)
    if rng.random() < 0.3 and journeys >= 8:
        faults = [*KINDS]
        rng.shuffle(faults)
        drawn += ["--bad-drives", ",".join(faults[: int(rng.integers(1, journeys // 4 + 1))])]
    return drawn + _several(rng, (_OUTAGES, _NO_LANES), width)


def _several(rng: Generator, options: Sequence[_Drawn], width: int) -> list[str]:
    """Those of the options that chance picks."""
    drawn: list[str] = []
    for each in options:
        if each.probability == 1 or rng.random() < each.probability:
            drawn += _values(rng, each, width)
    return drawn


def _values(rng: Generator, drawn: _Drawn, width: int) -> list[str]:
    words: list[str] = []
    for option, of in drawn.options:
        words += [option, *(_value(rng, text, width) for text in of)]
    return words


def _value(rng: Generator, text: str, width: int) -> str:
    """A value of what is drawn so, of a picture of this width."""
    how, *of = text.split()
    if how == "of":
        return one_of(rng, *of)
    least, most = float(of[0]), float(of[1])
    if how == "even":
        return str(float(np.round(rng.uniform(least, most), 3)))
    value = between(rng, least, most)
    return str(value * width / _USUAL_PX if of[-1] == "px" else value)


def one_of(rng: Generator, *choices: float | str) -> str:
    """One of the choices, as likely as any other, as a command line has it."""
    return str(choices[int(rng.integers(len(choices)))])


def between(rng: Generator, least: float, most: float) -> float:
    """A number between these, log-uniform."""
    return float(np.round(np.exp(rng.uniform(np.log(least), np.log(most))), 4))
