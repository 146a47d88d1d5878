"""`valuemap import kitti360`."""

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


@import_app.command("kitti360")
@with_detections
def import_kitti360(
    root: Annotated[Path, typer.Argument(help="Folder with calibration/ and data_poses/.")],
    sequence: Annotated[str, typer.Option(help="Such as 2013_05_28_drive_0000_sync.")],
    out: DatasetOut,
    detections: DetectionFile | None,
    cameras: Annotated[list[int] | None, typer.Option("--camera", help="0 to 3; repeatable; default: 0.")] = None,
    up: Up = None,
    anchor: Anchor = None,
    max_rejected: MaxRejected = MAX_REJECTED,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Import a sequence of KITTI-360: perspective cameras 0 and 1, fisheyes 2 and 3."""
    from valuemap.readers import READERS

    check_out(out, force=force)
    with progress_bars() as progress:
        found = READERS["kitti360"].in_portions(
            root,
            detections=detections,
            sequence=sequence,
            cameras=tuple(cameras or (0,)),
            up=up,
            anchor=anchor,
            max_rejected=max_rejected,
            progress=progress,
        )
    finish_import(found, out, force=force, as_json=as_json)
