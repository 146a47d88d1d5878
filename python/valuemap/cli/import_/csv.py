"""`valuemap import csv`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from valuemap.cli.import_.app import check_out, finish_import, import_app
from valuemap.cli.import_.options import Anchor, CameraHeight, CameraText, Columns, PixelCenter, with_detections
from valuemap.cli.options import AsJson, DatasetOut, Force, MaxRejected, Up, Vertical
from valuemap.cli.show import progress_bars, show_notes
from valuemap.geodesy import accuracy_note
from valuemap.readers.csv_file import parse_columns
from valuemap.readers.detections import DetectionFile
from valuemap.readers.poses import Axes, RotationName
from valuemap.readers.vet import MAX_REJECTED


@import_app.command("csv")
@with_detections
def import_csv(
    poses: Annotated[Path, typer.Argument(help="CSV: image; lat,lon or x,y; heading_deg or a quaternion; ...")],
    out: DatasetOut,
    detections: DetectionFile | None,
    camera: CameraText = None,
    columns: Columns = None,
    rotation: Annotated[RotationName, typer.Option(help="What a quaternion does.")] = "cam_from_world",
    axes: Annotated[Axes, typer.Option(help="Of the camera that a quaternion is about.")] = "right-down-forward",
    pixel_center: PixelCenter = 0.5,
    camera_height: CameraHeight = 0.0,
    crs: Annotated[str | None, typer.Option(help="Reference system of x, y: EPSG:32610.")] = None,
    vertical: Vertical = None,
    up: Up = None,
    anchor: Anchor = None,
    max_rejected: MaxRejected = MAX_REJECTED,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Import a table of images with poses or headings, on the Earth, in a map projection or in a frame of its own."""
    from valuemap.readers import READERS

    check_out(out, force=force)
    notes: list[str] = []
    with progress_bars() as progress:
        found = READERS["csv"].in_portions(
            poses,
            detections=detections,
            camera=camera,
            columns=parse_columns(columns or []),
            rotation=rotation,
            axes=axes,
            pixel_center=pixel_center,
            camera_height_m=camera_height,
            crs=crs,
            vertical=vertical,
            up=up,
            anchor=anchor,
            max_rejected=max_rejected,
            progress=progress,
            tell=notes.append,
        )
    note = None if crs is None else accuracy_note(crs)
    finish_import(found, out, force=force, as_json=as_json)
    show_notes(notes if note is None else [*notes, note])
