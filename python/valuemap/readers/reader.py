"""What makes a function that finds out what a format holds a reader."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Generic, ParamSpec

from valuemap.dataset import Dataset
from valuemap.readers.assemble import Imported
from valuemap.readers.options import check_options

P = ParamSpec("P")


class Reader(Generic[P]):
    """Reads somebody else's files: called, it returns all as a dataset; `in_portions` keeps detections in files.

    Paths may be given as texts.
    """

    def __init__(self, read: Callable[P, Imported]) -> None:
        self._read = read
        self._signature = inspect.signature(read)
        names = self._signature.parameters
        self._paths = {name for name, parameter in names.items() if "Path" in str(parameter.annotation)}
        functools.update_wrapper(self, read)

    def __call__(self, *arguments: P.args, **options: P.kwargs) -> Dataset:
        """Return the dataset; the parameters are those of the function."""
        return self.in_portions(*arguments, **options).whole()

    def in_portions(self, *arguments: P.args, **options: P.kwargs) -> Imported:
        """Return the dataset, whose detections may be more than memory holds."""
        given = self._signature.bind(*arguments, **options)
        for name in self._paths & given.arguments.keys():
            if isinstance(given.arguments[name], str):
                given.arguments[name] = Path(given.arguments[name])
        check_options(given.arguments)
        return self._read(*given.args, **given.kwargs)
