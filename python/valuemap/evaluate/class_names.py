"""Classes of truth and map that have no counterpart: a name that is spelt otherwise makes every object missed."""

from __future__ import annotations

import re

from valuemap.evaluate.truth import TrueObjects
from valuemap.tables import Categories, Labels


def note_classes(labels: Labels, objects: TrueObjects) -> tuple[str, ...]:
    """Return which classes of the truth the map does not have, with the one that is likely meant, as notes."""
    if objects.class_name is None or not len(labels):
        return ()
    in_map, in_truth = _used(labels.class_name), _used(objects.class_name)
    notes = []
    for name in sorted(in_truth - in_map):
        alike = sorted(other for other in in_map - in_truth if _plain(other) == _plain(name))
        if alike:
            notes.append(
                f"the truth has the class {name!r} and the map {alike[0]!r}: these are two classes, never matched"
            )
    if not in_map & in_truth and not notes:
        notes.append(
            f"no class of the truth ({_listed(in_truth)}) is in the map ({_listed(in_map)}): nothing can be matched"
        )
    return tuple(notes)


def _used(column: Categories) -> set[str]:
    return {column.names[code] for code in set(column.codes.tolist())}


def _plain(name: str) -> str:
    """Return a name without what people write in different ways."""
    return re.sub(r"[\W_]+", "", name.casefold()).removesuffix("s")


def _listed(names: set[str]) -> str:
    return ", ".join(map(repr, sorted(names)[:5])) + (", ..." if len(names) > 5 else "")
