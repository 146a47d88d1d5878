"""Where the parts of a run that is going on are, for commands: what stays there when the run is interrupted."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from valuemap.cli.app import on_interrupt
from valuemap.cli.show import log
from valuemap.cli.signals import Terminated
from valuemap.remote import Place, UrlPath, folder_of, place_of
from valuemap.tiles.work import has_parts, open_store, open_work, remove_work


@dataclass(frozen=True)
class Workplace:
    """A folder for what only this process needs, and where the rest is if that is not there, too."""

    folder: Path
    store: UrlPath | None = None


@contextmanager
def working(given: str | None, out: Path, *, resume: bool) -> Iterator[Workplace]:
    """Yield a place for unfinished parts, which is removed when all is done, or where there is nothing to go on from.

    It is that which the user names, a folder or a URL, else a folder beside `out`.
    """
    out = out.absolute()
    place = folder_of(place_of(given)) if given else out.parent / f"{out.name}.work"
    if isinstance(place, UrlPath):
        with (
            open_store(place, resume=resume, tell=log.print) as store,
            tempfile.TemporaryDirectory(prefix="valuemap-") as folder,
            _removed_at_the_end(store),
        ):
            yield Workplace(Path(folder), store)
    else:
        with open_work(place, resume=resume, tell=log.print) as folder_of_work, _removed_at_the_end(folder_of_work):
            yield Workplace(folder_of_work)


@contextmanager
def _removed_at_the_end(place: Place) -> Iterator[None]:
    try:
        yield
    except (KeyboardInterrupt, Terminated):
        if not has_parts(place):
            raise
        with on_interrupt(f"no map was written, what was done is in {place}", "go on with --resume"):
            raise
    else:
        remove_work(place)
    finally:
        if not has_parts(place):
            remove_work(place)
