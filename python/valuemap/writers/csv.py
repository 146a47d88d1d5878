"""CSV: the labels as a plain table, numbers with all their digits."""

from __future__ import annotations

from pathlib import Path

from valuemap.writers.attributes import Export

_FORMULA = ("=", "+", "-", "@", "\t", " =", " +", " -", " @")
"""A text that begins with one of these is a formula to a spreadsheet, which may do what it says."""


def write_csv(export: Export, path: Path) -> None:
    """Write all attributes; an unknown value is an empty field.

    A text that a spreadsheet would take for a formula gets an apostrophe before it, as OWASP advises.
    """
    table = export.attributes.copy()
    texts = [str(column) for column in table.columns if table[column].dtype == "string"]
    for name in texts:
        table[name] = table[name].str.replace(r"[\r\n]+", " ", regex=True)  # A row is a line.
        is_formula = table[name].str.startswith(_FORMULA).fillna(value=False).astype(bool)
        table[name] = table[name].mask(is_formula, "'" + table[name])
    table.to_csv(path, index=False, lineterminator="\n")
