"""`valuemap import opendronemap`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from valuemap.cli.import_.app import check_out, finish_import, import_app
from valuemap.cli.import_.options import Anchor, with_detections
from valuemap.cli.options import AsJson, DatasetOut, Force, MaxRejected
from valuemap.cli.show import progress_bars, show_notes
from valuemap.readers.detections import DetectionFile
from valuemap.readers.vet import MAX_REJECTED


@import_app.command("opendronemap")
@with_detections
def import_opendronemap(
    project: Annotated[Path, typer.Argument(help="odm_report/shots.geojson, or the folder of the project.")],
    out: DatasetOut,
    detections: DetectionFile | None,
    anchor: Anchor = None,
    max_rejected: MaxRejected = MAX_REJECTED,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Import OpenDroneMap's shots.geojson, with the lenses of cameras.json."""
    from valuemap.readers import READERS

    check_out(out, force=force)
    notes: list[str] = []
    with progress_bars() as progress:
        found = READERS["opendronemap"].in_portions(
            project,
            detections=detections,
            anchor=anchor,
            max_rejected=max_rejected,
            progress=progress,
            tell=notes.append,
        )
    finish_import(found, out, force=force, as_json=as_json)
    show_notes(notes)
