"""Tables written as Parquet, in groups of rows that do not depend on how the rows come."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import fields
from pathlib import Path
from typing import Self, TypeVar

import pyarrow as pa
import pyarrow.parquet as pq

from valuemap.tables.table import Table, join_tables, table_to_arrow

T = TypeVar("T", bound=Table)

ROWS_OF_GROUP = 2**20
"""Rows of a table that are one group in a file: a reader of a part of it reads whole groups."""

_ENCODINGS = {
    pa.int64(): "DELTA_BINARY_PACKED",
    pa.int32(): "DELTA_BINARY_PACKED",
    pa.float64(): "BYTE_STREAM_SPLIT",
    pa.float32(): "BYTE_STREAM_SPLIT",
}
"""Ids mostly ascend, and of numbers side by side the first bytes are alike."""


def write_table(table: Table, path: Path) -> None:
    """Write a table as Parquet; the same table gives the same bytes."""
    with TableWriter(path) as writer:
        writer.write(table)


class TableWriter:
    """Writes a table as Parquet, parts of it one after the other; the first says which columns there are."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def __enter__(self) -> Self:
        self._writer: pq.ParquetWriter | None = None
        self._file = self._path.open("wb")  # Arrow takes no path that is not UTF-8.
        return self

    def write(self, table: Table) -> None:
        """Write the next rows."""
        rows = table_to_arrow(table)
        if self._writer is None:
            # A large city is 9 % smaller than with zstd, written in 57 % and read in 54 % of the time. Dictionaries of
            # all columns made its votes 10 % larger, and took twice as long to write.
            texts = [n for f in fields(table) if f.metadata["kind"] == "category" for n in f.metadata["names"]]
            encodings = {column.name: _ENCODINGS[column.type] for column in rows.schema if column.type in _ENCODINGS}
            self._writer = pq.ParquetWriter(
                self._file, rows.schema, compression="snappy", use_dictionary=texts, column_encoding=encodings
            )
        self._writer.write_table(rows, row_group_size=ROWS_OF_GROUP)

    def __exit__(self, *_: object) -> None:
        with self._file:
            if self._writer is not None:
                self._writer.close()


def in_groups(tables: Iterable[T]) -> Iterator[T]:
    """Yield tables of one kind as others of as many rows as a group in a file has, the last of fewer, in their order.

    So a file is the same however its rows come.
    """
    held: list[T] = []
    count = 0
    for table in tables:
        while count + len(table) > ROWS_OF_GROUP:
            missing = ROWS_OF_GROUP - count
            group = join_tables([*held, table[:missing]])
            held, count, table = [], 0, table[missing:]
            yield group
            del group  # Before the next one is put together.
        held.append(table)
        count += len(table)
    if held:
        yield join_tables(held)
