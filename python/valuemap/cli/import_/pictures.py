"""`valuemap import pictures`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from valuemap.cli.import_.app import check_out, finish_import, import_app
from valuemap.cli.import_.options import Anchor, CameraText, with_detections
from valuemap.cli.options import AsJson, DatasetOut, Force, MaxRejected, Vertical
from valuemap.cli.show import progress_bars, show_notes
from valuemap.readers.detections import DetectionFile
from valuemap.readers.vet import MAX_REJECTED


@import_app.command("pictures")
@with_detections
def import_pictures(
    folder: Annotated[Path, typer.Argument(help="Pictures with GPS positions in their EXIF tags.")],
    out: DatasetOut,
    detections: DetectionFile | None,
    poses: Annotated[
        Literal["auto", "sfm", "exif"], typer.Option(help="exif takes headings as they are; auto: exif for panoramas.")
    ] = "auto",
    workspace: Annotated[
        Path | None, typer.Option(help="Where structure from motion keeps its work, to go on; default: OUT.sfm.")
    ] = None,
    camera: CameraText = None,
    gps_sigma: Annotated[float, typer.Option(help="Metres, of GPS positions that do not say theirs.")] = 3.0,
    threads: Annotated[int, typer.Option(min=0, max=1024, help="Of structure from motion, 0 for one per core.")] = 0,
    vertical: Vertical = None,
    anchor: Anchor = None,
    max_rejected: MaxRejected = MAX_REJECTED,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Import pictures without poses: from EXIF, and by structure from motion; started again, it goes on."""
    from valuemap.readers import READERS

    check_out(out, force=force)
    notes: list[str] = []
    with progress_bars() as progress:
        found = READERS["pictures"].in_portions(
            folder,
            workspace=workspace or out.with_name(f"{out.name}.sfm"),
            poses=poses,
            camera=camera,
            gps_sigma_m=gps_sigma,
            detections=detections,
            vertical=vertical,
            anchor=anchor,
            threads=threads,
            max_rejected=max_rejected,
            progress=progress,
            tell=notes.append,
        )
    finish_import(found, out, force=force, as_json=as_json)
    show_notes(notes)
