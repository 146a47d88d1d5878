"""What an interrupted run had found, so that the next one goes on behind it.

A first line says what the run is of; then there is one JSON line a picture, in the order of the pictures. Python
writes numbers so that they read back without a change: nobody can see in the result that a run was interrupted.
"""

from __future__ import annotations

import errno
import json
import os
import stat
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from valuemap.detect.boxes import Boxes
from valuemap.detect.letterbox import Size
from valuemap.errors import OutputError
from valuemap.system import OWN_FILE


@dataclass(frozen=True, eq=False)
class Outcome:
    """What became of one picture: boxes in its stored pixels, or why there are none; turned by its EXIF data or not.

    `stored` is its width and height as stored. A picture without structure is of one colour or noise: there is nothing
    in it, and the network did not see it.
    """

    boxes: Boxes
    stored: Size = (0, 0)
    problem: str | None = None
    was_turned: bool = False
    has_structure: bool = True

    def to_json(self) -> dict[str, Any]:
        """Return the object that `from_json` reads back without a change."""
        table = np.column_stack([self.boxes.center_px, self.boxes.size_px, self.boxes.score, self.boxes.class_code])
        return {
            "boxes": table.tolist(),
            "stored": list(self.stored),
            "problem": self.problem,
            "was_turned": self.was_turned,
            "has_structure": self.has_structure,
        }

    @staticmethod
    def from_json(entry: dict[str, Any]) -> Outcome:
        """Return the outcome that was written."""
        table = np.array(entry["boxes"], dtype=np.float64).reshape(-1, 6)
        boxes = Boxes(table[:, :2], table[:, 2:4], table[:, 4], table[:, 5].astype(np.int64))
        width, height = entry["stored"]
        return Outcome(boxes, (width, height), entry["problem"], entry["was_turned"], entry["has_structure"])


class Journal:
    """The file of a run of `run`; it begins anew where that is another run than the file tells of.

    Pictures go through the network in groups, so only whole groups of an older run count: `done` pictures.

    Raises
    ------
    OutputError
        What has its name is a link, or no file, or a file that no journal is.
    OSError
        The file cannot be written.
    """

    def __init__(self, path: Path, run: dict[str, Any], group: int) -> None:
        self.path = path
        self.done = 0
        head = json.dumps(run, sort_keys=True).encode() + b"\n"
        self._file = _open_own(path)
        first, end = self._file.readline(), len(head)
        if first == head:
            self.done, end = _whole_groups(self._file, end, group)
        elif first and not _is_head(first):
            self._file.close()
            raise _foreign(path)
        self._file.seek(end if self.done else 0)
        self._file.truncate()
        if not self.done:
            self._file.write(head)

    def write(self, outcomes: Iterable[Outcome]) -> None:
        """Append the outcomes of one group."""
        self._file.writelines(json.dumps(outcome.to_json()).encode() + b"\n" for outcome in outcomes)
        self._file.flush()

    def read(self) -> Iterator[Outcome]:
        """Yield all outcomes, those of the older run first."""
        with self.path.open("rb") as file:
            file.readline()
            for line in file:
                yield Outcome.from_json(json.loads(line))

    def close(self) -> None:
        """Close the file and leave it for the next run."""
        self._file.close()

    def remove(self) -> None:
        """Remove the file: the run is complete."""
        self.close()
        with suppress(OSError):
            self.path.unlink()


def _open_own(path: Path) -> BinaryIO:
    """Open a file for reading and writing, or make it; a link is not followed, and a pipe is not waited for."""
    flags = os.O_RDWR | os.O_CREAT | OWN_FILE
    try:
        descriptor = os.open(path, flags, 0o666)
    except OSError as error:
        if error.errno in (errno.ELOOP, errno.EISDIR, errno.ENXIO):
            raise _foreign(path) from error
        raise
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise _foreign(path)
    return os.fdopen(descriptor, "r+b")


def _is_head(line: bytes) -> bool:
    try:
        return "model_sha256" in json.loads(line)
    except (ValueError, TypeError, RecursionError):
        return False


def _foreign(path: Path) -> OutputError:
    return OutputError(
        f"{path}: is not ours to replace: it is no journal of an interrupted run",
        hint="remove it, or use another --out",
    )


def _whole_groups(file: Iterable[bytes], end: int, group: int) -> tuple[int, int]:
    """Return how many pictures of whole groups follow in the file, and where they end; `end` is where they begin."""
    done, end_of_line = 0, end
    for count, line in enumerate(file, start=1):
        try:
            Outcome.from_json(json.loads(line))
        except (ValueError, KeyError, TypeError):
            break
        end_of_line += len(line)
        if count % group == 0 and line.endswith(b"\n"):
            done, end = count, end_of_line
    return done, end
