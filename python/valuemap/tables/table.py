"""What all tables can do, whatever columns they have."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, ClassVar, Self, TypeVar

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from valuemap.arrays import Ints
from valuemap.arrow import numbers_to_arrow
from valuemap.tables.column import column_to_arrow, cut, joined, taken

if TYPE_CHECKING:
    import pandas as pd

_SHOWN_ROWS = 10


@dataclass(frozen=True, eq=False, repr=False)
class Table:
    """Base of the tables: arrays of one length, sorted by the key column."""

    KEY: ClassVar[str | None] = None
    MAY_BE_EMPTY: ClassVar[bool] = False

    def __len__(self) -> int:
        return len(getattr(self, fields(self)[0].name))

    def __getitem__(self, rows: NDArray[Any] | Sequence[int] | Sequence[bool] | slice) -> Self:
        """Return some rows as the same type of table: by a mask, by indices, or by a slice, which copies nothing."""
        if isinstance(rows, slice):
            return type(self)(**{f.name: cut(getattr(self, f.name), rows) for f in fields(self)})
        if isinstance(rows, int | np.integer):
            raise TypeError(f"a table has no single rows: take [{rows}:{rows + 1}] of it")
        chosen = np.asarray(rows)
        if chosen.dtype == np.bool_ and len(chosen) != len(self):
            raise IndexError(f"a mask of {len(chosen)} rows for a table of {len(self)}")
        return self.take(chosen if len(chosen) else np.empty(0, np.int64))

    def __dir__(self) -> list[str]:
        return [name for name in super().__dir__() if not name.isupper()]  # Constants are for `read_table`.

    def __repr__(self) -> str:
        columns = [name for f in fields(self) if getattr(self, f.name) is not None for name in f.metadata["names"]]
        return f"{type(self).__name__}({len(self):,} rows: {', '.join(columns)})"

    def _repr_html_(self) -> str:
        """Show the first rows in a notebook."""
        rest = f"<p>{len(self):,} rows</p>" if len(self) > _SHOWN_ROWS else ""
        html: str = self[:_SHOWN_ROWS].to_pandas().to_html(index=False, border=0)
        return html + rest

    def to_pandas(self) -> pd.DataFrame:
        """Return the columns as on disk as a data frame of pandas."""
        frame: pd.DataFrame = table_to_arrow(self).to_pandas()
        return frame

    def take(self, rows: NDArray[Any]) -> Self:
        """Return the rows given by indices or by a mask, as the same type of table."""
        return type(self)(**{f.name: taken(getattr(self, f.name), rows) for f in fields(self)})

    def by_key(self) -> Self:
        """Return the rows in ascending order of the key."""
        key: Ints = getattr(self, str(self.KEY))
        return self if np.all(np.diff(key) > 0) else self.take(np.argsort(key, kind="stable"))

    def replace(self, **changes: Any) -> Self:
        """Return a copy with some fields replaced."""
        return dataclasses.replace(self, **changes)


T = TypeVar("T", bound=Table)


def join_tables(tables: Sequence[T]) -> T:
    """Return tables of one kind, at least one, as one, in their order; an optional column stays if all have it."""
    if len(tables) == 1:
        return tables[0]
    return type(tables[0])(**{f.name: joined([getattr(table, f.name) for table in tables]) for f in fields(tables[0])})


def table_to_arrow(table: Table) -> pa.Table:
    """Return the columns as on disk; optional fields that are None are left out."""
    columns: dict[str, pa.Array] = {}
    for f in fields(table):
        value = getattr(table, f.name)
        if value is None:
            continue
        names = f.metadata["names"]
        if f.metadata["kind"] == "float":
            for i, name in enumerate(names):
                part = value if value.ndim == 1 else value[:, i]
                columns[name] = numbers_to_arrow(np.asarray(part, np.float64), nullable=f.metadata["nullable"])
        else:
            columns[names[0]] = column_to_arrow(value, f.metadata["kind"])
    return pa.table(columns)
