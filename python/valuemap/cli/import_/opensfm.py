"""`valuemap import opensfm`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from valuemap.cli.import_.app import check_out, finish_import, import_app
from valuemap.cli.import_.options import Anchor, with_detections
from valuemap.cli.options import AsJson, DatasetOut, Force, MaxRejected, Up
from valuemap.cli.show import progress_bars, show_notes
from valuemap.readers.detections import DetectionFile
from valuemap.readers.vet import MAX_REJECTED


@import_app.command("opensfm")
@with_detections
def import_opensfm(
    reconstruction: Annotated[Path, typer.Argument(help="reconstruction.json, or the folder with it.")],
    out: DatasetOut,
    detections: DetectionFile | None,
    up: Up = None,
    anchor: Anchor = None,
    max_rejected: MaxRejected = MAX_REJECTED,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Import an OpenSfM reconstruction, georeferenced where it says where it is."""
    from valuemap.readers import READERS

    check_out(out, force=force)
    notes: list[str] = []
    with progress_bars() as progress:
        found = READERS["opensfm"].in_portions(
            reconstruction,
            detections=detections,
            up=up,
            anchor=anchor,
            max_rejected=max_rejected,
            progress=progress,
            tell=notes.append,
        )
    finish_import(found, out, force=force, as_json=as_json)
    show_notes(notes)
