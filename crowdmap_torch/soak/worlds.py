"""Worlds at random: roads, cameras, detectors and receivers of all kinds, each simulated and mapped as they are.

The simulator's own presets have one camera, one noise, one rate. Here each number is drawn from what is met in the field,
and beyond: cameras of 640 to 3,840 pixels, 5 to 30 Hz, up to half of all detections missing, biases of up to two metres,
stated sigmas that are none or wrong. A line tells of each world what its map is worth, and how to make one that lacks signs.
"""

from __future__ import annotations

import argparse
import json
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path

import numpy as np

from crowdmap_torch.cli import main
from crowdmap_torch.soak.wide_worlds import between, drawn_wide_world, one_of

_RECALL, _PRECISION = 0.95, 0.9
"""Least of the signs that can be seen, and of those of the map, that are to be found and right."""
_SEED = 77
_DRAWN = {
    **dict.fromkeys(("--bias-e-m", "--bias-n-m", "--bias-u-m"), (0.2, 2.0)),
    "--drift-m": (0.1, 0.6),
    "--drift-length-m": (80, 400),
    "--drift-rot-deg": (0.05, 0.4),
    "--white-rot-deg": (0.01, 0.1),
    **dict.fromkeys(("--white-e-m", "--white-n-m", "--white-u-m"), (0.01, 0.08)),
    "--posts-per-km": (8, 50),
}
"""What positioning gets wrong, and how many posts there are: least and most, log-uniform."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What `soak worlds` takes."""
    parser.add_argument("--first", type=int, default=0, metavar="N", help="number of the first")
    parser.add_argument("--count", type=int, default=10, metavar="N", help="how many")
    parser.add_argument(
        "--wide",
        action="store_true",
        help="of all that the simulator has, cities and bad drives too",
    )


def run(options: argparse.Namespace) -> int:
    """Maps the worlds and prints the table; 0 if no map lacks signs, or has many that are none."""
    print(f"{'':>4} {'world':<8} {'camera':<18} signs recall right relative inside", flush=True)
    bad = 0
    with tempfile.TemporaryDirectory(prefix="soak-") as temporary:
        for number in range(options.first, options.first + options.count):
            drawn = drawn_wide_world(number) if options.wide else drawn_world(number)
            figures = _figures(drawn, Path(temporary) / str(number))
            held = figures is not None and _holds(figures)
            print(_line(number, drawn, figures), flush=True)
            if not held:
                bad += 1
                print(f"     crowdmap simulate DATA {' '.join(drawn)}", flush=True)
    return 1 if bad else 0


def drawn_world(number: int) -> list[str]:
    """The options of `crowdmap simulate` of a world by its number."""
    rng = np.random.default_rng([_SEED, number])
    world = one_of(rng, "suburb", "highway", "hills", "street", "suburb", "motorway", "block")
    drawn = ["--world", world, "--journeys", one_of(rng, 6, 10, 10, 15), "--seed", str(number)]
    if world != "block":
        drawn += ["--length-m", one_of(rng, 300, 400, 600)]
    camera = one_of(rng, "brown", "brown", "pinhole", "fisheye")
    width = int(one_of(rng, 1280, 1920, 640, 3840))
    height = int(width * float(one_of(rng, 0.5625, 0.75)))
    drawn += ["--camera", camera, "--width", str(width), "--height", str(height)]
    drawn += ["--focal-px", str(round(width * between(rng, 0.5, 1.4)))]
    drawn += ["--camera-height-m", str(between(rng, 1.1, 2.6))]
    drawn += ["--camera-pitch-deg", str(round(float(rng.uniform(-1, 6)), 2))]
    drawn += ["--frame-rate-hz", one_of(rng, 5, 10, 15, 30)]
    # Detectors see a picture of a size of their own: their noise is so many pixels of that.
    drawn += ["--pixel-noise-px", str(between(rng, 0.3, 2.0) * width / 1280)]
    drawn += ["--outliers", str(between(rng, 0.005, 0.08))]
    drawn += ["--missed", str(between(rng, 0.02, 0.5))]
    drawn += ["--lane-noise-px", str(between(rng, 0.5, 2.5) * width / 1280)]
    for option, bounds in _DRAWN.items():
        drawn += [option, str(between(rng, *bounds))]
    drawn += ["--shared-share", str(round(float(rng.uniform(0, 0.6)), 2))]
    if rng.random() < 0.3:
        drawn += ["--no-sigmas"]
    elif rng.random() < 0.5:
        drawn += ["--sigma-scale", str(between(rng, 0.4, 2.5))]
    if rng.random() < 0.4:
        drawn += ["--vehicles", one_of(rng, 2, 4), "--errors", "fleet"]
    if rng.random() < 0.3:
        drawn += ["--null-track", "0.5"]
    if rng.random() < 0.3:
        drawn += ["--max-lanes", "0"]
    return drawn


def _figures(drawn: Sequence[str], place: Path) -> Mapping | None:
    """What the map of a world is worth, as metrics.json has it; None: there is no map."""
    data, made = place / "data", place / "run"
    mapped = ["optimize", str(data), "--out", str(made), "--workers", "1", "--quiet"]
    with redirect_stdout(StringIO()), redirect_stderr(StringIO()) as told:
        failed = main(["simulate", str(data), *drawn]) or main(mapped)
    if failed:
        print(told.getvalue(), end="", flush=True)
        return None
    figures = json.loads((made / "metrics.json").read_text(encoding="utf-8"))["survey"]
    shutil.rmtree(place)
    return figures


def _holds(figures: Mapping) -> bool:
    signs = figures["signs"]
    recall, precision = signs["recall"], signs["precision"]
    nothing = not signs["observable"]
    return nothing or (recall >= _RECALL and precision is not None and precision >= _PRECISION)


def _line(number: int, drawn: Sequence[str], figures: Mapping | None) -> str:
    of = {name: drawn[drawn.index(f"--{name}") + 1] for name in ("world", "camera", "width")}
    of["rate"] = drawn[drawn.index("--frame-rate-hz") + 1]
    begin = f"{number:>4} {of['world']:<8} {of['camera']:<8}{of['width']:>4} {of['rate']:>2} Hz"
    if figures is None:
        return f"{begin} no map"
    signs, known = figures["signs"], figures["uncertainty"] or {}
    relative = (signs["relative"] or {}).get("total", {}).get("mean")
    return (
        f"{begin} {signs['observable']:>5} {_share(signs['recall']):>6} {_share(signs['precision']):>5}"
        f" {'-' if relative is None else f'{relative:.3f} m':>8} {_share(known.get('coverage')):>6}"
    )


def _share(share: float | None) -> str:
    return "-" if share is None else f"{100 * share:.0f} %"
