"""Values out of JSON that somebody else wrote: each is checked when it is taken, and errors say where it stands."""

from __future__ import annotations

import reprlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from valuemap.arrays import Floats
from valuemap.errors import InputError

_HUGE = 1e300


@dataclass(frozen=True)
class Json:
    """A value and where it stands, such as `shots.json: shots['a.jpg']`."""

    value: Any
    where: str
    hint: str = "is it a file of this format, and whole?"

    def __getitem__(self, key: str) -> Json:
        """Return a member of an object, which must be there."""
        if key not in self.object():
            raise self.wrong(f"expected {key!r}", ", ".join(map(str, list(self.value)[:8])) or "nothing")
        return self._at(self.value[key], f": {key}")

    def get(self, key: str) -> Json | None:
        """Return a member of an object, or None where it is missing or null."""
        value = self.object().get(key)
        return None if value is None else self._at(value, f": {key}")

    def __contains__(self, key: str) -> bool:
        return self.object().get(key) is not None

    def object(self) -> dict[str, Any]:
        """Return the value, which must be an object."""
        if not isinstance(self.value, dict):
            raise self.wrong("expected an object")
        return self.value

    def items(self) -> Iterator[tuple[str, Json]]:
        """Yield keys and members of an object, in the order of the keys."""
        for key in sorted(self.object()):
            yield key, self._at(self.value[key], f"[{key!r}]")

    def entries(self) -> Iterator[Json]:
        """Yield the entries of a list."""
        if not isinstance(self.value, list):
            raise self.wrong("expected a list")
        for row, entry in enumerate(self.value):
            yield self._at(entry, f"[{row}]")

    def text(self) -> str:
        """Return a text that is not empty."""
        if not isinstance(self.value, str) or not self.value:
            raise self.wrong("expected a text")
        return self.value

    def key(self) -> str:
        """Return an id: a text, or a whole number as one."""
        if type(self.value) is int:
            return str(self.value)
        return self.text()

    def number(self) -> float:
        """Return a finite number."""
        if type(self.value) not in (int, float) or not abs(self.value) < _HUGE:
            raise self.wrong("expected a finite number")
        return float(self.value)

    def whole(self) -> int:
        """Return a whole number below 2^63."""
        value = self.value
        if type(value) is float and value.is_integer() and abs(value) < 2**53:
            value = int(value)
        if type(value) is not int or abs(value) >= 2**63:
            raise self.wrong("expected a whole number")
        return int(value)

    def numbers(self, count: int) -> Floats:
        """Return a list of so many finite numbers."""
        values = self.value if isinstance(self.value, list) else []
        if len(values) != count or not all(type(v) in (int, float) and abs(v) < _HUGE for v in values):
            raise self.wrong(f"expected a list of {count} finite numbers")
        return np.array(values, dtype=np.float64)

    def known_numbers(self, count: int) -> Floats:
        """Return a list of so many numbers, as of a pose, NaN for those that are null or not finite."""
        values = self.value if isinstance(self.value, list) else []
        if len(values) != count or not all(v is None or type(v) in (int, float) for v in values):
            raise self.wrong(f"expected a list of {count} numbers")
        return np.array([v if v is not None and abs(v) < _HUGE else np.nan for v in values], dtype=np.float64)

    def matrix(self, rows: int, columns: int) -> Floats:
        """Return a list of lists of finite numbers."""
        lists = list(self.entries())
        if len(lists) != rows:
            raise self.wrong(f"expected {rows} lists of {columns} numbers")
        return np.array([row.numbers(columns) for row in lists])

    def wrong(self, expected: str, found: str | None = None) -> InputError:
        """Return the error that says what was expected here."""
        shown = " ".join(reprlib.repr(self.value).split()) if found is None else found
        return InputError(f"{self.where}: {expected}, found {shown[:120]}", hint=self.hint)

    def _at(self, value: Any, step: str) -> Json:
        return Json(value, self.where + step, self.hint)


class Told:
    """What answers told of each image, by its id: those for places next to each other have images in common."""

    def __init__(self) -> None:
        self._hash: dict[str, int] = {}

    def again(self, key: str, *values: Any) -> bool:
        """Return whether the values, which have the same text where they are the same, were told of an image before."""
        told = hash(repr(values))
        is_again = self._hash.get(key) == told
        self._hash[key] = told
        return is_again
