"""YAML of users: no aliases, with which a few lines can stand for more than memory holds."""

from __future__ import annotations

import re
from typing import Any

import numpy as np

_MAX_DEPTH = 200
_MAYBE_ALIAS = re.compile(rb"(^|[\s\[{,:-])\*\S", re.MULTILINE)


def load_yaml(content: bytes) -> Any:
    """Return what a YAML document holds.

    Raises
    ------
    ValueError
        It is no YAML, is nested too deeply, or has an alias; the message is one line.
    """
    import yaml  # Slow to import, and few commands need it.

    if _depth(content) > _MAX_DEPTH:  # It takes time by the square of the depth.
        raise ValueError(f"it is nested more than {_MAX_DEPTH} deep")
    # The loader in C is ten times as fast; wheels for some machines come without it. Both are safe.
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    try:
        # It may be part of a text: looking closely takes its time.
        events = yaml.parse(content, Loader=loader) if _MAYBE_ALIAS.search(content) else ()
        alias = next((event.anchor for event in events if isinstance(event, yaml.AliasEvent)), None)
        found = yaml.load(content, Loader=loader) if alias is None else None
    except (yaml.YAMLError, RecursionError) as error:
        raise ValueError(" ".join(str(error).split())) from error
    if alias is not None:
        raise ValueError(f"it has an alias, *{alias}, which is not read: write the value out")
    return found


def _depth(content: bytes) -> int:
    """Return how many brackets are open at most, those in texts among them."""
    letters = np.frombuffer(content, np.uint8)
    opens, closes = np.isin(letters, list(b"[{")), np.isin(letters, list(b"]}"))
    return int(np.cumsum(opens.astype(np.int64) - closes).max(initial=0))
