"""`valuemap import bearings`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from valuemap.cli.import_.app import check_out, finish_import, import_app
from valuemap.cli.import_.options import Anchor, CameraHeight, ClassName, Columns
from valuemap.cli.options import AsJson, DatasetOut, Force, MaxRejected
from valuemap.cli.show import progress_bars, show_notes
from valuemap.readers.csv_file import parse_columns
from valuemap.readers.vet import MAX_REJECTED


@import_app.command("bearings")
def import_bearings(
    bearings: Annotated[Path, typer.Argument(help="CSV: lat,lon,bearing and maybe depth, class, score, pass, image.")],
    out: DatasetOut,
    columns: Columns = None,
    class_name: ClassName = "object",
    depth_sigma: Annotated[float, typer.Option(help="Standard deviation of a depth, as a fraction of it.")] = 0.3,
    camera_height: CameraHeight = 0.0,
    anchor: Anchor = None,
    max_rejected: MaxRejected = MAX_REJECTED,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Import places with bearings (degrees clockwise from north) of objects, and maybe depths."""
    from valuemap.readers import READERS

    check_out(out, force=force)
    notes: list[str] = []
    with progress_bars() as progress:
        found = READERS["bearings"].in_portions(
            bearings,
            columns=parse_columns(columns or []),
            class_name=class_name,
            depth_sigma=depth_sigma,
            camera_height_m=camera_height,
            anchor=anchor,
            max_rejected=max_rejected,
            progress=progress,
            tell=notes.append,
        )
    finish_import(found, out, force=force, as_json=as_json)
    show_notes(notes)
