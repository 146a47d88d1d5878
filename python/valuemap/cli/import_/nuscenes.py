"""`valuemap import nuscenes`."""

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


@import_app.command("nuscenes")
@with_detections
def import_nuscenes(
    tables: Annotated[Path, typer.Argument(help="Folder of the JSON tables, such as v1.0-trainval.")],
    out: DatasetOut,
    detections: DetectionFile | None,
    location: Annotated[str | None, typer.Option(help="Which map, where there are several: boston-seaport.")] = None,
    sweeps: Annotated[bool, typer.Option("--sweeps", help="The images between key frames too.")] = False,
    up: Up = None,
    anchor: Anchor = None,
    max_rejected: MaxRejected = MAX_REJECTED,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Import nuScenes: the cameras of all scenes of one map, each image with its own ego pose."""
    from valuemap.readers import READERS

    check_out(out, force=force)
    with progress_bars() as progress:
        found = READERS["nuscenes"].in_portions(
            tables,
            detections=detections,
            location=location,
            sweeps=sweeps,
            up=up,
            anchor=anchor,
            max_rejected=max_rejected,
            progress=progress,
        )
    finish_import(found, out, force=force, as_json=as_json)
