"""What has to hold after a run on a destroyed data set, whatever was destroyed."""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from crowdmap_torch.soak.child import RESIDENT_BYTES, SECONDS, Outcome

EXIT_CODES = (0, 1, 2, 3)
SAID = re.compile(
    r"(crowdmap optimize: |set aside |looks wrong: |resumed: |warning: )\S"
    r"|(single journeys|clusters|bundle adjustment|covariances|errors and report)"
)
"""How a line on stderr begins."""
FARTHEST_M = 1e6


def problems(data: Path, run: Path, outcome: Outcome, before: str) -> list[str]:
    """What is broken of what has to hold; `before` is the data set's `digest` before the run."""
    found = [*_of_outcome(outcome)]
    if digest(data) != before:
        found.append("the data set was changed")
    if stray := sorted(p.name for p in (run.parent / "cwd").iterdir()):
        found.append(f"written beside RUN: {stray[:5]}")
    if outcome.code == 0:
        found += _of_map(run)
        found += _of_journeys(data, run, outcome)
    return found


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


def _of_outcome(outcome: Outcome) -> Iterator[str]:
    if outcome.code not in EXIT_CODES:
        yield f"exit code {outcome.code}"
    if outcome.seconds > SECONDS:
        yield f"took {outcome.seconds:.0f} s"
    if outcome.resident_bytes > RESIDENT_BYTES:
        yield f"took {outcome.resident_bytes / 2**20:.0f} MB"
    if "Traceback" in outcome.err or "Traceback" in outcome.out:
        yield f"a traceback: {outcome.err.strip().splitlines()[-1][:200]}"
    else:
        for line in re.split(r"[\r\n]+", outcome.err):
            if line.strip() and not SAID.match(line.strip()):
                yield f"an unknown line on stderr: {line.strip()[:200]!r}"
                break
    errors = [x for x in outcome.err.splitlines() if x.startswith("crowdmap optimize: ")]
    if outcome.code and len(errors) != 1:
        yield f"exit code {outcome.code} with {len(errors)} lines of reason"


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
