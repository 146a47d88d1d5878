"""The one tree of exceptions that users may meet.

Everything a user can cause (bad files, impossible settings, places that cannot be written) is a
`ValuemapError`. It says in one line what is wrong, and in `hint` what to do about it. Anything else
that escapes is a bug in valuemap.
"""

from __future__ import annotations


class ValuemapError(Exception):
    """Base of everything valuemap raises on purpose.

    Parameters
    ----------
    message
        One line: what is wrong and where (file, row), what was expected, what was found.
    hint
        One line: what the user can do about it.
    """

    def __init__(self, message: str, *, hint: str) -> None:
        super().__init__(_on_one_line(message))
        self.hint = _on_one_line(hint)


def _on_one_line(text: str) -> str:
    """Return a text with what is not printed written out, line breaks too: names may hold anything."""
    if text.isprintable():
        return text
    return "".join(letter if letter.isprintable() else repr(letter)[1:-1] for letter in text)


class InputError(ValuemapError):
    """A file or table that cannot be used as it is."""


class SettingError(ValuemapError):
    """A setting that does not exist or has an impossible value."""


class OutputError(ValuemapError):
    """A place that cannot be written to."""


class ClusterError(ValuemapError):
    """A cluster that cannot be reached, or cannot do what is asked of it."""


def check_kind(
    name: str,
    value: object,
    kinds: type | tuple[type, ...],
    expected: str,
    *,
    hint: str,
    error: type[InputError | SettingError] = InputError,
) -> None:
    """Refuse what a function was called with if it is of none of the kinds that it takes, which `expected` words.

    Functions that are called from Python ask this where they begin; what they then do relies on it.
    """
    if not isinstance(value, kinds):
        raise error(f"{name}: expected {expected}, found {type(value).__name__}", hint=hint)
