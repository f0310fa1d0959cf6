"""Mutations of Parquet files: values, types, columns, rows, and what the file is made of."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

NASTY = (
    *(np.nan, np.inf, -np.inf, 0.0, -0.0, -1.0, 1.0, 0.5, 1e-300, 5e-324, 1e-9, 1e9),
    *(1e18, -1e18, 1e155, 1e300, -1.7e308, 2.0**31, 2.0**53),
)
"""Numbers that somebody divides by, squares or takes the root of."""
WHOLE = (-1, 0, 1, 7, 255, 2**31 - 1, 2**31, 2**53, 2**61, 2**62, 2**63 - 1, -(2**63))
TEXTS = (
    *("", " ", "\n", "\u202eabc", "💥", "e\u0301", "x" * 300, "x" * 100_000, "../../etc/passwd"),
    *("<script>alert(1)</script>", "NaN", "'; DROP TABLE signs; --", "US:R1-1\nset aside"),
)
TYPES = (
    *(pa.float64(), pa.float32(), pa.float16(), pa.int64(), pa.int32(), pa.int8(), pa.uint64()),
    *(pa.string(), pa.large_string(), pa.binary(), pa.bool_(), pa.null(), pa.timestamp("ns")),
    *(pa.list_(pa.float64()), pa.list_(pa.int64()), pa.large_list(pa.float32()), pa.date32()),
    *(pa.list_(pa.list_(pa.float64())), pa.struct([("a", pa.float64())]), pa.decimal128(20, 3)),
)


def mutate_table(path: Path, rng: np.random.Generator) -> str:
    """Changes one Parquet file; what was done."""
    table = pq.read_table(path)
    if not table.num_columns:
        return "nothing: the file has no columns"
    name = _MUTATIONS[rng.integers(len(_MUTATIONS))]
    changed, done = name(table, rng)
    options: dict[str, Any] = {}
    if rng.random() < 0.1:
        options["row_group_size"] = int(rng.integers(1, 4))
    if rng.random() < 0.1:
        options["compression"] = str(rng.choice(["none", "gzip", "zstd", "brotli"]))
    pq.write_table(changed, path, **options)
    return f"{name.__name__.strip('_')}: {done}{f', {options}' if options else ''}"


def _column(table: pa.Table, rng: np.random.Generator) -> tuple[int, str]:
    at = int(rng.integers(table.num_columns))
    return at, table.column_names[at]


def _with(table: pa.Table, at: int, values: pa.Array | pa.ChunkedArray) -> pa.Table:
    return table.set_column(at, table.column_names[at], values)


def _rows(count: int, rng: np.random.Generator) -> np.ndarray:
    """Which rows are meant: one, some or all."""
    share = rng.choice([0.0, 0.3, 1.0])
    chosen = rng.random(count) < share
    if count:
        chosen[rng.integers(count)] = True
    return chosen


def _nasty_value(like: Any, rng: np.random.Generator) -> Any:
    """Something of about the same kind as a value, or not."""
    if rng.random() < 0.1:
        return None
    if isinstance(like, list):
        return _nasty_list(like, rng)
    if isinstance(like, str) or like is None:
        return str(TEXTS[rng.integers(len(TEXTS))])
    if isinstance(like, bool):
        return not like
    if isinstance(like, int):
        return int(WHOLE[rng.integers(len(WHOLE))])
    return float(NASTY[rng.integers(len(NASTY))])


def _nasty_list(like: list, rng: np.random.Generator) -> list:
    way = rng.integers(6)
    if way == 0:
        return []
    if way == 1:
        return like[:1]
    if way == 2:
        return like + like
    if way == 3:
        return like[::-1]
    if way == 4:
        return like * int(rng.integers(2, 2000))
    return [_nasty_value(item, rng) if rng.random() < 0.5 else item for item in like]


def _values(table: pa.Table, rng: np.random.Generator) -> tuple[pa.Table, str]:
    at, name = _column(table, rng)
    values, chosen = table.column(at).to_pylist(), _rows(len(table), rng)
    one = _nasty_value(values[0] if values else None, rng)
    same = rng.random() < 0.5
    new = [
        (one if same else _nasty_value(old, rng)) if bad else old
        for old, bad in zip(values, chosen, strict=True)
    ]
    try:
        column = pa.array(new, table.schema.field(at).type)
    except (pa.ArrowException, OverflowError, TypeError, ValueError):
        try:
            column = pa.array(new)
        except (pa.ArrowException, OverflowError, TypeError, ValueError):
            return table, f"nothing: {name} does not hold such values"
    shown = repr(one)[:40] if same else "various"
    return _with(table, at, column), f"{int(chosen.sum())} of {name} to {shown}"


def _scaled(table: pa.Table, rng: np.random.Generator) -> tuple[pa.Table, str]:
    at, name = _column(table, rng)
    kind = table.schema.field(at).type
    factor = float(rng.choice([-1, 0, 1e-9, 1e-3, 0.5, 1.01, 2, 57.3, 1e3, 1e6, 1e12]))
    offset = float(rng.choice([0, 0, 1, -100, 1e4, 1e6, 1e9]))
    if pa.types.is_list(kind) and pa.types.is_floating(kind.value_type):
        new = [
            None if row is None else [factor * x + offset for x in row]
            for row in table.column(at).to_pylist()
        ]
        return _with(table, at, pa.array(new, kind)), f"{name} times {factor:g} plus {offset:g}"
    if not (pa.types.is_floating(kind) or pa.types.is_integer(kind)):
        return _values(table, rng)
    with np.errstate(all="ignore"):
        old = table.column(at).to_numpy()
        new = (old.astype(float) * factor + offset).astype(old.dtype)
    return _with(table, at, pa.array(new)), f"{name} times {factor:g} plus {offset:g}"


def _noise(table: pa.Table, rng: np.random.Generator) -> tuple[pa.Table, str]:
    floats = [k for k, f in enumerate(table.schema) if pa.types.is_floating(f.type)]
    if not floats:
        return _values(table, rng)
    at = int(rng.choice(floats))
    sigma = float(rng.choice([1e-12, 0.01, 1.0, 30.0, 1e3, 1e5]))
    old = np.nan_to_num(table.column(at).to_numpy().astype(float))
    way = rng.integers(3)
    if way == 0:
        new, done = old + sigma * rng.standard_normal(len(old)), f"noise of {sigma:g}"
    elif way == 1:
        new, done = np.full_like(old, old[0] if len(old) else 0), "frozen"
    else:
        new = old + sigma * (np.arange(len(old)) >= rng.integers(len(old) + 1))
        done = f"a jump of {sigma:g}"
    return _with(table, at, pa.array(new)), f"{done} on {table.column_names[at]}"


def _dropped(table: pa.Table, rng: np.random.Generator) -> tuple[pa.Table, str]:
    at, name = _column(table, rng)
    return table.remove_column(at), name


def _renamed(table: pa.Table, rng: np.random.Generator) -> tuple[pa.Table, str]:
    names = list(table.column_names)
    at, name = _column(table, rng)
    choices = (*names, name.upper(), name + " ", "", "frame", "💥")
    names[at] = str(rng.choice(np.array(choices, dtype=object)))
    return table.rename_columns(names), f"{name} to {names[at]!r}"


def _twice(table: pa.Table, rng: np.random.Generator) -> tuple[pa.Table, str]:
    at, name = _column(table, rng)
    return table.append_column(name, table.column(at)), name


def _swapped(table: pa.Table, rng: np.random.Generator) -> tuple[pa.Table, str]:
    (a, first), (b, second) = _column(table, rng), _column(table, rng)
    one, other = table.column(a), table.column(b)
    return _with(_with(table, a, other), b, one), f"{first} and {second}"


def _cast(table: pa.Table, rng: np.random.Generator) -> tuple[pa.Table, str]:
    at, name = _column(table, rng)
    kind = TYPES[rng.integers(len(TYPES))]
    try:
        column = table.column(at).cast(kind)
    except (pa.ArrowException, ValueError):
        column = pa.nulls(len(table), kind)
    return _with(table, at, column), f"{name} to {kind}"


def _coded(table: pa.Table, rng: np.random.Generator) -> tuple[pa.Table, str]:
    at, name = _column(table, rng)
    try:
        return _with(table, at, table.column(at).dictionary_encode()), name
    except (pa.ArrowException, ValueError):
        return table, f"nothing: {name} has no codes"


def _ordered(table: pa.Table, rng: np.random.Generator) -> tuple[pa.Table, str]:
    n = len(table)
    way = str(rng.choice(["shuffled", "reversed", "doubled", "halved", "none", "one", "swapped"]))
    order = {
        "shuffled": rng.permutation(n),
        "reversed": np.arange(n)[::-1],
        "doubled": np.repeat(np.arange(n), int(rng.choice([2, 2, 2, 40]))),
        "halved": np.flatnonzero(rng.random(n) < 0.5),
        "none": np.arange(0),
        "one": np.arange(min(n, 1)),
        "swapped": np.arange(n),
    }[way]
    if way == "swapped" and n > 1:
        a, b = rng.integers(n, size=2)
        order[[a, b]] = order[[b, a]]
    return table.take(pa.array(order.astype(np.int64))), way


def _column_order(table: pa.Table, rng: np.random.Generator) -> tuple[pa.Table, str]:
    """The values of one column in another order than those beside it."""
    at, name = _column(table, rng)
    order = pa.array(rng.permutation(len(table)))
    return _with(table, at, table.column(at).take(order)), name


_MUTATIONS = (
    *(_values, _values, _values, _values, _scaled, _scaled, _noise, _noise),
    *(_dropped, _renamed, _twice, _swapped, _cast, _coded, _ordered, _ordered, _column_order),
)
