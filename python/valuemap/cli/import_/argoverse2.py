"""`valuemap import argoverse2`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from valuemap.cli.import_.app import check_out, finish_import, import_app
from valuemap.cli.import_.options import Anchor, with_detections
from valuemap.cli.options import AsJson, DatasetOut, Force, MaxRejected, Up
from valuemap.cli.show import progress_bars
from valuemap.readers.detections import DetectionFile
from valuemap.readers.vet import MAX_REJECTED


@import_app.command("argoverse2")
@with_detections
def import_argoverse2(
    logs: Annotated[Path, typer.Argument(help="Folder of a log, or of logs.")],
    out: DatasetOut,
    detections: DetectionFile | None,
    city: Annotated[str | None, typer.Option(help="ATX, DTW, MIA, PAO, PIT or WDC; default: as the map says.")] = None,
    up: Up = None,
    anchor: Anchor = None,
    max_rejected: MaxRejected = MAX_REJECTED,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Import Argoverse 2 sensor logs: one log, or all logs of one city in a folder."""
    from valuemap.readers import READERS

    check_out(out, force=force)
    with progress_bars() as progress:
        found = READERS["argoverse2"].in_portions(
            logs,
            detections=detections,
            city=city,
            up=up,
            anchor=anchor,
            max_rejected=max_rejected,
            progress=progress,
        )
    finish_import(found, out, force=force, as_json=as_json)
