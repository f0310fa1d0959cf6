"""Columns of a Parquet file, checked as they are taken: types, nulls, NaN.

Complaints name the file, the row and the column.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from jaxtyping import Bool, Float, Int

from crowdmap_torch.io.budget import FREE_BYTES, budget_now, file_size
from crowdmap_torch.io.errors import Code, InputError, one_line
from crowdmap_torch.io.faults import Fault, FaultsGathered, gathered

MAX_PLACE_M = 1e6
"""Nothing that is mapped is further from the origin, in any direction: the plane has left the earth there [m]."""


@dataclass(frozen=True)
class Lists:
    """A column of lists, one after the other."""

    values: Float[np.ndarray, " p *point"]
    count: Int[np.ndarray, " n"]
    """How many values each row has."""

    @property
    def start(self) -> Int[np.ndarray, " n"]:
        """Where each row begins in `values`."""
        return np.cumsum(self.count) - self.count

    @property
    def row(self) -> Int[np.ndarray, " p"]:
        """The row each value belongs to."""
        return np.repeat(np.arange(len(self.count)), self.count)

    def where(self, kept: Bool[np.ndarray, " p"]) -> Lists:
        """The same rows with some of their values."""
        count = np.bincount(self.row[kept], minlength=len(self.count))
        return Lists(self.values[kept], count)


class Sheet:
    """A Parquet file; only the columns asked for are read, others may be there."""

    def __init__(self, path: Path, required: Sequence[str], optional: Sequence[str] = ()) -> None:
        self.path = path
        self._table, missing = read_columns(path, required, optional)
        self._wrong: dict[str, Bool[np.ndarray, " n"]] = {}
        for name, rule in missing.items():
            self._keep(rule, "missing-column", np.zeros(0, dtype=np.int64), name)
            self._wrong[name] = np.ones(len(self), dtype=bool)

    def __len__(self) -> int:
        return self._table.num_rows

    def __contains__(self, name: str) -> bool:
        return name in self._table.column_names

    def fault(self, rule: str, row: int | None = None, code: Code = "other") -> InputError:
        """The error that says in which row of which file a rule is broken."""
        return InputError(f"{self.path}: {'' if row is None else f'row {row}: '}{rule}", code)

    def refuse(
        self,
        is_bad: Bool[np.ndarray, " n"],
        rule: Callable[[int], str],
        *columns: str,
        code: Code = "other",
    ) -> None:
        """Raises for the first bad row; `rule` words what is wrong with a row.

        Where faults are gathered all bad rows are kept instead, but for those in which one of `columns` is wrong
        already (any column, if none is named).
        """
        if gathered() is not None:
            known = [self._wrong[name] for name in columns or self._wrong if name in self._wrong]
            is_bad = is_bad & ~np.logical_or.reduce(known) if known else is_bad
        if not is_bad.any():
            return
        rows = np.flatnonzero(is_bad)
        self._keep(rule(int(rows[0])), code, rows, *(columns if len(columns) == 1 else ()))
        for name in columns:
            self._wrong[name] = self._wrong.get(name, False) | is_bad

    def leave_out(self, reason: str, code: Code, rows: Int[np.ndarray, " k"]) -> None:
        """Notes rows, where faults are gathered, that have a fault of their own and are not used."""
        faults = gathered()
        if faults is not None and len(rows):
            named = tuple(np.unique(rows).tolist())
            faults.append(Fault(self.path, reason, code, named, drops=True))

    def require_sound(self) -> None:
        """Where faults are gathered, ends the reading of a file that has some: what follows rests on its values."""
        if any(f.path == self.path and not f.drops for f in gathered() or ()):
            raise FaultsGathered(f"{self.path}: has faults")

    def _keep(self, rule: str, code: Code, rows: Int[np.ndarray, " k"], column: str = "") -> None:
        """Raises a fault, or gathers it."""
        faults = gathered()
        if faults is None:
            raise self.fault(rule, int(rows[0]) if len(rows) else None, code)
        faults.append(Fault(self.path, rule, code, tuple(rows.tolist()), column=column))

    def integers(self, name: str, *, null: int | None = None) -> Int[np.ndarray, " n"]:
        """Whole numbers; where `null` is given, a null or missing column holds it instead."""
        column = self._column(
            name, lambda t: t in (pa.int32(), pa.int64()), "int64", nullable=null is not None
        )
        if column is None:
            return np.full(len(self), null, dtype=np.int64)
        values = column.cast(pa.int64())
        # A copy: arrow's own memory is read-only.
        return np.array((values if null is None else values.fill_null(null)).to_numpy())

    def numbers(
        self, name: str, *, optional: bool = False, single: bool = False
    ) -> Float[np.ndarray, " n"]:
        """Finite numbers, NaN for unknown where `optional`. `single`: float32 will do."""
        allowed = (pa.float64(), pa.float32()) if single else (pa.float64(),)
        expected = "float" if single else "float64"
        column = self._column(name, lambda t: t in allowed, expected, nullable=optional)
        if column is None:
            return np.full(len(self), np.nan)
        values = column.cast(pa.float64())
        known = values.is_valid().to_numpy(zero_copy_only=False)
        numbers = np.array(values.fill_null(np.nan).to_numpy())
        self.refuse(
            known & ~np.isfinite(numbers),
            lambda row: f"column {name!r}: expected a finite number, found {numbers[row]}",
            name,
            code="not-finite",
        )
        return numbers

    def flags(self, name: str) -> Bool[np.ndarray, " n"]:
        """Whether each row is marked; a null and a missing column say that none is."""
        column = self._column(name, pa.types.is_boolean, "bool", nullable=True)
        if column is None:
            return np.zeros(len(self), dtype=bool)
        return np.array(column.fill_null(False).to_numpy(zero_copy_only=False))

    def strings(self, name: str, *, optional: bool = False) -> pa.StringArray:
        """Texts; where `optional`, nulls stand for unknown, and so does a missing column."""
        column = self._column(name, _is_text, "string", nullable=optional)
        if column is None:
            return pa.nulls(len(self), pa.string())
        self._refuse_long(name, column)
        try:
            texts = column.cast(pa.string())
            texts.validate(full=True)
        except pa.ArrowInvalid as error:
            rule = f"column {name!r}: expected UTF-8 ({one_line(error)})"
            raise self.fault(rule, code="unreadable") from error
        return texts

    def codes(
        self, name: str, names: Sequence[str], *, optional: bool = False
    ) -> Int[np.ndarray, " n"]:
        """The place of each text in `names`, -1 for null; a text that is not there is refused."""
        texts = self.strings(name, optional=optional)
        place = {known: code for code, known in enumerate(names)}
        encoded = texts.dictionary_encode()
        # The last entry is for null, whose index below is -1.
        found = [*(place.get(text, -2) for text in encoded.dictionary.to_pylist()), -1]
        codes = np.array(found)[encoded.indices.fill_null(-1).to_numpy()]
        self.refuse(
            codes == -2,
            lambda row: (
                f"column {name!r}: {texts[row].as_py()!r} is unknown; expected one of "
                + ", ".join(names)
            ),
            name,
            code="unknown-name",
        )
        return codes

    def ids(self, name: str) -> tuple[str, ...]:
        """Texts none of which is empty or stands in two rows."""
        names = self.strings(name).to_pylist()
        is_empty = np.array([text == "" for text in names], dtype=bool)
        rule = f"column {name!r}: expected a name, found ''"
        self.refuse(is_empty, lambda _: rule, name, code="null")
        first: dict[str, int] = {}
        earlier = np.array([first.setdefault(text, k) for k, text in enumerate(names)], dtype=int)
        self.refuse(
            (earlier != np.arange(len(names))) & ~is_empty,
            lambda row: (
                f"column {name!r}: {names[row]!r} stands in row {earlier[row]} too; "
                "expected each name once"
            ),
            name,
            code="name-twice",
        )
        return tuple(names)

    def number_lists(self, name: str, count: int | None = None, *, optional: bool = False) -> Lists:
        """Lists of finite numbers, `count` in each row if that is given; where `optional`, a row may have none."""
        column = self._column(name, _is_number_list, "list<double>", nullable=optional)
        if column is None:
            return Lists(np.zeros(0), np.zeros(len(self), dtype=np.int64))
        size = _lengths(column)
        row = np.repeat(np.arange(len(self)), size)
        lists = Lists(self._values(name, column.flatten(), row), size)
        if count is None:
            return lists
        self.refuse(
            column.is_valid().to_numpy(zero_copy_only=False) & (size != count),
            lambda row: f"column {name!r}: expected {count} numbers, found {size[row]}",
            name,
            code="point-count",
        )
        return lists.where(size[row] == count)

    def points(self, name: str, *, optional: bool = False) -> Lists:
        """A point of three numbers in each row; where `optional`, `count` is 0 for none."""
        lists = self.number_lists(name, 3, optional=optional)
        points = Lists(lists.values.reshape(-1, 3), lists.count // 3)
        self._refuse_far(name, points)
        return points

    def point_lists(self, name: str, *, optional: bool = False) -> Lists:
        """Lists of points of three numbers; where `optional`, a row may have none (`count` 0)."""
        column = self._column(name, _is_point_list, "list<list<double>>", nullable=optional)
        if column is None:
            return Lists(np.zeros((0, 3)), np.zeros(len(self), dtype=np.int64))
        count = _lengths(column)
        row = np.repeat(np.arange(len(self)), count)
        inner = column.flatten()
        is_null = inner.is_null().to_numpy(zero_copy_only=False)
        rule = f"column {name!r}: a point is null; expected 3 numbers"
        self.refuse(self._any(row[is_null]), lambda _: rule, name, code="null")
        if pa.types.is_null(inner.type):
            return Lists(np.zeros((0, 3)), np.zeros_like(count))
        size = np.where(is_null, 0, _lengths(inner))
        is_off = ~is_null & (size != 3)
        first = {int(row[at]): size[at] for at in np.flatnonzero(is_off)[::-1]}
        self.refuse(
            self._any(row[is_off]),
            lambda row: f"column {name!r}: a point has {first[row]} numbers; expected 3",
            name,
            code="point-count",
        )
        values = self._values(name, inner.flatten(), np.repeat(row, size))
        whole = Lists(np.zeros((len(row), 3)), count).where(size == 3)
        points = Lists(values[np.repeat(size == 3, size)].reshape(-1, 3), whole.count)
        self._refuse_far(name, points)
        return points

    def _refuse_far(self, name: str, points: Lists) -> None:
        """Refuses points that are not near the origin, as nothing in these files is."""
        far = np.abs(points.values).max(axis=-1, initial=0.0) > MAX_PLACE_M
        row = points.row

        def rule(bad: int) -> str:
            at = int((far & (row == bad)).argmax())
            place = ", ".join(f"{x:.7g}" for x in points.values[at])
            return (
                f"column {name!r}: ({place}) is over {MAX_PLACE_M / 1000:,.0f} km from the origin; "
                "expected metres east, north and up of it"
            )

        self.refuse(self._any(row[far]), rule, name, code="far-away")

    def _any(self, rows: Int[np.ndarray, " k"]) -> Bool[np.ndarray, " n"]:
        """Which rows of the sheet are among these."""
        return np.bincount(rows, minlength=len(self)).astype(bool)

    def _refuse_long(self, name: str, column: pa.Array) -> None:
        """Refuses texts that repeat until they fill the memory."""
        if not pa.types.is_dictionary(column.type):
            return
        count = np.bincount(column.indices.drop_null().to_numpy(), minlength=len(column.dictionary))
        length = pc.call_function("binary_length", [column.dictionary]).fill_null(0).to_numpy()
        most = min(budget_now().decoded_bytes, 2**31 - 1)
        if (found := int(count.astype(np.int64) @ length.astype(np.int64))) > most:
            rule = f"column {name!r}: {found} bytes of text; expected {most} at most"
            raise self.fault(rule, code="too-large")

    def _values(
        self, name: str, flat: pa.Array, row: Int[np.ndarray, " p"]
    ) -> Float[np.ndarray, " p"]:
        values = np.array(flat.cast(pa.float64()).fill_null(np.nan).to_numpy())
        bad = ~np.isfinite(values)
        if bad.any():
            first = int(bad.argmax())
            found = values[first] if flat[first].is_valid else "null"
            rule = f"column {name!r}: expected finite numbers, found {found}"
            self.refuse(self._any(row[bad]), lambda _: rule, name, code="not-finite")
        return values

    def _column(
        self, name: str, fits: Callable[[pa.DataType], bool], expected: str, nullable: bool = False
    ) -> pa.Array | None:
        """The column as one array of a type that fits; None if unknown throughout and `nullable`."""
        if name not in self:
            return self._stand_in(expected) if name in self._wrong else None
        column = self._table.column(name).combine_chunks()
        if pa.types.is_null(column.type) and (nullable or len(column) == 0):
            # Nobody can tell the type of a column without a value; it is what was expected.
            return None if nullable else pa.array([], _EMPTY[expected])
        if not fits(column.type):
            is_coded = pa.types.is_dictionary(column.type)
            found = column.type.value_type if is_coded else column.type
            rule = f"column {name!r} has type {found}; expected {expected}"
            self._keep(rule, "column-type", np.zeros(0, dtype=np.int64), name)
            self._wrong[name] = np.ones(len(self), dtype=bool)
            return self._stand_in(expected)
        if not nullable and column.null_count:
            is_null = column.is_null().to_numpy(zero_copy_only=False)
            rule = f"column {name!r} is null; expected a value in every row"
            self.refuse(is_null, lambda _: rule, name, code="null")
            values = column.to_pylist()
            filled = [_STAND_INS[expected] if value is None else value for value in values]
            return pa.array(filled, column.type)
        return column

    def _stand_in(self, expected: str) -> pa.Array:
        """Values in place of a column that is not there, so that the others are looked at."""
        return pa.array([_STAND_INS[expected]] * len(self), _EMPTY[expected])


_STAND_INS: dict[str, object] = {
    "int64": 0,
    "float64": 0.0,
    "float": 0.0,
    "bool": False,
    "string": "",
    "list<double>": [],
    "list<list<double>>": [],
}
"""What stands for a value that is wrong, while faults are gathered."""


_EMPTY = {
    "bool": pa.bool_(),
    "int64": pa.int64(),
    "float64": pa.float64(),
    "float": pa.float64(),
    "string": pa.string(),
    "list<double>": pa.list_(pa.float64()),
    "list<list<double>>": pa.list_(pa.list_(pa.float64())),
}


def read_columns(
    path: Path, required: Sequence[str], optional: Sequence[str]
) -> tuple[pa.Table, dict[str, str]]:
    """What a file has of the columns; and what is to be said of each that is missing, where faults are gathered."""
    try:
        size = file_size(path, budget_now().table_bytes)
    except InputError as error:
        rule = f"{error}; expected a Parquet file (with no rows if need be)"
        raise InputError(rule, error.code) from error
    try:
        with pq.ParquetFile(path) as file:
            names = file.schema_arrow.names
            wanted = [name for name in (*required, *optional) if name in names]
            missing = _missing(path, names, required, wanted)
            _weigh(path, size, file.metadata, wanted)
            texts = [name for name in wanted if _is_text(file.schema_arrow.field(name).type)]
        # Texts stay what they are in the file, numbers of a list: a long one in every row would fill the memory.
        with pq.ParquetFile(path, read_dictionary=texts) as file:
            return file.read(columns=wanted), missing
    except (pa.ArrowException, OSError, *_ARROW_TRIPS) as error:
        if isinstance(error, InputError):
            raise
        rule = f"{path}: cannot be read as Parquet ({one_line(error)})"
        raise InputError(rule, "unreadable") from error


_ARROW_TRIPS = (ValueError, TypeError, KeyError, OverflowError, MemoryError)
"""What pyarrow raises beside its own exceptions where a file's schema makes no sense."""


def _weigh(path: Path, size: int, footer: pq.FileMetaData, wanted: Sequence[str]) -> None:
    """Refuses a file whose footer claims more than the budget, or what a file of its size cannot hold."""
    budget = budget_now()
    groups = [footer.row_group(k) for k in range(footer.num_row_groups)]
    rows = [group.num_rows for group in groups]
    chunks = [group.column(k) for group in groups for k in range(group.num_columns)]
    chunks = [chunk for chunk in chunks if chunk.path_in_schema.split(".")[0] in wanted]
    # A number takes eight bytes, whether it is one or a text's place in a list of texts.
    decoded = sum(max(8 * c.num_values, c.total_uncompressed_size) for c in chunks)
    stored = [chunk.total_compressed_size for chunk in chunks]
    least = (*rows, *stored, *(c.num_values for c in chunks), 0)
    if sum(rows) != footer.num_rows or min(least) < 0 or sum(stored) > size:
        rule = f"{path}: cannot be read as Parquet (its footer contradicts itself)"
        raise InputError(rule, "unreadable")
    if footer.num_rows > budget.rows:
        rule = f"{path}: claims {footer.num_rows} rows; expected {budget.rows} at most"
        raise InputError(rule, "too-large")
    most = min(budget.decoded_bytes, FREE_BYTES + budget.expansion * size)
    if decoded > most:
        rule = f"{path}: {size} bytes claim to hold {decoded} bytes of numbers; expected {most} at most"
        raise InputError(rule, "too-large")


def _missing(
    path: Path, names: Sequence[str], required: Sequence[str], wanted: Sequence[str]
) -> dict[str, str]:
    """What is to be said of each column that is missing; InputError with the first, unless faults are gathered."""
    missing = {
        name: f"column {name!r} is missing; expected {', '.join(required)}, "
        f"found {', '.join(names) or 'no columns'}"
        for name in required
        if name not in names
    }
    if missing and gathered() is None:
        raise InputError(f"{path}: {next(iter(missing.values()))}", "missing-column")
    for name in wanted:
        if names.count(name) > 1:
            rule = f"{path}: column {name!r} is there twice; expected it once"
            raise InputError(rule, "name-twice")
    return missing


def _is_text(kind: pa.DataType) -> bool:
    if pa.types.is_dictionary(kind):
        kind = kind.value_type
    return pa.types.is_string(kind) or pa.types.is_large_string(kind)


def _is_list(kind: pa.DataType) -> bool:
    return (
        pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind)
    )


def _is_number_list(kind: pa.DataType) -> bool:
    # A column of empty lists has no type inside.
    return _is_list(kind) and kind.value_type in (pa.float32(), pa.float64(), pa.null())


def _is_point_list(kind: pa.DataType) -> bool:
    return _is_list(kind) and (_is_number_list(kind.value_type) or kind.value_type == pa.null())


def _lengths(column: pa.Array) -> Int[np.ndarray, " n"]:
    return column.value_lengths().fill_null(0).to_numpy().astype(np.int64)
