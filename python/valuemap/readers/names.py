"""Finding images by the names that other files give them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Sequence
from pathlib import PurePosixPath


def match_images(names: Collection[str], known: Sequence[str]) -> dict[str, int]:
    """Return the index in `known` of each of `names` that can be told for sure; the others are left out.

    The exact name counts first. Else the base name (without folders), if no other name and no other known
    image has it: `cam1/7.jpg` must not become `cam0/7.jpg` only because `cam1` is not among the known.
    """
    distinct = set(names)
    exact = {name: row for row, name in enumerate(known)}
    known_bases = Counter(map(_base, known))
    bases = Counter(map(_base, distinct))
    by_base = {_base(name): row for row, name in enumerate(known)}
    found = {}
    for name in distinct:
        base = _base(name)
        if name in exact:
            found[name] = exact[name]
        elif bases[base] == known_bases[base] == 1:
            found[name] = by_base[base]
    return found


def _base(name: str) -> str:
    return PurePosixPath(name).name
