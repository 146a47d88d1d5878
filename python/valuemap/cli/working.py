"""The folder of a run that is going on, for commands: what stays in it when the run is interrupted."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from valuemap.cli.app import on_interrupt
from valuemap.cli.signals import Terminated
from valuemap.tiles.work import has_parts, open_work, remove_work


@contextmanager
def working(given: Path | None, out: Path, *, resume: bool) -> Iterator[Path]:
    """Yield a folder for unfinished parts, which is removed when all is done, or where there is nothing to go on from.

    The folder is that which the user names, else it is beside `out`.
    """
    out = out.absolute()
    path = (given or out.with_name(f"{out.name}.work")).absolute()
    with open_work(path, resume=resume) as folder:
        try:
            yield folder
        except (KeyboardInterrupt, Terminated):
            if not has_parts(folder):
                raise
            with on_interrupt(f"no map was written, what was done is in {path}", "go on with --resume"):
                raise
        else:
            remove_work(folder)
        finally:
            if not has_parts(folder):
                remove_work(folder)
