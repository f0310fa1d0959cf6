"""What has to hold after a command on inputs that were destroyed, whatever was destroyed."""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections import Counter
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.found_calibration import folder_name, read_calibration
from crowdmap_torch.io.rigs import read_rig
from crowdmap_torch.soak.child import RESIDENT_BYTES, SECONDS, Outcome

EXIT_CODES = (0, 1, 2, 3)
WRITTEN = (0, 3)
"""Exit codes with which something was written."""
PROGRESS = re.compile(r"single journeys|clusters|bundle adjustment|covariances|errors and report")
"""How a line on stderr begins that says how far a run is."""
SAID = re.compile(r"(set aside |looks wrong: |resuming: |warning: )\S")
"""How others begin that are no errors."""
FARTHEST_M = 1e6
PLACES = {"inputs", "run", "figures.json", "done.json", "cwd", "out.txt", "err.txt"}
"""What may stand beside the inputs once a command has ended."""


def problems_of_outcome(
    outcome: Outcome, command: str, *, codes: Collection[int] = EXIT_CODES
) -> Iterator[str]:
    """What is broken of how a subcommand of `crowdmap` ended, and of what it said."""
    if outcome.code not in codes:
        yield f"exit code {outcome.code}"
    reason = f"crowdmap {command}: "
    lines = [line.strip() for line in re.split(r"[\r\n]+", outcome.err) if line.strip()]
    if "Traceback" in outcome.err or "Traceback" in outcome.out:
        yield f"a traceback: {(lines or [''])[-1][:200]}"
    elif unknown := [x for x in lines if not (_is_known(x) or x.startswith(reason))]:
        yield f"an unknown line on stderr: {unknown[0][:200]!r}"
    begins = "looks wrong: " if outcome.code == 3 else reason
    told = sum(line.startswith(begins) for line in lines)
    expected = {0: (0, 0), 3: (1, len(lines))}
    least, most = expected.get(outcome.code, (1, 1))
    if not least <= told <= most:
        yield f"exit code {outcome.code} with {told} lines of reason"


def problems_of_limits(outcome: Outcome) -> Iterator[str]:
    """Whether a command took too long, or too much memory."""
    if outcome.seconds > SECONDS:
        yield f"took {outcome.seconds:.0f} s"
    if outcome.resident_bytes > RESIDENT_BYTES:
        yield f"took {outcome.resident_bytes / 2**20:.0f} MB"


def _is_known(line: str) -> bool:
    return bool(SAID.match(line) or PROGRESS.match(line))


def problems_of_place(place: Path, before: str) -> Iterator[str]:
    """Whether anything but outputs was written; `before` is the `digest` of the inputs before the command."""
    if digest(place / "inputs") != before:
        yield "the inputs were changed"
    stray = {p.name for p in place.iterdir()} - PLACES
    stray |= {p.name for p in (place / "cwd").iterdir()}
    if stray:
        yield f"written beside the outputs: {sorted(stray)[:5]}"


def problems_of_run(data: Path, run: Path, outcome: Outcome) -> Iterator[str]:
    """What is broken of the folder of a run that ended well."""
    yield from _of_map(run)
    yield from _of_journeys(data, run, outcome)
    yield from problems_of_calibration(run)


def problems_of_calibration(run: Path) -> Iterator[str]:
    """What of the cars that a run found cannot be begun with, or used."""
    found = run / "calibration.json"
    try:
        cars = read_calibration(found) if found.exists() else {}
        for car in cars:
            read_rig(run / "rigs" / folder_name(car))
    except InputError as error:
        yield f"what was found of cars is not to be read: {error}"


def problems_of_figures(path: Path, hd_map: Path, survey: Path) -> Iterator[str]:
    """What is broken of the figures of a map, where `crowdmap evaluate` ended well."""
    figures = json.loads(path.read_text(), parse_constant=lambda name: {"is": name})
    if wrong := [name for name, value in _numbers(figures) if not np.isfinite(value)]:
        yield f"figures: {wrong[:5]} are not finite"
    signs, control = figures["signs"], figures["control_signs"]
    counted = {"true_signs": (signs["true_signs"] + control, survey)}
    if not control:
        counted["map_signs"] = (signs["map_signs"], hd_map)
    for name, (found, folder) in counted.items():
        if found != (rows := pq.read_metadata(folder / "signs.parquet").num_rows):
            yield f"figures: {name} counts {found} of {rows}"


def digest(folder: Path) -> str:
    """A hash of names, kinds and contents of all that is in a folder; nothing but files is opened."""
    total = hashlib.sha256()
    for root, folders, files in os.walk(folder):
        folders.sort()
        for name in sorted((*folders, *files)):
            path = os.path.join(root, name)
            total.update(os.fsencode(path) + str(os.lstat(path).st_mode).encode())
            if os.path.islink(path):
                total.update(os.fsencode(os.readlink(path)))
            elif os.path.isfile(path):
                total.update(Path(path).read_bytes())
    return total.hexdigest()


def _of_map(run: Path) -> Iterator[str]:
    for name, columns in (
        ("signs", ("corners", "center", "covariance")),
        ("tentative_signs", ("corners", "center", "covariance")),
        ("lanes", ("control_points", "points", "sigma_m")),
    ):
        table = pq.read_table(run / "map" / f"{name}.parquet")
        for column in columns:
            values = _flat(table.column(column))
            if not np.isfinite(values).all():
                yield f"map/{name}: {column} is not finite"
            elif column not in ("covariance", "sigma_m") and len(values):
                if (far := float(np.abs(values).max())) > FARTHEST_M:
                    yield f"map/{name}: {column} reaches {far:.3g} m"


def _of_journeys(data: Path, run: Path, outcome: Outcome) -> Iterator[str]:
    """No journey goes without a word, and no row of one that is used."""
    metrics = json.loads((run / "metrics.json").read_text())
    aside = {one["journey_id"] for one in metrics["rejected_journeys"]}
    used = {path.name for path in (run / "journeys").iterdir()}
    entries = [p for p in (data / "journeys").iterdir() if not p.name.startswith(".")]
    there = {p.name for p in entries if p.is_dir() or p.is_symlink()}
    if len(there) != len(used | aside) or used & aside or not used <= there:
        yield f"journeys {sorted(there)}: used {sorted(used)}, set aside {sorted(aside)}"
    if silent := [name for name in aside if f"set aside {name}: " not in outcome.err]:
        yield f"nothing said of {silent}"
    rows = pq.read_table(run / "associations.parquet").select(["journey_id", "kind"]).to_pylist()
    counted = Counter((row["journey_id"], row["kind"]) for row in rows)
    for name in sorted(used & there):
        for kind in ("sign", "lane"):
            expected = pq.read_metadata(data / "journeys" / name / f"{kind}s.parquet").num_rows
            if (found := counted[name, kind]) != expected:
                yield f"{name}: {found} of {expected} {kind} rows in associations.parquet"


def _flat(column: pa.ChunkedArray) -> np.ndarray:
    while pa.types.is_list(column.type):
        column = pa.chunked_array(
            [c.flatten() for c in column.chunks] or [], column.type.value_type
        )
    return column.to_numpy()


def _numbers(content: Any, name: str = "") -> Iterator[tuple[str, float]]:
    """Every number of nested content, and those that are none, by their place."""
    if isinstance(content, dict) and set(content) == {"is"}:
        yield name, np.nan
    elif isinstance(content, dict | list):
        items = content.items() if isinstance(content, dict) else enumerate(content)
        for key, value in items:
            yield from _numbers(value, f"{name}.{key}" if name else str(key))
    elif isinstance(content, int | float):
        yield name, content
