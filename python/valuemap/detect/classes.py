"""Which of a model's classes are wanted, and what they are called in the results."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from valuemap.arrays import Bools, Ints
from valuemap.errors import SettingError


@dataclass(frozen=True)
class WantedClasses:
    """Classes by their number in the model.

    `wanted` (N) ascending, None for all of them; `names` of the known ones.
    """

    wanted: tuple[int, ...] | None
    names: Mapping[int, str]
    _first_of_name: Mapping[str, int] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        first: dict[str, int] = {}
        for number in sorted(self.names):
            first.setdefault(self.names[number], number)
        object.__setattr__(self, "_first_of_name", first)

    def columns(self, count: int) -> Ints:
        """Return the numbers of the wanted ones among `count` classes."""
        if self.wanted is None:
            return np.arange(count)
        if self.wanted[-1] >= count:
            raise SettingError(
                f"--classes: there is no class {self.wanted[-1]}, the model has {count}", hint="numbers start at 0"
            )
        return np.array(self.wanted, dtype=np.int64)

    def are_wanted(self, numbers: Ints) -> Bools:
        """Return which of the classes (N) are wanted."""
        if self.wanted is None:
            return np.ones(len(numbers), np.bool_)
        return np.isin(numbers, self.wanted)

    def one_a_name(self, numbers: Ints) -> Ints:
        """Return numbers (N) in which classes of one name are one class."""
        found, inverse = np.unique(numbers, return_inverse=True)
        merged = [self._first_of_name.get(self.name_of(int(number)), int(number)) for number in found]
        return np.array(merged, dtype=np.int64)[inverse]

    def name_of(self, number: int) -> str:
        """Return the name of a class."""
        return self.names.get(number, f"class-{number}")


def choose_classes(wanted: str, known: Sequence[str]) -> WantedClasses:
    """Read what `--classes` says: names or numbers, each perhaps with a new name, as in "traffic light=light,11".

    Raises
    ------
    SettingError
        The model has no such class, or does not say what its classes are called; a class is to have two names.
    """
    names = dict(enumerate(known))
    entries = [entry.strip() for entry in wanted.split(",") if entry.strip()]
    if not entries:
        return WantedClasses(None, names)
    numbers: list[int] = []
    for entry in entries:
        text, _, new_name = (part.strip() for part in entry.partition("="))
        number = _number_of(text, known)
        called = new_name or names.get(number, "")
        if number in numbers and called != names.get(number, ""):
            raise SettingError(
                f"--classes: class {number} is given two names, {names[number]!r} and {called!r}",
                hint="give each class once",
            )
        numbers.append(number)
        if called:
            names[number] = called
    return WantedClasses(tuple(sorted(set(numbers))), names)


def _number_of(text: str, known: Sequence[str]) -> int:
    by_name = {name.casefold(): number for number, name in reversed(list(enumerate(known)))}
    if text.casefold() in by_name:
        return by_name[text.casefold()]
    if text.isdecimal():
        return int(text)
    if not known:
        raise SettingError(
            f"--classes: the model does not say which class is {text!r}", hint=f'give its number, as in "9={text}"'
        )
    near = difflib.get_close_matches(text.casefold(), by_name, n=1)
    raise SettingError(
        f"--classes: the model has no class {text!r}",
        hint=f"did you mean {known[by_name[near[0]]]!r}?" if near else f"it has {', '.join(known)}",
    )
